"""The status of a solution with a derivative: that of its minimiser, and that of the derivative."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from games import leaves_of, random_game, random_scene

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Backward, Implicit, Truncated, Unrolled
from epo_lightning.solvers.base import Minimiser, Stepwise
from epo_lightning.solvers.feedback.solver import Feedback
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OWN = ("acc", "turnr")
ENERGY = FeatureEnergy(OWN, [])
COMPLETED, DAMPED, STOPPED = int(Status.COMPLETED), int(Status.DAMPED), int(Status.STOPPED)


class Given(Stepwise):
    """A minimiser that stays where it is and reports given statuses, one per call."""

    steps = 2

    def __init__(self, *statuses: int) -> None:
        self.statuses = list(statuses)

    def run(
        self, energy: Energy, scene: Scene, parameters: GameParameters, steps: int, memory: Any = None
    ) -> tuple[Solution, None]:
        solution = LevenbergMarquardt(0)(energy, scene, parameters)
        return dataclasses.replace(solution, status=torch.full_like(solution.status, self.statuses.pop(0))), None


def resting_game() -> tuple[Scene, GameParameters]:
    """A game whose minimum are controls of zero, where it starts."""
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    return scene, random_game(scene, 1, 4, OWN, spread=0.0)


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        (COMPLETED, COMPLETED, COMPLETED),
        (DAMPED, COMPLETED, DAMPED),
        (STOPPED, COMPLETED, DAMPED),
        (COMPLETED, DAMPED, DAMPED),
        (COMPLETED, STOPPED, STOPPED),
        (STOPPED, STOPPED, STOPPED),
    ],
)
def test_the_status_of_truncated_steps_is_that_of_all_steps(first: int, last: int, expected: int) -> None:
    solution = Truncated(1)(Given(first, last), ENERGY, *resting_game())
    assert (solution.status == expected).all()


@pytest.mark.parametrize("status", [COMPLETED, DAMPED, STOPPED])
def test_an_implicit_derivative_keeps_the_status_of_the_minimiser(status: int) -> None:
    scene, parameters = resting_game()
    solution = Implicit()(Given(status), ENERGY, scene, leaves_of(parameters))
    assert (solution.status == status).all()
    for weight in parameters.own_weights.values():
        weight[1] = 0.0  # no minimum: any controls cost nothing
    solution = Implicit()(Given(status), ENERGY, scene, leaves_of(parameters))
    assert solution.status.flatten().tolist() == [status, STOPPED]


@pytest.mark.parametrize(
    ("solver", "derivative"),
    [
        (LevenbergMarquardt(3, backend="pytorch"), Unrolled()),
        (LevenbergMarquardt(3, backend="compiled"), Unrolled()),
        (LevenbergMarquardt(50, adaptive=True, backend="pytorch"), Implicit()),
        (LevenbergMarquardt(50, adaptive=True, backend="compiled"), Implicit()),
        (Feedback(), Implicit()),
        (Feedback(backend="pytorch"), Implicit()),
    ],
)
def test_a_scene_that_changed_before_the_backward_pass_is_noticed(solver: Minimiser, derivative: Backward) -> None:
    """The derivative would be that of another scene."""
    scene = random_scene(2, 2, history=2, size=1.0, dtype=torch.float64)
    energy = FeatureEnergy(OWN, ["proximity"])
    solution = derivative(solver, energy, scene, leaves_of(random_game(scene, 2, 4, OWN)))
    scene.history[0] += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        solution.states.sum().backward()
