"""Figures: their files, sizes and contents, and errors for invalid inputs."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
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


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures of weights that are saved, as they were."""
    figures: list[Figure] = []

    def keep(figure: Figure, path: str | Path) -> Path:
        figures.append(figure)
        return save(figure, path)

    monkeypatch.setattr(weights, "save", keep)
    return figures


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


def test_weights_are_drawn_as_the_squares_that_enter_the_energy(tmp_path: Path, drawn: list[Figure]) -> None:
    own = {"goal": torch.full((20, MODES, AGENTS), -3.0)}
    pair = {"proximity": torch.full((20, MODES, 1), 0.1)}
    equal = GameParameters(own, pair, torch.zeros(20, MODES, AGENTS, FUTURE, 2))
    learned_weights(dataclasses.replace(forecast(scenes(20)), parameters=equal), tmp_path / "equal.png")
    medians = [
        [float(line.get_xdata()[0]) for line in axes.lines if line.get_marker() == "o"] for axes in drawn[0].axes
    ]
    assert medians == [pytest.approx([9.0] * AGENTS), pytest.approx([0.01])]


def bars_and_dots(axes: Axes) -> dict[tuple[str, str], list[float]]:
    """Ends of the thin bar, ends of the thick bar and the dot, by the name beside them and the colour, from above."""
    assert axes.yaxis_inverted()
    names = [text.get_text() for text in axes.get_yticklabels()]
    found: dict[tuple[str, str], list[float]] = {}
    places = [(len(line.get_xdata()) == 1, line.get_linewidth(), line.get_ydata()[0]) for line in axes.lines]
    for _, line in sorted(zip(places, axes.lines, strict=True), key=lambda entry: entry[0]):
        (height,) = {float(value) for value in line.get_ydata()}
        name = names[int(np.abs(axes.get_yticks() - height).argmin())]
        color = line.get_markeredgecolor() if line.get_marker() == "o" else line.get_color()
        found.setdefault((name, color), []).extend(float(value) for value in line.get_xdata())
    return found


def test_bars_and_dots_are_percentiles_over_scenes_and_modes_of_every_agent(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    """Weights of every forecaster, feature and agent have a size and spread of their own, and some are negative."""
    random, count, agents = np.random.default_rng(0), 30, 3
    own: dict[str, dict[str, np.ndarray]] = {}
    pair: dict[str, np.ndarray] = {}
    forecasts = {}
    for place, name in enumerate(("EPO", "EPO 2")):
        size = 10.0 ** random.uniform(-1.0, 1.0, (2, agents))
        values = size[:, None, None] * random.normal(0.5 * place, 1.0, (2, count, MODES, agents))
        values[0, :, 1] *= 3.0  # the second mode is not like the first
        own[name] = {"goal": values[0], "vel": values[1]}
        pair[name] = random.normal(2.0, 1.0, (count, MODES, 3)) * np.array([0.1, 1.0, 10.0])
        game = GameParameters(
            {feature: torch.from_numpy(weight).float() for feature, weight in own[name].items()},
            {"proximity": torch.from_numpy(pair[name]).float()},
            torch.zeros(count, MODES, agents, FUTURE, 2),
        )
        states = torch.zeros(count, MODES, agents, FUTURE, 4)
        forecasts[name] = JointForecast(states, torch.full((count, MODES), 1 / MODES), parameters=game)
    learned_weights(forecasts, tmp_path / "weights.png")

    (figure,) = drawn
    (legend,) = figure.legends
    colors = {
        text.get_text(): handle.get_color()
        for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True)
    }
    assert list(colors) == ["robot", "pedestrian", "agent 3"]
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["EPO: own weights", "pair weights", "EPO 2: own weights", "pair weights"]
    for name, (left, right) in zip(own, (figure.axes[:2], figure.axes[2:]), strict=True):
        expected = {
            (feature, color): np.percentile(weight[..., i] ** 2, [5, 95, 25, 75, 50])
            for feature, weight in own[name].items()
            for i, color in enumerate(colors.values())
        }
        shown = bars_and_dots(left)
        assert list(shown) == list(expected), "agents have the order of the legend"
        for key, values in expected.items():
            np.testing.assert_allclose(shown[key], values, rtol=1e-5, err_msg=str(key))
        ((key, values),) = bars_and_dots(right).items()
        assert key[0] == "proximity"
        np.testing.assert_allclose(values, np.percentile(pair[name] ** 2, [5, 95, 25, 75, 50]), rtol=1e-5)


def test_weights_without_influence_stand_at_the_end_of_the_axis_and_missing_ones_do_not_count(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    goal = torch.stack(
        [torch.zeros(5, MODES), torch.tensor([[1.0], [2.0], [torch.nan], [3.0], [4.0]]).expand(-1, 2)], -1
    )
    game = GameParameters({"goal": goal}, {}, torch.zeros(5, MODES, AGENTS, FUTURE, 2))
    learned_weights(dataclasses.replace(forecast(scenes(5)), parameters=game), tmp_path / "zero.png")
    zero, present = bars_and_dots(drawn[0].axes[0]).values()
    assert zero == pytest.approx([weights.SMALLEST] * 5)
    squares = [1.0, 1.0, 4.0, 4.0, 9.0, 9.0, 16.0, 16.0]
    assert present == pytest.approx(np.percentile(squares, [5, 95, 25, 75, 50]).tolist())
    assert drawn[0].axes[0].get_xlim()[0] < weights.SMALLEST


@pytest.mark.parametrize("spread", [0.01, 0.1, 0.4, 3.0])
def test_numbers_below_narrow_weights_do_not_overlap(tmp_path: Path, spread: float, drawn: list[Figure]) -> None:
    random = torch.Generator().manual_seed(0)
    pair = {"proximity": 20 * (1 + spread * torch.rand(50, MODES, 1, generator=random))}
    own = game(50).own_weights
    narrow = GameParameters(own, pair, torch.zeros(50, MODES, AGENTS, FUTURE, 2))
    learned_weights(dataclasses.replace(forecast(scenes(50)), parameters=narrow), tmp_path / "narrow.png")
    for axes in drawn[0].axes:
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
