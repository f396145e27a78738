"""Comparison of the layer with its peer: ``python -m benchmarks.epo_layer``; docs/benchmarks.md explains the output."""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import devices, measure, scaling
from benchmarks.command_line import parser_of
from benchmarks.comparison import Measurement, measurements
from benchmarks.games import LANE_POINTS, SETTINGS, Game, activity, make
from benchmarks.implementations import NAMES, Missing, prepare
from epo_lightning.registry import ConfigError

GOALS = {
    ("exid", "pytorch"): (18, 28, 30),
    ("exid", "compiled"): (250, 400, 100),
    ("rpi", "pytorch"): (12, 18, 30),
    ("rpi", "compiled"): (400, 350, 100),
}
"""Goals by setting and implementation: speed-up over the peer, forward and with backward, and reduction of memory."""


def table(game: Game, found: Sequence[Measurement], machine: measure.Machine) -> Table:
    """Table of the measurements beside the peer's, our goals and the machine's floor."""
    sizes = game.sizes
    forward, adjoint = operations = measure.operations(
        sizes["N"], sizes["K"], LANE_POINTS if "lane" in game.energy.own else 0
    )
    problems = sizes["B"] * sizes["M"] * sizes["S"]
    floors = [problems * count / machine.product / 1e6 for count in (forward, sum(operations))]
    touching, steps = activity(game)
    n = 2 * sizes["N"] * sizes["K"]
    dense = problems * n**3 / 3 / machine.cholesky / 1e6
    result = Table(
        title=f"{game.setting}: {', '.join(f'{k}={v}' for k, v in sizes.items())}, {len(game.energy.own)} own features",
        caption=f"{touching:.0%} of all pairs touch, at {steps:.0%} of all steps. Floor: {forward / 1e3:.0f} kFLOP per "
        f"problem and step, {adjoint / 1e3:.0f} for the adjoint, at {machine.product:.0f} GFLOP/s: {floors[0]:.2f} and "
        f"{floors[1]:.2f} ms. One dense Cholesky factorisation per step, at {machine.cholesky:.0f} GFLOP/s: {dense:.1f} ms.",
    )
    for column in ("", "forward", "x peer", "with backward", "x peer", "peak MB", "1/x peer", "% of floor"):
        result.add_column(column, justify="right" if column else "left")
    peer = next((m for m in found if m.implementation == "peer"), None)
    for m in found:
        goals = GOALS.get((m.setting, m.implementation), (None, None, None))
        smaller = peer.peak_mb / m.peak_mb if peer and peer.peak_mb and m.peak_mb else None
        shares = [floor / ms for floor, ms in zip(floors, (m.forward_ms, m.forward_backward_ms), strict=True)]
        result.add_row(
            m.implementation,
            f"{m.forward_ms:.2f}",
            _times(m.peer_ratio_forward, goals[0]),
            f"{m.forward_backward_ms:.2f}",
            _times(m.peer_ratio_forward_backward, goals[1]),
            "?" if m.peak_mb is None else f"{m.peak_mb:.1f}",
            _times(smaller, goals[2]),
            " / ".join(f"{100 * share:.1f}" for share in shares) if m.implementation != "cuda" else "",
        )
    return result


def _times(ratio: float | None, goal: int | None) -> str:
    return ("" if ratio is None else f"{ratio:.1f}") + ("" if goal is None else f" (goal {goal})")


def latency(names: Sequence[str], repeats: int) -> dict[str, float]:
    """Wall time [ms] of one scene through the public API: N = 4, M = 5, S = 2, K = 20."""
    game = make("exid", B=1)
    ready = {}
    for name in names:
        if name in ("pytorch", "compiled", "cuda"):
            try:
                ready[name] = prepare(name, game).forward
            except Missing:
                continue
    return {name: times.wall for name, times in measure.interleaved(ready, repeats).items()}


def append(path: Path, found: Sequence[Measurement]) -> None:
    """One JSON line per measurement."""
    with path.open("a") as file:
        file.writelines(json.dumps(asdict(m)) + "\n" for m in found)


def _arguments(given: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of("epo_layer", __doc__)
    parser.add_argument("--settings", nargs="+", default=["exid", "rpi"], choices=SETTINGS)
    parser.add_argument("--implementations", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--repeats", type=measure.positive, default=7, help="rounds; the median counts")
    parser.add_argument("--threads", type=measure.positive, default=1, help="threads of PyTorch and of the kernel")
    for name, meaning in zip("BMNKS", ("scenes", "modes", "agents", "time steps", "solver steps"), strict=True):
        parser.add_argument(f"--{name}", type=measure.positive, help=f"{meaning}, instead of the setting's own number")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="cuda: what runs on a GPU")
    parser.add_argument(
        "--batches",
        type=measure.positive,
        nargs="+",
        default=list(devices.BATCHES),
        help="batch sizes of --device cuda",
    )
    parser.add_argument("--json", type=Path, help="append a line per measurement to this file")
    parser.add_argument("--scaling", action="store_true", help="grow N, M and K instead of comparing at one size")
    parser.add_argument("--plot", type=Path, help="where --scaling draws its curves (PNG)")
    return parser.parse_args(given)


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    arguments = _arguments(given)
    torch.set_num_threads(arguments.threads)
    measure.keep_freed_memory()
    warnings.filterwarnings("ignore", message=".*sparse.*|.*cholmod.*|.*baspacho.*")
    console = Console(width=max(Console().width, 128))
    sizes: dict[str, Any] = {name: getattr(arguments, name) for name in "BMNKS"}
    device = devices.require(arguments.device)
    try:
        if device.type == "cuda":
            others = {name: sizes[name] for name in "MNKS"}
            devices.run(
                device, arguments.settings, arguments.batches, arguments.repeats, arguments.json, console, **others
            )
            return
        _measure(arguments, sizes, console)
    except ConfigError as error:
        raise SystemExit(str(error)) from error


def _measure(arguments: argparse.Namespace, sizes: dict[str, Any], console: Console) -> None:
    if arguments.scaling:
        lines = scaling.run(arguments.implementations, sizes, arguments.repeats, arguments.threads, console)
        if arguments.json:
            append(arguments.json, [m for line in lines.values() for m in line])
        console.print(scaling.table(lines))
        if arguments.plot:
            console.print(f"drawn: {scaling.draw(lines, arguments.plot)}")
        return
    for setting in arguments.settings:
        game = make(setting, **sizes)
        found = measurements(game, arguments.implementations, arguments.repeats, arguments.threads, console)
        if arguments.json:
            append(arguments.json, found)
        machine = measure.machine(2 * game.sizes["N"] * game.sizes["K"])
        console.print(table(game, found, machine))
    for name, ms in latency(arguments.implementations, arguments.repeats).items():
        console.print(f"one scene (B=1, N=4, M=5, K=20, S=2) through the public API, {name}: {ms:.2f} ms (goal 0.5 ms)")


if __name__ == "__main__":
    main()
