"""Report of several methods: order, games, modes and costs, compared with hand-computed values."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import pytest
from rich.console import Console

from epo_lightning.files import read_json, write_json
from epo_lightning.report.charts import charts_of
from epo_lightning.report.columns import Column, significant
from epo_lightning.report.costs import cost_sheets, last_fifth
from epo_lightning.report.latex import to_latex
from epo_lightning.report.made import how_made
from epo_lightning.report.paper import is_papers
from epo_lightning.report.render import legend, to_markdown
from epo_lightning.report.runs import collect, find_runs
from epo_lightning.report.tables import Table, build_tables
from epo_lightning.report.timings import duration_text, read_timings
from epo_lightning.report.write import Report, write_report

from .methods import METHODS, PARTS, of_methods, time_it
from .page_runs import timed
from .run_folders import make_run, scores


def tables_of(folder: Path) -> dict[str, Table]:
    """Runs in the order of the sweep, which differs from that of the folders."""
    return {table.title: table for table in build_tables(collect(of_methods(folder)))}


def lines(text: str, start: str) -> list[list[str]]:
    """The cells of the Markdown lines that begin so."""
    found = [line for line in text.splitlines() if line.startswith(f"| {start} |")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in found]


def test_methods_of_one_forecaster_stand_in_the_order_of_the_sweep(tmp_path: Path) -> None:
    table = tables_of(tmp_path)["rpi, test split"]
    assert [row.name for row in table.rows] == ["JFP", "EPO", "Laplace"]
    assert {row.group for row in table.rows} == {("v_lstm", "energy")}
    assert [row.cells["minSADE"].rank for row in table.rows] == [None, 1, 2]
    assert [row.cells["minSADE"].n for row in table.rows] == [2, 2, 2]


def test_only_the_papers_own_row_has_the_papers_numbers(tmp_path: Path) -> None:
    rows = tables_of(tmp_path)["rpi, test split"].rows
    assert [row.cells["minSADE"].paper for row in rows] == [None, 0.03, None]


@pytest.mark.parametrize("kind", PARTS)
def test_any_other_part_makes_another_method(kind: str) -> None:
    ours = dict(zip(PARTS, METHODS[1].parts, strict=True))
    config = {part: {"name": name} for part, name in ours.items()}
    assert is_papers("epo", config)
    assert is_papers("epo", {key: value for key, value in config.items() if key != kind})  # of an older version
    assert is_papers("epo", {**config, kind: None})
    assert not is_papers("epo", {**config, kind: {"name": "another"}})
    assert is_papers("marginal", {**config, kind: {"name": "another"}})


def test_other_methods_are_not_compared_as_epo(tmp_path: Path) -> None:
    of_methods(tmp_path)
    for seed in range(2):
        make_run(tmp_path / f"sc{seed}", "V-LSTM + SC", "scene_consistent", scores(0.1), seed=seed)
    write_report(Report.of_folder(tmp_path), tmp_path / "out", console=Console(file=io.StringIO()))
    found = csv.DictReader((tmp_path / "out" / "comparisons.csv").open())
    assert {(line["method"], line["other"]) for line in found} == {("EPO", "V-LSTM + SC")}


def test_equilibrium_scores_of_every_method_have_a_table(tmp_path: Path) -> None:
    table = tables_of(tmp_path)["rpi, test split: equilibrium"]
    assert [column.metric for column in table.columns] == [
        *("energy_initial", "energy_solved", "energy_optimum", "gradient_norm", "nash_gap", "nash_gap_relative"),
    ]
    ranks = {
        column.metric: [row.cells[column.metric].rank for row in table.rows if column.metric in row.cells]
        for column in table.columns
    }
    assert ranks.pop("nash_gap_relative") == [None, 2, 1]
    assert all(rank is None for found in ranks.values() for rank in found), "their units are each method's own"
    markdown = to_markdown(table)
    # Two equal seeds deviate by nothing. A finite game has no gradient.
    assert lines(markdown, "JFP") == [
        ["JFP", "2", "900 ± 0", "15.2 ± 0", "12.0 ± 0", "-", "3.50 ± 0", "0.250 ± 0"],
    ]
    assert lines(markdown, "Laplace")[0][5:] == ["2.0e-05 ± 0", "3.0e-05 ± 0", "**1.0e-06 ± 0**"]
    assert lines(markdown, "EPO")[0][-1] == "<u>0.125 ± 0</u>"


def test_empty_columns_and_rows_without_a_game_are_left_out(tmp_path: Path) -> None:
    of_methods(tmp_path)
    make_run(tmp_path / "m", "V-LSTM", "marginal", scores(0.1))
    whole = {table.title: table for table in build_tables(collect(tmp_path))}
    assert "V-LSTM" in {row.name for row in whole["rpi, test split"].rows}
    assert "V-LSTM" not in {row.name for row in whole["rpi, test split: equilibrium"].rows}
    finite = {table.title: table for table in build_tables(collect(tmp_path / "JFP-s0"))}
    assert "gradient_norm" not in {column.metric for column in finite["rpi, test split: equilibrium"].columns}
    assert list({table.title for table in build_tables(collect(tmp_path / "m"))}) == ["rpi, test split"]


def test_a_gap_missing_for_one_seed_is_shown_as_a_dash(tmp_path: Path) -> None:
    runs = of_methods(tmp_path)
    content = read_json(runs[3].metrics_file())
    del content["metrics"]["nash_gap_relative"]
    write_json(runs[3].metrics_file(), content)
    markdown = write_report(Report.of_folder(tmp_path), tmp_path / "out", console=Console(file=io.StringIO()))
    found = next(line for line in lines(markdown, "EPO") if len(line) == 8 and line[5].startswith("0.750"))
    assert found[-2:] == ["0.250 ± 0", "-"]


def test_accuracy_of_the_k_most_likely_modes_has_a_table(tmp_path: Path) -> None:
    table = tables_of(tmp_path)["rpi, test split: accuracy of the k most likely modes"]
    assert [column.label for column in table.columns] == ["SADE, k=1", "SADE, k=2", "SADE, k=3"]
    markdown = to_markdown(table)
    assert lines(markdown, "JFP")[0][2:] == ["0.070 ± 0.000", "0.060 ± 0.000", "0.010 ± 0.000"]
    assert lines(markdown, "EPO")[0][2:] == ["**0.040 ± 0.000**", "**0.030 ± 0.000**", "-"]


def test_ten_modes_are_in_numeric_order_and_a_single_mode_has_no_table(tmp_path: Path) -> None:
    many = {f"minSADE_{k}": 1.0 / k for k in range(1, 12)}
    make_run(tmp_path / "many", "V-LSTM", "marginal", scores(0.1) | many)
    make_run(tmp_path / "cv", "Constant velocity", "constant_velocity", scores(0.5) | {"minSADE_1": 0.5})
    _, table = build_tables(collect(tmp_path))
    assert [column.metric for column in table.columns] == [f"minSADE_{k}" for k in range(1, 12)]
    assert [row.name for row in table.rows] == ["V-LSTM", "Constant velocity"]
    assert len(build_tables(collect(tmp_path / "cv"))) == 1


def test_missing_cells_are_dashes_in_every_format(tmp_path: Path) -> None:
    tables = tables_of(tmp_path / "runs")
    table = tables["rpi, test split: accuracy of the k most likely modes"]
    row = next(line for line in to_latex(table).splitlines() if line.startswith("EPO &"))
    assert row.removesuffix(r" \\").split(" & ")[-1] == "-"
    console = Console(file=io.StringIO(), width=160)
    write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=console)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    part = printed[printed.index("k=3") :]
    assert next(line.split() for line in part.splitlines() if line.split()[:1] == ["EPO"]) == [
        "EPO",
        "2",
        "0.040",
        "0.030",
        "-",
    ]
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<td>-</td>") == 3  # EPO and Laplace without a third mode, JFP without a gradient
    found = list(csv.DictReader((tmp_path / "out" / "results.csv").open()))
    assert {line["method"] for line in found if line["metric"] == "minSADE_3"} == {"JFP"}
    assert {line["method"] for line in found if line["metric"] == "gradient_norm"} == {"EPO", "Laplace"}


def test_legends_explain_games_and_modes_only_if_present(tmp_path: Path) -> None:
    tables = tables_of(tmp_path)
    main, modes, equilibrium = (legend([table]) for table in tables.values())
    assert "Nash gap is the most that an agent could gain by changing its strategy alone" in equilibrium
    assert "Displacements" not in equilibrium
    assert "Nash" not in main + modes
    assert "the k most likely" in modes
    assert "most likely;" not in main


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((900.0, "900"), (15.25, "15.2"), (0.125, "0.125"), (0.00123456, "0.00123"), (0.000123, "1.2e-04")),
        *((12345.6, "12346"), (123456.0, "1.2e+05"), (0.0, "0"), (-3.14159, "-3.14"), (9.999, "10.0"), (math.nan, "-")),
        *((0.0009999, "0.00100"), (math.inf, "inf")),
    ],
)
def test_numbers_have_three_significant_digits(value: float, text: str) -> None:
    assert significant(value) == text
    assert Column("nash_gap", "").text(value) == text


def test_costs_equal_hand_computed_values(tmp_path: Path) -> None:
    runs = of_methods(tmp_path)
    tables = build_tables(collect(runs))
    (sheet,) = cost_sheets(tables, read_timings(runs)[0])
    assert sheet.title == "Cost: rpi"
    assert sheet.header == ("method", "n", "training", "steps", "ms per step", "parameters", "forecast")
    # (60 s + 180 s) / 2 over 1000 steps; medians of 2 ms and 4 ms.
    assert sheet.lines[0] == ("JFP", "2", "2 min", "1000", "120", "1234", "3.0 ms")
    assert [line[0] for line in sheet.lines] == ["JFP", "EPO", "Laplace"]
    assert "median time of one joint forecast, on A CPU (cpu, 1 thread)." in sheet.note


def test_costs_of_untrained_and_untimed_rows_are_dashes(tmp_path: Path) -> None:
    runs = of_methods(tmp_path)
    runs[-1].metrics_file("time").unlink()  # one seed of Laplace is left
    time_it(runs[0], 0.5, "A slow CPU")
    runs.append(make_run(tmp_path / "cv", "CV", "constant_velocity", scores(0.5)))
    runs[-1].update(steps=0, seconds=0.3, parameters=0)
    (sheet,) = cost_sheets(build_tables(collect(runs)), read_timings(runs)[0])
    assert sheet.header[-2:] == ("forecast (1)", "forecast (2)")
    assert [line[-2:] for line in sheet.lines] == [("500 ms", "4.0 ms"), ("-", "3.0 ms"), ("-", "2.0 ms"), ("-", "-")]
    assert sheet.lines[-1][2:6] == ("-", "-", "-", "0")
    assert "(1) on A slow CPU (cpu, 1 thread); (2) on A CPU (cpu, 1 thread)." in sheet.note


def test_the_change_in_the_last_fifth_is_that_of_the_lowest_score(tmp_path: Path) -> None:
    assert last_fifth({200: 2.0, 400: 1.0, 800: 1.25, 1000: 0.9}) == pytest.approx(-0.1)
    assert last_fifth({400: 1.0, 800: 0.8, 900: 0.7, 1000: 0.9}) == pytest.approx(-0.125)
    assert last_fifth({400: 1.0, 1000: 1.5}) == 0
    assert last_fifth({900: 1.0, 1000: 0.5}) is None
    assert last_fifth({400: 0.0, 1000: 0.0}) is None

    runs = [make_run(tmp_path / str(seed), "V-LSTM", "marginal", scores(0.3), seed=seed) for seed in range(2)]
    for run, last in zip(runs, (0.9, 1.0), strict=True):
        run.update(steps=10, seconds=1.0)
        (run.path / "logs").mkdir(exist_ok=True)
        (run.path / "logs" / "metrics.csv").write_text(f"step,val/minSADE\n3,1.0\n9,{last}\n")
    (sheet,) = cost_sheets(build_tables(collect(runs)), [])
    assert dict(zip(sheet.header, sheet.lines[0], strict=True))["last fifth"] == "-5.0 %"
    (runs[1].path / "logs" / "metrics.csv").unlink()
    (sheet,) = cost_sheets(build_tables(collect(runs)), [])
    assert "last fifth" not in sheet.header


def test_without_times_there_is_no_cost_table(tmp_path: Path) -> None:
    run = make_run(tmp_path, "V-LSTM", "marginal", scores(0.3))
    tables = build_tables(collect([run]))
    assert cost_sheets(tables, []) == []
    run.update(steps=10, seconds=1.0)
    (sheet,) = cost_sheets(tables, [])
    assert sheet.lines == (("V-LSTM", "1", "1 s", "10", "100", "1234"),)
    assert "Forecast" not in sheet.note


def test_costs_count_a_row_once_and_have_one_table_per_data_set(tmp_path: Path) -> None:
    for data, title in (("rpi", "V-LSTM"), ("exid", "V-LSTM"), ("exid", "V-LSTM")):
        for split in ("test", "val"):
            run = make_run(tmp_path / data, title, "marginal", scores(0.3), data=data, split=split)
        run.update(steps=10, seconds=1.0)
    sheets = cost_sheets(build_tables(collect(tmp_path)), [])
    assert [(sheet.title, len(sheet.lines)) for sheet in sheets] == [("Cost: exid", 1), ("Cost: rpi", 1)]


def test_costs_are_written_in_every_format(tmp_path: Path) -> None:
    of_methods(tmp_path / "runs")
    console = Console(file=io.StringIO(), width=80)
    markdown = write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=console)
    assert "## Cost: rpi" in markdown
    assert ["EPO", "2", "2 min", "1000", "120", "1234", "3.0 ms"] in lines(markdown, "EPO")
    assert "Time of a forecast" not in markdown  # said once
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "Cost: rpi" in printed
    assert max(map(len, printed.splitlines())) <= 80
    latex = (tmp_path / "out" / "results.tex").read_text()
    assert r"\label{tab:cost-rpi}" in latex
    assert r"JFP & 2 & 2 min & 1000 & 120 & 1234 & 3.0 ms \\" in latex
    page = (tmp_path / "out" / "index.html").read_text()
    assert 'id="tab-cost"' in page
    assert "on A CPU (cpu, 1 thread)" in page


def test_runs_of_several_methods_that_were_only_timed_are_named(tmp_path: Path) -> None:
    for method in METHODS:
        named = {f"{kind}.name": name for kind, name in zip(PARTS, method.parts, strict=True)}
        run = make_run(tmp_path / method.title, method.title, "epo", None, settings=named)
        time_it(run, 0.002)
    markdown = write_report(Report.of_folder(tmp_path), tmp_path / "out", console=Console(file=io.StringIO()))
    assert "| method | N | S | M | mean |" in markdown
    assert [line[0] for name in ("JFP", "EPO", "Laplace") for line in lines(markdown, name)[:1]] == [
        "JFP",
        "EPO",
        "Laplace",
    ]


def test_runs_that_were_scored_and_timed_are_made_once(tmp_path: Path) -> None:
    of_methods(tmp_path)
    made = how_made(build_tables(collect(tmp_path)), read_timings(find_runs(tmp_path))[0])
    assert sorted((row.name, row.seeds) for row in made) == [("EPO", "0, 1"), ("JFP", "0, 1"), ("Laplace", "0, 1")]


def test_runs_that_were_only_timed_are_in_the_order_of_their_seeds(tmp_path: Path) -> None:
    for path, seed in (("a", 10), ("b", 2)):
        time_it(make_run(tmp_path / path, "EPO", "epo", None, seed=seed), 0.002)
    (row,) = how_made([], read_timings(find_runs(tmp_path))[0])
    assert (row.what, row.seeds) == ("rpi, runtime", "2, 10")


def test_runtime_figures_show_one_method_each(tmp_path: Path) -> None:
    for agents in (2, 4):
        timed(tmp_path / "ours", agents, 2, 4, 0.001 * agents)
    other = timed(tmp_path / "other", 4, 8, 4, 0.5)
    config = other.config()
    config["energy"] = {"name": "neural"}
    other.begin(config, other.record)
    (chart,) = charts_of([], read_timings(find_runs(tmp_path))[0])
    assert chart.name == "runtime"
    assert [line[:4] for line in chart.numbers] == [("2", "2", "4", "2.0 ms"), ("4", "2", "4", "4.0 ms")]


def test_a_forecaster_without_a_game_is_in_the_runtime_figure_of_every_method(tmp_path: Path) -> None:
    timed(tmp_path, 2, 2, 4, 0.002)
    timed(tmp_path, 2, None, 4, 0.001)
    (chart,) = charts_of([], read_timings(find_runs(tmp_path))[0])
    assert [line[:4] for line in chart.numbers] == [("2", "-", "4", "1.0 ms"), ("2", "2", "4", "2.0 ms")]


def test_durations_have_a_suitable_unit() -> None:
    assert [duration_text(value) for value in (0.4, 75, 119.4, 179, 720, 7199, 11400)] == [
        "0 s",
        "75 s",
        "119 s",
        "3 min",
        "12 min",
        "2 h 0 min",
        "3 h 10 min",
    ]


def test_backward_and_objective_may_differ_between_rows(tmp_path: Path) -> None:
    for name in ("unrolled", "implicit"):
        settings = {"backward.name": name, "objective.name": "imitation"}
        make_run(tmp_path / name, "EPO", "epo", scores(0.1), settings=settings)
    names = [row.name.partition(",")[0] for row in build_tables(collect(tmp_path))[0].rows]
    assert names == ["EPO", "EPO"]


def test_every_energy_stands_below_its_own_name(tmp_path: Path) -> None:
    """EPO's game costs 2.0 at the initial strategies, 1.5 as forecast and 1.0 at the optimum."""
    of_methods(tmp_path / "runs")
    write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=Console(file=io.StringIO()))
    expected = {
        "energy, initial": "2.00",
        "energy, solved": "1.50",
        "energy, optimum": "1.00",
        "gradient norm": "0.750",
        "Nash gap": "0.250",
        "Nash gap, relative": "0.125",
    }
    table = tables_of(tmp_path / "again")["rpi, test split: equilibrium"]
    by_column = {column.label: column.metric for column in table.columns}
    assert by_column["energy, solved"] == "energy_solved"
    assert by_column["energy, optimum"] == "energy_optimum"
    for text, separator in (((tmp_path / "out/results.md").read_text(), "|"), (to_latex(table), "&")):
        header = next(line for line in text.splitlines() if "energy, solved" in line)
        values = next(line for line in text.splitlines() if "EPO" in line and "1.50" in line)
        cells = [[cell.strip(" \\*") for cell in line.strip("|").split(separator)] for line in (header, values)]
        shown = dict(zip(*cells, strict=True))
        for name, value in expected.items():
            assert value in shown[name].partition(r"\,")[0], (name, shown)
    rows = list(csv.DictReader((tmp_path / "out" / "results.csv").open()))
    means = {row["metric"]: float(row["mean"]) for row in rows if row["method"] == "EPO"}
    assert [means[f"energy_{name}"] for name in ("initial", "solved", "optimum")] == [2.0, 1.5, 1.0]
