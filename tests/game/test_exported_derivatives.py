"""Features whose derivatives need automatic differentiation, in programs for any number of scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from io import BytesIO

import jaxtyping
import pytest
import torch
from torch import Tensor, nn
from torch.export import Dim, export, load, save

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_derivatives import differentiate, undeclared_change
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import SPEED, TURN_RATE, Scene
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

SCENES = Dim("B", min=1)


class Call(nn.Module):
    """A function as a module, which the exporter takes."""

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__()
        self.function = function

    def forward(self, *given: Tensor) -> object:
        return self.function(*given)


@pytest.fixture(autouse=True)
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """No runtime checks of annotations: sizes are symbols while a program is exported, and no ints."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def own_features() -> Iterator[None]:
    """Features that a test declares are unknown after it."""
    kept = [(known, dict(known)) for known in (OWN_FEATURES, PAIR_FEATURES)]
    yield
    for known, before in kept:
        known.clear()
        known.update(before)


def exported(function: Callable[..., object], *example: Tensor, axes: tuple[int, ...]) -> Callable[..., object]:
    """A function as a program in a file, for any number of scenes, whose axis in each of the arguments is given."""
    shapes = (tuple({axis: SCENES} for axis in axes),)
    with torch.no_grad():
        program = export(Call(function), example, dynamic_shapes=shapes, strict=False)
    file = BytesIO()
    save(program, file)
    file.seek(0)
    return load(file).module()


@pytest.mark.parametrize(
    "function",
    [
        lambda states, controls: states[..., SPEED] * controls[..., TURN_RATE],
        lambda states, controls: torch.exp(-states[..., :2].square().sum(-1)),  # no controls
        lambda states, controls: states[..., :2].norm(dim=-1).diff(dim=-1) * 2.0,
        lambda states, controls: (states @ states.new_ones(4, 2) * controls).min(-1).values,
    ],
    ids=["product", "exponential", "differences", "smallest"],
)
def test_changes_along_directions_are_those_of_difference_quotients(function: Callable[..., Tensor]) -> None:
    def change(states: Tensor, controls: Tensor, moved: Tensor, turned: Tensor) -> tuple[Tensor, Tensor]:
        return undeclared_change(function, (states, controls), (moved, turned))

    def draw(scenes: int) -> list[Tensor]:
        torch.manual_seed(scenes)
        shapes = (scenes, 5, 4), (scenes, 5, 2), (3, scenes, 5, 4), (3, scenes, 5, 2)
        return [torch.randn(shape, dtype=torch.float64) for shape in shapes]

    program = exported(change, *draw(7), axes=(0, 0, 1, 1))
    for scenes in (1, 4):
        states, controls, moved, turned = draw(scenes)
        value, found = program(states, controls, moved, turned)
        torch.testing.assert_close(value, function(states, controls))
        step = 1e-6
        ahead, behind = (function(states + by * moved, controls + by * turned) for by in (step, -step))
        torch.testing.assert_close(found, (ahead - behind) / (2 * step), atol=1e-6, rtol=1e-6)


def test_elementwise_functions_have_their_first_and_second_derivatives() -> None:
    def bend(value: Tensor) -> Tensor:
        return torch.relu(value) + torch.exp(2.0 * value)

    program = exported(lambda value: tuple(differentiate(bend, value, second=True)), torch.randn(7, 3), axes=(0,))
    for scenes in (1, 4):
        value = torch.randn(scenes, 3)
        found = program(value)
        wanted = bend(value), (value > 0) + 2.0 * torch.exp(2.0 * value), 4.0 * torch.exp(2.0 * value)
        torch.testing.assert_close(found, wanted)


@pytest.mark.slow
@pytest.mark.usefixtures("own_features")
def test_a_program_solves_games_of_features_of_every_kind() -> None:
    own_feature("latacc", Source.STEP)(lambda states, controls: states[..., SPEED] * controls[..., TURN_RATE])
    own_feature("hurry", Source.SPEED)(lambda speed: torch.relu(speed - 0.5))
    own_feature("smooth")(lambda states, controls: controls[..., TURN_RATE].diff(dim=-1))
    pair_feature("comfort", Source.DISTANCE)(lambda distance, reach: torch.relu(reach + 2.0 - distance))
    pair_feature("close", Source.STEP)(lambda first, second: torch.exp(-(first - second)[..., :2].square().sum(-1)))
    energy = FeatureEnergy(own=["goal", "acc", "latacc", "hurry", "smooth"], pair=["comfort", "close", "circles"])

    def solve(history: Tensor, controls: Tensor) -> Tensor:
        scenes = history.shape[0]  # a symbol while the program is exported
        parameters = GameParameters(
            own_weights={name: history.new_ones(scenes, 1, 2) for name in energy.own},
            pair_weights={name: history.new_ones(scenes, 1, 1) for name in energy.pair},
            goals=history.new_ones(scenes, 1, 2, 2),
            initial_controls=controls,
        )
        solver = LevenbergMarquardt(steps=1, step_size=0.3, damping=1.0, backend="pytorch")
        return solver(energy, Scene(history, dt=0.1, size=history.new_ones(scenes, 2, 2)), parameters).controls

    def draw(scenes: int) -> list[Tensor]:
        torch.manual_seed(scenes)
        return [torch.randn(scenes, 2, 1, 4), torch.randn(scenes, 1, 2, 4, 2)]

    program = exported(solve, *draw(7), axes=(0, 0))
    for scenes in (1, 4):
        torch.testing.assert_close(program(*draw(scenes)), solve(*draw(scenes)), atol=1e-5, rtol=1e-5)
