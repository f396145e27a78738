"""The commands of the README in order, in an empty folder, at the smallest size."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from docs.pages import ROOT, blocks, lines
from experiment.conftest import epo  # noqa: F401 - a fixture

README = ROOT / "README.md"
DATA = ["data.games=6", "data.placements=1"]
CHEAPER = {
    "epo generate": [*DATA, "workers=1", "progress=false"],
    "epo drive run=rpi/v_lstm_epo_game_refined": ["episodes=1", "timed=1", "ways=[own]", "baselines=[]"],
    "epo train experiment=rpi/v_lstm_epo_relaxed budget=long": [
        *DATA,
        "budget=smoke",
        "callbacks.progress=none",
        "run_dir=runs/rpi/v_lstm_epo_relaxed/long-s0",
    ],
    "epo sweep rpi_relaxed budget=long": [*DATA, "budget=smoke", "callbacks.progress=none", "seed=0", "runs=swept"],
    "epo sweep status rpi_relaxed": ["runs=swept"],
    "epo report rpi_relaxed": ["runs=swept"],
}
"""Words that make a command cheap; later words win. The sweep has its own folder, as the first run has other settings."""
NOT_RUN = {
    "make run": "installs, and takes minutes",
    "make test": "these tests",
    "epo train resume=runs/rpi/v_lstm_epo_relaxed/long-s0": "the run is finished; tests/experiment/test_resume.py kills one",
    ". .venv/bin/activate": "tests run in an environment",
    "epo explore run=rpi/v_lstm_epo_game_refined": "serves a page until Ctrl-C; tests/explore opens it in a browser",
    "epo generate data=highway_sim": "minutes of simulation; tests/data/simulate",
    "epo train experiment=highway/vibes_epo data=highway_sim budget=short": "needs that set; make smoke trains the row",
    "epo train experiment=urban/v_lstm_epo data=interaction data.folder=data/interaction": "needs those recordings",
    "epo evaluate run=runs/highway_sim/vibes_epo/short-s0 data=us101 data.folder=data/us101": "needs run and recordings",
}


def test_all_commands_of_the_readme_run(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "cache"))
    commands = [line for block in blocks(README) if block.language != "python" for line in lines(block.text)]
    assert set(CHEAPER) | set(NOT_RUN) <= set(commands)
    for command in commands:
        if command not in NOT_RUN:
            words = [word for word in shlex.split(command)[1:] if word != "budget=long"]
            assert epo(*words, *CHEAPER.get(command, [])) == 0, command
    assert (tmp_path / "runs/rpi/v_lstm_epo_relaxed/long-s0/metrics.json").is_file()
    assert (tmp_path / "predictions/figures").is_dir()
    (page,) = tmp_path.glob("swept/sweeps/*/report/index.html")
    assert "V-LSTM + EPO" in page.read_text()

    exec(next(block.text for block in blocks(ROOT / "docs" / "reports.md") if block.language == "python"), {})
    assert (tmp_path / "report" / "index.html").is_file()
