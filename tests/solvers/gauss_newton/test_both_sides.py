"""Equilibria on both sides on which agents can pass, from one start."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import leaves_of

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.gauss_newton.both_sides import BothSides, _chosen

ENERGY = FeatureEnergy(own=["goal", "vel", "acc", "turnr"], pair=["clearance"], margins={"clearance": 0.5})
HORIZON = 30


def meeting(*directions: float, weight: float = 8.0, modes: int = 2) -> tuple[Scene, GameParameters]:
    """Two agents that meet in the middle, a little beside each other; agent 1 comes from one direction per scene."""
    count = len(directions)
    angle = torch.tensor(directions, dtype=torch.double)
    from_left = torch.tensor([-2.0, 0.03, 0.0, 1.3], dtype=torch.double).expand(count, 4)
    other = torch.stack((-2 * angle.cos(), -2 * angle.sin(), angle, torch.full_like(angle, 1.3)), -1)
    current = torch.stack((from_left, other), 1)
    scene = Scene(history=current[:, :, None], dt=0.1, size=torch.full((count, 2, 2), 0.5, dtype=torch.double))
    shape = (count, modes, 2)
    game = GameParameters(
        own_weights={
            name: torch.full(shape, value, dtype=torch.double)
            for name, value in {"goal": 10.0, "vel": 3.0, "acc": 3.0, "turnr": 3.0}.items()
        },
        pair_weights={"clearance": torch.full((count, modes, 1), weight, dtype=torch.double)},
        initial_controls=torch.zeros(*shape, HORIZON, 2, dtype=torch.double),
        goals=-current[:, None, :, :2].expand(-1, modes, -1, -1),
    )
    return scene, game


def turns(states: torch.Tensor) -> torch.Tensor:
    """Direction in which the line of sight between the agents turns, [B, M]."""
    sight = states[..., 1, :, :2] - states[..., 0, :, :2]
    change = torch.atan2(sight[..., 1], sight[..., 0]).diff(dim=-1)
    return ((change + math.pi) % (2 * math.pi) - math.pi).sum(-1).sign()


def test_the_modes_are_minima_on_different_sides() -> None:
    scene, game = meeting(math.pi, 2.5, -2.5, 2.0)
    solution = BothSides(steps=15)(ENERGY, scene, game)
    assert (solution.status == Status.COMPLETED).all()
    side = turns(solution.states)
    assert (side[:, 0] == -side[:, 1]).all()
    assert solution.gradient_norm.max() < 1e-6
    torch.testing.assert_close(solution.energy, ENERGY(scene, game, solution.controls))


def test_the_first_mode_is_the_descent_from_the_first_start() -> None:
    scene, game = meeting(math.pi, 2.0)
    solver = BothSides(steps=15)
    with torch.no_grad():
        expected = solver.descent()(ENERGY, scene, game)
    game.initial_controls[:, 1] = 7.0  # ignored
    torch.testing.assert_close(solver(ENERGY, scene, game).controls[:, 0], expected.controls[:, 0])


def test_agents_that_do_not_interact_have_equal_modes() -> None:
    scene, game = meeting(math.pi, weight=0.0)
    solution = BothSides()(ENERGY, scene, game)
    torch.testing.assert_close(solution.controls[:, 0], solution.controls[:, 1])
    alone = dataclasses.replace(game, pair_weights={})
    again = BothSides()(FeatureEnergy(own=ENERGY.own, pair=[]), scene, alone)
    torch.testing.assert_close(again.controls, solution.controls)


def test_both_modes_have_the_derivative_of_their_minima() -> None:
    """The implicit derivative by the pair weight, against finite differences."""
    scene, game = meeting(math.pi, 2.3)
    weigh = torch.randn(2, 2, 2, HORIZON, 4, dtype=torch.double)
    leaves = leaves_of(game)
    (Implicit()(BothSides(steps=20), ENERGY, scene, leaves).states * weigh).sum().backward()
    slope = leaves.pair_weights["clearance"].grad

    def total(step: float) -> torch.Tensor:
        weights = {"clearance": game.pair_weights["clearance"] + step}
        states = BothSides(steps=20)(ENERGY, scene, dataclasses.replace(game, pair_weights=weights)).states
        return (states * weigh).sum((2, 3, 4))

    expected = (total(1e-5) - total(-1e-5)) / 2e-5
    torch.testing.assert_close(slope[..., 0], expected, rtol=1e-4, atol=1e-4)


def solutions(energy: list[float], place: list[float]) -> Solution:
    """Solutions of one scene with one agent that stands at a place."""
    count = len(energy)
    states = torch.zeros(1, count, 1, 3, 4)
    states[..., 0] = torch.tensor(place)[None, :, None, None]
    values = torch.tensor([energy])
    return Solution(
        controls=torch.tensor(place)[None, :, None, None, None].expand(1, count, 1, 3, 2),
        states=states,
        initial_energy=values,
        energy=values,
        gradient_norm=values,
        status=torch.zeros(1, count, dtype=torch.long),
    )


@pytest.mark.parametrize(
    ("energy", "place", "modes", "chosen"),
    [
        ([5.0, 2.0, 1.0], [0.0, 9.0, 0.05], 2, [0, 1]),  # the third repeats the first
        ([5.0, 2.0, 1.0], [0.0, 9.0, 8.0], 2, [0, 2]),  # the lower one
        ([5.0, 2.0, 1.0], [0.0, 9.0, 8.0], 3, [0, 2, 1]),
        ([5.0, 2.0, 1.0, 3.0], [0.0, 9.0, 9.05, 4.0], 3, [0, 2, 3]),  # the second repeats the third
        ([5.0, 2.0, 1.0], [0.0, 0.0, 0.0], 3, [0, 2, 1]),  # all repeat: the lowest of the others
        ([5.0, math.nan, 1.0], [0.0, 9.0, 0.0], 2, [0, 2]),  # a repeat rather than no solution
        ([math.nan, math.nan, math.nan], [0.0, 9.0, 0.0], 2, [0, 1]),
    ],
)
def test_a_mode_differs_from_those_before_and_has_the_lowest_energy(energy, place, modes, chosen) -> None:
    found = _chosen(solutions(energy, place), modes)
    assert found.energy.nan_to_num(-1.0).flatten().tolist() == [
        pytest.approx(-1.0 if math.isnan(energy[k]) else energy[k]) for k in chosen
    ]
    assert found.states[0, :, 0, 0, 0].tolist() == pytest.approx([place[k] for k in chosen])


def test_too_few_or_impossible_reflections_are_refused() -> None:
    assert BothSides().for_modes(3).modes == 3
    with pytest.raises(ConfigError, match=r"solver.reflections has 1 numbers, but forecaster.modes=3"):
        BothSides(reflections=(2.0,)).for_modes(3)
    with pytest.raises(ConfigError, match=r"solver.reflections must be a number, positive"):
        BothSides(reflections=(0.0,))
    with pytest.raises(ConfigError, match=r"solver.newton_steps"):
        BothSides(newton_steps=-1)
