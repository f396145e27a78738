"""Runs of results files, trained again by the code at hand: do the tables still come out of it?

    python -m benchmarks.repeat results/rpi_hard.json results/us101.json

Of every file one run is trained from its saved settings: the shortest one with a game layer, or the shortest one if there is
none. Its validation scores and, where the file has them, its scores on the test split are compared with the saved ones. On
processors of one kind, with one version of PyTorch, they agree digit by digit as long as no change of the code affects
them; elsewhere rounding differs, and training amplifies the difference. The new runs stay in ``--out``, and finished ones
are not trained again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.command_line import parser_of
from epo_lightning.experiment.assembly import build_data
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.train import train
from epo_lightning.files import read_json
from epo_lightning.identity import ELSEWHERE
from epo_lightning.registry import ConfigError
from epo_lightning.report.curves import METRIC
from epo_lightning.report.results import SavedRun, read_results, results_name
from epo_lightning.run_folder import RunFolder

SPLITS = {"metrics.json": "test", "metrics-val.json": "val"}
"""Split by the name of the file of its scores."""


def trained_runs(file: str) -> list[SavedRun]:
    """The runs of a results file that were trained, and not only timed.

    Raises:
        ConfigError: there is none, or the file cannot be read.
    """
    runs = [run for run in read_results(file).runs if isinstance(run, SavedRun)]
    trained = [run for run in runs if run.record.get("steps") and run.record.get("seconds")]
    if not trained:
        raise ConfigError("no run was trained")
    return trained


def chosen(runs: Sequence[SavedRun]) -> SavedRun:
    """The run with the shortest training, among those with a game layer if there are any."""
    layered = [run for run in runs if run.settings["forecaster"]["name"] == "epo"]
    return min(layered or runs, key=lambda run: run.record["seconds"])


def repeated(saved: SavedRun, folder: Path, overrides: Sequence[str]) -> RunFolder:
    """Train and score a saved run again.

    Args:
        saved: the run of a results file, which has no places of data.
        folder: run folder of the new run.
        overrides: settings of ``epo train`` that do not decide on the result, such as ``data.folder=...``.

    Raises:
        ConfigError: its data is missing or has changed, its settings have another meaning now, or it cannot be trained.
    """
    splits = [split for name, split in SPLITS.items() if name in saved.scores]
    section = saved.settings["data"]
    rest = compose("train", [f"data={section.get('dataset', section['name'])}", *overrides])
    placed = {
        name: {**elsewhere(rest[name], name), **saved.settings[name]} for name in ("data", "trainer", "callbacks")
    }
    digest = build_data(placed["data"]).digest
    if digest != saved.record.get("data_digest"):
        raise ConfigError(f"its data has the digest {digest} now, and had {saved.record.get('data_digest')}")
    again = train({**rest, **saved.settings, **placed, "run_dir": str(folder), "score": splits, "existing": "continue"})
    if again.record["identity"] != saved.record.get("identity"):
        raise ConfigError("it is another run now: its settings have another meaning")
    return again


def elsewhere(section: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The part of a section that does not decide on the result: places of data, the machine, and progress."""
    return {key: value for key, value in section.items() if f"{name}.{key}" in ELSEWHERE}


def distance(saved: SavedRun, again: RunFolder) -> tuple[float, int]:
    """Largest difference of a validation or test score, and the number of scores that both runs have.

    Raises:
        ConfigError: the runs were not validated equally often.
    """
    before, now = saved.log(), validated(again)
    if len(before) != len(now):
        raise ConfigError(f"it was validated {len(now)} times, and {len(before)} times before")
    pairs = [(float(a[METRIC]), float(b[METRIC])) for a, b in zip(before, now, strict=True)]
    for name, split in SPLITS.items():
        if name in saved.scores:
            old, new = saved.scores[name]["metrics"], read_json(again.metrics_file(split))["metrics"]
            pairs += [(old[metric], new[metric]) for metric in old if metric in new]
    return max(difference(*pair) for pair in pairs), len(pairs)


def difference(before: float, now: float) -> float:
    """Distance of two scores: zero if neither is a number, and infinite if one of them is not."""
    if math.isnan(before) or math.isnan(now):
        return 0.0 if math.isnan(before) and math.isnan(now) else math.inf
    return 0.0 if before == now else abs(before - now)


def one_line(error: Exception) -> str:
    """The message of an error for a cell of a table."""
    return " ".join(str(error).split())


def validated(run: RunFolder) -> list[dict[str, str]]:
    """Rows of a run's log with a validation."""
    return [row for row in run.log() if METRIC in row]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("repeat", __doc__)
    parser.add_argument("words", nargs="+", help="results files, and overrides such as data.folder=<recordings>")
    parser.add_argument("--out", type=Path, default=Path("build/repeat"), help="folder of the new runs")
    parser.add_argument("--longest", type=float, default=math.inf, help="longest training [s] that is repeated")
    given = parser.parse_intermixed_args(arguments)
    overrides = ["callbacks.progress=none", *(word for word in given.words if "=" in word)]
    print("| results file | run | commit | steps | scores | largest difference |")
    print("|:--|:--|:--|--:|--:|--:|")
    for file in (word for word in given.words if "=" not in word):
        try:
            saved = chosen(trained_runs(file))
            commit = str(saved.record.get("git_commit"))[:7]
            about = f"{saved.settings['title']}, seed {saved.settings['seed']} | {commit} | "
            if saved.record["seconds"] > given.longest:
                raise ConfigError(f"it took {saved.record['seconds']:.0f} s, more than --longest")
            largest, scores = distance(saved, repeated(saved, given.out / results_name(file), overrides))
            print(f"| {results_name(file)} | {about}{saved.record['steps']} | {scores} | {largest:.2g} |", flush=True)
        except ConfigError as error:
            print(f"| {results_name(file)} | not repeated: {one_line(error)} | | | | |", flush=True)


if __name__ == "__main__":
    main()
