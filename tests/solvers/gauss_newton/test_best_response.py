"""Best responses: a decentralised solution of the same game."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re

import pytest
import torch
from games import random_scene

from epo_lightning.forecast import GameParameters, JointForecast, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium
from epo_lightning.solvers.gauss_newton.best_response import BestResponse
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general.dense import gauss_newton, gradient

ENERGY = FeatureEnergy(own=["goal", "vel", "acc", "turnr"], pair=["clearance"], margins={"clearance": 0.5})
CENTRAL = LevenbergMarquardt(steps=30, step_size=1.0, damping=1.0, adaptive=True, newton_steps=20)
ORDERS = pytest.mark.parametrize("order", ["in_turn", "at_once"])


def crossing(agents: int = 3, modes: int = 2, weight: float = 4.0) -> tuple[Scene, GameParameters]:
    """Agents on a circle that walk towards the other side, each a little beside the middle."""
    angle = 2 * math.pi * torch.arange(agents, dtype=torch.double) / agents
    place = 2.0 * torch.stack((angle.cos(), angle.sin()), -1)
    current = torch.cat((place, (angle + math.pi)[:, None] + 0.1, torch.ones(agents, 1, dtype=torch.double)), -1)
    scene = Scene(history=current[None, :, None], dt=0.1, size=torch.full((1, agents, 2), 0.5, dtype=torch.double))
    generator = torch.Generator().manual_seed(0)
    game = GameParameters(
        own_weights={
            name: torch.full((1, modes, agents), value, dtype=torch.double)
            for name, value in {"goal": 3.0, "vel": 1.0, "acc": 2.0, "turnr": 2.0}.items()
        },
        pair_weights={"clearance": torch.full((1, modes, agents * (agents - 1) // 2), weight, dtype=torch.double)},
        goals=-place.expand(1, modes, -1, -1),
        initial_controls=0.1 * torch.randn(1, modes, agents, 20, 2, dtype=torch.double, generator=generator),
    )
    return scene, game


@ORDERS
def test_a_single_minimum_is_the_one_of_the_central_solution(order: str) -> None:
    scene, game = crossing(weight=0.3)  # weak interaction: one minimum
    with torch.no_grad():
        expected = CENTRAL(ENERGY, scene, game)
    found = BestResponse(rounds=200, order=order, tolerance=0.0)(ENERGY, scene, game)
    assert (found.status == Status.COMPLETED).all()
    torch.testing.assert_close(found.energy, expected.energy, rtol=1e-8, atol=0)
    torch.testing.assert_close(found.states, expected.states, rtol=0, atol=1e-4)


@ORDERS
@pytest.mark.parametrize("agents", [2, 5])
def test_the_end_is_a_nash_equilibrium(order: str, agents: int) -> None:
    """Checked by the equilibrium report, which optimises every agent's strategy with other steps."""
    scene, game = crossing(agents)
    found = BestResponse(rounds=300, order=order, tolerance=0.0)(ENERGY, scene, game)
    best = (found.energy == found.energy.amin(1, keepdim=True)).double()
    report = equilibrium(ENERGY, scene, JointForecast(found.states, best, parameters=game, solution=found))
    assert (report.nash_gap <= 1e-5 * report.objective).all()


@ORDERS
def test_no_round_raises_the_energy(order: str) -> None:
    scene, game = crossing(4, weight=30.0)
    energies = [BestResponse(rounds=rounds, order=order)(ENERGY, scene, game).energy for rounds in range(6)]
    assert all((after <= before).all() for before, after in itertools.pairwise(energies))
    assert (energies[-1] < energies[0]).all()


@ORDERS
def test_a_first_round_with_too_little_damping_is_not_the_end(order: str) -> None:
    """Agents with cheap controls that stand: the first step of each goes too far, and the next one has more damping."""
    scene, game = crossing(2, modes=1)
    weights = {name: 0.01 * value if name in ("acc", "turnr") else value for name, value in game.own_weights.items()}
    game = dataclasses.replace(game, own_weights=weights, initial_controls=torch.zeros_like(game.initial_controls))
    first, more = (BestResponse(rounds, order, 1, 0.01)(ENERGY, scene, game) for rounds in (1, 10))
    assert torch.equal(first.energy, first.initial_energy), "no step was taken"
    assert (more.energy < 0.98 * first.energy).all()


def test_agents_that_do_not_interact_need_no_exchange() -> None:
    """All at once: every agent's steps are then those that it takes alone."""
    scene, game = crossing(3, weight=0.0)
    together = BestResponse(rounds=1, order="at_once", steps=3)(ENERGY, scene, game)
    turns = BestResponse(rounds=1, order="in_turn", steps=3)(ENERGY, scene, game)
    torch.testing.assert_close(together.controls, turns.controls)


def test_a_round_in_turn_is_block_coordinate_descent() -> None:
    """Against steps with the agent's block of a dense Gauss-Newton matrix by automatic differentiation."""
    scene, game = crossing(3, modes=1)
    found = BestResponse(rounds=1, steps=1, damping=2.0)(ENERGY, scene, game)
    controls = game.initial_controls
    for agent in range(3):
        value, slope = gradient(ENERGY, scene, game, controls)
        matrix = gauss_newton(ENERGY, scene, game, controls).view(3, 40, 3, 40)[agent, :, agent]
        step = torch.linalg.solve(matrix + 2.0 * torch.eye(40, dtype=torch.double), slope[0, 0, agent].flatten())
        moved = controls.clone()
        moved[0, 0, agent] -= step.view(20, 2)
        controls = moved if ENERGY(scene, game, moved) < value else controls
    torch.testing.assert_close(found.controls, controls, rtol=1e-7, atol=1e-9)


@ORDERS
def test_both_backends_agree_also_for_absent_agents_and_shorter_games(order: str) -> None:
    torch.manual_seed(0)
    scene = random_scene(3, 3, dtype=torch.double)
    scene = dataclasses.replace(
        scene,
        agent_mask=torch.tensor([[True, True, True], [True, False, True], [False, False, True]]),
        game_steps=torch.tensor([20, 7, 1]),
    )
    game = crossing(3)[1].map(lambda tensor: tensor.expand(3, *tensor.shape[1:]))
    one, other = (
        BestResponse(rounds=4, order=order, backend=backend)(ENERGY, scene, game) for backend in ("pytorch", "compiled")
    )
    torch.testing.assert_close(one.controls, other.controls, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(one.energy, other.energy)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"order": "in_turns"}, "unknown solver.order 'in_turns': did you mean 'in_turn'?"),
        ({"steps": 0}, "solver.steps"),
        ({"rounds": -1}, "solver.rounds"),
        ({"damping": math.nan}, "solver.damping"),
        ({"tolerance": -1.0}, "solver.tolerance"),
    ],
)
def test_invalid_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        BestResponse(**changes)  # type: ignore[arg-type]


@ORDERS
def test_a_game_with_a_margin_that_is_no_number_is_stopped_and_disturbs_no_other(order: str) -> None:
    scene, game = crossing(agents=2, modes=2)
    margins = torch.full((1, 2, 1), 0.5, dtype=torch.double)
    margins[0, 0, 0] = math.nan
    energy = dataclasses.replace(ENERGY, margins={})
    broken = dataclasses.replace(game, margins={"clearance": margins})
    sound = dataclasses.replace(game, margins={"clearance": torch.full_like(margins, 0.5)})
    solve = BestResponse(rounds=5, order=order)
    found, expected = solve(energy, scene, broken), solve(energy, scene, sound)
    assert found.status.tolist() == [[int(Status.STOPPED), int(Status.COMPLETED)]]
    torch.testing.assert_close(found.controls[:, 1], expected.controls[:, 1], rtol=0, atol=0)
