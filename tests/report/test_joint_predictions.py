"""Figures of joint predictions: what is drawn has the coordinates, sizes and probabilities of the scenes and forecasts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.text import Annotation
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.report import figures
from epo_lightning.report.figures import joint_predictions
from epo_lightning.report.style import MODES, TRUTH
from epo_lightning.scene import Scene

SCENES, AGENTS, HISTORY, FUTURE = 2, 2, 4, 6
PROBABILITIES = {"SC": [[0.2, 0.5, 0.3], [0.7, 0.1, 0.2]], "EPO": [[0.15, 0.25, 0.6], [0.34, 0.56, 0.1]]}
ORDERS = {"SC": [[1, 2, 0], [0, 2, 1]], "EPO": [[2, 1, 0], [1, 0, 2]]}
"""The modes of every scene by probability."""


def walks(*shape: int, steps: int, seed: int) -> Tensor:
    """States of random walks, in which x is far from y and no two positions are equal."""
    random = np.random.default_rng(seed)
    states = np.cumsum(random.uniform(0.1, 0.5, (*shape, steps, 4)), axis=-2)
    states[..., :2] += random.uniform(-3.0, 3.0, (*shape, 1, 2)) + np.array([20.0, -10.0])
    return torch.from_numpy(states).float()


@pytest.fixture(scope="module")
def scene() -> Scene:
    states = walks(SCENES, AGENTS, steps=HISTORY + FUTURE, seed=0)
    return Scene(
        history=states[:, :, :HISTORY],
        future=states[:, :, HISTORY:],
        dt=0.1,
        goal_candidates=walks(SCENES, AGENTS, steps=1, seed=1)[..., :2],
        size=torch.tensor([[[0.5, 0.5], [0.8, 0.8]], [[0.6, 0.6], [0.4, 0.4]]]),
    )


@pytest.fixture(scope="module")
def forecasts() -> dict[str, JointForecast]:
    return {
        name: JointForecast(walks(SCENES, 3, AGENTS, steps=FUTURE, seed=seed), torch.tensor(values))
        for seed, (name, values) in enumerate(PROBABILITIES.items(), 2)
    }


@pytest.fixture(scope="module")
def alternatives() -> Tensor:
    return walks(SCENES, AGENTS, steps=FUTURE, seed=4)


@pytest.fixture(scope="module")
def drawn(
    scene: Scene,
    forecasts: dict[str, JointForecast],
    alternatives: Tensor,
    tmp_path_factory: pytest.TempPathFactory,
) -> Figure:
    """The figure of two scenes, two forecasters and the other equilibria, as it is saved."""
    caught: list[Figure] = []
    original = figures.save

    def save(figure: Figure, path: str | Path) -> Path:
        caught.append(figure)
        return original(figure, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "save", save)
        joint_predictions(scene, forecasts, tmp_path_factory.mktemp("figures") / "joint.png", alternatives)
    (figure,) = caught
    return figure


def panels(figure: Figure) -> list[tuple[int, str, Axes]]:
    """Every panel with its scene and forecaster: one scene per row, one forecaster per column."""
    assert len(figure.axes) == SCENES * len(PROBABILITIES)
    names = list(PROBABILITIES)
    return [(i // len(names), names[i % len(names)], axes) for i, axes in enumerate(figure.axes)]


def lines(axes: Axes, points: int, marker: str = "None") -> list[np.ndarray]:
    """Positions of the lines and markers with so many points."""
    chosen = [line for line in axes.lines if str(line.get_marker()) == marker]
    return [line.get_xydata() for line in chosen if len(line.get_xydata()) == points]


def paths(axes: Axes, color: str) -> list[LineCollection]:
    """The trajectories that end in this colour."""
    collections = [
        entry for entry in axes.collections if isinstance(entry, LineCollection) and len(entry.get_segments())
    ]
    return [entry for entry in collections if to_hex(entry.get_colors()[-1]) == color.lower()]


def positions(path: LineCollection) -> np.ndarray:
    """The points of a trajectory without gaps."""
    segments = np.array(path.get_segments())
    np.testing.assert_array_equal(segments[1:, 0], segments[:-1, 1])
    return np.concatenate([segments[:1, 0], segments[:, 1]])


def test_history_truth_other_equilibrium_and_goal_are_those_of_the_scene(
    drawn: Figure, scene: Scene, alternatives: Tensor
) -> None:
    assert scene.future is not None
    assert scene.goal_candidates is not None
    history, future = scene.history[..., :2].numpy(), scene.future[..., :2].numpy()
    for row, _, axes in panels(drawn):
        np.testing.assert_allclose(lines(axes, HISTORY), history[row])
        np.testing.assert_allclose(lines(axes, 1, "o"), history[row, :, :1])
        np.testing.assert_allclose(lines(axes, FUTURE), alternatives[row, ..., :2].numpy())
        np.testing.assert_allclose(lines(axes, 1, "*"), scene.goal_candidates[row].numpy())
        truth = np.concatenate([history[row, :, -1:], future[row]], axis=1)
        np.testing.assert_allclose([positions(path) for path in paths(axes, TRUTH)], truth)


def test_modes_lead_from_t0_to_discs_of_the_agents_size(
    drawn: Figure, scene: Scene, forecasts: dict[str, JointForecast]
) -> None:
    assert scene.size is not None
    for row, name, axes in panels(drawn):
        current = scene.history[row, :, -1:, :2].numpy()
        discs = [patch for patch in axes.patches if isinstance(patch, Circle)]
        assert len(discs) == 3 * AGENTS
        for mode in range(3):
            states = forecasts[name].states[row, mode, ..., :2].numpy()
            expected = np.concatenate([current, states], axis=1)
            np.testing.assert_allclose([positions(path) for path in paths(axes, MODES[mode])], expected)
            ends = [disc for disc in discs if to_hex(disc.get_edgecolor()) == MODES[mode].lower()]
            np.testing.assert_allclose([disc.center for disc in ends], states[:, -1])
            diameters = [2 * disc.radius for disc in ends]
            assert diameters == pytest.approx(scene.size[row, :, 0].tolist())


def test_the_most_likely_mode_is_the_broadest_and_lowest(drawn: Figure) -> None:
    for row, name, axes in panels(drawn):
        order = ORDERS[name][row]
        widths = [{path.get_linewidths()[0] for path in paths(axes, MODES[mode])} for mode in order]
        heights = [{path.get_zorder() for path in paths(axes, MODES[mode])} for mode in order]
        assert all(len(entry) == 1 for entry in (*widths, *heights)), "the agents of a mode look the same"
        (broad, middle, narrow), (low, between, high) = (
            [entry.pop() for entry in found] for found in (widths, heights)
        )
        assert broad > middle > narrow > 0
        assert low < between < high
        assert all(path.get_zorder() > high for path in paths(axes, TRUTH))


def test_every_panel_has_the_probabilities_of_its_modes(drawn: Figure) -> None:
    for row, name, axes in panels(drawn):
        legend = axes.get_legend()
        assert legend is not None
        assert [text.get_text() for text in legend.get_texts()] == [f"p = {p:.2f}" for p in PROBABILITIES[name][row]]
        for mode, handle in enumerate(legend.legend_handles):
            assert isinstance(handle, Line2D)
            assert handle.get_color() == MODES[mode]
            assert handle.get_linewidth() == paths(axes, MODES[mode])[0].get_linewidths()[0]


def test_legend_titles_and_axes_say_what_is_drawn(drawn: Figure) -> None:
    (legend,) = drawn.legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == ["history", "ground truth", "other equilibrium", "goal", "mode 1", "mode 2", "mode 3"]
    handles = dict(zip(labels, legend.legend_handles, strict=True))
    shown = {name: handle.get_color() for name, handle in handles.items() if isinstance(handle, Line2D)}
    assert {name: shown[name] for name in labels[1:2] + labels[4:]} == {
        "ground truth": TRUTH,
        **{f"mode {mode + 1}": MODES[mode] for mode in range(3)},
    }
    (first, second, third, last) = drawn.axes
    assert [axes.get_title() for axes in drawn.axes] == ["SC", "EPO", "", ""]
    assert [axes.get_ylabel() for axes in (first, third)] == ["y [m]", "y [m]"]
    assert [axes.get_xlabel() for axes in (third, last)] == ["x [m]", "x [m]"]
    assert second.get_xlim() == first.get_xlim() != third.get_xlim()


def test_agents_are_named_at_their_first_positions(drawn: Figure, scene: Scene) -> None:
    for row, name, axes in panels(drawn):
        names = {text.get_text(): text.xy for text in axes.texts if isinstance(text, Annotation)}
        assert list(names) == (["robot", "pedestrian"] if name == "SC" else [])
        for agent, place in enumerate(names.values()):
            assert place == pytest.approx(scene.history[row, agent, 0, :2].tolist())


def test_all_positions_lie_within_the_limits_and_metres_are_equal(
    drawn: Figure, scene: Scene, forecasts: dict[str, JointForecast]
) -> None:
    assert scene.future is not None
    assert scene.goal_candidates is not None
    for row, _, axes in panels(drawn):
        every = [forecast.states[row] for forecast in forecasts.values()]
        every += [scene.history[row], scene.future[row], scene.goal_candidates[row]]
        points = np.concatenate([states[..., :2].reshape(-1, 2).numpy() for states in every])
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
        assert (points > low).all()
        assert (points < high).all()
        right, up = axes.transData.transform([(1, 0), (0, 1)]) - axes.transData.transform((0, 0))
        assert right[0] == pytest.approx(up[1])


def test_more_modes_than_colours_are_drawn(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The seventh mode has the colour of the first one, in its panel as in the legend."""
    caught: list[Figure] = []
    monkeypatch.setattr(figures, "save", lambda figure, path: caught.append(figure) or path)
    many = JointForecast(walks(1, 7, AGENTS, steps=FUTURE, seed=5), torch.full((1, 7), 1 / 7))
    joint_predictions(scene[0], {"EPO": many}, tmp_path / "many.png")
    (legend,) = caught[0].legends
    entries = zip(legend.get_texts(), legend.legend_handles, strict=True)
    colors = {text.get_text(): handle.get_color() for text, handle in entries if isinstance(handle, Line2D)}
    assert [colors[f"mode {mode + 1}"] for mode in range(7)] == [*MODES, MODES[0]]
    drawn = [positions(path) for path in paths(caught[0].axes[0], MODES[0])]
    ends = {tuple(path[-1].round(3)) for path in drawn}
    expected = many.states[0, [0, 6], :, -1, :2].reshape(-1, 2).numpy()
    assert ends == {tuple(end.round(3)) for end in expected.astype(float)}
