"""The recursion's branches for GPUs on a CPU, whose compiler takes them with the emulated instructions of
`recursion_threads.cpp`: what many threads find is what one thread finds."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

warp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install 'epo_lightning[gpu]'")
from epo_lightning.solvers.gauss_newton.fused_kernel import constants, layout, recursion

COMPILER = shutil.which("c++")
if COMPILER is None:
    pytest.skip("there is no C++ compiler on this machine", allow_module_level=True)

SIGNATURES = {
    "begin": "void begin(Array<NUMBER> fast, int end)",
    "eliminate": "int eliminate(Array<NUMBER> work, int linear, Array<NUMBER> fast, Array<NUMBER> factors, int record, "
    "int pairs, int first, int last, int end, NUMBER dt)",
    "pull": "void pull(Array<NUMBER> work, int linear, Array<NUMBER> fast, Array<NUMBER> factors, int end, NUMBER dt)",
    "push": "void push(Array<NUMBER> work, int linear, Array<NUMBER> fast, Array<NUMBER> factors, int end, NUMBER dt, "
    "Array<NUMBER> to, int place, int own_rows, Array<int> rows, int count, int K)",
}
"""All but the slopes, which have no branch for GPUs."""
ASSEMBLY = {
    r'asm volatile\("cp\.async\.cg\.shared\.global .*" ::"r"\((.*)\), "l"\((.*)\) : "memory"\);': r"request_copy(\1, \2);",
    r'asm volatile\("cp\.async\.commit_group;" ::: "memory"\);': "commit_copies();",
    r'asm volatile\("cp\.async\.wait_group %0;" ::"n"\((.*)\) : "memory"\);': r"wait_for_copies(\1);",
    r'asm\("rsqrt\.approx\.ftz\.f32 %0, %1;" : "=f"\((.*)\) : "f"\((.*)\)\);': r"\1 = rsqrt(\2);",
}
"""Instructions of a GPU, and what emulates them."""
FORWARDS, BACKWARDS = 1, -1


@dataclass(frozen=True)
class Case:
    """What the functions are compiled for, with ``threads`` threads for a game on a GPU."""

    number: str
    agents: int
    threads: int
    horizon: int
    pairs: int

    def __str__(self) -> str:
        return f"{self.number}-{self.agents}-{self.threads}"

    @property
    def fast(self) -> layout.Fast:
        return layout.fast(self.agents, 9, self.pairs, self.horizon, self.number == "double", self.threads)

    @property
    def kept(self) -> bool:
        """Whether factors stay in fast memory."""
        return self.fast.factors >= 0

    @property
    def joined(self) -> bool:
        """Whether a warp has all columns at once, and exchanges them."""
        return 6 * self.agents < constants.WARP

    @property
    def copied(self) -> bool:
        """Whether factors are copied to shared memory while a step is computed."""
        return self.fast.shared and not self.kept


CASES = [
    Case("float", 4, constants.TEAM, 20, pairs=1),
    Case("double", 2, constants.WARP, 20, pairs=1),
    Case("float", 8, constants.TEAM, 3, pairs=1),
    Case("float", 8, constants.WARP, 6, pairs=1),
    Case("double", 8, constants.TEAM, 6, pairs=6),
]


def test_the_cases_take_all_branches():
    """Which ones a case takes depends on the places in fast memory."""
    assert {(case.kept, case.joined) for case in CASES} == {(a, b) for a in (True, False) for b in (True, False)}
    assert {case.copied for case in CASES if not case.kept} == {True, False}
    assert any(case.fast.steps < case.horizon for case in CASES), "costs of some steps at a time"


@dataclass(frozen=True)
class Result:
    """What threads found: how many of them that all pivots are positive, the step, and that for another right-hand side."""

    positive: int
    step: torch.Tensor
    other: torch.Tensor

    def is_close_to(self, expected: Result, tolerance: float) -> bool:
        """Relative to the largest number; NaN is close to nothing."""
        pairs = [(self.step, expected.step), (self.other, expected.other)]
        return all(bool(((a - b).abs() <= tolerance * b.abs().max()).all()) for a, b in pairs)


@dataclass(frozen=True)
class Program:
    case: Case
    path: Path

    def solve(self, game: list[torch.Tensor], direction: int = FORWARDS, left_out: str = "") -> tuple[Result, Result]:
        """What one thread finds, and what many find that take turns in this order."""
        numbers = b"".join(part.double().numpy().tobytes() for part in game)
        command = [str(self.path), str(direction), left_out]
        done = subprocess.run(command, input=numbers, capture_output=True, timeout=60)
        assert done.returncode == 0, done.stderr.decode()
        one, many = (torch.tensor([float(word) for word in line.split()]).double() for line in done.stdout.splitlines())
        return tuple(Result(int(found[0]), *found[1:].chunk(2)) for found in (one, many))


@pytest.fixture(scope="module", params=CASES, ids=str)
def program(request, tmp_path_factory) -> Program:
    case, folder = request.param, tmp_path_factory.mktemp("recursion")
    number = warp.float64 if case.number == "double" else warp.float32
    bodies = recursion.bodies(number, case.agents, case.fast, backwards=False)
    functions = "".join(f"{head} {{\n{bodies[name]}}}\n" for name, head in SIGNATURES.items())
    for instruction, emulation in ASSEMBLY.items():
        functions, count = re.subn(instruction, emulation, functions)
        assert count, f"no instruction is {instruction}"
    assert "asm" not in functions, "an instruction that is not emulated"
    (folder / "functions.hpp").write_text(functions)
    sizes = {
        "NUMBER": case.number,
        "AGENTS": case.agents,
        "HORIZON": case.horizon,
        "PAIRS": case.pairs,
        "BLOCK": case.threads,
        "CONTROL_ITEMS": layout.CONTROL_ITEMS,
        "FACTOR_NUMBERS": layout.factor_numbers(case.agents),
        **{f"FAST_{name.upper()}": getattr(case.fast, name) for name in ("steps", "control", "own", "rows", "numbers")},
    }
    harness, path = Path(__file__).with_name("recursion_threads.cpp"), folder / "program"
    options = ["-std=c++17", "-O1", "-pthread", f"-I{folder}", *(f"-D{name}={value}" for name, value in sizes.items())]
    subprocess.run([COMPILER, *options, str(harness), "-o", str(path)], check=True)
    return Program(case, path)


def random_game(case: Case) -> list[torch.Tensor]:
    """Derivatives by controls and by states, gradients of pair features, and another right-hand side."""
    generator, K, A = torch.Generator().manual_seed(3), case.horizon, case.agents

    def uniform(*shape: int) -> torch.Tensor:
        return 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1

    controls, own = uniform(K, layout.CONTROL_ITEMS, A), uniform(K, A, 5, 4)
    controls[:, constants.DAMPED_STIFFNESS :][:, :2] += 12
    controls[:, constants.RATE_STIFFNESS :][:, :2] += 3
    controls[:, constants.COUPLING] *= 0.1
    controls[:, constants.MOTION :] *= 0.3
    own[..., :4, :] += own[..., :4, :].mT.clone()
    own[..., :4, :] += 2 * (3 + A) * torch.eye(4)
    return [controls, own, 0.5 * uniform(case.pairs, K, A, A, 4), uniform(K, 2 * A)]


@pytest.mark.parametrize("direction", [FORWARDS, BACKWARDS])
def test_many_threads_find_what_one_finds(program, direction):
    one, many = program.solve(random_game(program.case), direction)
    assert (one.positive, many.positive) == (1, program.case.threads)
    assert many.is_close_to(one, 1e-12 if program.case.number == "double" else 1e-5)


@pytest.mark.parametrize("direction", [FORWARDS, BACKWARDS])
def test_all_threads_learn_of_a_pivot_that_is_not_positive(program, direction):
    game = random_game(program.case)
    game[0][1, constants.DAMPED_STIFFNESS] = -1e3
    one, many = program.solve(game, direction)
    assert (one.positive, many.positive) == (0, 0)


def test_without_barriers_exchange_or_copies_results_are_others(program):
    """So the branches that have them were taken, and what is missing is noticed."""
    case, game = program.case, random_game(program.case)
    for left_out, used in {"barriers": True, "exchange": case.joined, "copies": case.copied}.items():
        one, many = program.solve(game, left_out=left_out)
        assert many.is_close_to(one, 1e-3) != used, left_out
