"""Counts of runs that pages state in words, recounted from all results files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

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


def runs() -> dict[str, Run]:
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
    return found


def counted(chosen: list[Run]) -> tuple[int, int]:
    """Runs that teach both passing sides, and all of them."""
    return sum(run.taught for run in chosen), len(chosen)


def stated(pattern: str) -> Iterator[tuple[str, Any]]:
    """Page and numbers of every match of a pattern."""
    for page in PAGES:
        for match in re.finditer(pattern, page.read_text()):
            yield page.name, tuple(map(int, match.groups()))


RUNS = runs()
SQUARED = counted([run for run in RUNS.values() if run.power > 1 and run.trained >= 3670])
REMEDY = [run for run in RUNS.values() if run.remedy and run.power == 1 and run.all_games and run.trained >= 2000]
COUNTS = [
    (r"(\d+) of (\d+) joint runs of 3670 steps or more", SQUARED),
    (
        r"in all (\d+) runs of \+SC and of \+EPO with two steps",
        (counted([r for r in REMEDY if r.layer_steps in (None, 2)])[1],),
    ),
    (r"in (\d+) of (\d+) with other numbers of steps", counted([r for r in REMEDY if r.layer_steps not in (None, 2)])),
]


def test_the_remedy_teaches_both_sides_with_two_steps():
    taught, known = counted([run for run in REMEDY if run.layer_steps in (None, 2)])
    assert taught == known > 100


@pytest.mark.parametrize(("pattern", "expected"), COUNTS)
def test_counts_in_words_are_those_of_the_results_files(pattern: str, expected: tuple[int, ...]):
    pages = dict(stated(pattern))
    assert pages
    assert all(numbers == expected for numbers in pages.values()), (pages, expected)
