"""Tests of the compiled backend: the suite of all backends, its threads, its interface, and a missing library."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from backends import BackendSuite, gradients, stacked
from games import ALL, BOUNDS, leaves_of, nearest_points_held, random_game, random_scene

from epo_lightning.forecast import Status
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.gauss_newton.backends import choice, compiled, pytorch
from epo_lightning.solvers.gauss_newton.kernel import build, interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

if isinstance(interface.find(), str) and shutil.which("c++") is None:
    pytest.skip("there is no C++ compiler on this machine, so the kernel was not built", allow_module_level=True)


class TestCompiled(BackendSuite):
    solve = staticmethod(compiled.solve)


def test_the_kernel_was_built_from_these_sources():
    assert interface.library().epo_fingerprint() == build.fingerprint()


@pytest.mark.skipif("EPO_KERNEL" in os.environ, reason="a library with sanitizers has one level of instructions")
def test_all_levels_of_instructions_agree():
    scene, energy = random_scene(9, 3, history=2, size=1.5, dtype=torch.float64), FeatureEnergy(ALL, bounds=BOUNDS)
    parameters = random_game(scene, modes=3, horizon=9)
    library = interface.library()
    count = library.epo_levels()
    if library.epo_built() == 1 and platform.machine() == "x86_64":
        pytest.skip("the kernel was built for this machine only; build.py --portable builds all levels")
    results = []
    try:
        for level in range(count):
            library.epo_choose(level)
            leaves = leaves_of(parameters)
            solution = compiled.solve(energy, scene, leaves, 2, 0.3, torch.full((9, 3), 10.0))
            solution.states.square().sum().backward()
            results.append({"controls": solution.controls.detach(), **gradients(leaves)})
    finally:
        library.epo_choose(count - 1)
    assert count > 1 or platform.machine() != "x86_64", "any x86-64 of the last ten years has AVX2"
    for result in results[:-1]:
        for name, value in result.items():
            torch.testing.assert_close(value, results[-1][name], rtol=1e-10, atol=1e-10, msg=name)


def test_a_library_for_another_processor_is_refused(tmp_path):
    """Its functions would end the process with an illegal instruction."""
    source = f"""
        #include <cstdint>
        extern "C" std::int64_t epo_fingerprint() {{ return {build.fingerprint()}; }}
        extern "C" std::int64_t epo_levels() {{ return 0; }}
    """
    (tmp_path / "other.cpp").write_text(source)
    library = tmp_path / "epo_kernel.so.1"
    compiler = shutil.which("c++")
    assert compiler is not None
    subprocess.run([compiler, "-shared", "-fPIC", str(tmp_path / "other.cpp"), "-o", str(library)], check=True)
    with pytest.raises(OSError, match=r"instructions that this one lacks .--portable"):
        build.load(library)


def test_threads_change_no_bit():
    scene, energy = random_scene(23, 3, history=2, size=1.0), FeatureEnergy(ALL, bounds=BOUNDS)
    parameters = random_game(scene, modes=3, horizon=9)
    results = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        leaves = leaves_of(parameters)
        solution = compiled.solve(energy, scene, leaves, 2, 0.3, torch.full((23, 3), 10.0))
        solution.states.square().sum().backward()
        results.append((solution, gradients(leaves)))
    torch.set_num_threads(1)
    (one, by_one), (three, by_three) = results
    assert torch.equal(one.controls, three.controls)
    assert torch.equal(one.energy, three.energy)
    assert all(torch.equal(by_one[name], by_three[name]) for name in by_one)


def test_memory_goes_back_when_a_solution_is_dropped():
    """Without waiting for the garbage collector: a cycle would keep the factors of every past step."""
    released = []

    class Watched(compiled._Tape):
        def __del__(self):
            released.append(self.address)
            super().__del__()

    scene, energy = random_scene(3, 2, history=2), FeatureEnergy(["acc", "turnr"])
    original, compiled._Tape = compiled._Tape, Watched
    try:
        for keep in (False, True):
            leaves = leaves_of(random_game(scene, own=("acc", "turnr")))
            solution = compiled.solve(energy, scene, leaves, 2, 0.3, torch.full((3, 2), 10.0), keep_iterates=keep)
            del solution
    finally:
        compiled._Tape = original
    assert len(released) == 2


def test_a_reference_line_that_does_not_exist_stops_that_sample():
    scene, energy = random_scene(3, 2, history=2), FeatureEnergy(["lane", "acc", "turnr"])
    parameters = random_game(scene)
    parameters.reference[1, 0, 1] = 99
    solution = compiled.solve(energy, scene, parameters, 2, 0.3, torch.full((3, 2), 10.0))
    assert solution.status.tolist() == [[0, 0], [Status.STOPPED, 0], [0, 0]]


@pytest.mark.parametrize(
    ("energy", "agents", "dtype", "reason"),
    [
        (FeatureEnergy(["acc"], dynamics=Unicycle("heun")), 2, torch.float32, "integrates by euler, not heun"),
        (FeatureEnergy(["acc"]), 65, torch.float32, "up to 64 agents, not 65"),
        (FeatureEnergy(["acc"]), 2, torch.float16, "not torch.float16"),
    ],
)
def test_unsupported_games_are_refused_with_the_reason(energy, agents, dtype, reason):
    scene = random_scene(1, agents, history=2)
    parameters = random_game(scene, own=("acc",))
    assert compiled.obstacle(energy, scene, parameters) is None or dtype == torch.float32
    assert reason in compiled.obstacle(energy, scene, parameters.to(dtype))


def test_sixty_four_agents_are_solved():
    scene, energy = (
        random_scene(1, 64, history=2, size=0.7, dtype=torch.float64),
        FeatureEnergy(["acc", "turnr", "goal"]),
    )
    parameters = random_game(scene, modes=1, horizon=3)
    damping = torch.ones(1, 1, dtype=torch.float64)
    solution = compiled.solve(energy, scene, parameters, 200, 1.0, damping)
    assert solution.gradient_norm.item() < 1e-6
    assert (energy.terms(scene, parameters, parameters.initial_controls)["proximity"] > 0).sum() > 64


def test_the_layer_uses_the_kernel_or_warns_once(monkeypatch):
    scene, energy = random_scene(2, 2, history=2), FeatureEnergy(ALL, bounds=BOUNDS)
    parameters = random_game(scene)
    by_default = LevenbergMarquardt()(energy, scene, parameters).controls
    assert torch.equal(by_default, LevenbergMarquardt(backend="compiled")(energy, scene, parameters).controls)
    plain = LevenbergMarquardt(backend="pytorch")(energy, scene, parameters).controls
    assert not torch.equal(by_default, plain), "two ways to the same numbers differ in the last bits"
    torch.testing.assert_close(by_default, plain, rtol=0, atol=1e-4)

    monkeypatch.setattr(interface, "find", lambda: "it was not built")
    choice.say_once.cache_clear()
    with pytest.warns(
        UserWarning, match="the compiled layer is missing: it was not built.*Plain PyTorch does the same"
    ):
        assert torch.equal(LevenbergMarquardt()(energy, scene, parameters).controls, plain)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LevenbergMarquardt()(energy, scene, parameters)
    with pytest.raises(ValueError, match=r"solver\.backend is 'compiled', but the compiled layer is missing"):
        LevenbergMarquardt(backend="compiled")(energy, scene, parameters)
    with pytest.raises(RuntimeError, match="it was not built"):
        interface.library()


def test_a_kernel_built_from_other_sources_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "fingerprint", lambda: 1)
    with pytest.raises(OSError, match="built from other sources"):
        build.load()
    (tmp_path / "empty.so").write_bytes(b"")
    with pytest.raises(OSError, match=r"empty\.so"):
        build.load(tmp_path / "empty.so")


def sources_in(folder):
    """A copy of the sources and their build."""
    for path in build.HERE.iterdir():
        if path.suffix in (".py", ".hpp", ".cpp"):
            shutil.copy(path, folder)


def test_a_missing_compiler_is_named(tmp_path):
    """The installation prints a note and continues."""
    sources_in(tmp_path)
    found = subprocess.run(
        [sys.executable, tmp_path / "build.py"],
        env={"CXX": "no-such-compiler"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 1
    assert "the compiled layer was not built" in found.stderr
    assert "no-such-compiler" in found.stderr
    assert not list(tmp_path.glob("epo_kernel*"))


def test_a_scene_that_changed_before_the_backward_pass_is_noticed():
    for name in ("history", "size", "references", "reference_speed", "agent_mask"):
        scene, energy = random_scene(3, 2, history=2, size=2.0), FeatureEnergy(ALL, bounds=BOUNDS)
        solution = compiled.solve(energy, scene, leaves_of(random_game(scene)), 2, 0.3, torch.full((3, 2), 10.0))
        getattr(scene, name)[0] = getattr(scene, name)[1].clone()
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            solution.controls.sum().backward()


def test_a_step_is_as_exact_as_its_matrix_allows():
    """Error against a QR factorisation of (J, sqrt(lambda) I) in units of eps cond(H) |d|; PyTorch's system is stiffer."""
    own = ("goal", "lane", "steer", "vel", "acc", "turnacc", "turnrb", "turnaccb")
    scene, damping = random_scene(8, 2, history=2, size=0.01, dtype=torch.float64), 1e-3
    parameters = random_game(scene, horizon=5, own=own, spread=0.1)
    energy, raised = FeatureEnergy(own, bounds=BOUNDS), torch.full((8, 2), damping, dtype=torch.float64)
    for _ in range(3):
        start = parameters.initial_controls
        with nearest_points_held():
            jacobian = torch.func.jacfwd(lambda u: stacked(energy, scene, parameters, u).sum((0, 1)))(start)  # noqa: B023
        jacobian = jacobian.permute(1, 2, 0, 3, 4, 5).flatten(3)
        ridge = damping**0.5 * torch.eye(jacobian.shape[-1], dtype=torch.float64).expand(8, 2, -1, -1)
        matrix = torch.cat([jacobian, ridge], -2)
        residual = stacked(energy, scene, parameters, start)
        right = torch.nn.functional.pad(residual, (0, ridge.shape[-1]))[..., None]
        q, triangle = torch.linalg.qr(matrix)
        step = -torch.linalg.solve_triangular(triangle, q.mT @ right, upper=True).view_as(start)
        singular = torch.linalg.svdvals(matrix)
        unit = (
            torch.finfo(torch.float64).eps
            * (singular[..., 0] / singular[..., -1]).square()
            * step.abs().amax((2, 3, 4))
        )
        for solve, most in ((compiled.solve, 5.0), (pytorch.solve, 1000.0)):
            found = solve(energy, scene, parameters, 1, 1.0, raised).controls
            assert ((found - start - step).abs().amax((2, 3, 4)) / unit).max() < most
        parameters = dataclasses.replace(parameters, initial_controls=start + step)


_FORK = """
import os, sys, torch
sys.path[:0] = {path!r}
from games import random_game, random_scene
from epo_lightning import FeatureEnergy, LevenbergMarquardt
torch.set_num_threads(2)
scene = random_scene(64, 2, history=2)
solve, energy = LevenbergMarquardt(backend="compiled"), FeatureEnergy(["acc", "turnr"])
parameters = random_game(scene, own=("acc", "turnr"))
expected = solve(energy, scene, parameters).controls
child = os.fork()
if child == 0:
    os._exit(0 if torch.equal(solve(energy, scene, parameters).controls, expected) else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_has_threads_of_its_own():
    path = [str(Path(__file__).parents[3]), str(Path(__file__).parents[4])]
    subprocess.run([sys.executable, "-c", _FORK.format(path=path)], check=True, timeout=120)


_INTERRUPTS = """
import random, signal, sys, time, torch
sys.path[:0] = {path!r}
from games import BOUNDS, leaves_of, random_game, random_scene
from epo_lightning import FeatureEnergy, LevenbergMarquardt

class Interrupt(BaseException):
    pass

def handler(_, frame):
    # Only inside of gradients(): an interrupt in the lines of the loop below would end this program.
    while frame is not None:
        if frame.f_code is gradients.__code__:
            raise Interrupt
        frame = frame.f_back

torch.set_num_threads(8)
own = ("acc", "turnr", "goal")
scene, energy = random_scene(96, 3, history=2, size=2.0), FeatureEnergy(own, bounds=BOUNDS)
solve, parameters = LevenbergMarquardt(2, backend="compiled"), random_game(scene, 2, 20, own=own)

def gradients():
    leaves = leaves_of(parameters)
    solve(energy, scene, leaves).states.square().sum().backward()
    return [leaf.grad for leaf in (leaves.initial_controls, leaves.goals, *leaves.own_weights.values())]

expected = gradients()
start = time.perf_counter()
gradients()
took = time.perf_counter() - start
draw, interrupted, overwritten = random.Random(0), 0, 0
signal.signal(signal.SIGALRM, handler)
for _ in range(300):
    try:
        # The first interrupt comes at a random moment, and further ones every 0.2 ms, also during the handling of the first.
        signal.setitimer(signal.ITIMER_REAL, draw.uniform(1e-5, 1.2 * took), 2e-4)
        gradients()
    except Interrupt:
        interrupted += 1
    signal.setitimer(signal.ITIMER_REAL, 0)
    # What the call has released is allocated again: a thread that still ran would write into it.
    sentinels = [torch.full_like(one, 7.0) for one in expected for _ in range(4)]
    time.sleep(0.002)
    overwritten += any((sentinel != 7.0).any().item() for sentinel in sentinels)
    del sentinels
assert all(torch.equal(one, other) for one, other in zip(gradients(), expected))
print(interrupted, overwritten)
"""


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no interval timers on this system")
def test_interrupts_leave_no_thread_that_writes_to_released_memory():
    """The second interrupt comes while the first one is handled; results afterwards equal those before."""
    path = [str(Path(__file__).parents[3]), str(Path(__file__).parents[4])]
    program = [sys.executable, "-c", _INTERRUPTS.format(path=path)]
    found = subprocess.run(program, timeout=300, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    interrupted, overwritten = map(int, found.stdout.split())
    assert interrupted > 20
    assert overwritten == 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("WHEELBASE", 0.5, "kWheelbase is 0.5 in Python and 0.6 in the kernel"),
        ("RETRIES", 5, "kRetries is 5 in Python and 4.0 in the kernel"),
        ("OWN", ("lane", "goal", *interface.OWN[2:]), "GOAL is 1 in Python and 0.0 in the kernel; LANE is 0 in Python"),
        ("SIGNALS", interface.SIGNALS[:-1], "BOUND_TURNACC is missing in Python and 4.0 in the kernel"),
    ],
)
def test_a_constant_that_differs_from_the_kernel_is_named(monkeypatch, name, value, message):
    monkeypatch.setattr(interface, name, value)
    interface.find.cache_clear()
    with pytest.raises(RuntimeError, match=re.escape(message)):
        interface.find()
    monkeypatch.undo()
    interface.find.cache_clear()
    assert not isinstance(interface.find(), str)


def test_a_structure_that_differs_from_the_kernel_is_named(monkeypatch):
    class EpoRun(ctypes.Structure):
        _fields_ = (("extra", ctypes.c_int64), *interface.EpoRun._fields_)

    monkeypatch.setattr(interface, "EpoRun", EpoRun)
    with pytest.raises(RuntimeError, match=r"EpoRun\.damping is 24 in Python and 16\.0.*EpoRun\.extra.*sizeof EpoRun"):
        interface.find.__wrapped__()


_SHORT_OF_MEMORY = """
import resource, sys, torch
sys.path[:0] = {path!r}
from games import leaves_of, random_game, random_scene
from epo_lightning import FeatureEnergy, LevenbergMarquardt
torch.set_num_threads(1)
scene, own = random_scene(1, 64, history=2, size=50.0), ("acc", "turnr")
leaves = leaves_of(random_game(scene, 1, 40, own=own))
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 400 * 2**20,) * 2)
try:
    LevenbergMarquardt(6, backend="compiled")(FeatureEnergy(own), scene, leaves)
except MemoryError as error:
    print(error)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="limits the memory as Linux does")
def test_too_little_memory_is_an_exception():
    """Sixty-four agents that all touch leave 170 MB of factors per step."""
    path = [str(Path(__file__).parents[3]), str(Path(__file__).parents[4])]
    program = [sys.executable, "-c", _SHORT_OF_MEMORY.format(path=path)]
    found = subprocess.run(program, check=True, timeout=120, capture_output=True, text=True)
    assert "fewer scenes or modes at a time" in found.stdout


def test_headings_beyond_reduction_stop_a_sample():
    scene, energy = random_scene(3, 2, history=2), FeatureEnergy(["acc", "turnr", "goal"])
    scene.history[1, 0, -1, 2] = 3e9
    solution = compiled.solve(energy, scene, random_game(scene), 2, 0.3, torch.full((3, 2), 10.0))
    assert solution.status.tolist() == [[0, 0], [Status.STOPPED] * 2, [0, 0]]
