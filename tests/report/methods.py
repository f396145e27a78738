"""Run folders of a sweep over several methods that infer a game, with the same backbone and forecaster."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from epo_lightning.files import write_json
from epo_lightning.run_folder import RunFolder

from .run_folders import make_run, scores

PARTS = ("energy", "solver", "backward", "objective")


@dataclass(frozen=True)
class Method:
    """A row: its parts, and the number that its scores are made of."""

    title: str
    parts: tuple[str, str, str, str]
    value: float
    game: Mapping[str, float]


def game(initial: float, solved: float, optimum: float, gap: float, relative: float, **more: float) -> dict[str, float]:
    energies = {"energy_initial": initial, "energy_solved": solved, "energy_optimum": optimum}
    return energies | {"nash_gap": gap, "nash_gap_relative": relative} | more


METHODS = (
    Method("JFP", ("neural", "enumeration", "unrolled", "conditional"), 0.06, game(900.0, 15.25, 12.0, 3.5, 0.25)),
    Method("EPO", ("features", "levenberg_marquardt", "unrolled", "imitation"), 0.03, {}),
    Method("Laplace", ("features", "levenberg_marquardt", "detached", "laplace"), 0.04, {}),
)
EPO_GAME = game(2.0, 1.5, 1.0, 0.25, 0.125, gradient_norm=0.75)
LAPLACE_GAME = game(40.0, 30.0, 30.0, 0.00003, 0.000001, gradient_norm=0.00002)


def of_methods(folder: Path, times: bool = True) -> list[RunFolder]:
    """Three methods with two seeds each, listed in this order; one has three modes, and EPO's second seed was slower."""
    games = {"JFP": METHODS[0].game, "EPO": EPO_GAME, "Laplace": LAPLACE_GAME}
    runs = []
    for method in METHODS:
        for seed in range(2):
            modes = {f"minSADE_{k}": method.value + (2 - k) / 100 for k in (1, 2)}
            if method.title == "JFP":
                modes["minSADE_3"] = 0.01
            metrics = scores(method.value) | modes | games[method.title]
            named = {f"{kind}.name": name for kind, name in zip(PARTS, method.parts, strict=True)}
            run = make_run(folder / f"{method.title}-s{seed}", method.title, "epo", metrics, seed=seed, settings=named)
            run.update(steps=1000, seconds=60.0 + 120 * seed, began=f"2024-05-0{seed + 1}T10:00:00Z")
            if times:
                time_it(run, (0.002, 0.004)[seed])
            runs.append(run)
    return runs


def time_it(run: RunFolder, median: float, machine: str = "A CPU") -> None:
    """The time of a forecast, as it is measured after training."""
    seconds = {"mean": 2 * median, "median": median, "p10": median, "p90": 3 * median}
    content = {"agents": 2, "steps": 2, "modes": 2, "batch": 1, "samples": 100, "seconds": seconds}
    write_json(
        run.metrics_file("time"),
        content | {"device": "cpu", "machine": machine, "threads": 1, "data_digest": "abc"},
    )
