"""Panels of traffic and their animation: forecasts, headings, colours and the clock are those of scene and forecast."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from epo_lightning.report import animation
from epo_lightning.report import scenes as pictures
from epo_lightning.report.animation import animate
from epo_lightning.report.scenes import draw
from epo_lightning.report.style import HISTORY, TRUTH, VEHICLES

from .traffic_scenes import DT, SIZES, boxes, forecast, short, traffic


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that would be saved."""
    figures: list[Figure] = []

    def keep(figure: Figure, path: str | Path) -> Path:
        figures.append(figure)
        return Path(path)

    monkeypatch.setattr(pictures, "save", keep)
    return figures


def tracks(axes: Axes, width: float) -> list[tuple[np.ndarray, list[str]]]:
    """Positions and colours of the trajectories of one width that have any segment: forecasts are broader than motions."""
    found = []
    for lines in axes.collections:
        assert isinstance(lines, LineCollection)
        segments = np.array(lines.get_segments())
        if lines.get_linewidths()[0] == width and len(segments):
            colors = [to_hex(color) for color in lines.get_colors()]
            found.append((np.concatenate([segments[:1, 0], segments[:, 1]]), colors))
    return found


MOTION, FORECAST = 1.0, 3.0
"""Widths of the lines of observed motions and of forecasts."""


def whiteness(color: str) -> int:
    """Sum of red, green and blue of a colour."""
    return sum(bytes.fromhex(color[1:]))


def test_every_panel_has_the_trajectories_of_its_mode_in_the_colours_of_the_agents(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    scene = traffic()
    assert scene.future is not None
    predicted = forecast(scene)
    draw(scene, predicted, tmp_path / "scene.png")
    centre = scene.current[0, :, :2].numpy().mean(0)
    observed = torch.cat([scene.history, scene.future], dim=2)[0, ..., :2].numpy() - centre
    for mode, axes in zip((2, 1, 0), drawn[0].axes, strict=True):  # the most likely one first
        ahead = np.concatenate([scene.current[0, :, None], predicted.states[0, mode].numpy()], axis=1)[..., :2] - centre
        for i, (positions, colors) in enumerate(tracks(axes, FORECAST)):
            np.testing.assert_allclose(positions, ahead[i], atol=1e-4)
            assert colors[-1] == VEHICLES[i].lower()
            assert whiteness(colors[0]) > whiteness(colors[len(colors) // 2]) > whiteness(colors[-1])
        assert len(tracks(axes, FORECAST)) == 4
        for i, (positions, colors) in enumerate(tracks(axes, MOTION)):
            np.testing.assert_allclose(positions, observed[i], atol=1e-4)
            assert (colors[0], colors[-1]) == (HISTORY.lower(), TRUTH.lower())
        assert len(tracks(axes, MOTION)) == 4


def test_the_legend_has_the_colours_of_the_vehicles(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    draw(scene, forecast(scene), tmp_path / "scene.png")
    (figure,) = drawn
    entries = {
        text.get_text(): handle
        for legend in figure.legends
        for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True)
        if isinstance(handle, Line2D)
    }
    for i, name in enumerate(("1 car", "2 van", "3 truck", "4 car")):
        color = str(entries[name].get_markerfacecolor())
        assert color == VEHICLES[i]
        (corners,) = boxes(figure.axes[0], color)
        np.testing.assert_allclose(np.ptp(corners, axis=0), SIZES[i], rtol=1e-5)
    assert (entries["history"].get_color(), entries["ground truth"].get_color()) == (HISTORY, TRUTH)


def test_vehicles_point_where_they_head(tmp_path: Path, drawn: list[Figure]) -> None:
    """Two vehicles of equal speed head 0.3 rad to the left and to the right, so that the road stays where it is."""
    scene = traffic()
    headings = (0.0, -0.3, 0.3, 0.0)
    scene.history[0, :, -1, 2] = torch.tensor(headings)
    scene.history[0, 1:3, -1, 3] = 30.0
    predicted = forecast(scene)
    predicted.states[0, 2, 0, -1, 2] = 0.2
    draw(scene, predicted, tmp_path / "scene.png")
    axes = drawn[0].axes[0]
    centre = scene.current[0, :, :2].numpy().mean(0)
    for i, heading in enumerate(headings):
        length, width = SIZES[i].tolist()
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
        expected = scene.current[0, i, :2].numpy() - centre + square @ turn.T
        (corners,) = boxes(axes, VEHICLES[i])
        distances = np.linalg.norm(corners[:, None] - expected[None], axis=-1)
        assert distances.min(0).max() < 1e-3
        assert distances.min(1).max() < 1e-3
    fronts = [p.get_xy()[:-1] for p in axes.patches if isinstance(p, Polygon) and len(p.get_xy()) == 4]
    tips = [front[0] - front[1:].mean(0) for front in fronts]
    pointing = sorted(round(float(np.arctan2(tip[1], tip[0])), 3) for tip in tips)
    ends = (0.2, *headings[1:])
    assert pointing == sorted(headings + ends), "at t0, and where the forecasts end"


def test_the_clock_and_the_trajectories_of_an_animation_follow_its_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = short()
    assert scene.future is not None
    predicted = forecast(scene)
    shown: dict[float, tuple[str, str, list[np.ndarray], list[tuple[np.ndarray, list[str]]]]] = {}
    original = animation._moving

    def moving(axes: Axes, *rest: object) -> Iterator[float]:
        for time in original(axes, *rest):
            observed = [positions for positions, _ in tracks(axes, MOTION)]
            clock, title = axes.get_title(loc="right"), axes.get_title(loc="left")
            shown[round(time, 3)] = clock, title, observed, tracks(axes, FORECAST)
            yield time

    monkeypatch.setattr(animation, "_moving", moving)
    monkeypatch.setattr(animation, "write_gif", lambda figure, frames, seconds, path: path.write_text(f"{[*frames]}"))
    animate(scene, predicted, tmp_path / "scene.gif", "EPO")
    assert list(shown) == pytest.approx(np.arange(-0.4, 1.25, DT / 2))
    centre = scene.current[0, :, :2].numpy().mean(0)
    known = torch.cat([scene.history, scene.future], dim=2)[0, ..., :2].numpy() - centre
    ahead = np.concatenate([scene.current[0, :, None], predicted.states[0, 2].numpy()], axis=1)[..., :2] - centre
    for time, (clock, title, observed, forecasts) in shown.items():
        assert (clock, title) == (f"t = {time:+.1f} s", "EPO,  p = 0.50")
        step = time / DT
        if step != round(step):
            continue
        assert len(observed) == (0 if step == -2 else 4)
        for i, positions in enumerate(observed):
            np.testing.assert_allclose(positions, known[i, : round(step) + 3], atol=1e-4)
        assert len(forecasts) == (0 if step <= 0 else 4)
        for i, (positions, colors) in enumerate(forecasts):
            np.testing.assert_allclose(positions, ahead[i, : round(step) + 1], atol=1e-4)
            assert whiteness(colors[-1]) >= whiteness(VEHICLES[i])
            assert step < 6 or colors[-1] == VEHICLES[i].lower()
