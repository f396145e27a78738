"""Run folders for all sections of a page: rows with seeds, logs, optimisation steps and runtimes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from epo_lightning.files import write_json
from epo_lightning.run_folder import RunFolder

from .run_folders import make_run, scores

ROWS = (("V-LSTM", "marginal", 0.13), ("V-LSTM + SC", "scene_consistent", 0.05), ("V-LSTM + EPO", "epo", 0.03))


def write_log(run: RunFolder, values: Sequence[float], every: int = 100) -> Path:
    """metrics.csv as training leaves it: a line per validation, and one per training loss between them."""
    lines = ["epoch,step,train/loss,val/minADE,val/minSADE"]
    for epoch, value in enumerate(values):
        step = (epoch + 1) * every - 1
        lines += [f"{epoch},{step},,{value * 0.9},{value}", f"{epoch},{step},{value * 2},,"]
    file = run.path / "logs" / "metrics.csv"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")
    return file


def rows_with_seeds(folder: Path) -> None:
    """Three learned rows with three seeds each, which learned for ten epochs, and constant velocity."""
    for title, forecaster, best in ROWS:
        for seed in range(3):
            metrics = scores(best * (1 + 0.05 * seed), 0.001 * seed)
            if forecaster == "epo":
                metrics |= {"initial/minSADE": best * 2, "initial/minSFDE": best * 3}
            run = make_run(folder / forecaster / f"s{seed}", title, forecaster, metrics, seed=seed)
            run.update(began=f"2024-05-0{seed + 1}T10:00:00Z", seconds=61.5, steps=1000, versions={"torch": "2.13.0"})
            write_log(run, [best * (1 + 8 / (epoch + 1)) + 0.01 * seed for epoch in range(10)])
    make_run(folder / "cv", "Constant velocity", "constant_velocity", scores(0.5, 0.1))


def over_steps(folder: Path) -> None:
    """The row of the S curve: S = 1, 2, 4, 8 with two seeds, on the validation split."""
    for steps, (solved, initial) in {1: (0.06, 0.07), 2: (0.05, 0.08), 4: (0.04, 0.09), 8: (0.039, 0.1)}.items():
        for seed in range(2):
            metrics = scores(solved + 0.002 * seed) | {"initial/minSADE": initial, "initial/minSFDE": initial}
            make_run(
                folder / f"S{steps}-s{seed}",
                "V-LSTM + EPO",
                "epo",
                metrics,
                seed=seed,
                split="val",
                settings={"solver.steps": steps},
            )


def timed(folder: Path, agents: int, steps: int | None, modes: int, mean: float, **changes: Any) -> RunFolder:
    """A run that was timed and not scored."""
    settings = {"data.agents": agents, "solver.steps": steps or 0, "forecaster.modes": modes, "forecaster.note": ""}
    name = f"N{agents}-S{steps}-M{modes}"
    run = make_run(folder / name, name, "epo" if steps else "marginal", None, settings=settings)
    seconds = {"mean": mean, "median": mean * 0.98, "p10": mean * 0.9, "p90": mean * 1.1}
    content = {"agents": agents, "steps": steps, "modes": modes, "batch": 1, "samples": 100, "seconds": seconds}
    content |= {"device": "cpu", "machine": "A <fast> CPU", "threads": 1, "data_digest": "abc"}
    write_json(run.metrics_file("time"), content | changes)
    return run


def over_runtime(folder: Path) -> None:
    """A grid over N and S with M = 4, and a line over M."""
    for agents in (2, 4, 8, 12):
        for steps in (1, 2, 4, 8, 12):
            timed(folder, agents, steps, 4, 0.0002 * agents * steps**0.8 + 0.001)
    for modes in (1, 2, 8, 12):
        timed(folder, 4, 2, modes, 0.002 + 0.0001 * modes)
