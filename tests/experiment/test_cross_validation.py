"""A cross-validation over recordings on the command line: one data set and one run for each fold, one report on all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
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


@pytest.mark.slow
def test_each_data_set_of_several_is_made_by_the_jobs_of_a_launcher(epo: Epo, tmp_path: Path) -> None:
    for place in range(4):
        folder = pedestrians.square(tmp_path / "data", f"square{place}", seed=place)
    words = ("data=ucy", f"data.folder={folder}", "data.val_share=0.3", "data.test=[square0],[square1]")
    assert epo("generate", "-m", *words, "hydra/launcher=local", "jobs=2", "progress=false") == 0
    assert len([*(tmp_path / "cache").glob("ucy-*/manifest.json")]) == 2


FOLDS = """\
# @package _global_
hydra:
  sweeper:
    params:
      experiment: ucy/const_vel
      data: ucy
      data.test: "[square0],[square2,square3]"
      data.batch_size: 8,16
"""


def test_a_sweep_makes_its_data_sets(
    epo: Epo, refused: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in range(4):
        folder = pedestrians.square(tmp_path / "data", f"square{place}", seed=place)
    (tmp_path / "conf" / "sweeps").mkdir(parents=True)
    (tmp_path / "conf" / "sweeps" / "folds.yaml").write_text(FOLDS)
    conf = f"--config-dir={tmp_path / 'conf'}"
    words = ("folds", f"data.folder={folder}", "data.val_share=0.3", *SMALL)
    said = refused(conf, "sweep", *words)  # data.folder is a setting of the data that the file chooses
    assert "`epo sweep generate folds data.folder=" in said
    assert conf in said
    assert "optimizer.lr" in refused(conf, "sweep", "generate", *words, "optimizer.lr=fast"), "before any data is made"
    assert "nofile.yaml" in refused(conf, "sweep", "generate", *words, "choices=nofile.yaml")
    assert epo(conf, "sweep", "generate", *words, "workers=1", "progress=false") == 0
    out = capsys.readouterr().out
    assert "data set 2 of 2" in out, "once for all batch sizes"
    assert "square2" in out, "the report of the data set"
    assert "next: epo sweep folds data.folder=" in out
    assert len([*(tmp_path / "cache").glob("ucy-*/manifest.json")]) == 2
    assert epo(conf, "sweep", *words) == 0
    assert "4 runs: 4 done" in capsys.readouterr().out
