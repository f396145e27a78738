"""What a dashboard adds to a short training: ``python -m benchmarks.dashboards [--repeats 3] [--epochs 8]``.

Runs of a paper's row on few games (`epo generate data=rpi data.games=10 data.placements=1` makes them), in a sweep of two
seeds per process and per dashboard, in turns. The first run of a process pays for a dashboard's imports and services, the
second is what every further run of a sweep pays. There is no network: W&B is offline.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

LOGGERS = ("csv", "tensorboard", "wandb", "mlflow")
DATA = ("data=rpi", "data.games=10", "data.placements=1")
Spent = dict[str, float]


def measure(logger: str, row: str, epochs: int) -> Spent:
    """Seconds of a process that trains two runs: of each run by the clock, and of the whole process by clock and CPU."""
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "train",
            "-m",
            f"experiment={row}",
            *DATA,
            "budget=reduced",
            f"trainer.max_epochs={epochs}",
            "seed=0,1",
        ]
        words += [f"runs={folder}", f"logger=[{logger}]", "callbacks.progress=none"]
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("WANDB", "MLFLOW"))}
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "epo_lightning.cli", *words], env=environment, check=True, stdout=subprocess.DEVNULL
        )
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        records = sorted(Path(folder).rglob("run.json"))
        first, second = (json.loads(record.read_text())["seconds"] for record in records)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return {"first": first, "second": second, "process": wall, "CPU": cpu}


def main() -> None:
    """Measure in turns and print medians, and what each dashboard adds to the CSV file alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", default="rpi/v_lstm_epo")
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also append every measurement to this file")
    arguments = parser.parse_args()
    found: dict[str, list[Spent]] = {logger: [] for logger in LOGGERS}
    for _ in range(arguments.repeats):
        for logger in LOGGERS:
            spent = measure(logger, arguments.row, arguments.epochs)
            found[logger].append(spent)
            if arguments.json:
                with arguments.json.open("a") as file:
                    file.write(json.dumps({"logger": logger, **spent}) + "\n")
    medians = {
        logger: {name: statistics.median(spent[name] for spent in all_spent) for name in all_spent[0]}
        for logger, all_spent in found.items()
    }
    table = Table(title=f"{arguments.row}, {arguments.epochs} epochs, median of {arguments.repeats} [s]")
    table.add_column("logger")
    for name in medians["csv"]:
        table.add_column(name, justify="right")
    for logger, spent in medians.items():
        more = {name: spent[name] / medians["csv"][name] - 1 for name in spent}
        table.add_row(logger, *(f"{spent[name]:.2f} ({more[name]:+.1%})" for name in spent))
    Console().print(table)


if __name__ == "__main__":
    main()
