"""A cross-validation over recordings on the command line: one data set and one run for each fold, one report on all."""

from __future__ import annotations

from pathlib import Path

from experiment import pedestrians
from experiment.conftest import Epo

from epo_lightning.report.template import Results

SMALL = ("budget=smoke", "callbacks.progress=none")


def test_every_fold_has_a_data_set_a_run_and_a_table(epo: Epo, tmp_path: Path) -> None:
    for place in range(4):
        pedestrians.square(tmp_path / "data", f"square{place}", seed=place)
    words = (
        "data=ucy",
        f"data.folder={tmp_path / 'data'}",
        "data.val_share=0.3",
        "data.test=[square0],[square2,square3]",
    )
    assert epo("generate", "-m", *words, "workers=1", "progress=false") == 0
    assert len([*(tmp_path / "cache").glob("ucy-*/manifest.json")]) == 2
    assert epo("train", "-m", "experiment=ucy/const_vel", *words, *SMALL, "score=test") == 0
    assert epo("report", "runs=runs", "out=report", "save=results/folds.json", "scenes=false") == 0
    text = (tmp_path / "report" / "results.md").read_text()
    assert "ucy, test square0, test split" in text
    assert "ucy, test square2, square3, test split" in text
    (row,) = Results(tmp_path / "results").folds("folds").values()
    assert row.n == 2
    assert len({*row.values("SADE")}) == 2, "the folds have different scenes"


def test_each_data_set_of_several_is_made_by_the_jobs_of_a_launcher(epo: Epo, tmp_path: Path) -> None:
    for place in range(4):
        folder = pedestrians.square(tmp_path / "data", f"square{place}", seed=place)
    words = ("data=ucy", f"data.folder={folder}", "data.val_share=0.3", "data.test=[square0],[square1]")
    assert epo("generate", "-m", *words, "hydra/launcher=local", "jobs=2", "progress=false") == 0
    assert len([*(tmp_path / "cache").glob("ucy-*/manifest.json")]) == 2
