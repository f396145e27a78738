"""Links and paths of README and docs have targets, and the site's table of contents has every page."""

from __future__ import annotations

import importlib.util
import re
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from docs.pages import PAGES, ROOT

from epo_lightning.experiment.config.compose import tree

FOLDERS = "docs|tests|conf|sweeps|benchmarks|epo_lightning|docker"
GENERATED = ROOT / "docs" / "reference"
"""Pages that the build of the site generates from the code."""
EXAMPLES = {
    "mine",
    "gru",
    "test_gru",
    "curvature",
    "test_curvature",
    "rpi_curvature",
    "v_lstm_epo_curvature",
    "imitation_speed",
    "test_imitation_speed",
    "fixed_step",
    "heading",
}
"""Files that the pages tell a reader to write."""


def slugs(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and the site name them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = (title.lower() for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    return {re.sub(r"[^\w\- ]", "", title).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_have_targets(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if target.startswith(("http", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if file.is_relative_to(GENERATED):
            continue
        assert file.exists(), target
        if anchor and file.suffix == ".md":
            assert anchor in slugs(file), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_paths_exist(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for path in re.findall(rf"`((?:{FOLDERS})/[\w./-]+)`", text):
        made = Path(path).stem in EXAMPLES or (ROOT / path).is_relative_to(GENERATED)
        assert made or (ROOT / path).exists(), path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_empty_lines_are_around_tables(page: Path) -> None:
    """A sentence directly below a table would be one of its rows, and a table directly below a sentence a part of it."""
    text = re.sub(r"^```.*?^```$", "```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    lines = [line.strip() for line in text.splitlines()]
    joined = [two for two in pairwise(lines) if all(two) and two[0].startswith("|") != two[1].startswith("|")]
    assert joined == []


def test_every_page_is_in_the_table_of_contents() -> None:
    listed = re.findall(r"^([\w/]+)$", (ROOT / "docs" / "index.md").read_text(), re.MULTILINE)
    pages = {page.stem for page in PAGES if page.name not in ("README.md", "index.md")}
    assert sorted(pages) == sorted(name for name in listed if "/" not in name)


def test_the_configuration_reference_has_every_key() -> None:
    path = ROOT / "docs" / "configuration_reference.py"
    spec = importlib.util.spec_from_file_location("configuration_reference", path)
    assert spec is not None
    assert spec.loader is not None
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    page = reference.page()
    for file in sorted((tree() / "conf").rglob("*.yaml")):
        group = file.relative_to(tree() / "conf").parent
        if group.parts[:1] == ("experiment",):
            assert f"`experiment={file.relative_to(tree() / 'conf' / 'experiment').with_suffix('').as_posix()}`" in page
            continue
        text = file.read_text()
        keys = [key for key in yaml.safe_load(text) or {} if key not in ("defaults", "hydra")]
        prefix = "" if "@package _global_" in text or not group.parts else ".".join(group.parts) + "."
        for key in keys:
            assert f"| `{prefix}{key}` |" in page, (file.name, key)
    # A comment that goes with a nested key stands in its row.
    assert "| `data.windows.radius` | `60.0` | neighbours are nearer than this to the focal agent" in page
