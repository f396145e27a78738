"""The backbone of docs/extend.md, unchanged, in the suite of backbones."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from suites import BackboneSuite, model

from epo_lightning import registry
from epo_lightning.forecasters import build_forecaster
from epo_lightning.registry import ConfigError, parts

PAGE = Path(__file__).parents[2] / "docs" / "extend.md"


def documented() -> tuple[dict[str, Any], dict[str, Any]]:
    """Names defined by the code blocks of the section; the parts that they register are removed afterwards."""
    before = dict(parts("backbone"))
    section = PAGE.read_text().split("## A backbone")[1].split("\n## ")[0]
    defined: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", section, re.DOTALL):
        exec(block, defined)
    known = registry._PARTS["backbone"]
    added = {name: known.pop(name) for name in set(known) - set(before)}
    return defined, added


DEFINED, ADDED = documented()
SUITES = {name: value for name, value in DEFINED.items() if name.startswith("Test")}
globals().update(SUITES)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, part in ADDED.items():
        monkeypatch.setitem(registry._PARTS["backbone"], name, part)


def test_the_page_has_a_backbone_with_its_suite():
    assert set(ADDED) == {"gru"}
    assert all(issubclass(suite, BackboneSuite) for suite in SUITES.values())
    assert [suite.config for suite in SUITES.values()] == [{"name": "gru"}]


def test_the_documented_backbone_goes_with_a_forecaster():
    epo = {"name": "epo", "modes": 2}
    assert build_forecaster(model(epo, backbone={"name": "gru", "width": 32})).backbone.width == 32
    with pytest.raises(ConfigError, match="use goal=energy"):
        build_forecaster(model(epo, backbone={"name": "gru"}, goal="all"))
