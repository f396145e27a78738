"""Time, memory, and what the machine could do at best."""

from __future__ import annotations

import ctypes
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

Key = TypeVar("Key", bound=Hashable)

SHORTEST = 0.02
"""What takes less time than this [s] is run several times in a row, and the mean counts as one measurement."""


@dataclass(frozen=True)
class Times:
    """Medians over the rounds [ms].

    Attributes:
        cpu: of the process, over all its threads; does not count what other processes do meanwhile.
        wall: of the clock on the wall.
    """

    cpu: float
    wall: float


def interleaved(actions: Mapping[Key, Callable[[], Any]], repeats: int) -> dict[Key, Times]:
    """Times of several actions, taken in turns, so that a machine that slows down slows all of them down.

    Each action is run once before any is measured. Actions on a GPU have to wait for it themselves.
    """
    inner = {}
    for name, action in actions.items():
        action()
        start = time.perf_counter()
        action()
        inner[name] = max(1, int(SHORTEST / (time.perf_counter() - start)))
    found: dict[Key, list[Times]] = {name: [] for name in actions}
    for _ in range(repeats):
        for name, action in actions.items():
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(inner[name]):
                action()
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            found[name].append(Times(1e3 * cpu / inner[name], 1e3 * wall / inner[name]))
    return {
        name: Times(statistics.median(t.cpu for t in times), statistics.median(t.wall for t in times))
        for name, times in found.items()
    }


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, instead of asking the system for it again and again.

    Half of the time of an implementation with large temporary arrays would otherwise go into pages of zeros: this favours
    those that allocate most. Of effect with glibc only.
    """
    if sys.platform == "linux":
        trim_threshold, top_pad, mmap_max = -1, -2, -4
        libc = ctypes.CDLL(None)
        libc.mallopt(mmap_max, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)
        libc.mallopt(top_pad, 2**28)


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a module's function in a Python process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def peak_mb(action: Callable[[], Any]) -> float | None:
    """How much memory [MB] an action needs at its peak, beyond what the process holds already; None if unknown.

    Meaningful in a fresh process, in which no freed memory lies about.
    """
    if sys.platform != "linux":
        return None
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # the high-water mark begins anew
    before = _status("VmRSS")
    action()
    return (_status("VmHWM") - before) / 1e3


def _status(name: str) -> float:
    """An entry of the process's status [kB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


@dataclass(frozen=True)
class Machine:
    """Measured rates [GFLOP/s] with the current number of threads, float32.

    Attributes:
        product: of a product of 1024 x 1024 matrices: no kernel is faster.
        cholesky: of batched factorisations of n x n matrices.
    """

    product: float
    cholesky: float


def machine(n: int) -> Machine:
    """Measure the rates; ``n`` is the size of the matrices that are factorised."""
    matrix = torch.randn(1024, 1024)
    batch = torch.randn(32, n, n)
    batch = batch @ batch.mT + n * torch.eye(n)
    out, info = torch.empty_like(matrix), torch.empty(32, dtype=torch.int32)
    factors = torch.empty_like(batch).mT  # in Fortran's order, in place: as fast as it gets
    actions = {
        "product": lambda: torch.mm(matrix, matrix, out=out),
        "cholesky": lambda: torch.linalg.cholesky_ex(factors.copy_(batch), out=(factors, info)),
    }
    times = interleaved(actions, 7)
    return Machine(
        product=2 * 1024**3 / times["product"].wall / 1e6, cholesky=32 * n**3 / 3 / times["cholesky"].wall / 1e6
    )


def operations(agents: int, horizon: int, points: int = 0) -> tuple[float, float]:
    """Floating-point operations of one solver step of one problem: forward, and its adjoint.

    The cheapest method that we know, a Riccati recursion over K steps with 6 numbers of state (position, heading, speed,
    previous controls) and 2 controls per agent, when all pairs are active: the factor of the controls' block, the gain, the
    update of the value function (half of it, it is symmetric), two substitutions, the transition (row and column
    additions), and rollout, features and closest points of lanes with ``points`` points. The adjoint substitutes once more
    with the same factors and evaluates the model three times.
    """
    states, controls, pairs = 6 * agents, 2 * agents, agents * (agents - 1) / 2
    factor = controls**3 / 3 + controls**2 * states + controls * states**2
    transition = 20 * agents * states
    substitutions = 4 * controls * states + 2 * controls**2 + 20 * agents
    model = (120 + 12 * points) * agents + 40 * pairs
    return horizon * (factor + transition + substitutions + model), horizon * (substitutions + 3 * model)
