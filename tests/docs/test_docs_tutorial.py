"""The tutorial: its files are written and its commands run as they stand, in an empty folder; training is cut short."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path

import pytest
from docs.pages import ROOT, blocks, lines

from epo_lightning import cli, registry

PAGE = ROOT / "docs" / "tutorial.md"
CHEAPER = {
    "epo generate": ["workers=1", "progress=false"],
    "epo train": ["budget=smoke", "callbacks.progress=none"],
    "epo sweep": ["budget=smoke", "callbacks.progress=none", "seed=0", "experiment=ucy/const_vel,ucy/v_lstm_epo"],
}
"""Words that make a command cheap; later words win."""


def test_the_tutorial_leads_from_recordings_to_a_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("EPO_CACHE", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, text in re.findall(r"^`([\w./]+)`:\n\n```\w+\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    registry.parts("format")
    try:
        for block in blocks(PAGE):
            for command in lines(block.text) if block.language == "bash" else ():
                work(command, tmp_path)
    finally:
        registry._PARTS["format"].pop("my_csv", None)
    (run,) = (tmp_path / "runs" / "ucy" / "const_vel").iterdir()
    assert (run / "metrics.json").is_file()
    (page,) = tmp_path.glob("runs/sweeps/*/report/index.html")
    assert "V-LSTM + EPO" in page.read_text()


def work(command: str, folder: Path) -> None:
    """Run one command of the page."""
    program, *words = shlex.split(command)
    if program == "python":
        runpy.run_path(str(folder / words[0]))
    elif command == "pip install -e .":
        # What an entry point does, without changing the environment that the tests run in.
        runpy.run_path(str(folder / "my_format.py"), run_name="my_format")
    else:
        words = [word for word in words if word != "budget=short"]
        cli.main([*words, *CHEAPER.get(f"epo {words[0]}", [])])
