"""Dynamics and costs of stages: against the gradient and the linearisation of the whole game."""

from __future__ import annotations

import pytest
import torch
from games import random_game, random_scene
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import STAGES
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, OwnFeature, PairFeature, Source
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import SPEED, TURN_RATE, Scene
from epo_lightning.solvers.feedback.compiled import CONTROL, STATE
from epo_lightning.solvers.feedback.lq_game import LQGame
from epo_lightning.solvers.feedback.solver import Feedback
from epo_lightning.solvers.feedback.stages import lq_game

OWN = ("goal", "heading", "lane", "velref", "vel", "acc", "turnr", "velb", "accb", "turnrb")
PAIR = ("proximity", "clearance")
BOUNDS = {"vel": [-0.05, 0.6], "acc": [-0.3, 0.3], "turnr": [-0.2, 0.2]}
HORIZON = 6

CASES = pytest.mark.parametrize(
    ("integrator", "stride", "ends"), [("euler", 1, None), ("heun", 2, None), ("semi_implicit", 1, [6, 4, 1])]
)


def setup(
    integrator: str, stride: int, ends: list[int] | None, own: tuple[str, ...] = OWN, pair: tuple[str, ...] = PAIR
):
    scene = random_scene(3, 3, history=2, horizon=HORIZON, size=2.0, dtype=torch.double)
    scene = Scene(**{**vars(scene), "game_steps": None if ends is None else torch.tensor(ends)})
    energy = FeatureEnergy(
        own=own, pair=pair, bounds=BOUNDS, dynamics=Unicycle(integrator), pair_stride=stride, margins={"clearance": 0.5}
    )
    game = random_game(scene, 2, HORIZON, own=OWN, pair=PAIR)
    return energy, scene, game, game.initial_controls


def around(energy: FeatureEnergy, scene: Scene, game: GameParameters, controls: Tensor) -> LQGame:
    states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
    return lq_game(energy, scene, game, states, controls, rho=0.0)


def cost_of(energy: FeatureEnergy, scene: Scene, game: GameParameters, controls: Tensor, agent: int) -> Tensor:
    """J_i, summed over games."""
    terms = energy.terms(scene, game, controls)
    first, second = pairs(controls.shape[2])
    mine = (first == agent) | (second == agent)
    own = sum(terms[name][:, :, agent].sum() for name in energy.own)
    return own + sum((terms[name] * mine).sum() for name in energy.pair)


@CASES
def test_stages_have_the_gradient_of_every_agents_cost(integrator: str, stride: int, ends: list[int] | None) -> None:
    energy, scene, game, controls = setup(integrator, stride, ends)
    found = around(energy, scene, game, controls)
    first, second = pairs(3)
    for i in range(3):
        leaf = controls.clone().requires_grad_()
        (wanted,) = torch.autograd.grad(cost_of(energy, scene, game, leaf, i), leaf)
        for j in range(3):
            # The costs of agent i by the states of agent j, and their costates.
            slope = found.own_cost[:, i, ..., STATE] if j == i else torch.zeros_like(found.own_cost[:, i, ..., STATE])
            for p, members in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
                if i in members and j in members:
                    place = STATE * members.index(j)
                    slope = slope + found.pair_cost[:, p, :, place : place + STATE, 2 * STATE]
            costate = torch.zeros_like(slope[:, 0])
            for k in range(HORIZON - 1, -1, -1):
                costate = costate + slope[:, k]
                gradient = (found.B[:, j, k].mT @ costate[..., None])[..., 0]
                gradient = gradient + found.push[:, i, k] if j == i else gradient
                torch.testing.assert_close(gradient, wanted.flatten(0, 1)[:, j, k], rtol=1e-9, atol=1e-9)
                costate = (found.A[:, j, k].mT @ costate[..., None])[..., 0]


@CASES
@pytest.mark.parametrize(("own", "pair"), [(OWN, ()), (("acc",), PAIR)])
def test_stages_have_the_gauss_newton_matrix(
    integrator: str, stride: int, ends: list[int] | None, own: tuple[str, ...], pair: tuple[str, ...]
) -> None:
    """1/2 |J d|^2 along a direction d of the controls: the quadratic costs of the deviation that d leads to."""
    energy, scene, game, controls = setup(integrator, stride, ends, own, pair)
    found = around(energy, scene, game, controls)
    direction = torch.randn(1, *controls.shape, dtype=torch.double)
    _, change = energy.linearisation(scene, game, controls, direction)
    d = direction[0].flatten(0, 1)
    state, total = torch.zeros(*found.A.shape[:2], STATE, dtype=torch.double), torch.zeros(len(d), dtype=torch.double)
    first, second = pairs(3)
    for k in range(HORIZON):
        state = (found.A[:, :, k] @ state[..., None] + found.B[:, :, k] @ d[:, :, k, :, None])[..., 0]
        total += torch.einsum("sia,siab,sib->s", state, found.own_cost[:, :, k, :, :STATE], state)
        both = torch.cat((state[:, first], state[:, second]), -1)
        total += torch.einsum("spa,spab,spb->s", both, found.pair_cost[:, :, k, :, : 2 * STATE], both)
        total += torch.einsum("sia,siab,sib->s", d[:, :, k], found.effort[:, :, k], d[:, :, k])
    torch.testing.assert_close(total, change[0].flatten(0, 1).square().sum(-1), rtol=1e-9, atol=1e-9)


def test_agents_alone_and_energies_without_pairs_have_no_pair_costs() -> None:
    energy, scene, game, controls = setup("euler", 1, None, pair=())
    assert not around(energy, scene, game, controls).pair_cost.any()
    alone = random_scene(2, 1, history=2, horizon=HORIZON, dtype=torch.double)
    own = random_game(alone, 1, HORIZON, own=OWN, pair=PAIR)
    energy = FeatureEnergy(own=OWN, pair=PAIR, bounds=BOUNDS, margins={"clearance": 0.5})
    found = around(energy, alone, own, own.initial_controls)
    assert found.pair_cost.shape == (2, 0, HORIZON, 2 * STATE, 2 * STATE + 1)
    assert found.effort.shape == (2, 1, HORIZON, CONTROL, CONTROL)


@pytest.mark.parametrize("name", ["jerk", "turnacc", "steer"])
def test_features_between_steps_are_refused(name: str) -> None:
    energy, scene, game, _ = setup("euler", 1, None, own=("goal", name))
    assert STAGES not in energy.offers
    with pytest.raises(
        ValueError, match=f"takes features of the states or of the controls of single time steps, and not {name}: leave"
    ):
        Feedback().descent()(energy, scene, game)


def test_functions_of_trajectories_are_refused_unless_they_are_of_single_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = PairFeature(Source.TRAJECTORY, lambda one, other: (one - other)[..., 0].square())
    monkeypatch.setitem(PAIR_FEATURES, "whole", whole)
    assert STAGES not in FeatureEnergy(own=["goal"], pair=["whole"]).offers
    # The LQ games have no costs of a state and a control together.
    own = OwnFeature(
        Source.STEP, "sideways", function=lambda states, controls: states[..., SPEED] * controls[..., TURN_RATE]
    )
    monkeypatch.setitem(OWN_FEATURES, "sideways", own)
    assert STAGES not in FeatureEnergy(own=["goal", "sideways"], pair=["clearance"]).offers
    assert STAGES in FeatureEnergy(own=["goal"], pair=["longitudinal"]).offers
