"""Charts of many runs: plotted values equal those of the runs, and damaged or missing files are noted."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from epo_lightning.registry import ConfigError
from epo_lightning.report.charts import _word, charts_of
from epo_lightning.report.curves import Curve, draw_learning, draw_steps, learning_curves, steps_curves, validation_log
from epo_lightning.report.efficiency import draw_efficiency, efficiencies
from epo_lightning.report.made import how_made
from epo_lightning.report.paper import RUNTIME, RUNTIME_MODES, STEPS
from epo_lightning.report.runs import collect, find_runs
from epo_lightning.report.runtime import draw_modes, heat_map
from epo_lightning.report.style import svg
from epo_lightning.report.tables import build_tables, distinct
from epo_lightning.report.timings import grid, over_modes, places, read_timings, time_text, timing_sheet
from epo_lightning.run_folder import RunFolder

from .page_runs import over_runtime, over_steps, rows_with_seeds, timed, write_log
from .run_folders import make_run, scores


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def lines(figure: Figure) -> dict[str, list[tuple[float, float]]]:
    return {
        str(line.get_gid()): list(zip(line.get_xdata(), line.get_ydata(), strict=True)) for line in figure.axes[0].lines
    }


def test_learning_curves_are_means_over_seeds_with_the_range_as_band(tmp_path: Path) -> None:
    for seed, values in enumerate(([1.0, 0.5, 0.4], [2.0, 0.9])):
        write_log(make_run(tmp_path / str(seed), "V-LSTM", "marginal", scores(0.3), seed=seed), values)
    curves, notes = learning_curves(distinct(build_tables(collect(tmp_path))))
    assert notes == []
    assert curves == [Curve("V-LSTM", (100, 200), (1.5, 0.7), (1.0, 0.5), (2.0, 0.9), 2)]
    figure = draw_learning(curves)
    assert lines(figure) == {"row0-line": [(100, 1.5), (200, 0.7)]}
    band = figure.axes[0].collections[0]
    assert band.get_gid() == "row0-band"
    corners = {tuple(corner) for corner in band.get_paths()[0].vertices.tolist()}
    assert corners == {(100, 1.0), (100, 2.0), (200, 0.5), (200, 0.9)}


def test_training_steps_are_whole_numbers() -> None:
    figure = draw_learning([Curve("V-LSTM", (2, 3, 4), (0.3, 0.2, 0.1), (0.3, 0.2, 0.1), (0.3, 0.2, 0.1), 1)])
    figure.canvas.draw()
    labels = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert {"2", "3", "4"} <= {*labels}
    assert all(label.lstrip("\N{MINUS SIGN}").isdigit() for label in labels)


def test_a_row_with_a_damaged_log_is_left_out_with_a_note(tmp_path: Path) -> None:
    for name in ("whole", "missing", "empty", "nan", "other"):
        run = make_run(tmp_path / name, name, "marginal", scores(0.3))
        if name == "nan":
            write_log(run, [float("nan")])
        elif name != "missing":
            write_log(run, [0.5, 0.4])
    (tmp_path / "empty" / "logs" / "metrics.csv").write_text("")
    (tmp_path / "other" / "logs" / "metrics.csv").write_text("epoch,step\n0,99\n")
    make_run(tmp_path / "cv", "Constant velocity", "constant_velocity", scores(0.5))
    curves, notes = learning_curves(distinct(build_tables(collect(tmp_path))))
    assert [curve.name for curve in curves] == ["whole"]
    assert sorted(note.split(" ")[0] for note in notes) == ["empty", "missing", "nan", "other"]
    assert any("missing/logs/metrics.csv is missing or has no row" in note for note in notes)
    with pytest.raises(ValueError, match="no row"):
        draw_learning([])


def test_truncated_lines_are_ignored_and_repeated_steps_count_once(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.logs.mkdir()
    (run.logs / "metrics.csv").write_text("epoch,step,val/minSADE\n0,99,0.5\n1,199,0.4\n1,199,0.3\n2,x9,0.2\n2,299,0.2")
    assert validation_log(run, "val/minSADE") == {100: 0.5, 200: 0.3}
    with pytest.raises(ConfigError, match=r"metrics\.csv has no finite val/minFDE"):
        validation_log(run, "val/minFDE")


def test_the_s_curve_joins_rows_that_differ_only_in_steps(tmp_path: Path) -> None:
    over_steps(tmp_path / "steps")
    shutil.rmtree(tmp_path / "steps" / "S8-s1")  # not done yet
    (curve,) = steps_curves(distinct(build_tables(collect(tmp_path))))
    assert (curve.name, curve.split, curve.paper) == ("V-LSTM + EPO", "rpi, val split", True)
    assert curve.optimised.x == (1, 2, 4, 8)
    assert curve.optimised.mean == pytest.approx((0.061, 0.051, 0.041, 0.039))
    (chart,) = (chart for chart in charts_of(build_tables(collect(tmp_path)), []) if chart.section == "S curve")
    assert [line[:2] for line in chart.numbers] == [("1", "2"), ("2", "2"), ("4", "2"), ("8", "1")]
    assert curve.initial is not None
    assert curve.initial.mean == pytest.approx((0.07, 0.08, 0.09, 0.1))
    drawn = lines(draw_steps(curve))
    assert [point[1] for point in drawn["row0-line"]] == list(curve.optimised.mean)
    assert [point[1] for point in drawn["row1-line"]] == list(curve.initial.mean)
    assert drawn["row2-line"] == [(steps, values["minSADE"]) for steps, values in STEPS.items()]
    assert drawn["row3-line"] == [(steps, values["initial/minSADE"]) for steps, values in STEPS.items()]


def test_the_s_curve_shows_the_row_without_steps(tmp_path: Path) -> None:
    for steps in (0, 2):
        make_run(tmp_path / str(steps), "V-LSTM + EPO", "epo", scores(0.1 + steps), settings={"solver.steps": steps})
    (curve,) = steps_curves(distinct(build_tables(collect(tmp_path))))
    assert curve.optimised.x == (0, 2)
    (axes,) = draw_steps(curve).axes
    places = axes.transData.transform([(0, 0.1), (2, 0.1)])[:, 0]
    assert np.isfinite(places).all()
    assert places[0] < places[1]
    assert axes.get_xlim()[0] < 0


def test_rows_that_differ_in_more_than_steps_are_not_joined(tmp_path: Path) -> None:
    for steps, width in ((1, 32), (2, 64)):
        settings = {"solver.steps": steps, "backbone.width": width}
        make_run(tmp_path / str(steps), "V-LSTM + EPO", "epo", scores(0.1), settings=settings)
    assert steps_curves(distinct(build_tables(collect(tmp_path)))) == []


def test_rows_with_other_seeds_are_points_of_one_curve(tmp_path: Path) -> None:
    for steps, seed in ((1, 0), (2, 7)):
        made = {"settings": {"solver.steps": steps}, "seed": seed}
        make_run(tmp_path / str(steps), "V-LSTM + EPO", "epo", scores(0.1 * steps), **made)  # type: ignore[arg-type]
    (curve,) = steps_curves(distinct(build_tables(collect(tmp_path))))
    assert (curve.optimised.x, curve.optimised.mean) == ((1, 2), (0.1, 0.2))


def test_rows_on_two_splits_have_curves_apart(tmp_path: Path) -> None:
    for steps, value in ((1, 0.3), (2, 0.2)):
        for split, more in (("test", 0.0), ("val", 0.5)):
            path, settings = tmp_path / str(steps), {"solver.steps": steps}
            make_run(path, "V-LSTM + EPO", "epo", scores(value + more), split=split, settings=settings)
    curves = steps_curves(distinct(build_tables(collect(tmp_path))))
    means = {curve.split: curve.optimised.mean for curve in curves}
    assert means == {"rpi, test split": (0.3, 0.2), "rpi, val split": (0.8, 0.7)}


def test_data_efficiency_joins_rows_that_differ_only_in_the_share_of_the_games(tmp_path: Path) -> None:
    values = {("V-LSTM + SC", None): 0.02, ("V-LSTM + SC", 0.1): 0.04, ("V-LSTM + SC", 0.01): 0.2, ("Other", 0.1): 0.5}
    for (title, share), value in values.items():
        settings = {} if share is None else {"data.games_share": share}
        for seed in range(2 if share != 0.1 else 1):
            folder = tmp_path / title / f"{share}-s{seed}"
            refines = {**settings, "forecaster.frozen": f"runs/{share}-s{seed}"}
            make_run(folder, title, "scene_consistent", scores(value + 0.01 * seed), seed=seed, settings=refines)
    wider = {"data.games_share": 0.1, "backbone.width": 256}
    make_run(tmp_path / "wide", "V-LSTM + SC", "scene_consistent", scores(0.7), settings=wider)
    tables = build_tables(collect(tmp_path))
    (entry,) = efficiencies(distinct(tables))
    assert entry.data == "rpi, test split"
    (curve,) = entry.curves
    assert (curve.name, curve.x, entry.seeds) == ("V-LSTM + SC", (0.01, 0.1, 1.0), ((2, 1, 2),))
    assert curve.mean == pytest.approx((0.205, 0.04, 0.025))
    (chart,) = (chart for chart in charts_of(tables, []) if chart.section == "Data efficiency")
    assert chart.numbers[0] == ("V-LSTM + SC", "1 %", "2", "0.20500")
    drawn = lines(draw_efficiency(entry.curves))
    assert drawn == {"row0-line": list(zip(curve.x, curve.mean, strict=True))}


def test_data_efficiency_is_that_of_trained_rows_on_one_split(tmp_path: Path) -> None:
    for share, value in ((0.1, 0.4), (1.0, 0.2)):
        settings = {"data.games_share": share}
        for split, more in (("test", 0.0), ("val", 0.5)):
            path = tmp_path / f"sc-{share}"
            make_run(path, "SC", "scene_consistent", scores(value + more), split=split, settings=settings)
        make_run(tmp_path / f"cv-{share}", "CV", "constant_velocity", scores(0.9), settings=settings)
    found = efficiencies(distinct(build_tables(collect(tmp_path))))
    means = {entry.data: [(curve.name, curve.mean) for curve in entry.curves] for entry in found}
    assert means == {"rpi, test split": [("SC", (0.4, 0.2))], "rpi, val split": [("SC", (0.9, 0.7))]}


def test_the_heat_map_shows_every_timing_and_the_papers(tmp_path: Path) -> None:
    over_runtime(tmp_path)
    timed(tmp_path, 4, None, 4, 0.0009)
    timings, notes = read_timings(find_runs(tmp_path))
    assert notes == []
    assert len(timings) == 25
    ((where, members),) = places(timings).items()
    assert where == "rpi, v_lstm, A <fast> CPU (cpu, 1 thread)"
    modes, seconds = grid(members)
    assert modes == 4
    assert len(seconds) == 21
    figure = heat_map(seconds, RUNTIME)
    mesh = figure.axes[0].collections[0].get_array()
    assert mesh.shape == (6, 4)  # S = none, 1, 2, 4, 8, 12 downwards; N = 2, 4, 8, 12
    assert mesh[0, 1] == 0.0009
    assert mesh.mask[0].tolist() == [True, False, True, True]
    for row, steps in enumerate((1, 2, 4, 8, 12), 1):
        for column, agents in enumerate((2, 4, 8, 12)):
            assert mesh[row, column] == seconds[agents, steps]
    by_id = {text.get_gid(): text.get_text() for text in figure.findobj(Text) if text.get_gid()}
    assert by_id["keep-12-8"] == time_text(seconds[12, 8])
    assert by_id["keep-12-8-paper"] == f"paper {time_text(RUNTIME[12, 8])}" == "paper 320 ms"
    assert "keep-4-None-paper" not in by_id


def test_timings_are_listed_in_a_table(tmp_path: Path) -> None:
    timed(tmp_path, 12, 8, 4, 0.0076)
    timed(tmp_path, 4, 2, 1, 0.003)
    timed(tmp_path, 4, None, 1, 0.0009)
    sheet = timing_sheet("here", read_timings(find_runs(tmp_path))[0])
    assert sheet.header[:4] == ("method", "N", "S", "M")
    assert [(*line[:5], line[-1]) for line in sheet.lines] == [
        ("N4-SNone-M1", "4", "-", "1", "900 µs", ""),
        ("N4-S2-M1", "4", "2", "1", "3.0 ms", "170 ms"),
        ("N12-S8-M4", "12", "8", "4", "7.6 ms", "320 ms"),
    ]
    assert timing_sheet("here", read_timings(find_runs(tmp_path / "N4-S2-M1"))[0]).header[0] == "N"  # one method


def test_runtime_over_modes_shows_ours_and_the_papers(tmp_path: Path) -> None:
    over_runtime(tmp_path)
    timings, _ = read_timings(find_runs(tmp_path))
    key, seconds = over_modes(timings)
    assert key == (4, 2)
    assert list(seconds) == [1, 2, 4, 8, 12]
    drawn = lines(draw_modes(seconds, RUNTIME_MODES))
    assert drawn["row0-line"] == list(seconds.items())
    assert drawn["row1-line"] == list(RUNTIME_MODES.items())


def test_seeds_of_a_timing_are_averaged_and_machines_kept_apart(tmp_path: Path) -> None:
    timed(tmp_path / "a", 2, 1, 4, 0.001)
    timed(tmp_path / "b", 2, 1, 4, 0.003)
    timed(tmp_path / "c", 2, 1, 4, 0.5, machine="Slow")
    found = places(read_timings(find_runs(tmp_path))[0])
    assert [grid(members)[1] for members in found.values()] == [{(2, 1): pytest.approx(0.002)}, {(2, 1): 0.5}]


@pytest.mark.parametrize(
    "changes", [{"seconds": {"mean": -1}}, {"samples": None}, {"seconds": None}, {"threads": "many"}]
)
def test_a_damaged_timing_gives_a_note(tmp_path: Path, changes: dict[str, object]) -> None:
    run = timed(tmp_path, 2, 1, 4, 0.001, **changes)
    timings, (note,) = read_timings([run])
    assert timings == []
    assert note.startswith(f"{run.path}/runtime.json is not what `score=time` writes")


def test_times_have_two_digits_and_a_unit() -> None:
    values = (12.3, 1.04, 0.9996, 0.17, 0.0099, 0.00123, 0.000046, 2e-7)
    assert [time_text(value) for value in values] == [
        *("12 s", "1.0 s", "1.0 s", "170 ms", "9.9 ms", "1.2 ms", "46 µs", "0.2 µs"),
    ]


def test_charts_come_with_legends_and_numbers(tmp_path: Path) -> None:
    for make in (rows_with_seeds, over_steps, over_runtime):
        make(tmp_path / make.__name__)
    tables = build_tables(collect(tmp_path))
    timings, _ = read_timings(find_runs(tmp_path))
    charts = {chart.name: chart for chart in charts_of(tables, timings)}
    assert list(charts) == ["learning_curves", "steps", "runtime", "runtime_modes"]
    assert [key.label for key in charts["learning_curves"].legend] == ["V-LSTM", "V-LSTM + SC", "V-LSTM + EPO"]
    assert charts["learning_curves"].numbers[2] == ("V-LSTM + EPO", "3", "1000", "0.0640", "0.0640", "1000")
    assert charts["steps"].numbers[0] == ("1", "2", "0.0610", "0.0700")
    assert len(charts["runtime"].numbers) == 24
    for chart in charts.values():
        drawn = chart.draw(chart.wide, False)
        gids = [f"row{i}-line" for i in range(len(chart.legend))]
        assert [line.get_gid() for line in drawn.axes[0].lines] == gids
        assert "legend" not in str(drawn.get_children()).lower()
    made = {row.name: row for row in how_made(tables, timings)}
    assert made["V-LSTM"].seeds == "0, 1, 2"
    assert made["N2-S1-M4"].runs[0].command == "epo train experiment=None seed=0"


def test_svg_drawings_have_unique_ids_and_no_style_sheet() -> None:
    curve = Curve("a", (1, 2), (0.5, 0.4), (0.4, 0.3), (0.6, 0.5), 2)
    drawing, again = (svg(draw_learning([curve], legend=False), "name") for _ in range(2))
    assert drawing == again
    ids = re.findall(r'\bid="([^"]*)"', drawing)
    assert len(ids) == len(set(ids))
    assert all(name.startswith("name-") for name in ids)
    assert {"name-row0-line", "name-row0-band"} <= set(ids)
    assert set(re.findall(r'url\(#([^)]*)\)|href="#([^"]*)"', drawing)) <= {
        (a, b) for a in [*ids, ""] for b in [*ids, ""]
    }
    assert "<style" not in drawing
    assert "font-family" not in drawing
    assert "training steps</text>" in drawing


def test_labels_do_not_overlap() -> None:
    seconds = {(n, s): 0.0123 * n * (s or 1) for n in (2, 4, 8, 12) for s in (None, 1, 2, 4, 8, 12)}
    for figure in (
        heat_map(seconds, RUNTIME, size=(4.0, 4.4)),
        heat_map({(2, 1): 0.1, (4, 1): 0.2}, RUNTIME, size=(4.0, 4.4)),
    ):
        svg(figure, "laid-out")  # drawing lays out
        boxes = [text.get_window_extent() for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        edges = figure.bbox
        for i, one in enumerate(boxes):
            assert one.x0 >= edges.x0 - 1
            assert one.x1 <= edges.x1 + 1
            assert not any(one.overlaps(other) for other in boxes[i + 1 :])
    assert np.isfinite([box.x0 for box in boxes]).all()


@pytest.mark.parametrize("players", ["potential", "feedback_converged"])
def test_the_figure_over_s_has_the_papers_curve_for_every_kind_of_players(tmp_path: Path, players: str) -> None:
    for steps in (1, 2):
        settings = {"data.solver": players, "solver.steps": steps}
        make_run(tmp_path / str(steps), "V-LSTM + EPO", "epo", scores(0.1), settings=settings)
    (curve,) = steps_curves(distinct(build_tables(collect(tmp_path))))
    assert curve.paper


def test_long_names_of_data_sets_give_short_and_different_file_names() -> None:
    names = [_word(f"square, test {', '.join(f'group{i}' for i in range(100))}, {last}") for last in "ab"]
    assert names[0] != names[1]
    assert max(map(len, names)) < 60
