"""Animations of traffic: in real time, with every vehicle at its interpolated position."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from PIL import Image

from epo_lightning.forecast import JointForecast
from epo_lightning.registry import ConfigError
from epo_lightning.report import animation
from epo_lightning.report.animation import animate
from epo_lightning.report.style import TRUTH, VEHICLES
from epo_lightning.scene import Scene

from .traffic_scenes import DT, STEPS, boxes, forecast, short, traffic


def frames(path: Path) -> Iterator[tuple[np.ndarray, int]]:
    """Pixels and milliseconds of the frames of a GIF."""
    with Image.open(path) as image:
        assert image.format == "GIF"
        for index in range(image.n_frames):
            image.seek(index)
            yield np.asarray(image.convert("RGB")), image.info["duration"]


def test_an_animation_runs_in_real_time_and_stays_small(tmp_path: Path) -> None:
    scene = traffic()
    path = animate(scene, forecast(scene), tmp_path / "scene.gif", "EPO")
    assert path.stat().st_size < 500_000
    shown = list(frames(path))
    assert len(shown) == 2 * (STEPS - 1) + 1
    assert sum(duration for _, duration in shown[:-1]) == pytest.approx(1000 * DT * (STEPS - 1))
    assert shown[-1][1] > 1000
    assert all(not np.array_equal(one, other) for (one, _), (other, _) in pairwise(shown))


def test_an_animation_shows_its_forecast_from_t0_on(tmp_path: Path) -> None:
    scene = short()
    predicted = forecast(scene)
    path = animate(scene, predicted, tmp_path / "scene.gif")
    assert path.read_bytes() == animate(scene, predicted, tmp_path / "again.gif").read_bytes()
    states = predicted.states.clone()
    states[:, 2, 0, :, 0] -= 3.0
    other = animate(scene, dataclasses.replace(predicted, states=states), tmp_path / "other.gif")
    pairs = zip(frames(path), frames(other), strict=True)
    apart = [np.abs(one.astype(int) - two).max() > 64 for (one, _), (two, _) in pairs]
    assert apart == [False] * 5 + [True] * 12


def test_every_frame_has_vehicles_at_their_interpolated_positions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = short()
    predicted = forecast(scene)
    seen: dict[float, tuple[np.ndarray, list[np.ndarray]]] = {}
    original = animation._moving

    def moving(axes: Axes, *rest: object) -> Iterator[float]:
        for time in original(axes, *rest):
            (vehicle,) = boxes(axes, VEHICLES[0])
            seen[round(time, 3)] = vehicle.mean(0), [corners.mean(0) for corners in boxes(axes, TRUTH, filled=False)]
            yield time

    monkeypatch.setattr(animation, "_moving", moving)
    animate(scene, predicted, tmp_path / "scene.gif")
    centre = scene.current[0, :, :2].numpy().mean(0)
    for step in range(-2, 7):
        vehicle, outlines = seen[round(step * DT, 3)]
        expected = scene.history[0, 0, step - 1] if step <= 0 else predicted.states[0, 2, 0, step - 1]
        np.testing.assert_allclose(vehicle + centre, expected[:2], atol=1e-4)
        assert len(outlines) == (0 if step <= 0 else 4)
        if step > 0:
            np.testing.assert_allclose(outlines + centre, scene.future[0, :, step - 1, :2], atol=1e-4)
    between = (predicted.states[0, 2, 0, 3, :2] + predicted.states[0, 2, 0, 4, :2]) / 2
    np.testing.assert_allclose(seen[0.9][0] + centre, between, atol=1e-4)


def test_masked_values_do_not_change_an_animation(tmp_path: Path) -> None:
    written = []
    for garbage in (torch.nan, 1e9):
        scene = short()
        predicted = forecast(scene)
        scene.agent_mask[0, 1] = scene.history_mask[0, 0, 0] = scene.future_mask[0, 2, 2] = False
        scene.history[0, 1] = scene.history[0, 0, 0] = scene.future[0, 1] = scene.future[0, 2, 2] = garbage
        predicted.states[0, :, 1] = garbage
        written.append(animate(scene, predicted, tmp_path / "masked.gif").read_bytes())
    assert written[0] == written[1]


def test_a_forecast_that_is_not_finite_is_left_out_of_the_animation(tmp_path: Path) -> None:
    scene = short()
    broken = JointForecast(forecast(scene).states * torch.nan, torch.ones(1, 3) / 3)
    assert len(list(frames(animate(scene, broken, tmp_path / "broken.gif")))) == 17


def test_a_scene_without_future_map_and_sizes_is_animated(tmp_path: Path) -> None:
    predicted = JointForecast(forecast(short(), modes=1).states, torch.ones(1, 1))
    assert len(list(frames(animate(Scene(short().history, DT), predicted, tmp_path / "scene.gif")))) == 17


def test_headings_are_interpolated_along_the_shorter_arc(tmp_path: Path) -> None:
    states = np.array([[0.0, 0, np.pi - 0.1, 1], [1.0, 0, -np.pi + 0.1, 1]])
    path, seen = animation._until(states, np.array([True, True]), 0.5)
    assert seen.all()
    assert np.cos(path[-1, 2]) == pytest.approx(-1)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_an_mp4_is_written_with_ffmpeg(tmp_path: Path) -> None:
    scene = short()
    path = animate(scene, forecast(scene), tmp_path / "scene.mp4")
    assert path.read_bytes()[4:8] == b"ftyp"
    assert 1000 < path.stat().st_size < 1_000_000


def test_other_endings_and_a_missing_ffmpeg_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = traffic()
    predicted = forecast(scene)
    with pytest.raises(ConfigError, match=r"\.gif or"):
        animate(scene, predicted, tmp_path / "scene.avi")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"needs the program ffmpeg.*choose a \.gif"):
        animate(scene, predicted, tmp_path / "scene.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_animation_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(animation, "write_gif", full)
    with pytest.raises(OSError, match="no space"):
        animate(traffic(), forecast(traffic()), tmp_path / "scene.gif")
    assert list(tmp_path.iterdir()) == []
