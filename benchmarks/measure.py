"""Measurement of time and memory, and the peak rates of the machine."""

from __future__ import annotations

import argparse
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
Result = TypeVar("Result")

SHORTEST = 0.02
"""An action that takes less time than this [s] is run several times in a row; the mean counts as one measurement."""


def positive(text: str) -> int:
    """A whole number, 1 or more, from the command line.

    Raises:
        argparse.ArgumentTypeError: as said.
    """
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 1 or more")
    return int(text)


@dataclass(frozen=True)
class Times:
    """Medians over the rounds [ms].

    Attributes:
        cpu: CPU time of the process, over all its threads; other processes do not count.
        wall: elapsed time.
    """

    cpu: float
    wall: float


def interleaved(actions: Mapping[Key, Callable[[], Any]], repeats: int) -> dict[Key, Times]:
    """Median times of several actions, which take turns, so that a change of the machine's speed concerns all of them.

    Each action is run once before any is measured. An action on a GPU has to synchronise with it.
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


def cpu_milliseconds(action: Callable[[], Result], count: int) -> tuple[Result, float]:
    """The result of an action on ``count`` items, and its CPU time per item [ms], over all threads of the process."""
    start = time.process_time()
    result = action()
    return result, 1e3 * (time.process_time() - start) / count


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, instead of requesting it from the system again (glibc only).

    Otherwise an implementation with large temporary arrays spends half of its time in pages of zeros; so this favours the
    implementations that allocate most.
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
    """Peak memory [MB] of an action beyond that of the process before it; None where it is unknown.

    It is meaningful in a fresh process only, which holds no freed memory.
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
        product: rate of a product of 1024 x 1024 matrices, which no kernel exceeds.
        cholesky: rate of batched factorisations of n x n matrices.
    """

    product: float
    cholesky: float


def machine(n: int) -> Machine:
    """Measure the rates; ``n`` is the size of the matrices that are factorised."""
    matrix = torch.randn(1024, 1024)
    batch = torch.randn(32, n, n)
    batch = batch @ batch.mT + n * torch.eye(n)
    out, info = torch.empty_like(matrix), torch.empty(32, dtype=torch.int32)
    factors = torch.empty_like(batch).mT  # column-major and in place: the fastest way
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
