"""Pages whose numbers are looked up in results files: their templates write them byte for byte."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from docs.pages import ROOT

from epo_lightning.report.template import write_page

TEMPLATES = sorted((ROOT / "docs").glob("*.md.j2"))


def test_the_pages_of_results_have_templates() -> None:
    pages = {template.stem for template in TEMPLATES}
    assert pages == {
        f"{page}.md"
        for page in (
            "results",
            "claims",
            "results_files",
            "drive",
            "rpi",
            "rpi_results",
            "highway_results",
            "urban",
            "family",
            "game",
            "game_feedback",
            "game_intentions",
            "transfer",
        )
    }


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda template: template.stem)
def test_a_page_is_rebuilt_from_the_results_files_byte_for_byte(template: Path, tmp_path: Path) -> None:
    written = write_page(template, ROOT / "results", tmp_path).read_text(encoding="utf-8")
    assert written == template.with_suffix("").read_text(encoding="utf-8"), "make tables writes it again"


def test_the_list_of_results_files_is_that_of_the_page_of_evidence() -> None:
    claims, files = (
        (ROOT / "docs" / f"{page}.md.j2").read_text(encoding="utf-8") for page in ("claims", "results_files")
    )
    used = set(re.findall(r'(?:results|folds|transfer)\("(\w+)"', claims))
    assert used
    assert used == {name for name in re.findall(r'"(\w+)"', files) if (ROOT / "results" / f"{name}.json").exists()}
