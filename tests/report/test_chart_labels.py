"""Charts as they are read: legends, colours, ticks, captions and tables name the values that are drawn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text

from epo_lightning.report.charts import Chart, charts_of
from epo_lightning.report.paper import RUNTIME_MODES, STEPS
from epo_lightning.report.runs import collect, find_runs
from epo_lightning.report.runtime import heat_map
from epo_lightning.report.tables import build_tables
from epo_lightning.report.timings import read_timings, timing_sheet

from .page_runs import over_runtime, over_steps, rows_with_seeds, timed, write_log
from .run_folders import make_run, scores

SHARES = {"V-LSTM": {0.01: 0.4, 0.1: 0.2, 1.0: 0.05}, "V-LSTM + SC": {0.01: 0.3, 0.1: 0.09, 1.0: 0.02}}
"""minSADE by row and share of the training games."""
FORECASTERS = {"V-LSTM": "marginal", "V-LSTM + SC": "scene_consistent"}
LINES = ("learning_curves", "steps", "data_efficiency", "runtime_modes")


def made(folder: Path) -> list[Chart]:
    """All charts of the runs in a folder."""
    return charts_of(build_tables(collect(folder)), read_timings(find_runs(folder))[0])


@pytest.fixture(scope="module")
def charts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Chart]:
    folder = tmp_path_factory.mktemp("runs")
    for make in (rows_with_seeds, over_steps, over_runtime):
        make(folder / "rows" / make.__name__)
    for title, shares in SHARES.items():
        for share, value in shares.items():
            settings = {} if share == 1.0 else {"data.games_share": share}
            path = folder / "shares" / title / str(share)
            make_run(path, title, FORECASTERS[title], scores(value), settings=settings)
    return {chart.name: chart for name in ("rows", "shares") for chart in made(folder / name)}


def values(name: str) -> dict[str, dict[float, float]]:
    """The values of every line of a chart, computed from what the runs were made of."""
    epochs = range(1, 11)
    best = {"V-LSTM": 0.13, "V-LSTM + SC": 0.05, "V-LSTM + EPO": 0.03}
    grid = 0.0002 * 4 * 2**0.8 + 0.001  # N = 4, S = 2, M = 4
    return {
        "learning_curves": {
            row: {100.0 * epoch: score * (1 + 8 / epoch) + 0.01 for epoch in epochs} for row, score in best.items()
        },
        "steps": {
            "optimised": {1: 0.061, 2: 0.051, 4: 0.041, 8: 0.04},
            "initial": {1: 0.07, 2: 0.08, 4: 0.09, 8: 0.1},
            "paper, optimised": {steps: paper["minSADE"] for steps, paper in STEPS.items()},
            "paper, initial": {steps: paper["initial/minSADE"] for steps, paper in STEPS.items()},
        },
        "data_efficiency": SHARES,
        "runtime_modes": {
            "here": {modes: grid if modes == 4 else 0.002 + 0.0001 * modes for modes in (1, 2, 4, 8, 12)},
            "paper": dict(RUNTIME_MODES),
        },
    }[name]


def looks(line: Line2D) -> tuple[str, bool]:
    """Colour of a line, and whether it is dashed."""
    return str(line.get_color()), line.get_linestyle() != "-"


@pytest.mark.parametrize("name", LINES)
def test_the_line_that_looks_like_an_entry_of_the_legend_has_its_values(charts: dict[str, Chart], name: str) -> None:
    chart, expected = charts[name], values(name)
    figure = chart.draw(chart.wide, True)
    (legend,) = figure.legends
    labels = [text.get_text() for text in legend.get_texts()]
    entries = [handle for handle in legend.legend_handles if isinstance(handle, Line2D)]
    assert [(label, *looks(entry)) for label, entry in zip(labels, entries, strict=True)] == [
        (key.label, key.color, key.dashed) for key in chart.legend
    ], "the page has the legend of the figure"
    assert labels == list(expected)
    for i, (label, entry) in enumerate(zip(labels, entries, strict=True)):
        (line,) = (line for line in figure.axes[0].lines if looks(line) == looks(entry))
        assert line.get_gid() == f"row{i}-line"
        assert dict(zip(line.get_xdata(), line.get_ydata(), strict=True)) == pytest.approx(expected[label])
        for band in figure.axes[0].collections:
            if band.get_gid() == f"row{i}-band":
                assert to_hex(band.get_facecolor()[0]) == to_hex(line.get_color())


def seconds(text: str) -> float:
    """The number of seconds that a time like ``3.0 ms`` stands for."""
    number, unit = text.split(" ")
    return float(number) * {"s": 1.0, "ms": 1e-3, "µs": 1e-6}[unit]


@pytest.mark.parametrize(
    ("name", "titles", "read_x", "read_y"),
    [
        ("learning_curves", ("training steps", "minSADE, validation [m]"), float, float),
        ("steps", ("optimisation steps S", "minSADE [m]"), float, float),
        (
            "data_efficiency",
            ("share of the training games", "minSADE [m]"),
            lambda text: float(text.removesuffix(" %")) / 100,
            float,
        ),
        ("runtime_modes", ("modes M", "runtime"), float, seconds),
    ],
)
def test_the_numbers_at_the_axes_are_those_of_their_places(
    charts: dict[str, Chart],
    name: str,
    titles: tuple[str, str],
    read_x: Callable[[str], float],
    read_y: Callable[[str], float],
) -> None:
    chart = charts[name]
    (axes,) = chart.draw(chart.wide, False).axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == titles
    for axis, read, (low, high) in ((axes.xaxis, read_x, axes.get_xlim()), (axes.yaxis, read_y, axes.get_ylim())):
        ticks = zip(axis.get_majorticklocs(), axis.get_ticklabels(), strict=True)
        shown = {float(place): label.get_text() for place, label in ticks if low <= place <= high}
        assert len(shown) > 1
        assert [read(text) for text in shown.values()] == pytest.approx(list(shown))


def test_a_time_of_the_heat_map_stands_at_its_agents_and_steps() -> None:
    texts = {
        **{(2, None): (0.0021, "2.1 ms"), (4, None): (0.0044, "4.4 ms"), (12, None): (0.012, "12 ms")},
        **{(4, 1): (0.11, "110 ms"), (12, 1): (0.13, "130 ms")},
        **{(2, 8): (0.82, "820 ms"), (4, 8): (0.84, "840 ms"), (12, 8): (1.2, "1.2 s")},
    }
    times = {sizes: value for sizes, (value, _) in texts.items()}
    figure = heat_map(times, {(4, 8): 0.25})
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("agents N", "optimisation steps S")
    columns = dict(zip(axes.get_xticks(), (label.get_text() for label in axes.get_xticklabels()), strict=True))
    rows = dict(zip(axes.get_yticks(), (label.get_text() for label in axes.get_yticklabels()), strict=True))
    shown = {}
    for text in figure.findobj(Text):
        if str(text.get_gid()).startswith("keep"):
            x, y = text.xy if isinstance(text, Annotation) else text.get_position()
            shown[columns[x], rows[y], text.get_text().startswith("paper")] = text.get_text()
    expected = {(str(n), "no game" if s is None else str(s), False): text for (n, s), (_, text) in texts.items()}
    assert shown == {**expected, ("4", "8", True): "paper 250 ms"}
    mesh = axes.collections[0].get_array()
    for i, x in enumerate(columns.values()):
        for j, y in enumerate(rows.values()):
            key = (int(x), None if y == "no game" else int(y))
            assert bool(mesh.mask[j, i]) == (key not in times)
            assert key not in times or mesh[j, i] == times[key]


def test_the_best_score_of_a_training_is_told_with_its_step(tmp_path: Path) -> None:
    for seed, scored in enumerate(([1.0, 0.5, 0.9], [1.0, 0.3, 0.5])):
        write_log(make_run(tmp_path / str(seed), "V-LSTM", "marginal", scores(0.3), seed=seed), scored)
    (chart,) = made(tmp_path)
    assert dict(zip(chart.header, chart.numbers[0], strict=True)) == {
        "row": "V-LSTM",
        "seeds": "2",
        "last step": "300",
        "minSADE there": "0.7000",
        "smallest mean": "0.4000",
        "at step": "200",
    }


def test_mean_median_and_percentiles_of_times_stand_below_their_names(tmp_path: Path) -> None:
    measured = {"mean": 0.004, "median": 0.003, "p10": 0.002, "p90": 0.009}
    runs = [timed(tmp_path, 3, steps, 5, 0.001, seconds=measured, samples=70) for steps in (1, 6)]
    timings, _ = read_timings(runs)
    (chart,) = charts_of([], timings)
    shown = dict(zip(chart.header, chart.numbers[1], strict=True))
    assert shown.pop("run") == str(runs[1].path)
    expected = {"N": "3", "S": "6", "M": "5", "mean": "4.0 ms", "median": "3.0 ms"}
    assert shown == {**expected, "10 % to 90 %": "2.0 ms to 9.0 ms", "forecasts": "70"}
    sheet = timing_sheet("here", timings)
    listed = dict(zip(sheet.header, sheet.lines[1], strict=True))
    assert {name: listed[name] for name in expected} == expected
    assert listed["10 % to 90 %"] == "2.0 ms to 9.0 ms"
    assert listed["forecasts"] == "70"


@pytest.mark.parametrize("least", [0.0, -0.001, float("inf")])
def test_a_time_that_is_no_positive_number_is_left_out_with_a_note(least: float, tmp_path: Path) -> None:
    """A chart of times has a logarithmic axis."""
    measured = {"mean": 0.004, "median": 0.003, "p10": least, "p90": 0.009}
    timings, (note,) = read_timings([timed(tmp_path, 3, 1, 5, 0.001, seconds=measured)])
    assert timings == []
    assert "seconds must be positive numbers" in note


def test_captions_name_the_sizes_that_a_figure_does_not_vary(tmp_path: Path) -> None:
    for agents, steps, modes in ((2, 1, 3), (2, 6, 3), (5, 6, 3), (5, 6, 1)):
        timed(tmp_path, agents, steps, modes, 0.001 * agents)
    captions = {chart.name: chart.caption for chart in charts_of([], read_timings(find_runs(tmp_path))[0])}
    assert captions["runtime"].startswith("Mean time of one joint forecast with M = 3 modes.")
    assert captions["runtime_modes"] == "Mean time of one joint forecast with N = 5 agents and S = 6 steps."
