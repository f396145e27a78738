"""Every Python block of README and docs runs, most of them unchanged."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from docs.pages import PAGES, ROOT, blocks

FIXTURE = ROOT / "tests" / "fixtures" / "exid_sim"
ELSEWHERE = {
    ("reports.md", "Report.of_folder"): "needs runs: test_docs_readme.py",
    ("tutorial.md", ""): "test_docs_tutorial.py",
    ("formats.md", "waymo"): "tests/data/recorded/formats/test_waymo.py",
    ("extend.md", ""): "test_documented_backbone.py, test_docs_extend.py, test_extend.py of tests/game and tests/data",
}
"""Blocks that other tests run, by page and a word in them."""
CHEAPER = {
    "repeats=25": "repeats=1",
    '"cache/highway_sim-recordings-..."': repr(str(FIXTURE)),
    '("commonroad", "data/us101")': repr(("exid", str(FIXTURE))),
}
"""Replacements in blocks that are run: fewer iterations, and recordings of the repository."""
BLOCKS = {
    f"{page.name}-{number}": block.text
    for page in PAGES
    for number, block in enumerate(block for block in blocks(page) if block.language == "python")
    if not any(page.name == other and word in block.text for other, word in ELSEWHERE)
}


SLOW = ("highway_sim.md-0", "features.md-0")
"""Blocks that take half a minute."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in BLOCKS])
def test_code_blocks_run(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))
    monkeypatch.chdir(tmp_path)  # where blocks write their pictures
    monkeypatch.syspath_prepend(str(ROOT))  # for `benchmarks`, which runs from the root of the repository
    text = BLOCKS[name]
    for one, other in CHEAPER.items():
        text = text.replace(one, other)
    threads, names = torch.get_num_threads(), {"__name__": name}
    try:
        exec(compile(text, name, "exec"), names)
    finally:
        torch.set_num_threads(threads)
    if "solution" in names:
        assert (names["solution"].energy < names["solution"].initial_energy).all()
