"""Results of ``epo drive`` in pages: texts of estimates and tables, and errors that name the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from epo_lightning.registry import ConfigError
from epo_lightning.report.closed_loop import measures_table, read_closed_loop
from epo_lightning.report.template import write_page

FIRST, SECOND = "V-LSTM + EPO", "true game"


def estimate(mean: float, low: float, high: float) -> dict[str, float]:
    return {"mean": mean, "low": low, "high": high}


def results() -> dict[str, Any]:
    """The contents of a ``results.json``."""
    return {
        "settings": {"world": "rpi"},
        "commit": "0123456789abcdef",
        "worlds": {
            "plays": {
                "planners": {
                    FIRST: {"collision": estimate(0.106, 0.082, 0.136), "cost": estimate(945.4, 889.0, 1004.0)},
                    SECOND: {"collision": estimate(0.0, 0.0, 0.0076), "cost": estimate(0.1234, -0.0001, 0.5)},
                },
                "differences": {
                    f"{FIRST} - {SECOND}": {"collision": estimate(0.106, 0.08, 0.13), "cost": estimate(1.5, 1.0, 2.0)}
                },
                "units": {"collision": "%"},
            }
        },
        "milliseconds": {"plays": {FIRST: {"clock 99 %": 3.14, "clock median": 2.2, "plans": 81}}},
    }


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "drive").mkdir()
    path = tmp_path / "drive" / "rpi.json"
    path.write_text(json.dumps(results()))
    return path


def test_a_page_shows_estimates_differences_and_times(file: Path, tmp_path: Path) -> None:
    template = tmp_path / "page.md.j2"
    template.write_text(
        '{% set plays = driven("rpi", "plays") %}\n'
        f'{{{{ plays.table(["{SECOND}", "{FIRST}"], "cost", "collision") }}}}\n'
        f'{{{{ plays.text("{FIRST} - {SECOND}", "collision") }}}}\n'
        f'{{{{ plays.times_table(["{FIRST}"]) }}}}\n'
        "{{ plays.commit[:7] }}"
    )
    assert write_page(template, tmp_path).read_text() == "\n".join(
        [
            "| planner | cost | collision [%] |",
            "|:--|--:|--:|",
            f"| {SECOND} | 0.123 (0.000 to 0.500) | 0.0 (0.0 to 0.8) |",
            f"| {FIRST} | 945 (889 to 1004) | 10.6 (8.2 to 13.6) |",
            "10.6 (8.0 to 13.0)",
            "| planner | clock 99 % | clock median | plans |",
            "|:--|--:|--:|--:|",
            f"| {FIRST} | 3.1 | 2.2 | 81 |",
            "0123456",
        ]
    )


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((-150.25, -201.0, -99.4), "-150 (-201 to -99)"),
        ((-1.5, -2.0, -1.0), "-1.50 (-2.00 to -1.00)"),
        ((-0.1, -0.2, 0.0), "-0.100 (-0.200 to 0.000)"),
    ],
)
def test_negative_differences_have_the_decimals_of_positive_ones(values: tuple[float, float, float], text: str) -> None:
    assert measures_table({"a": {"cost": estimate(*values)}}, {}, ["cost"]).endswith(f"| a | {text} |")


def test_names_that_are_not_there_are_refused(file: Path) -> None:
    plays = read_closed_loop(file, "plays")
    with pytest.raises(ConfigError, match=r"rpi\.json has no planner 'true gam'; did you mean 'true game'"):
        plays.text("true gam", "cost")
    with pytest.raises(ConfigError, match=r"rpi\.json has no measure 'colision'; did you mean 'collision'"):
        plays.table([FIRST], "colision")
    with pytest.raises(ConfigError, match=r"rpi\.json has no times of a planner 'true game'; known: V-LSTM"):
        plays.times_table([SECOND])
    with pytest.raises(ConfigError, match=r"rpi\.json has no kind of others 'ignores'; known: plays"):
        read_closed_loop(file, "ignores")


@pytest.mark.parametrize("lost", ["worlds", "milliseconds", "commit"])
def test_another_file_is_refused(file: Path, lost: str) -> None:
    content = results()
    del content[lost]
    file.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=rf"rpi\.json is no results\.json of epo drive, .*{lost}"):
        read_closed_loop(file, "plays")


def test_a_template_that_names_no_file_is_told_the_known_ones(file: Path, tmp_path: Path) -> None:
    template = tmp_path / "page.md.j2"
    template.write_text('{{ driven("rpy", "plays") }}')
    with pytest.raises(ConfigError, match=r"line 1: no results file .*rpy\.json; did you mean 'rpi'"):
        write_page(template, tmp_path)
