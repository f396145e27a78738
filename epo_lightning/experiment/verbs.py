"""Verbs of the command line: each function calls the module that does the work, and prints the outcome.

``train_and_print`` calls :func:`.train.train`, ``evaluate_and_print`` calls :func:`.evaluate.evaluate`, and so on.
"""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from epo_lightning import pretrained
from epo_lightning.experiment.config.settings import (
    DriveSettings,
    EvaluateSettings,
    ExploreSettings,
    ExportSettings,
    GenerateSettings,
    PredictSettings,
    ReportSettings,
    measures,
)
from epo_lightning.files import read_json
from epo_lightning.registry import ConfigError
from epo_lightning.report.columns import is_own
from epo_lightning.report.labels import word
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import check_part, read

SCHEMAS: dict[str, type] = {
    "generate": GenerateSettings,
    "evaluate": EvaluateSettings,
    "predict": PredictSettings,
    "explore": ExploreSettings,
    "export": ExportSettings,
    "drive": DriveSettings,
    "report": ReportSettings,
}
HEADLINE = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp")


def check_settings(verb: str, config: dict[str, Any]) -> Any:
    """The settings of a verb other than train.

    Raises:
        ConfigError: an unknown key, a missing key or a value that is not allowed.
    """
    settings: Any = read(SCHEMAS[verb], config)
    if (section := getattr(settings, "data", None)) is not None:
        check_part("data", section)
    return settings


def generate_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Make the data set unless it exists, and print its report and a command that trains on it."""
    settings = check_settings("generate", config)
    from epo_lightning.data.datamodule import OF_DATA
    from epo_lightning.experiment.config.compose import tree
    from epo_lightning.experiment.config.sources import HIGHWAYS

    data = make_data(settings, overrides)
    dataset = settings.data.get("dataset", "rpi")
    row = f"{dataset}/v_lstm_epo" + ("_relaxed" if dataset == "rpi" else "")
    kept = [word for word in overrides if word.lstrip("+").startswith(OF_DATA)]
    vehicles = dataset in HIGHWAYS
    if (vehicles and data.task.map) or (tree() / "conf" / "experiment" / f"{row}.yaml").is_file():
        words = [f"experiment={row}", *(word for word in kept if word != f"data={dataset}")]
    else:
        on_lanes = "urban" if settings.data.get("windows", {}).get("lines") else "highway"
        rows = on_lanes if data.task.map else "dut" if vehicles or has_vehicles(data) else "ucy"
        words = [f"experiment={rows}/v_lstm_epo", *kept]
    print(f"\nnext: epo train {shlex.join(words)} budget=short" + " (minutes; without a budget: the paper's settings)")


def has_vehicles(data: Any) -> bool:
    """Whether some agents of a data set of recordings are no pedestrians."""
    from epo_lightning.scene import KINDS

    return bool((data.open("train").tables["kind"] != KINDS.index("pedestrian")).any())


def make_data(settings: GenerateSettings, overrides: Sequence[str] = ()) -> Any:
    """Make a data set unless it exists, and print its report.

    Returns:
        its data module.

    Raises:
        ConfigError: settings that do not fit this data, or recordings that are missing or cannot be read.
    """
    from epo_lightning.experiment import assembly
    from epo_lightning.experiment.config.replaced import keys_of

    data = assembly.build_data(settings.data)
    assembly.refuse_missing_folder(data, keys_of(overrides))
    known = inspect.signature(data.generate).parameters
    special: dict[str, Any] = {}
    if settings.strict:
        if "strict" not in known:
            raise ConfigError(
                f"strict=true refuses recordings that cannot be read, and data={settings.data['name']} has no recordings: "
                "leave it out"
            )
        special["strict"] = True
    if launch := _launch(settings, overrides):
        if "launch" not in known:
            raise ConfigError(
                f"a launcher divides recordings among jobs, and data={settings.data['name']} has no recordings: leave "
                "hydra/launcher and jobs out"
            )
        special["launch"] = launch
    folder = data.generate(workers=settings.workers, progress=settings.progress, **special)
    print(f"\ndata in {folder}, digest {data.digest}")
    print("\n".join(data.summary()))
    return data


def _launch(settings: GenerateSettings, overrides: Sequence[str]) -> Any:
    """The function that has recordings extracted by jobs; None without a launcher.

    Raises:
        ConfigError: a launcher without a number of jobs, or the other way round.
    """
    from epo_lightning.experiment import generation

    if generation.chosen(overrides) != (settings.jobs is not None):
        raise ConfigError(
            "hydra/launcher=<name> and jobs=<number> belong together: the launcher divides the recordings among so many jobs"
        )
    if settings.jobs is None:
        return None
    option = "--config-dir="
    words = [word for word in overrides if not word.startswith(option)]
    return generation.launching(
        words, settings.jobs, [w.removeprefix(option) for w in overrides if w.startswith(option)]
    )


def train_and_print(config: dict[str, Any], overrides: Sequence[str]) -> float | None:
    """Train a run, and print its best score and its folder; returns the best score."""
    from epo_lightning.experiment import train

    return _print_trained(train.train(config, overrides))


def resume_and_print(run: RunFolder) -> float | None:
    """Continue a run, and print its best score and its folder; returns the best score."""
    from epo_lightning.experiment import train

    train.resume(run)
    return _print_trained(run)


def _print_trained(run: RunFolder) -> float | None:
    """Print a run's parameters, best score and folder, and the next command; returns the best score."""
    record = run.record
    best = next(iter(record.get("best", {}).items()), None)
    score = f", best {best[0]} {best[1]:.4f}" if best and best[1] is not None else ""
    print(f"{record['title']}, seed {record['seed']}: {record.get('parameters', 0)} parameters{score}")
    asked = measures(run.config().get("score")) or ("test",)
    for which in ("test", "val"):
        if which in asked and run.metrics_file(which).is_file():
            print(f"  {which}: {_headline(read_json(run.metrics_file(which)).get('metrics', {}))}")
    scored = all(run.metrics_file(which).is_file() for which in asked)
    verb, key = ("report", "runs") if scored else ("evaluate", "run")
    print(f"run folder: {run.path}\nnext: epo {verb} {word(key, str(run.path))}")
    return best[1] if best else None


def _headline(metrics: Mapping[str, float]) -> str:
    """The most important scores, and those of registered metrics, in one line."""
    own = [name for name in metrics if is_own(name)]
    return ", ".join(f"{name} {metrics[name]:.4f}" for name in (*HEADLINE, *own) if name in metrics)


def evaluate_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Score runs, and print the headline metrics."""
    settings = check_settings("evaluate", config)
    from epo_lightning.experiment.evaluate import evaluate
    from epo_lightning.report.columns import TRUTH

    own = settings.data is None
    for run, file, metrics in evaluate(config, overrides):
        where = settings.own_split if own else _tested_on(file, settings.data)
        print(f"{run.path} ({where}): {_headline(metrics)}")
        if costs := ", ".join(
            f"{column.label} {metrics[column.metric]:.3f}" for column in TRUTH if column.metric in metrics
        ):
            print(f"  inferred against true costs: {costs}")
        if own and file != run.metrics_file(settings.own_split):
            name = run.metrics_file(settings.own_split).name
            print(f"  in {file}: {name} is for the best checkpoint, and is never replaced")
        elif not own and file.is_file():
            print(f"  in {file}")
    if settings.run not in pretrained.names():
        print(f"next: epo report {word('runs', settings.runs or settings.run)}")


def _tested_on(file: Path, data: Mapping[str, Any] | None) -> str:
    """The data, split and number of scenes of a file with scores on other data; the name of the data without a file."""
    if data is not None and not file.is_file():
        return f"{data.get('dataset', data['name'])}, not stored: nothing is written beside a forecaster of the package"
    content = read_json(file)
    return f"{content['data']}, {content['split']}, {content['scenes']} scenes"


def predict_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Write forecasts and figures, and print their paths."""
    settings = check_settings("predict", config)
    from epo_lightning.experiment.predict import predict

    written = predict(settings, overrides)
    print("\n".join(f"wrote {path}" for path in written))


def explore_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Serve the page of a run's games until Ctrl-C, and print its address."""
    settings = check_settings("explore", config)
    from epo_lightning.experiment.explore import explore

    explore(settings, overrides, lambda address: print(f"open {address} in a browser; Ctrl-C ends", flush=True))


def export_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Write a run's forecaster as a program, and print the file and its difference from the forecaster."""
    settings = check_settings("export", config)
    from epo_lightning.experiment.export import export

    file, difference = export(settings, overrides, partial(print, flush=True))
    size = file.stat().st_size / 1e6
    print(f"wrote {file} ({size:.1f} MB); its outputs differ from the forecaster's by {difference:.1g} at most")


def drive_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Drive episodes in closed loop, and print a line per planner and the paths of the files."""
    settings = check_settings("drive", config)
    from epo_lightning.experiment.drive import drive

    tell = partial(print, flush=True)  # a file shows the progress at once
    print("\n".join(f"wrote {path}" for path in drive(settings, tell)))


def report_and_print(config: dict[str, Any], overrides: Sequence[str]) -> None:
    """Write tables and figures of all evaluated runs below a folder, and print the path of the page."""
    settings = check_settings("report", config)
    from epo_lightning.experiment.report import report, report_page

    print(f"wrote {report_page(settings) if settings.template else report(settings) / 'index.html'}")


RUN: dict[str, Callable[[dict[str, Any], Sequence[str]], Any]] = {
    "generate": generate_and_print,
    "train": train_and_print,
    "evaluate": evaluate_and_print,
    "predict": predict_and_print,
    "explore": explore_and_print,
    "export": export_and_print,
    "drive": drive_and_print,
    "report": report_and_print,
}
