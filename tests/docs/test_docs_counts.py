"""Counts of runs that pages state in words, recounted from all results files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]


class Run(NamedTuple):
    """A run of +SC or +EPO on RPI."""

    layer_steps: int | None
    trained: int
    all_games: bool
    power: float
    remedy: bool
    taught: bool


@cache
def runs() -> list[Run]:
    """Runs of +SC and +EPO, but not of inferred games that are solved, by identity: repetitions count once."""
    found = {}
    for file in sorted((ROOT / "results").glob("*.json")):
        for entry in json.loads(file.read_text())["runs"]:
            config, record = entry["config"], entry["record"]
            name, title = config["forecaster"]["name"], config["title"]
            joint = name == "scene_consistent" or (name == "epo" and title.startswith("V-LSTM + EPO"))
            on_rpi = config["data"]["name"] == "rpi"
            if on_rpi and joint and not re.search("game|equilibrium", title) and "metrics.json" in entry["scores"]:
                own = config["objective" if name == "epo" else "forecaster"]
                missed = entry["scores"]["metrics.json"]["metrics"]["alternative/missed"]
                found[record.get("identity", entry["folder"])] = Run(
                    config["solver"]["steps"] if name == "epo" else None,
                    record["steps"],
                    config["data"].get("games_share", 1) == 1,
                    own.get("power", 1.0),
                    own.get("relaxation", 0.0) > 0,
                    missed < 0.25,
                )
    return list(found.values())


def counted(chosen: Callable[[Run], bool]) -> tuple[int, int]:
    """Runs that teach both passing sides, and all of them, among the chosen ones."""
    found = [run for run in runs() if chosen(run)]
    return sum(run.taught for run in found), len(found)


def stated(pattern: str) -> list[tuple[str, tuple[int, ...]]]:
    """Page and numbers of every match of a pattern."""
    texts = [(page.name, page.read_text()) for page in PAGES]
    return [(name, tuple(map(int, match.groups()))) for name, text in texts for match in re.finditer(pattern, text)]


def squared(run: Run) -> bool:
    """Errors to a power above one."""
    return run.power > 1 and run.trained >= 3670


def remedied(run: Run) -> bool:
    """The remedy, with all training games."""
    return run.remedy and run.power == 1 and run.all_games and run.trained >= 2000


def two_steps_or_none(run: Run) -> bool:
    """The remedy, +SC or +EPO with the paper's two steps."""
    return remedied(run) and run.layer_steps in (None, 2)


def other_steps(run: Run) -> bool:
    """The remedy, +EPO with another number of steps."""
    return remedied(run) and run.layer_steps not in (None, 2)


def test_the_remedy_teaches_both_sides_with_two_steps():
    taught, known = counted(two_steps_or_none)
    assert known - taught == 1, "one run of +EPO, on 160 main games, misses a side"
    assert known > 100


@pytest.mark.parametrize(
    ("pattern", "chosen"),
    [
        (r"(\d+) of (\d+) joint runs of (?:at least )?3670", squared),
        (r"in (\d+) of (\d+) runs of \+SC and of \+EPO with two solver steps", two_steps_or_none),
        (r"in (\d+) of (\d+) runs with other numbers of solver steps", other_steps),
    ],
)
def test_counts_in_words_are_those_of_the_results_files(pattern: str, chosen: Callable[[Run], bool]):
    found = stated(pattern)
    assert found
    assert all(numbers == counted(chosen) for _, numbers in found), (found, counted(chosen))
