"""Pictures of traffic: scale, positions, independence of the recording's frame, and notes on omitted content."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon
from PIL import Image
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.report import scenes as pictures
from epo_lightning.report.scene_view import LONGEST
from epo_lightning.report.scenes import draw, draw_rows
from epo_lightning.report.style import TRUTH, VEHICLES
from epo_lightning.scene import KINDS, Scene

from .traffic_scenes import DT, HISTORY, LANE, SIZES, STEPS, boxes, forecast, road, states, traffic


def moved(values: Tensor, angle: float, shift: tuple[float, float]) -> Tensor:
    """Positions in the first two entries, turned and shifted; a heading in the third."""
    cos, sin = np.cos(angle), np.sin(angle)
    values = values.double().clone()
    x, y = values[..., 0].clone(), values[..., 1].clone()
    values[..., 0], values[..., 1] = cos * x - sin * y + shift[0], sin * x + cos * y + shift[1]
    if values.shape[-1] > 2:
        values[..., 2] += angle
    return values


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are saved, as they were."""
    figures: list[Figure] = []
    original = pictures.save

    def save(figure: Figure, path: str | Path) -> Path:
        figures.append(figure)
        return original(figure, path)

    monkeypatch.setattr(pictures, "save", save)
    return figures


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"))


def test_a_panel_for_each_mode_the_most_likely_first(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    path = draw(scene, forecast(scene), tmp_path / "deep" / "scene.png", "EPO, scene 3")
    assert min(pixels(path).shape[:2]) > 300
    (figure,) = drawn
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["mode 3,  p = 0.50", "mode 2,  p = 0.33", "mode 1,  p = 0.17"]
    assert figure.axes[-1].get_xlabel() == "along the road [m]"
    assert "EPO, scene 3" in [text.get_text() for text in figure.texts]
    labels = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert labels == {"history", "ground truth", "forecast", "goal", "1 car", "2 van", "3 truck", "4 car"}


def test_vehicles_stand_to_scale_where_they_are(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    predicted = forecast(scene)
    draw(scene, predicted, tmp_path / "scene.png")
    (axes, *_) = drawn[0].axes
    centre = scene.current[0, :, :2].numpy().mean(0)
    for i in range(4):
        (corners,) = boxes(axes, VEHICLES[i])
        np.testing.assert_allclose(corners.mean(0), scene.current[0, i, :2].numpy() - centre, atol=1e-4)
        np.testing.assert_allclose(np.ptp(corners, axis=0), SIZES[i], rtol=1e-5)
    ends = np.stack([corners.mean(0) for corners in boxes(axes, TRUTH, filled=False)])
    np.testing.assert_allclose(ends, scene.future[0, :, -1, :2].numpy() - centre, atol=1e-4)
    fronts = [p.get_xy()[:-1] for p in axes.patches if isinstance(p, Polygon) and len(p.get_xy()) == 4]
    assert len(fronts) == 8  # at t0 and where the forecast ends
    for front in fronts:
        assert front[0, 0] == front[:, 0].max()  # the tip points ahead
    stars = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "*"]
    np.testing.assert_allclose(stars, predicted.parameters.goals[0, 2].numpy() - centre, atol=1e-4)
    across, up = np.diff(axes.transData.transform([(0, 0), (1, 0), (0, 1)])[[0, 1, 0, 2]].reshape(2, 2, 2), axis=1)[
        :, 0
    ]
    assert across[0] == pytest.approx(up[1])


def test_the_picture_does_not_depend_on_the_frame_of_the_recording(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    predicted = forecast(scene)
    angle, shift = 2.4, (512.0, -77.0)

    def turn(values: Tensor) -> Tensor:
        return moved(values, angle, shift)

    lanes = torch.cat([turn(scene.lanes[..., :2]), turn(scene.lanes[..., 2:])], -1)
    elsewhere = dataclasses.replace(scene, history=turn(scene.history), future=turn(scene.future), lanes=lanes)
    game = dataclasses.replace(predicted.parameters, goals=turn(predicted.parameters.goals))
    there = dataclasses.replace(predicted, states=turn(predicted.states), parameters=game)
    draw(scene, predicted, tmp_path / "here.png")
    draw(elsewhere, there, tmp_path / "there.png")
    for one, other in zip(drawn[0].axes, drawn[1].axes, strict=True):
        np.testing.assert_allclose(one.get_xlim() + one.get_ylim(), other.get_xlim() + other.get_ylim(), atol=1e-3)
        for color in VEHICLES[:4]:
            np.testing.assert_allclose(boxes(one, color), boxes(other, color), atol=1e-3)
        for first, second in zip(one.lines, other.lines, strict=True):
            np.testing.assert_allclose(first.get_xydata(), second.get_xydata(), atol=1e-3)


def test_oncoming_traffic_does_not_turn_the_picture(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    scene.history[0, 1, :, 2] = torch.pi
    draw(scene, forecast(scene), tmp_path / "scene.png")
    (corners,) = boxes(drawn[0].axes[0], VEHICLES[2])
    np.testing.assert_allclose(np.ptp(corners, axis=0), SIZES[2], rtol=1e-5)


def test_only_lanes_within_the_picture_are_drawn(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    draw(scene, forecast(scene), tmp_path / "scene.png")
    (axes, *_) = drawn[0].axes
    bands = [patch.get_path().get_extents() for patch in axes.patches if isinstance(patch, PathPatch)]
    middle = float(scene.current[0, :, 1].mean())
    assert sorted((band.y0 + band.y1) / 2 for band in bands) == pytest.approx(
        [LANE * k - middle for k in (-1, 0, 1)], abs=0.01
    )
    assert all(band.x0 <= axes.get_xlim()[0] and band.x1 >= axes.get_xlim()[1] for band in bands)
    without = dataclasses.replace(scene, lanes=None, lane_mask=None)
    draw(without, forecast(scene), tmp_path / "without.png")
    assert not [patch for patch in drawn[1].axes[0].patches if isinstance(patch, PathPatch)]


def test_equal_forecasts_give_equal_bytes_and_others_do_not(tmp_path: Path) -> None:
    scene, size = traffic(), mpl.rcParams["font.size"]
    predicted = forecast(scene)
    first, second = (draw(scene, predicted, tmp_path / name) for name in ("a.png", "b.png"))
    assert first.read_bytes() == second.read_bytes()
    states = predicted.states.clone()
    states[:, 1, 2, 5:, 1] += 1.0
    other = draw(scene, dataclasses.replace(predicted, states=states), tmp_path / "c.png")
    assert pixels(other).shape == pixels(first).shape
    assert not np.array_equal(pixels(other), pixels(first))
    assert mpl.rcParams["font.size"] == size
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png", "c.png"]


def test_masked_values_are_not_drawn(tmp_path: Path) -> None:
    written = []
    for garbage in (torch.nan, 1e9):
        scene = traffic()
        absent = torch.tensor([[False, True, False, False]])
        unseen = torch.zeros(1, 4, STEPS, dtype=torch.bool)
        unseen[0, 0, :4] = unseen[0, 2, HISTORY + 5 : HISTORY + 8] = unseen[0, 3, HISTORY + 12 :] = True
        hidden = torch.zeros(scene.lanes.shape[:3], dtype=torch.bool)
        hidden[0, 0, ::2] = True
        predicted = forecast(scene)
        predicted.states[0, :, 1] = predicted.parameters.goals[0, :, 1] = garbage
        masked = dataclasses.replace(
            scene,
            agent_mask=~absent,
            history=scene.history.masked_fill((unseen[..., :HISTORY] | absent[..., None])[..., None], garbage),
            history_mask=~unseen[..., :HISTORY],
            future=scene.future.masked_fill((unseen[..., HISTORY:] | absent[..., None])[..., None], garbage),
            future_mask=~unseen[..., HISTORY:],
            size=scene.size.masked_fill(absent[..., None], garbage),
            lanes=scene.lanes.masked_fill(hidden[..., None], garbage),
            lane_mask=~hidden,
        )
        written.append(draw(masked, predicted, tmp_path / "masked.png").read_bytes())
    assert written[0] == written[1]
    assert written[0] != draw(traffic(), forecast(traffic()), tmp_path / "whole.png").read_bytes()


def test_unobserved_steps_are_gaps(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    scene.future_mask[0, 2, 5:8] = False
    scene.future_mask[0, 3, 12:] = False
    scene.future_mask[0, 1] = False
    draw(scene, forecast(scene), tmp_path / "scene.png")
    (axes, *_) = drawn[0].axes
    lines = [c.get_segments() for c in axes.collections if to_hex(c.get_colors()[-1]) == TRUTH.lower()]
    assert [len(lines[0]), len(lines[1])] == [STEPS - 1, STEPS - 1 - 4]
    ends = np.stack([corners.mean(0) for corners in boxes(axes, TRUTH, filled=False)])
    centre = scene.current[0, :, :2].mean(0)
    last = torch.stack([scene.future[0, 0, -1], scene.future[0, 2, -1], scene.future[0, 3, 11]])[:, :2]
    np.testing.assert_allclose(ends, last - centre, atol=1e-4)


def test_a_forecast_that_is_not_finite_is_noted_in_its_panel(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    predicted = forecast(scene)
    predicted.states[0, 2, 1, 3] = torch.nan
    predicted.states[0, 1] = torch.inf
    predicted.parameters.goals[0, 2, 1] = torch.nan
    pixels(draw(scene, predicted, tmp_path / "scene.png"))
    notes = [axes.get_title(loc="right") for axes in drawn[0].axes]
    assert notes == ["not finite: 2 van", "the forecast is not finite", ""]
    nothing = dataclasses.replace(
        predicted, states=predicted.states * torch.nan, probabilities=torch.full((1, 3), torch.nan)
    )
    pixels(draw(scene, nothing, tmp_path / "nothing.png"))
    assert all(np.isfinite(axes.get_xlim() + axes.get_ylim()).all() for axes in drawn[1].axes)


def test_a_diverging_forecast_does_not_enlarge_the_picture(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    predicted = forecast(scene)
    predicted.states[0, 0, 1] *= 1e7
    path = draw(scene, predicted, tmp_path / "scene.png")
    axes = drawn[0].axes[0]
    assert np.ptp(axes.get_xlim()) <= LONGEST
    assert np.ptp(axes.get_ylim()) < 60
    assert max(pixels(path).shape) < 3000


def test_a_scene_without_future_map_and_sizes_is_drawn(tmp_path: Path, drawn: list[Figure]) -> None:
    bare = Scene(traffic().history, DT)
    predicted = JointForecast(forecast(traffic(), modes=1).states, torch.ones(1, 1))
    pixels(draw(bare, predicted, tmp_path / "scene.png"))
    (axes,) = drawn[0].axes
    assert axes.get_title(loc="left") == "mode 1,  p = 1.00"
    assert not boxes(axes, TRUTH, filled=False)
    labels = {text.get_text() for legend in drawn[0].legends for text in legend.get_texts()}
    assert labels == {"history", "forecast", *(f"agent {i}" for i in range(1, 5))}


def test_pedestrians_are_discs_in_their_own_frame(tmp_path: Path, drawn: list[Figure]) -> None:
    walking = states(torch.tensor([0.0, 2.0]), torch.tensor([1.2, -1.0]), torch.tensor([0.0, 1.0]))
    walking = torch.stack([walking[..., 1], walking[..., 0], walking[..., 2] + torch.pi / 2, walking[..., 3]], -1)
    scene = Scene(
        walking[:, :, :HISTORY],
        DT,
        future=walking[:, :, HISTORY:],
        size=torch.full((1, 2, 2), 0.5),
        kind=torch.full((1, 2), KINDS.index("pedestrian")),
    )
    draw(scene, forecast(scene), tmp_path / "scene.png")
    axes = drawn[0].axes[-1]
    assert axes.get_xlabel() == "x [m]"
    for i in range(2):
        (ring,) = boxes(axes, VEHICLES[i])
        here = scene.current[0, i, :2].numpy()
        np.testing.assert_allclose(np.linalg.norm(ring - here, axis=1), 0.25, rtol=1e-5)


def test_many_agents_and_modes_fit_into_the_picture(tmp_path: Path, drawn: list[Figure]) -> None:
    many = 32
    places = torch.linspace(-300, 300, many)
    track = states(places, torch.full((many,), 25.0), LANE * (torch.arange(many) % 3 - 1))
    scene = Scene(
        track[:, :, :HISTORY], DT, future=track[:, :, HISTORY:], size=SIZES[:1].expand(1, many, 2), lanes=road()
    )
    path = draw(scene, forecast(scene, modes=9), tmp_path / "scene.png")
    assert len(drawn[0].axes) == 6
    assert "the 6 most likely of 9 modes" in [text.get_text() for text in drawn[0].texts]
    axes = drawn[0].axes[0]
    assert np.ptp(axes.get_xlim()) == pytest.approx(LONGEST)
    inside = int(((places >= axes.get_xlim()[0]) & (places <= axes.get_xlim()[1])).sum())
    assert axes.get_title(loc="right") == f"{many - inside} agents farther away"
    assert not any("agent" in text.get_text() for legend in drawn[0].legends for text in legend.get_texts())
    assert max(pixels(path).shape) < 3000


def test_a_comparison_has_a_panel_for_each_forecaster(tmp_path: Path, drawn: list[Figure]) -> None:
    scene = traffic()
    row = forecast(scene)
    constant = JointForecast(row.states[:, :1], torch.ones(1, 1))
    path = draw_rows(scene, {"Constant velocity": constant, "EPO": row}, tmp_path / "rows.png")
    assert [a.get_title(loc="left") for a in drawn[0].axes] == ["Constant velocity,  p = 1.00", "EPO,  p = 0.50"]
    ends = []
    for axes in drawn[0].axes:
        light = [p for p in axes.patches if isinstance(p, Polygon) and 0 < p.get_facecolor()[3] < 1]
        ends.append(light[0].get_xy()[:-1].mean(0))
    offset = (row.states[0, 2, 0, -1, :2] - row.states[0, 0, 0, -1, :2]).numpy()
    np.testing.assert_allclose(ends[1] - ends[0], offset, atol=1e-4)
    assert pixels(path).shape[0] > 300


def test_missing_forecasts_several_scenes_and_absent_agents_are_refused(tmp_path: Path) -> None:
    scene = traffic()
    predicted = forecast(scene)
    with pytest.raises(ValueError, match="without forecasts"):
        draw_rows(scene, {}, tmp_path / "no.png")
    with pytest.raises(ValueError, match="one scene, not 2"):
        draw(scene[[0, 0]], predicted[[0, 0]], tmp_path / "no.png")
    nobody = dataclasses.replace(scene, agent_mask=torch.zeros(1, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match="without an observed agent"):
        draw(nobody, predicted, tmp_path / "no.png")
    assert list(tmp_path.iterdir()) == []


def test_a_picture_is_a_png_of_one_scene(tmp_path: Path) -> None:
    scene = traffic()
    with pytest.raises(ValueError, match=r"scene\.gif: a picture is written as a PNG"):
        draw(scene, forecast(scene), tmp_path / "scene.gif")
    for rows in ([], [0, 0]):
        with pytest.raises(ValueError, match=f"a picture shows one scene, not {len(rows)}"):
            draw(scene[rows], forecast(scene)[rows], tmp_path / "scene.png")
    assert not list(tmp_path.iterdir())
