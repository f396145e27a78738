"""Figures: their files, sizes and contents, and errors for invalid inputs."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.image import imread

from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.report import weights
from epo_lightning.report.figures import joint_predictions
from epo_lightning.report.style import save
from epo_lightning.report.weights import learned_weights
from epo_lightning.scene import Scene

HISTORY, FUTURE, MODES, AGENTS = 5, 8, 2, 2


def scenes(count: int = 2) -> Scene:
    """Agents that walk towards each other's start."""
    time = torch.linspace(-1, 1, HISTORY + FUTURE)
    states = torch.zeros(count, AGENTS, HISTORY + FUTURE, 4)
    states[:, 0, :, 0], states[:, 1, :, 1] = 2 * time, -2 * time
    return Scene(
        history=states[:, :, :HISTORY],
        dt=0.1,
        future=states[:, :, HISTORY:],
        goal_candidates=torch.full((count, AGENTS, 1, 2), 2.0),
        size=torch.full((count, AGENTS, 2), 0.5),
    )


def forecast(scene: Scene, offset: float = 0.3) -> JointForecast:
    assert scene.future is not None
    states = torch.stack([scene.future, scene.future + offset], dim=1)
    return JointForecast(states, torch.tensor([[0.7, 0.3]]).expand(len(states), 2))


def game(count: int = 20, scale: float = 1.0) -> GameParameters:
    random = torch.Generator().manual_seed(0)
    own = {name: torch.randn(count, MODES, AGENTS, generator=random) * scale for name in ("goal", "vel", "acc")}
    pair = {"proximity": torch.randn(count, MODES, 1, generator=random)}
    return GameParameters(own, pair, torch.zeros(count, MODES, AGENTS, FUTURE, 2))


def pixels(path: Path) -> np.ndarray:
    return imread(path)[..., :3]


def test_the_figure_grows_with_scenes_and_forecasters(tmp_path: Path) -> None:
    one, many = scenes(1), scenes(2)
    small = joint_predictions(one, {"SC": forecast(one)}, tmp_path / "deep" / "one.png")
    large = joint_predictions(many, {"SC": forecast(many), "EPO": forecast(many)}, tmp_path / "many.png")
    assert pixels(large).shape[0] > 1.5 * pixels(small).shape[0]
    assert pixels(large).shape[1] > 1.5 * pixels(small).shape[1]


def test_joint_predictions_show_forecasts_and_alternatives(tmp_path: Path) -> None:
    scene = scenes(1)
    near, far = (joint_predictions(scene, {"a": forecast(scene, d)}, tmp_path / f"{d}.png") for d in (0.2, 0.4))
    assert pixels(near).shape == pixels(far).shape
    assert not np.array_equal(pixels(near), pixels(far))
    other = joint_predictions(scene, {"a": forecast(scene, 0.2)}, tmp_path / "alternative.png", scene.future)
    assert pixels(other).shape != pixels(near).shape or not np.array_equal(pixels(other), pixels(near))


def test_masked_values_are_not_drawn(tmp_path: Path) -> None:
    scene = scenes(1)
    pictures = []
    for garbage in (torch.nan, 1e9):
        mask = torch.tensor([[True, False]])
        broken = torch.tensor([False, True])[:, None, None].expand(-1, HISTORY, 4)
        masked = dataclasses.replace(scene, agent_mask=mask, history=scene.history.masked_fill(broken, garbage))
        predicted = forecast(scene)
        predicted.states[:, :, 1] = garbage
        pictures.append(pixels(joint_predictions(masked, {"a": predicted}, tmp_path / "masked.png")))
    assert np.array_equal(*pictures)


def test_equal_figures_have_equal_bytes_and_matplotlib_settings_stay(tmp_path: Path) -> None:
    scene, size = scenes(1), mpl.rcParams["font.size"]
    first, second = (joint_predictions(scene, {"a": forecast(scene)}, tmp_path / name) for name in ("a.png", "b.png"))
    assert first.read_bytes() == second.read_bytes()
    assert mpl.rcParams["font.size"] == size


def test_weights_of_one_and_several_forecasters_are_drawn(tmp_path: Path) -> None:
    plain = forecast(scenes())
    learned = dataclasses.replace(plain, parameters=game())
    one = learned_weights(learned, tmp_path / "one.png")
    several = learned_weights({"SC": plain, "EPO": learned, "EPO 2": learned}, tmp_path / "several.png")
    assert pixels(several).shape[0] > 1.5 * pixels(one).shape[0]
    zero = learned_weights(dataclasses.replace(plain, parameters=game(scale=0.0)), tmp_path / "zero.png")
    assert not np.array_equal(pixels(zero), pixels(one))


def test_weights_are_drawn_as_the_squares_that_enter_the_energy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = []
    monkeypatch.setattr(weights, "save", lambda figure, path: figures.append(figure) or save(figure, path))
    own = {"goal": torch.full((20, MODES, AGENTS), -3.0)}
    pair = {"proximity": torch.full((20, MODES, 1), 0.1)}
    equal = GameParameters(own, pair, torch.zeros(20, MODES, AGENTS, FUTURE, 2))
    learned_weights(dataclasses.replace(forecast(scenes(20)), parameters=equal), tmp_path / "equal.png")
    medians = [
        [float(line.get_xdata()[0]) for line in axes.lines if line.get_marker() == "o"] for axes in figures[0].axes
    ]
    assert medians == [pytest.approx([9.0] * AGENTS), pytest.approx([0.01])]


@pytest.mark.parametrize("spread", [0.01, 0.1, 0.4, 3.0])
def test_numbers_below_narrow_weights_do_not_overlap(
    tmp_path: Path, spread: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = []
    monkeypatch.setattr(weights, "save", lambda figure, path: figures.append(figure) or save(figure, path))
    random = torch.Generator().manual_seed(0)
    pair = {"proximity": 20 * (1 + spread * torch.rand(50, MODES, 1, generator=random))}
    own = game(50).own_weights
    narrow = GameParameters(own, pair, torch.zeros(50, MODES, AGENTS, FUTURE, 2))
    learned_weights(dataclasses.replace(forecast(scenes(50)), parameters=narrow), tmp_path / "narrow.png")
    for axes in figures[0].axes:
        labels = [*axes.get_xticklabels(), *axes.get_xticklabels(minor=True)]
        low, high = axes.get_window_extent().x0 - 1, axes.get_window_extent().x1 + 1
        boxes = [label.get_window_extent() for label in labels if label.get_text()]
        boxes = sorted((box for box in boxes if low <= (box.x0 + box.x1) / 2 <= high), key=lambda box: box.x0)
        assert boxes
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


def test_invalid_inputs_are_refused(tmp_path: Path) -> None:
    scene = scenes()
    with pytest.raises(ValueError, match=r"\['SC'\] has inferred a game"):
        learned_weights({"SC": forecast(scene)}, tmp_path / "no.png")
    with pytest.raises(ValueError, match="without a forecast"):
        joint_predictions(scene, {}, tmp_path / "no.png")
    with pytest.raises(ValueError, match=r"Scene\.future is missing"):
        joint_predictions(Scene(scene.history, 0.1), {"a": forecast(scene)}, tmp_path / "no.png")
    assert list(tmp_path.iterdir()) == []
