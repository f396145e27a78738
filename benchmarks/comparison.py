"""Several implementations on one game: checked against each other, then measured in turns."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console

from benchmarks import measure, peer
from benchmarks.games import Game, make
from benchmarks.implementations import Implementation, Missing, disagreement, faster_linear_solver, prepare


@dataclass(frozen=True)
class Measurement:
    """One line of the JSON file: how one implementation did in one setting.

    Times are CPU time of the process on one thread of a CPU, and wall time otherwise.
    """

    setting: str
    implementation: str
    B: int
    M: int
    N: int
    K: int
    S: int
    threads: int
    forward_ms: float
    forward_backward_ms: float
    peak_mb: float | None
    peer_ratio_forward: float | None
    peer_ratio_forward_backward: float | None


def measurements(
    game: Game, names: Sequence[str], repeats: int, threads: int, console: Console, thorough: bool = True
) -> list[Measurement]:
    """Measure those implementations of a game that can run here.

    Args:
        thorough: refuse what does not agree with the reference, let the peer try all its linear solvers, and measure memory
            as well.
    """
    ready: dict[str, Implementation] = {}
    linear_solver = peer.LINEAR_SOLVERS[0]
    for name in names:
        try:
            if name == "peer" and thorough:
                linear_solver = faster_linear_solver(game)
                console.print(f"peer: {linear_solver} is the faster one here")
            implementation = prepare(name, game, linear_solver)
        except Missing as reason:
            console.print(f"{name}: left out, {reason}")
            continue
        if thorough and (trouble := disagreement(implementation)):
            raise SystemExit(f"no times of different things are compared: {trouble}")
        ready[name] = implementation
    actions: dict[tuple[str, int], Callable[[], Any]] = {}
    for name, implementation in ready.items():
        actions |= {(name, 0): implementation.forward, (name, 1): implementation.forward_backward}
    times = measure.interleaved(actions, repeats)

    def of(name: str, backward: int) -> float:
        found = times[name, backward]
        return found.cpu if threads == 1 and name != "cuda" else found.wall

    def ratio(name: str, backward: int) -> float | None:
        return of("peer", backward) / of(name, backward) if "peer" in ready else None

    return [
        Measurement(
            setting=game.setting,
            implementation=name,
            **game.sizes,
            threads=threads,
            forward_ms=of(name, 0),
            forward_backward_ms=of(name, 1),
            peak_mb=measure.in_fresh_process(_peak, game.setting, game.sizes, name, threads, linear_solver)
            if thorough
            else None,
            peer_ratio_forward=ratio(name, 0),
            peer_ratio_forward_backward=ratio(name, 1),
        )
        for name in ready
    ]


def _peak(setting: str, sizes: dict[str, int], name: str, threads: int, linear_solver: str) -> float | None:
    """Peak memory [MB] of forward and backward, in a process that has done nothing but the same for one scene."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    prepare(name, make(setting, **{**sizes, "B": 1, "M": 1}), linear_solver).forward_backward()
    implementation = prepare(name, make(setting, **sizes), linear_solver)
    if name == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        implementation.forward_backward()
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    return measure.peak_mb(implementation.forward_backward)
