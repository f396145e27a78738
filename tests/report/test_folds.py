"""Folds of a cross-validation: which runs are joined, and what their scores become."""

from __future__ import annotations

from pathlib import Path

import pytest

from epo_lightning.report.folds import joined, named_by_fold
from epo_lightning.report.runs import EvaluatedRun, collect

from .run_folders import make_run, scores


def of_folds(folder: Path, folds: dict[tuple[str, ...], list[float]]) -> list[EvaluatedRun]:
    """Runs of one row on folds with these groups in their test splits, one for every score."""
    for number, (groups, values) in enumerate(folds.items()):
        for seed, value in enumerate(values):
            metrics = scores(value) | ({"interactive/minSADE": value} if number == 0 else {})
            settings = {"data.test": list(groups)}
            make_run(
                folder / f"{number}-{seed}",
                "SC",
                "scene_consistent",
                metrics,
                seed=seed,
                data="ucy",
                digest=f"digest{number}",
                settings=settings,
            )
    return named_by_fold(collect(folder))


def test_the_fold_is_the_unit_and_its_score_the_mean_over_seeds(tmp_path: Path) -> None:
    runs = of_folds(tmp_path, {("b", "c"): [1.0, 3.0], ("a",): [7.0]})
    assert sorted({run.data for run in runs}) == ["ucy, test a", "ucy, test b, c"]
    found = joined(runs)
    assert [(run.data, run.seed, run.metrics["minSADE"]) for run in found] == [("ucy", 0, 7.0), ("ucy", 1, 2.0)]
    assert len({run.row for run in found}) == 1
    assert {run.data_digest for run in found} == {"digest0, digest1"}
    assert not [run for run in found if "interactive/minSADE" in run.metrics], "one of the folds lacks it"


@pytest.mark.parametrize("folds", [[("a",), ("a", "b")], [("a", "b"), ("b", "c")], [("a",)]])
def test_folds_with_a_group_in_common_and_single_ones_are_not_joined(
    folds: list[tuple[str, ...]], tmp_path: Path
) -> None:
    """Scenes of the common group would count twice."""
    assert joined(of_folds(tmp_path, {groups: [1.0] for groups in folds})) == []
