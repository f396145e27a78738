"""Every Python block of README and docs runs, most of them as they stand."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from docs.pages import PAGES, ROOT, blocks
from games import random_scene

from epo_lightning import registry
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings, read

FIXTURE = ROOT / "tests" / "fixtures" / "exid_sim"
ELSEWHERE = {
    "README.md": {1: "needs a trained run: test_docs_readme.py"},
    "extend.md": {
        0: "test_the_backbone_of_extend",
        1: "a test file of the backbone's suite",
        2: "tests/game/test_extend.py",
        3: "tests/game/test_extend.py",
        4: "tests/game/test_extend.py",
        5: "tests/data/test_extend.py",
    },
    "reports.md": {0: "needs runs: test_docs_readme.py"},
    "tutorial.md": {0: "test_docs_tutorial.py", 1: "test_docs_tutorial.py"},
}
"""Blocks that other tests run, by page and number."""
CHEAPER = {
    "repeats=7": "repeats=1",
    '"cache/highway_sim-recordings-..."': repr(str(FIXTURE)),
    '("commonroad", "data/us101")': repr(("exid", str(FIXTURE))),
}
"""What is replaced in blocks that run here: fewer rounds, and recordings that are in the repository."""
BLOCKS = {
    f"{page.name}-{number}": block.text
    for page in PAGES
    for number, block in enumerate(block for block in blocks(page) if block.language == "python")
    if number not in ELSEWHERE.get(page.name, {})
}


SLOW = ("highway_sim.md-0", "solver.md-1")
"""Blocks that take half a minute."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in BLOCKS])
def test_blocks_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_the_backbone_of_extend(tmp_path: Path) -> None:
    page = ROOT / "docs" / "extend.md"
    code = next(block.text for block in blocks(page) if block.language == "python")
    settings = next(block.text for block in blocks(page) if block.language == "yaml")
    (tmp_path / "backbone").mkdir()
    (tmp_path / "backbone" / "mean_pool.yaml").write_text(settings)
    registry.parts("backbone")
    try:
        exec(code, {"__name__": "mean_pool"})
        scene = random_scene(3, 2, history=2)
        backbone = registry.build("backbone", {"name": "mean_pool", "width": 8})
        assert backbone(scene).shape == (len(scene.history), scene.history.shape[1], 8)
        words = ["experiment=rpi/v_lstm_epo", "backbone=mean_pool", "title=MeanPool + EPO"]
        assembly.check(read(Settings, compose("train", words, [str(tmp_path)])))
    finally:
        registry._PARTS["backbone"].pop("mean_pool", None)
