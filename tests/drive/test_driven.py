"""The record of what was driven: damage, and files of others."""

from __future__ import annotations

import json
import resource
from pathlib import Path
from typing import Any

import pytest
import torch

from epo_lightning.drive.driven import Driven
from epo_lightning.registry import ConfigError

SETTINGS, WEIGHTS = {"seed": 0, "ways": ("own",)}, {"runs/a": "12"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A record of three rows."""
    driven = Driven(tmp_path / "out" / "episodes.jsonl", SETTINGS, WEIGHTS, print)
    for planner in ("a", "b"):
        driven.add("plays", planner, range(2), {"distance": torch.tensor([torch.inf, 2.0]), "cost": torch.ones(2)})
    driven.add("plays", "a", range(2, 3), {"distance": torch.tensor([0.1]), "cost": torch.ones(1)}, {"cost"})
    return driven.path


def opened(path: Path, lines: list[str], **others: Any) -> Driven:
    return Driven(path, **{"settings": SETTINGS, "weights": WEIGHTS, "tell": lines.append, **others})


def test_what_was_written_is_read_again_with_infinite_values(path: Path) -> None:
    text, lines = path.read_text(), list[str]()
    driven = opened(path, lines)
    assert not lines
    assert path.read_text() == text
    assert driven.has("plays", "a", range(2))
    assert not driven.has("plays", "b", range(2, 3))
    assert driven.rates("plays") >= {"collision", "cost"}
    assert driven.measured("plays", ["a"])["a"]["distance"].tolist() == [torch.inf, 2.0, pytest.approx(0.1)]


def test_measures_are_in_the_order_of_episodes_also_if_some_were_driven_again(path: Path) -> None:
    """Planners are compared by differences of the same episodes."""
    first, damaged, *rest = path.read_text().splitlines()
    path.write_text("\n".join([first, damaged.replace("2.0", "3.0"), *rest, ""]))
    driven = opened(path, [])
    assert not driven.has("plays", "a", range(2))
    driven.add("plays", "a", range(2), {"distance": torch.tensor([torch.inf, 2.0]), "cost": torch.ones(2)})
    for record in (driven, opened(path, [])):
        assert record.measured("plays", ["a"])["a"]["distance"].tolist() == [torch.inf, 2.0, pytest.approx(0.1)]


@pytest.mark.parametrize(
    "change",
    [
        {"kind": 3},
        {"planner": None},
        {"measures": None},
        {"episodes": []},
        {"episodes": "01"},
        {"rates": 5},
        {"measures": {"distance": [1.0, 2.0]}},
        {"measures": {"distance": [1.0, 2.0, 3.0], "cost": [1.0, 1.0]}},
        {"measures": {"distance": [1.0, "x"], "cost": [1.0, 1.0]}},
        {"measures": {"distance": [1.0, float("nan")], "cost": [1.0, 1.0]}},
    ],
)
def test_a_damaged_row_is_dropped_with_a_line_that_names_it(path: Path, change: dict[str, Any]) -> None:
    first, second, *rest = path.read_text().splitlines()
    edited = {name: value for name, value in {**json.loads(second), **change}.items() if value is not None}
    path.write_text("\n".join([first, json.dumps(edited), *rest, ""]))
    lines: list[str] = []
    driven = opened(path, lines)
    assert lines == [f"{path}, line 2 is damaged: its episodes are driven again"]
    assert not driven.has("plays", "a", range(2))
    assert driven.has("plays", "b", range(2))
    assert opened(path, lines).has("plays", "a", range(2, 3))
    assert len(lines) == 1, "the line is gone"


@pytest.mark.parametrize("line", ["", "5", "[]", "{}", "{", "null", "[" * 10**5])
def test_a_line_that_is_no_row_is_dropped(path: Path, line: str) -> None:
    path.write_text(path.read_text() + line + "\n")
    lines: list[str] = []
    opened(path, lines)
    assert lines == [f"{path}, line 5 is damaged: its episodes are driven again"]


def test_a_line_that_was_cut_off_is_dropped(path: Path) -> None:
    text, lines = path.read_text(), list[str]()
    path.write_text(text[:-20])
    assert not opened(path, lines).has("plays", "a", range(2, 3))
    assert not lines
    assert path.read_text() == "".join(text.splitlines(keepends=True)[:3])


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"settings": {"seed": 1, "ways": ("own",)}}, r"begun with other settings \(seed\)"),
        ({"settings": {"ways": ("own",), "mode": "likely"}}, r"begun with other settings \(mode, seed\)"),
        ({"weights": {"runs/a": "13"}}, "the checkpoint of the run runs/a has changed since, as by further training"),
    ],
)
def test_rows_of_others_are_refused(path: Path, others: dict[str, Any], message: str) -> None:
    text = path.read_text()
    with pytest.raises(ConfigError, match=message):
        opened(path, [], **others)
    assert path.read_text() == text


def test_a_record_without_rows_belongs_to_no_settings(path: Path) -> None:
    path.write_text(path.read_text().splitlines(keepends=True)[0])
    opened(path, [], settings={"seed": 1})
    assert json.loads(path.read_text())["settings"] == {"seed": 1}


@pytest.mark.parametrize("first", ["{", "5", '{"seed": 0}', '{"settings": 1, "weights": {}}'])
def test_a_damaged_first_line_and_an_older_one_are_named(path: Path, first: str) -> None:
    path.write_text("\n".join([first, *path.read_text().splitlines()[1:], ""]))
    with pytest.raises(ConfigError, match="was begun by an older version, or its first line is damaged"):
        opened(path, [])


def test_bytes_that_are_not_text_are_an_error_that_names_the_file(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"plays", b"pl\xffys", 1))
    with pytest.raises(
        ConfigError, match=r"episodes.jsonl is not UTF-8 .*: restore it, delete it, or choose another out="
    ):
        opened(path, [])


def test_other_episodes_together_are_refused(path: Path) -> None:
    with pytest.raises(ConfigError, match="was begun by a version that drove other episodes together"):
        opened(path, []).has("plays", "a", range(3))


def test_a_row_that_cannot_be_written_names_the_file(path: Path) -> None:
    driven = opened(path, [])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 5, hard))
    try:
        with pytest.raises(OSError, match=r"episodes\.jsonl"):
            driven.add("plays", "c", range(2), {"distance": torch.ones(2)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert opened(path, []).has("plays", "b", range(2))
