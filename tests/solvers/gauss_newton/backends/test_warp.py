"""The fused kernels on Warp's CPU device, and their machine code for GPUs."""

from __future__ import annotations

import dataclasses
import functools

import pytest
import torch
from backends import STATE_PAIRS, BackendSuite, HostMustNotWait, gradients
from games import ALL, BOUNDS, leaves_of, random_game, random_scene

from epo_lightning.forecast import Status
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import PAIR_FEATURES
from epo_lightning.registry import ConfigError
from epo_lightning.solvers.gauss_newton.backends import choice, pytorch, warp
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install 'epo_lightning[gpu]'")
from epo_lightning.solvers.gauss_newton.fused_kernel import ahead_of_time, kernels
from epo_lightning.solvers.gauss_newton.fused_kernel.features import Features
from epo_lightning.solvers.gauss_newton.fused_kernel.layout import fast


class TestFused(BackendSuite):
    solve = staticmethod(warp.solve)


def assert_same_as_pytorch(energy, scene, game, damping, steps=3):
    ours, theirs = leaves_of(game), leaves_of(game)
    found = warp.solve(energy, scene, ours, steps, 0.3, damping, keep_iterates=True)
    expected = pytorch.solve(energy, scene, theirs, steps, 0.3, damping, keep_iterates=True)
    for name in ("controls", "states", "initial_energy", "energy", "gradient_norm", "status"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9, msg=name)
    weigh = torch.randn_like(expected.states)
    ((found.states * weigh).sum() + found.iterates[1].square().sum()).backward()
    ((expected.states * weigh).sum() + expected.iterates[1].square().sum()).backward()
    exact, by = gradients(theirs), gradients(ours)
    for name, gradient in exact.items():
        scale = gradient.abs().max().clamp_min(1.0) if gradient.numel() else 1.0
        torch.testing.assert_close(by[name] / scale, gradient / scale, rtol=0, atol=1e-9, msg=name)
    return found


@pytest.mark.parametrize("pair", [("proximity",), *STATE_PAIRS, tuple(PAIR_FEATURES)])
@pytest.mark.parametrize("agents", [2, 3, 8])
@pytest.mark.parametrize("threads", [None, kernels.TEAM])
def test_games_of_different_lengths_are_those_of_pytorch(pair, agents, threads, monkeypatch):
    """With absent agents, fixed margins, strides and lines that slide, also with a GPU's places in fast memory."""
    if threads is not None:
        made = functools.partial(kernels.make, True, warp.size_for(agents), None, 6, threads)
        monkeypatch.setattr(warp, "kernels", lambda *_: made())
    scene = random_scene(4, agents, history=2, size=1.5, dtype=torch.float64)
    scene.size[..., 1] *= 0.4
    scene.agent_mask[1, 0] = False
    scene = dataclasses.replace(scene, game_steps=torch.tensor([6, 3, 1, 5]))
    margins = {"clearance": 0.3} if "clearance" in pair else {}
    energy = FeatureEnergy(ALL, pair, BOUNDS, pair_stride=2, margins=margins, lane_slides=True)
    game = random_game(scene, 2, 6, pair=pair)
    found = assert_same_as_pytorch(energy, scene, game, torch.full((4, 2), 10.0, dtype=torch.float64))
    assert (found.controls[2, :, :, 1:] == game.initial_controls[2, :, :, 1:]).all(), "after the end of a game"


def test_agents_with_infinite_damping_keep_their_controls_exactly():
    scene, energy = random_scene(3, 4, history=2, size=2.0, dtype=torch.float64), FeatureEnergy(ALL, bounds=BOUNDS)
    game = random_game(scene, 2, 6)
    damping = torch.where(torch.arange(4) == 1, torch.inf, 1.0 + torch.rand(3, 2, 4, dtype=torch.float64))
    found = assert_same_as_pytorch(energy, scene, game, damping)
    assert torch.equal(found.controls[:, :, 1], game.initial_controls[:, :, 1])
    assert not torch.equal(found.controls[:, :, 0], game.initial_controls[:, :, 0])


@pytest.mark.parametrize("backwards", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_threads_of_a_game_need_no_barrier_that_is_missing(backwards, monkeypatch):
    """Warp runs blocks of 32 threads on a CPU, each from barrier to barrier: results are those of one thread, bit for bit.

    Without a barrier, a thread would read what a later one has yet to write; in the opposite order, what an earlier one has.
    """
    scene = random_scene(3, 8, history=2, size=1.5, dtype=torch.float64)
    scene.agent_mask[1, :4] = False
    energy, pair = FeatureEnergy(ALL, tuple(PAIR_FEATURES), BOUNDS), tuple(PAIR_FEATURES)
    game, damping = random_game(scene, 1, 5, pair=pair), torch.full((3, 1), 10.0, dtype=torch.float64)
    results = []
    for block in (False, True):
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", block)
        monkeypatch.setattr(warp, "kernels", lambda *_, b=block: kernels.make(True, 8, backwards=backwards and b))
        leaves = leaves_of(game)
        solution = warp.solve(energy, scene, leaves, 2, 0.3, damping, keep_iterates=True)
        (solution.states.square().sum() + solution.iterates[1].square().sum()).backward()
        results.append((solution, gradients(leaves)))
    (one, by_one), (many, by_many) = results
    for name in ("controls", "states", "initial_energy", "energy", "gradient_norm", "status"):
        assert torch.equal(getattr(many, name), getattr(one, name)), name
    assert all(torch.equal(by_many[name], by_one[name]) for name in by_one)


def test_the_host_does_not_wait_for_the_device():
    """On a CPU it can only be seen that PyTorch is asked for nothing that waits; Warp's launches do not either."""
    scene, energy = random_scene(3, 3, history=2, size=2.0), FeatureEnergy(ALL, bounds=BOUNDS)
    scene = dataclasses.replace(scene, game_steps=torch.tensor([7, 2, 5]))
    leaves = leaves_of(random_game(scene))
    with HostMustNotWait():
        warp.solve(energy, scene, leaves, 2, 0.3, torch.full((3, 2), 10.0)).states.sum().backward()
    assert leaves.initial_controls.grad.isfinite().all()


def test_the_backend_warp_takes_the_steps_of_the_layer():
    scene, energy = (
        random_scene(3, 2, history=2, size=1.0, dtype=torch.float64),
        FeatureEnergy(["goal", "acc", "turnr"]),
    )
    game = random_game(scene, 2, 6)
    for adaptive in (False, True):
        found = LevenbergMarquardt(4, 1.0, 1.0, adaptive=adaptive, backend="warp")(energy, scene, game)
        expected = LevenbergMarquardt(4, 1.0, 1.0, adaptive=adaptive, backend="pytorch")(energy, scene, game)
        torch.testing.assert_close(found.controls, expected.controls, rtol=0, atol=1e-9)
    energy = FeatureEnergy(["lane", "acc", "turnr"])
    for line in (2, 99, -1):
        game.reference[1, 0, 1] = line
        solution = warp.solve(energy, scene, game, 2, 0.3, torch.full((3, 2), 10.0, dtype=torch.float64))
        assert solution.status.tolist() == [[0, 0], [Status.STOPPED, 0], [0, 0]], "a line that does not exist"


def test_games_that_the_kernels_do_not_solve_are_refused(monkeypatch):
    scene = random_scene(2, 2, history=2)
    game, energy = random_game(scene), FeatureEnergy(["acc"], dynamics=Unicycle("heun"))
    with pytest.raises(
        ValueError, match="backend is 'warp', but the fused layer integrates by euler, not heun; 'auto' and"
    ):
        choice.choose("warp", energy, scene, game)
    wide = random_scene(1, 9, history=2)
    assert "up to 8 agents, not 9" in warp.obstacle(FeatureEnergy(["acc"]), wide, random_game(wide, own=("acc",)))
    monkeypatch.setattr(warp, "LONGEST", 2 * game.initial_controls.numel() - 1)
    assert "this batch has too many: split it" in warp.obstacle(FeatureEnergy(["acc"]), scene, game)
    lines = dataclasses.replace(scene, references=scene.references.repeat(1, 1, 1, 5, 1))
    monkeypatch.setattr(warp, "LONGEST", 2 * game.initial_controls.numel())
    assert "this batch has too many: split it" in warp.obstacle(FeatureEnergy(["lane"]), lines, game)
    assert warp.obstacle(FeatureEnergy(["acc"]), lines, game) is None
    monkeypatch.undo()
    assert "not torch.float16" in warp.obstacle(FeatureEnergy(["acc"]), scene, game.to(torch.float16))
    with pytest.raises(ValueError, match=r"no Newton steps; 'compiled', 'host' .on a GPU. and 'pytorch' have them"):
        warp.solve(FeatureEnergy(["acc"]), scene, game, 1, 1.0, torch.ones(2, 2), exact=True)
    with pytest.raises(ConfigError, match=r"solver\.backend=warp has no Newton steps: set solver\.newton_steps=0"):
        LevenbergMarquardt(backend="warp", adaptive=True, newton_steps=2)
    monkeypatch.setattr(warp, "installed", lambda: False)
    with pytest.raises(ValueError, match=r"the fused layer needs NVIDIA Warp: pip install 'epo_lightning\[gpu\]'"):
        choice.choose("warp", FeatureEnergy(["acc"]), scene, game)


@pytest.mark.parametrize("architecture", [pytest.param(80, marks=pytest.mark.slow), 90])
@pytest.mark.parametrize("games", [pytest.param(warp.FEW, marks=pytest.mark.slow), warp.FEW + 1])
def test_machine_code_for_gpus_is_made_without_one(architecture, games, tmp_path):
    found = ahead_of_time.compile_for(architecture, False, 4, games, tmp_path)
    for name, resources in found.items():
        assert 32 < resources.registers <= 255, name
        assert resources.stack < 1024, "values that do not fit into registers"
        threads = kernels.TEAM if games <= warp.FEW else kernels.WARP
        needed = 4 * fast(4, 9, 1, 20, False, threads).numbers
        assert needed <= resources.shared <= needed + 2048, "all functions of a game have one array in shared memory"
        assert 10_000 < resources.code < 128 * 1024, "more code makes threads wait for instructions"
        if threads == kernels.WARP:
            assert 16 * resources.shared <= 228 * 1024, "16 games on a multiprocessor"
    with pytest.raises(ValueError, match="does not begin as an ELF file"):
        ahead_of_time.resources(b"no machine code")


def test_kernels_that_differ_in_constants_are_not_taken_for_each_other():
    """Warp finds compiled kernels by a hash of their source; features, sizes and registers are constants of it."""
    ours = {"double": False, "agents": 2, "features": Features(("goal", "acc"), ("proximity",)), "count": 32}
    others = (
        {"double": True},
        {"agents": 4},
        {"features": Features(("acc", "goal"), ("proximity",))},
        {"features": Features(("goal", "turnr"), ("proximity",))},
        {"features": Features(("goal", "acc"), ("clearance",))},
        {"features": Features(("goal", "acc"), ("clearance",), ("clearance",))},
        {"count": 128},
    )
    made = [kernels.make(**ours | change) for change in ({}, *others)]
    hashes = {bytes(each.solve.module.get_module_hash(each.threads)) for each in made}
    assert len(hashes) == len(made)


@pytest.mark.slow
def test_the_largest_games_in_double_precision_fit_into_the_memory_of_a_multiprocessor(tmp_path):
    """Their arrays are in global memory; for the sum of all functions' arrays, ptxas has 48 kB of shared memory."""
    for resources in ahead_of_time.compile_for(90, True, warp.SIZES[-1], warp.FEW, tmp_path).values():
        assert resources.shared < 4096


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize(
    ("agents", "pair"), [*((agents, tuple(PAIR_FEATURES)) for agents in (2, 3, 8)), (8, ("proximity",))]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scenes", [warp.FEW // 2, warp.FEW])
def test_a_gpu_gets_the_results_of_pytorch_on_a_cpu_also_in_a_cuda_graph(agents, pair, dtype, scenes):
    """The numbers of agents, of pair features and of games choose the kernels, and what is in shared memory."""
    scene = random_scene(scenes, agents, history=2, size=1.5, dtype=dtype)
    energy = FeatureEnergy(ALL, pair, BOUNDS)
    theirs, damping = leaves_of(random_game(scene, 2, 7, pair=pair)), torch.full((scenes, 2), 10.0, dtype=dtype)
    ours, there = leaves_of(theirs.to("cuda")), scene.to("cuda")

    dampings = {device: damping.to(device) for device in ("cpu", "cuda")}  # a graph cannot contain a copy from the CPU

    def both(solve, scene, game):
        solution = solve(energy, scene, game, 2, 0.3, dampings[game.initial_controls.device.type])
        leaves = [game.initial_controls, *game.own_weights.values(), *game.pair_weights.values()]
        return solution, torch.autograd.grad(solution.states.square().sum(), leaves)

    expected, exact = both(pytorch.solve, scene, theirs)
    tolerance = 1e-3 if dtype == torch.float32 else 1e-9

    def check(found, by):
        torch.testing.assert_close(found.controls.cpu(), expected.controls, rtol=0, atol=tolerance)
        assert torch.equal(found.status.cpu(), expected.status)
        for one, other in zip(by, exact, strict=True):
            scale = other.abs().max().clamp_min(1.0)
            torch.testing.assert_close(one.cpu() / scale, other / scale, rtol=0, atol=tolerance)

    # PyTorch remembers the stream on which a leaf was first used; a graph cannot wait for the default one.
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        for _ in range(3):
            check(*both(warp.solve, there, ours))
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=side):
        captured = both(warp.solve, there, ours)
    for _ in range(2):
        graph.replay()
        torch.cuda.synchronize()
        check(*captured)
