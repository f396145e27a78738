"""Paired comparisons against arithmetic by hand and against SciPy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from epo_lightning.report.runs import collect
from epo_lightning.report.statistics import Comparison, Difference, build_comparisons, compare
from epo_lightning.report.tables import build_tables

from .run_folders import make_run, scores

numbers = st.integers(0, 10**8).map(lambda number: number / 1e6)  # SciPy's variance of tiny numbers is zero


def test_three_pairs_equal_hand_computed_values() -> None:
    # Differences -1, -2, -3: mean -2, sample variance (1 + 0 + 1) / 2 = 1, standard error 1 / sqrt(3) = 0.57735.
    # t = -2 / 0.57735 = -3.4641 with 2 degrees of freedom. The distribution function of t with 2 degrees is
    # 1/2 + t / (2 sqrt(2 + t^2)), so p = 1 - 3.4641 / sqrt(2 + 12) = 1 - 0.92582 = 0.07418.
    # Its 97.5 % quantile solves t / sqrt(2 + t^2) = 0.95: t = 0.95 sqrt(2 / (1 - 0.9025)) = 4.30265.
    # Interval: -2 -+ 4.30265 * 0.57735 = -2 -+ 2.48414.
    found = compare([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
    assert (found.n, found.mean, found.reason) == (3, -2.0, "")
    assert found.p == pytest.approx(0.07418, abs=1e-5)
    assert (found.low, found.high) == (pytest.approx(-4.48414, abs=1e-5), pytest.approx(0.48414, abs=1e-5))


def test_two_pairs_equal_hand_computed_values() -> None:
    # Differences 1 and 3: mean 2, sample deviation sqrt(2), standard error 1, t = 2 with 1 degree of freedom, a Cauchy
    # variable: p = 1 - (2 / pi) atan(2), quantile tan(0.475 pi).
    found = compare([2.0, 4.0], [1.0, 1.0])
    assert found.p == pytest.approx(1 - 2 / math.pi * math.atan(2))
    assert found.high == pytest.approx(2 + math.tan(0.475 * math.pi))


@given(st.lists(st.tuples(numbers, numbers), min_size=2, max_size=8))
def test_p_values_and_intervals_equal_those_of_scipy(pairs: list[tuple[float, float]]) -> None:
    one, other = (np.array(values) for values in zip(*pairs, strict=True))
    found = compare(list(one), list(other))
    assert found.n == len(pairs)
    assert found.mean == pytest.approx(np.mean(one - other), abs=1e-12)
    if found.reason:
        assert np.ptp(one - other) <= 1e-7
        assert (found.low, found.high, found.p) == (None, None, None)
        return
    expected = scipy.stats.ttest_rel(one, other)
    interval = expected.confidence_interval(0.95)
    assert found.p == pytest.approx(expected.pvalue, rel=1e-6, abs=1e-12)
    assert (found.low, found.high) == (pytest.approx(interval.low), pytest.approx(interval.high))


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=6))
def test_swapping_the_rows_changes_only_signs(pairs: list[tuple[float, float]]) -> None:
    one, other = zip(*pairs, strict=True)
    there, back = compare(one, other), compare(other, one)
    assert there.mean is not None
    assert back.mean == -there.mean
    assert (back.p, back.reason) == (there.p, there.reason)
    if there.low is not None:
        assert back.high == pytest.approx(-there.low)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([], [], Difference(0, reason="no common seed")),
        ([1.0], [3.0], Difference(1, -2.0, reason="one common seed, two are needed")),
        ([1.0, 2.0], [1.0, 2.0], Difference(2, 0.0, reason="equal for every seed")),
        ([1.0, math.nan], [1.0, 2.0], Difference(2, reason="a score is not a finite number")),
        ([1.0, math.inf], [1.0, math.inf], Difference(2, reason="a score is not a finite number")),
    ],
)
def test_a_missing_test_has_a_reason(one: list[float], other: list[float], expected: Difference) -> None:
    assert compare(one, other) == expected


def test_differences_equal_up_to_rounding_count_as_equal() -> None:
    one, other = [0.3, 0.2, 0.7], [0.2, 0.1, 0.6]  # 0.1 each, but for the last bits
    assert len({a - b for a, b in zip(one, other, strict=True)}) > 1
    assert compare(one, other).reason == "equal for every seed"


@pytest.mark.parametrize("scale", [1e-9, 1e6])
def test_rounding_is_relative_to_the_scores(scale: float) -> None:
    one, other, shaken = ([scale * value for value in values] for values in ((0.3, 0.2), (0.2, 0.1), (0.2, 0.1 + 1e-6)))
    assert compare(one, other).reason == "equal for every seed"
    assert compare(one, shaken).reason == ""


def test_scores_are_paired_by_seed_whatever_their_order(tmp_path: Path) -> None:
    epo, sc = {2: 0.2, 0: 0.1, 1: 0.12}, {0: 0.3, 1: 0.1, 2: 0.25}
    for title, forecaster, values in (("EPO", "epo", epo), ("SC", "scene_consistent", sc)):
        for seed, value in values.items():
            make_run(tmp_path / f"{title}-{seed}", title, forecaster, scores(value), seed=seed)
    ((pair,),) = (found.pairs for found in build_comparisons(build_tables(collect(tmp_path))))
    expected = scipy.stats.ttest_rel([epo[seed] for seed in range(3)], [sc[seed] for seed in range(3)])
    assert pair.differences["minSADE"].p == pytest.approx(expected.pvalue)


def test_rows_with_parts_that_the_paper_does_not_have_are_no_epo_of_a_comparison(tmp_path: Path) -> None:
    make_run(tmp_path / "sc", "SC", "scene_consistent", scores(0.2))
    make_run(tmp_path / "epo", "EPO", "epo", scores(0.1))
    make_run(tmp_path / "other", "Another", "epo", scores(0.1), settings={"solver.name": "gradient_descent"})
    (found,) = build_comparisons(build_tables(collect(tmp_path)))
    assert [pair.one.name for pair in found.pairs] == ["EPO"]


def test_epo_against_sc_of_the_same_backbone_and_goal_over_common_seeds(tmp_path: Path) -> None:
    def row(title: str, forecaster: str, values: dict[int, float], **options: str) -> None:
        for seed, value in values.items():
            path = tmp_path / f"{title}-{seed}"
            make_run(path, title, forecaster, scores(value), seed=seed, **options)  # type: ignore[arg-type]

    row("V-LSTM", "marginal", {0: 0.9, 1: 0.8})
    row("V-LSTM + SC", "scene_consistent", {0: 0.10, 1: 0.20, 2: 0.30, 7: 9.0})
    row("V-LSTM + EPO", "epo", {5: 9.0, 2: 0.26, 1: 0.17, 0: 0.09})
    row("V-LSTM + EPO, goal known", "epo", {0: 0.01, 1: 0.01}, goal="all")
    row("VIBES + SC", "scene_consistent", {0: 0.5}, backbone="vibes")
    row("VIBES + EPO", "epo", {0: 0.4}, backbone="vibes")
    row("HiVT-M + EPO", "epo", {0: 0.4}, backbone="hivt_m")
    make_run(tmp_path / "val", "V-LSTM + EPO", "epo", scores(0.3), split="val")
    (found,) = build_comparisons(build_tables(collect(tmp_path)))
    assert found.title == "rpi, test split: +EPO against +SC, seed by seed"
    names = [(pair.one.name, pair.other.name, pair.seeds) for pair in found.pairs]
    assert names == [("V-LSTM + EPO", "V-LSTM + SC", [0, 1, 2]), ("VIBES + EPO", "VIBES + SC", [0])]
    lstm, vibes = found.pairs
    # Differences -0.01, -0.03, -0.04: mean -0.08 / 3.
    assert lstm.differences["minSADE"].mean == pytest.approx(-0.08 / 3)
    assert lstm.differences["minSADE"].n == 3
    assert lstm.differences["overlap_jfp"].reason == "equal for every seed"
    assert vibes.differences["minSADE"] == Difference(1, pytest.approx(-0.1), reason="one common seed, two are needed")


def test_every_variant_is_compared(tmp_path: Path) -> None:
    for title in ("V-LSTM + EPO", "V-LSTM + EPO, no init"):
        make_run(tmp_path / title, title, "epo", scores(0.1))
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.2))
    (found,) = build_comparisons(build_tables(collect(tmp_path)))
    assert [pair.one.name for pair in found.pairs] == ["V-LSTM + EPO", "V-LSTM + EPO, no init"]
    assert all(isinstance(pair, Comparison) for pair in found.pairs)


def test_rows_with_other_powers_of_the_loss_are_no_pair(tmp_path: Path) -> None:
    for title, power in (("plain", 1.0), ("squared", 2.0)):
        make_run(
            tmp_path / title / "sc",
            f"SC {title}",
            "scene_consistent",
            scores(0.2),
            settings={"forecaster.power": power},
        )
        objective = {"objective.name": "imitation", "objective.power": power}
        make_run(tmp_path / title / "epo", f"EPO {title}", "epo", scores(0.1), settings=objective)
    tables = build_tables(collect(tmp_path))
    (found,) = build_comparisons(tables)
    names = [(pair.one.name, pair.other.name) for pair in found.pairs]
    assert names == [("EPO plain", "SC plain"), ("EPO squared", "SC squared")]
    (main,) = (table for table in tables if table.main)
    assert [row.name for row in main.rows] == ["SC plain", "EPO plain", "SC squared", "EPO squared"]


def test_without_a_pair_there_is_no_comparison(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM + EPO", "epo", scores(0.1))
    assert build_comparisons(build_tables(collect(tmp_path))) == []


def test_tables_of_subsets_and_stages_have_no_comparisons_of_their_own(tmp_path: Path) -> None:
    for title, forecaster, value in (("SC", "scene_consistent", 0.2), ("EPO", "epo", 0.1)):
        of_subset = {"executed/minSADE": value, "executed/minSFDE": value}
        make_run(tmp_path / title, title, forecaster, scores(value) | of_subset)
    tables = build_tables(collect(tmp_path))
    assert [table.main for table in tables] == [True, False]
    assert [found.title for found in build_comparisons(tables)] == ["rpi, test split: +EPO against +SC, seed by seed"]


def test_a_metric_that_one_of_two_rows_lacks_is_not_compared(tmp_path: Path) -> None:
    without = {name: value for name, value in scores(0.2).items() if name != "overlap_authors"}
    make_run(tmp_path / "sc", "SC", "scene_consistent", without)
    make_run(tmp_path / "epo", "EPO", "epo", scores(0.1))
    ((pair,),) = (found.pairs for found in build_comparisons(build_tables(collect(tmp_path))))
    assert set(pair.differences) == set(without)
