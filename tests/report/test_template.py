"""Pages whose numbers come from results files: every number against a plain computation, and errors that name the line."""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from random import Random
from statistics import fmean, stdev

import pytest
from scipy.stats import t as student

from epo_lightning.experiment.config.settings import ReportSettings
from epo_lightning.experiment.report import report_page
from epo_lightning.registry import ConfigError
from epo_lightning.report.results import read_results, save_results
from epo_lightning.report.scores import Differences, Scores, average, below, table
from epo_lightning.report.template import Results, write_page
from epo_lightning.report.write import Report

from .run_folders import make_run
from .run_folders import scores as make_scores
from .test_transfer import on

RESULTS = Path(__file__).parents[2] / "results"


def write(folder: Path, text: str) -> str:
    """The page of a template with this text."""
    template = folder / "page.md.j2"
    template.write_text(text, encoding="utf-8")
    return write_page(template, RESULTS).read_text(encoding="utf-8")


def scores(metric: str, title: str) -> dict[int, float]:
    """Scores by seed of a row of ``rpi_hard_settled.json``, read without the module under test."""
    runs = read_results(RESULTS / "rpi_hard_settled.json").evaluated
    return {run.seed: run.metrics[metric] for run in runs if run.name == title}


def test_numbers_are_those_of_a_plain_computation(tmp_path: Path) -> None:
    epo, sc = scores("minSFDE", "V-LSTM + EPO, relaxed"), scores("minSFDE", "V-LSTM + SC, relaxed")
    found = [epo[seed] - sc[seed] for seed in range(5)]
    half = student.ppf(0.975, 4) * stdev(found) / sqrt(5)
    expected = [
        f"{fmean(epo.values()):.4f} ± {stdev(epo.values()):.4f}",
        f"{fmean(found):+.4f} ({fmean(found) - half:+.4f} to {fmean(found) + half:+.4f})",
        f"{fmean(epo.values()) / fmean(sc.values()):.2f}",
        f"{sum(value < 0 for value in found)} of 5",
        ", ".join(f"{epo[seed]:.5f}" for seed in range(5)),
    ]
    page = write(
        tmp_path,
        '{% set rows = results("rpi_hard_settled", digits=4) %}\n'
        '{% set sc, epo = rows["V-LSTM + SC, relaxed"], rows["V-LSTM + EPO, relaxed"] %}\n'
        '{{ epo.text("SFDE") }}|{{ (epo - sc).text("SFDE") }}|{{ epo.over(sc, "SFDE") }}|'
        '{{ below([epo - sc], "SFDE") }}|{{ epo.seeds("SFDE", 5) }}',
    )
    assert page.split("|") == [text.replace("0.", ".") for text in expected]


def test_differences_are_of_the_seeds_that_both_rows_have() -> None:
    one = Scores("one", {0: {"minSADE": 1.0}, 1: {"minSADE": 2.0}, 2: {"minSADE": 9.0}})
    other = Scores("other", {1: {"minSADE": 0.5}, 0: {"minSADE": 0.75}})
    assert (one - other).by_seed == {0: {"minSADE": 0.25}, 1: {"minSADE": 1.5}}
    with pytest.raises(ConfigError, match="no seed in common"):
        one - Scores("none", {7: {"minSADE": 1.0}})


def test_an_average_takes_the_seed_as_the_unit() -> None:
    pairs = [Differences("a", {0: {"x": 1.0}, 1: {"x": 2.0}}), Differences("b", {0: {"x": 3.0}, 1: {"x": -6.0}})]
    both = average(pairs)
    assert isinstance(both, Differences)
    assert both.values("x") == [2.0, -2.0]
    with pytest.raises(ConfigError, match="rows 'a', 'b' have no seed in common"):
        average([Scores("a", {0: {"x": 1.0}}), Scores("b", {1: {"x": 1.0}})])
    assert below(pairs, "x") == "1 of 4"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.5, ".5000"), (-0.5, "-.5000"), (10.5, "10.5000"), (0.0, ".0000"), (-1e-9, ".0000"), (-10.25, "-10.2500")],
)
def test_only_a_zero_before_the_point_is_left_out(value: float, text: str) -> None:
    assert Scores("row", {0: {"x": value}}, 4).text("x") == text


def test_a_single_difference_has_no_interval() -> None:
    assert Differences("row", {0: {"x": 0.5}}).text("x") == "+.500"
    assert Differences("row", {0: {"x": 0.5}, 1: {"x": 0.5}}).text("x") == "+.500"


@pytest.mark.parametrize("missing", [{}, {"x": float("nan")}, {"x": float("inf")}])
def test_a_score_that_a_seed_lacks_is_no_number_of_a_page(missing: dict[str, float]) -> None:
    row = Scores("row", {0: {"x": 1.0}, 3: missing})
    for use in (lambda: row.text("x"), lambda: row.over(row, "x"), lambda: below([row], "x")):
        with pytest.raises(ConfigError, match=r"row 'row', seed 3: x is (nan|inf), and a page needs a finite score"):
            use()


def test_a_table_has_the_papers_values_beside_its_rows() -> None:
    rows = {
        "ours": Scores("a", {0: {"minSADE": 1.0}, 1: {"minSADE": 2.0}}),
        "other": Scores("b", {0: {"minSADE": 3.0}}),
    }
    assert table("method", rows, "SADE", paper={"ours": [".99"]}).splitlines() == [
        "| method | n | SADE | paper: SADE |",
        "|:--|--:|--:|--:|",
        "| ours | 2 | 1.500 ± .707 | .99 |",
        "| other | 1 | 3.000 |  |",
    ]


def test_values_are_in_the_order_of_the_seeds_and_have_a_deviation_where_they_differ() -> None:
    assert Scores("row", {10: {"x": 2.0}, 2: {"x": 1.0}}).values("x") == [1.0, 2.0]
    assert Scores("row", {0: {"x": 0.5}, 1: {"x": 0.5}}).text("x") == ".500"


def test_a_ratio_is_that_of_the_means_and_equal_pairs_are_not_below() -> None:
    one, other = Scores("a", {0: {"x": 1.0}, 1: {"x": 3.0}}), Scores("b", {0: {"x": 1.0}, 1: {"x": 4.0}})
    assert one.over(other, "x") == ".80"
    assert below([one - other], "x") == "1 of 2"


def test_a_page_has_the_scores_on_the_test_split_that_were_written_last_and_the_commits(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs" / "a", "SC", "scene_consistent", make_scores(0.5), data="a")
    make_run(run.path, "SC", "scene_consistent", make_scores(0.25), data="a", split="val")
    run.update(git_commit="f" * 40 + "+", steps=10)
    on(run, "b", 3.0)
    on(run, "b", 4.0, "-2")
    save_results(Report.of_folder(tmp_path / "runs"), tmp_path / "results" / "file.json")
    results = Results(tmp_path / "results")
    assert results.rows("file")["SC"].values("SADE") == [0.5]
    assert results.transfer("file", "a", "b")["SC"].values("SADE") == [4.0]
    assert "| fffffff+ | 0 | 1 | 10 |" in results.sources()


def cross_validation(folder: Path) -> Path:
    """A folder with a results file of two rows, three folds and two seeds."""
    random = Random(0)
    for title, forecaster in (("V-LSTM + SC", "scene_consistent"), ("V-LSTM + EPO", "epo")):
        for test in ("a", "b", "c"):
            for seed in (0, 1):
                path, found = folder / "runs" / f"{forecaster}-{test}-{seed}", make_scores(random.uniform(0.1, 0.9))
                if test != "b":  # a fold may have no interactive scenes
                    found["interactive/minSADE"] = 1.0
                make_run(path, title, forecaster, found, seed=seed, settings={"data.test": [test]}, digest=test)
    save_results(Report.of_folder(folder / "runs"), folder / "results" / "folds.json")
    return folder / "results"


def test_in_a_cross_validation_the_test_split_is_the_unit(tmp_path: Path) -> None:
    rows = Results(cross_validation(tmp_path)).folds("folds")
    means: dict[str, list[float]] = {}
    for run in read_results(tmp_path / "results" / "folds.json").evaluated:
        means.setdefault(run.name + run.config["data"]["test"][0], []).append(run.metrics["minSADE"])
    expected = {title: [fmean(means[title + test]) for test in "abc"] for title in ("V-LSTM + SC", "V-LSTM + EPO")}
    assert set(rows) == set(expected)
    for title, row in rows.items():
        assert row.values("SADE") == pytest.approx(expected[title])
    with pytest.raises(ConfigError, match="has no metric 'interactive SADE'"):
        rows["V-LSTM + SC"].values("interactive SADE")
    found = (rows["V-LSTM + EPO"] - rows["V-LSTM + SC"]).values("SADE")
    assert found == pytest.approx(
        [e - s for e, s in zip(expected["V-LSTM + EPO"], expected["V-LSTM + SC"], strict=True)]
    )


def test_a_results_file_without_a_cross_validation_has_no_folds() -> None:
    with pytest.raises(ConfigError, match="has no cross-validation: runs on one data set with different groups"):
        Results(RESULTS).folds("rpi_hard_settled")


def test_rows_are_asked_for_by_the_data_of_their_training_and_of_their_test() -> None:
    runs = read_results(RESULTS / "transfer.json").runs
    found = {
        (run.settings["title"], run.settings["seed"]): content["metrics"]["minSADE"]
        for run in runs
        for file, content in run.scores.items()
        if run.path.parts[1] == "us101" and file.startswith("scores-on-dut-")
    }
    rows = Results(RESULTS).transfer("transfer", "us101", "dut", digits=12)
    assert {(name, seed): row.by_seed[seed]["minSADE"] for name, row in rows.items() for seed in row.by_seed} == found
    own = Results(RESULTS).transfer("transfer", "us101", "us101")
    assert own["V-LSTM + EPO"].n == 3
    with pytest.raises(ConfigError, match="found us; did you mean 'us101'"):
        Results(RESULTS).transfer("transfer", "us", "dut")
    with pytest.raises(ConfigError, match="found dutt; did you mean 'dut'"):
        Results(RESULTS).transfer("transfer", "us101", "dutt")


def test_the_sources_are_the_files_that_were_used(tmp_path: Path) -> None:
    page = write(tmp_path, '{% set rows = results("game") %}{{ sources() }}')
    lines = page.splitlines()
    assert len(lines) == 3
    assert lines[2].startswith("| [game](tables/game/results.md) | rpi_hard, recipe 2 (")
    assert lines[2].endswith("| 81b9ee8, 9dcc1de, a951099 | 0 to 4 | 16 | 3670 | -5.8 to 0.0 % |")


def test_the_validation_score_is_the_lowest_of_the_log(tmp_path: Path) -> None:
    run = next(
        run
        for run in read_results(RESULTS / "game.json").evaluated
        if run.name == "V-LSTM + EPO, game" and not run.seed
    )
    lowest = min(float(entry["val/minSADE"]) for entry in run.records.log())
    text = '{{ results("game")["V-LSTM + EPO, game"].seeds("validation SADE", 7) }}'
    assert write(tmp_path, text).split(", ")[0] == f"{lowest:.7f}".replace("0.", ".", 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('a\n{{ results("gmae") }}', r"line 2: no results file .*gmae\.json; did you mean 'game'"),
        ('a\n\n{{ results("game")["V-LSTM + SC"] }}', "line 3: .*has no row 'V-LSTM \\+ SC'; did you mean"),
        ('{{ results("game")["V-LSTM + SC, relaxed"].text("SAED") }}', "line 1: .*no metric 'SAED'"),
        ('{{ results("rpi_games_share") }}', "line 1: .*data must name one of its data sets, found None"),
        ('{{ results("rpi_goal", data="rpi") }}', "line 1: .*found rpi; did you mean 'rpi_hard'"),
        (
            '\n{% set rows = results("rpi_hard") %}{{ rows["V-LSTM"].over(rows["V-LSTM"] - rows["V-LSTM"], "SADE") }}',
            "line 2: .*division by zero",
        ),
        ("a\n{{ nothing.text() }}", "line 2: 'nothing' is undefined"),
        ('a\n{% set one, two = results("rpi_hard").values() %}', "line 2: too many values to unpack"),
        ('{{ table("row", {"a": "text"}, "SADE") }}', "line 1: 'str' object has no attribute 'n'"),
        ('{% set a = results("runtime") %}\n{{ sources() }}', "line 2: results file runtime has no scored runs"),
        ("a\n{% if %}", "line 2: "),
    ],
)
def test_an_error_names_the_template_and_the_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"page\.md\.j2, {message}"):
        write(tmp_path, text)
    assert not (tmp_path / "page.md").exists()


def test_settings_of_another_kind_of_report_are_refused(tmp_path: Path) -> None:
    template = tmp_path / "page.md.j2"
    template.write_text("text", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"name ends with \.j2"):
        write_page(tmp_path / "page.md", RESULTS)
    with pytest.raises(ConfigError, match="leave out the name of a sweep"):
        report_page(ReportSettings(template=str(template), sweep="rpi_main"))
    out = report_page(ReportSettings(template=str(template), results=str(RESULTS), out=str(tmp_path / "out")))
    assert out.read_text(encoding="utf-8") == "text"
