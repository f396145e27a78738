"""Comparison of implementations on one game: they are checked against the reference, then measured in turns."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console

from benchmarks import measure, peer
from benchmarks.games import Game, make
from benchmarks.implementations import Implementation, Missing, disagreement, prepare


@dataclass(frozen=True)
class Measurement:
    """One line of the JSON file: times and memory of one implementation in one setting.

    Times are CPU times of the process for one thread of a CPU, and wall times otherwise.
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
    """Measurements of the implementations of a game that can run here.

    Args:
        thorough: check against the reference, time the peer with all its linear solvers (the fastest counts), and
            measure memory as well.

    Raises:
        SystemExit: an implementation differs from the reference.
    """
    ready: dict[str, Implementation] = {}
    for name in names:
        try:
            implementation = prepare(name, game)
        except Missing as reason:
            console.print(f"{name}: left out, {reason}")
            continue
        if thorough and (trouble := disagreement(implementation)):
            raise SystemExit(f"nothing was measured: {trouble}; times of different results cannot be compared")
        ready[name] = implementation
    candidates = dict(ready)
    if "peer" in ready and thorough:
        candidates |= {solver: prepare("peer", game, solver) for solver in peer.LINEAR_SOLVERS[1:]}
    actions: dict[tuple[str, int], Callable[[], Any]] = {}
    for name, implementation in candidates.items():
        actions |= {(name, 0): implementation.forward, (name, 1): implementation.forward_backward}
    times = measure.interleaved(actions, repeats)

    def of(name: str, backward: int) -> float:
        rivals = [solver for solver in peer.LINEAR_SOLVERS if solver in candidates] if name == "peer" else []
        found = [times[candidate, backward] for candidate in (name, *rivals)]
        return min(t.cpu if threads == 1 and name != "cuda" else t.wall for t in found)

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
            peak_mb=measure.in_fresh_process(_peak, game.setting, game.sizes, name, threads) if thorough else None,
            peer_ratio_forward=ratio(name, 0),
            peer_ratio_forward_backward=ratio(name, 1),
        )
        for name in ready
    ]


def _peak(setting: str, sizes: dict[str, int], name: str, threads: int) -> float | None:
    """Peak memory [MB] of forward and backward, in a process that has only done the same for one scene."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    prepare(name, make(setting, **{**sizes, "B": 1, "M": 1})).forward_backward()
    implementation = prepare(name, make(setting, **sizes))
    if name == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        implementation.forward_backward()
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    return measure.peak_mb(implementation.forward_backward)
