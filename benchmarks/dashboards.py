"""Cost of a dashboard in a short training: ``python -m benchmarks.dashboards [--repeats 3] [--epochs 8]``.

Every process trains one row of the paper with two seeds, as a sweep, and with one dashboard; processes take turns. The first
run of a process pays for a dashboard's imports and services, the second run is the cost of every further run of a sweep.
W&B is offline, so no network is needed. The data set is small: `epo generate data=rpi data.games=10 data.placements=1`.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.command_line import parser_of
from benchmarks.measure import positive
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.registry import ConfigError
from epo_lightning.schema import read

LOGGERS = ("csv", "tensorboard", "wandb", "mlflow")
DATA = ("data=rpi", "data.games=10", "data.placements=1")
Spent = dict[str, float]


def check_data(row: str, data: Sequence[str]) -> None:
    """Load the data set once, so that a missing one is an error before anything is measured.

    Raises:
        ConfigError: it is missing, or the overrides do not fit the row; the message says what to do.
    """
    settings = read(Settings, compose("train", [f"experiment={row}", *data]))
    assembly.build_data(settings.data).setup("fit")


def measure(logger: str, row: str, data: Sequence[str], epochs: int) -> Spent:
    """Seconds of a process that trains two runs: wall time of each run, wall and CPU time of the process.

    Raises:
        SystemExit: the training failed; the message is its last line.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "train",
            "-m",
            f"experiment={row}",
            *data,
            "budget=reduced",
            f"trainer.max_epochs={epochs}",
            "seed=0,1",
        ]
        words += [f"runs={folder}", f"logger=[{logger}]", "callbacks.progress=none"]
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("WANDB", "MLFLOW"))}
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        command = [sys.executable, "-m", "epo_lightning.cli", *words]
        done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        records = [json.loads(record.read_text()) for record in sorted(Path(folder).rglob("run.json"))]
        if done.returncode or len(records) != 2 or not all("seconds" in record for record in records):
            said = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()[-1]
            raise SystemExit(f"a training with logger=[{logger}] failed: {said}")
        first, second = (record["seconds"] for record in records)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return {"first": first, "second": second, "process": wall, "CPU": cpu}


def main(given: Sequence[str] | None = None) -> None:
    """Measure in turns; print medians and the increase over the first logger."""
    parser = parser_of("dashboards", __doc__)
    parser.add_argument("--row", default="rpi/v_lstm_epo", help="the experiment")
    parser.add_argument("--data", nargs="+", default=list(DATA), help="overrides that choose the data set")
    parser.add_argument(
        "--loggers", nargs="+", default=list(LOGGERS), choices=LOGGERS, help="the first is the baseline"
    )
    parser.add_argument("--epochs", type=positive, default=8)
    parser.add_argument("--repeats", type=positive, default=3, help="rounds; the median counts")
    parser.add_argument("--json", type=Path, help="append a line per measurement to this file")
    arguments = parser.parse_args(given)
    try:
        check_data(arguments.row, arguments.data)
    except ConfigError as error:
        raise SystemExit(str(error)) from error
    found: dict[str, list[Spent]] = {logger: [] for logger in arguments.loggers}
    for _ in range(arguments.repeats):
        for logger in found:
            spent = measure(logger, arguments.row, arguments.data, arguments.epochs)
            found[logger].append(spent)
            if arguments.json:
                with arguments.json.open("a") as file:
                    file.write(json.dumps({"logger": logger, **spent}) + "\n")
    medians = {
        logger: {name: statistics.median(spent[name] for spent in all_spent) for name in all_spent[0]}
        for logger, all_spent in found.items()
    }
    baseline = medians[arguments.loggers[0]]
    table = Table(title=f"{arguments.row}, {arguments.epochs} epochs, median of {arguments.repeats} [s]")
    table.add_column("logger")
    for name in baseline:
        table.add_column(name, justify="right")
    for logger, spent in medians.items():
        table.add_row(logger, *(f"{spent[name]:.2f} ({spent[name] / baseline[name] - 1:+.1%})" for name in spent))
    Console().print(table)


if __name__ == "__main__":
    main()
