"""The committed results files are whole and small, and their tables are written from them."""

from __future__ import annotations

from pathlib import Path

import pytest

from epo_lightning.experiment.config.settings import ReportSettings
from epo_lightning.experiment.report import report
from epo_lightning.report.results import read_results

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "results").glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_committed_results_file_is_whole_small_and_without_folders_of_a_machine(file: Path) -> None:
    report = read_results(file)
    assert report.runs
    assert file.stat().st_size < 1_000_000
    assert str(file.relative_to(ROOT)) in (ROOT / "docs" / "tables" / "index.md").read_text(encoding="utf-8")
    text = file.read_text(encoding="utf-8")
    assert not any(f"/{folder}/" in text for folder in ("tmp", "home", "root", "work"))
    for run in report.runs:
        assert run.record["command"].startswith("epo train ")
        assert len(run.record["git_commit"]) == 40
        assert run.record["data_digest"]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_tables_and_figures_are_rebuilt_from_a_results_file_byte_for_byte(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "epo_lightning.report.page.page", lambda _: ""
    )  # index.html takes half of the time, and is not committed
    committed = ROOT / "docs" / "tables" / file.stem
    report(ReportSettings(results=str(file), out=str(tmp_path)))
    shown = {path.relative_to(committed) for path in committed.rglob("*.*")}
    assert shown == {path.relative_to(tmp_path) for path in (tmp_path / "results.md", *tmp_path.glob("figures/*"))}
    for path in shown:
        assert (committed / path).read_bytes() == (tmp_path / path).read_bytes(), f"{path}: make tables writes it again"
