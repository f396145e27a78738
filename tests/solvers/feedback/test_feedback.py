"""Feedback equilibria of driving games: against the generator of RPI, against open-loop minima, and their derivative."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.sparse.linalg
import torch
from games import leaves_of

from epo_lightning.data.rpi import solve as generator
from epo_lightning.data.rpi.game import GameConstants, main_game
from epo_lightning.drive.rpi import ENERGY as TRUE_ENERGY
from epo_lightning.drive.rpi import true_game
from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.feedback import derivative, iteration
from epo_lightning.solvers.feedback.anderson import Anderson
from epo_lightning.solvers.feedback.lq_game import LQGame, Policy
from epo_lightning.solvers.feedback.solver import Feedback
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

ENERGY = FeatureEnergy(own=["goal", "vel", "acc", "turnr"], pair=["clearance"], margins={"clearance": 0.5})
HORIZON = 20
EXACT = {"tolerance": 1e-11, "iterations": 300}


def meeting(*directions: float, modes: int = 2, weight: float = 8.0) -> tuple[Scene, GameParameters]:
    """Two agents that meet in the middle; agent 1 comes from one direction per scene."""
    angle = torch.tensor(directions, dtype=torch.double)
    from_left = torch.tensor([-1.3, 0.03, 0.0, 1.3], dtype=torch.double).expand(len(angle), 4)
    other = torch.stack((-1.3 * angle.cos(), -1.3 * angle.sin(), angle, torch.full_like(angle, 1.3)), -1)
    current = torch.stack((from_left, other), 1)
    shape = (len(angle), modes, 2)
    own = {"goal": 10.0, "vel": 3.0, "acc": 3.0, "turnr": 3.0}
    scene = Scene(history=current[:, :, None], dt=0.1, size=torch.full((len(angle), 2, 2), 0.5, dtype=torch.double))
    return scene, GameParameters(
        own_weights={name: torch.full(shape, value, dtype=torch.double) for name, value in own.items()},
        pair_weights={"clearance": torch.full((*shape[:2], 1), weight, dtype=torch.double)},
        initial_controls=torch.zeros(*shape, HORIZON, 2, dtype=torch.double),
        goals=-current[:, None, :, :2].expand(-1, modes, -1, -1),
    )


def test_solutions_are_those_of_the_generator_of_rpi() -> None:
    """The same games, solved by code that the solver shares no line with."""
    constants, steps = GameConstants(), 60
    settings = generator.FeedbackSettings(step=1.0, tolerance=1e-9, iterations=400)
    for number in range(3):
        game = main_game(3, number, 1, 4, constants)
        start = game.start.copy()
        start[[3, 7]] = 0.6  # already on their way
        u = np.zeros((steps, 4))
        given = (start, u, constants.array(), game.goals, game.weight)
        _, u, _, _ = generator.solve_potential(*given, np.ones(2), generator.PotentialSettings())
        x, _, converged, _ = generator.solve_feedback(start, u, *given[2:], settings)
        assert converged
        agents = torch.from_numpy(start).view(1, 2, 4)
        scene = Scene(history=agents[:, :, None], dt=constants.dt, size=torch.full((1, 2, 2), 0.5, dtype=torch.double))
        goals = torch.from_numpy(game.goals)[None]
        ours = true_game(torch.tensor([game.weight]), goals[..., :2], goals[..., 2], steps)
        ours = dataclasses.replace(ours, initial_controls=torch.from_numpy(u).view(1, 1, steps, 2, 2).transpose(2, 3))
        found = Feedback(**EXACT).descent().near_minimum()(TRUE_ENERGY, scene, ours)
        assert found.status.item() == Status.COMPLETED
        wanted = torch.from_numpy(x[1:]).view(steps, 2, 4).transpose(0, 1)
        torch.testing.assert_close(found.states[0, 0], wanted, rtol=0, atol=1e-7)


def test_the_modes_are_on_different_sides_and_not_those_of_the_open_loop_game() -> None:
    scene, game = meeting(math.pi, 2.5, -2.5)
    found = Feedback()(ENERGY, scene, game)
    sight = found.states[..., 1, :, :2] - found.states[..., 0, :, :2]
    turn = torch.atan2(sight[..., 1], sight[..., 0]).diff(dim=-1)
    side = ((turn + math.pi) % (2 * math.pi) - math.pi).sum(-1).sign()
    assert (side[:, 0] == -side[:, 1]).all()
    assert (found.status == Status.COMPLETED).all()
    assert (found.gradient_norm > 1.0).all(), "an open-loop equilibrium has no gradient"
    torch.testing.assert_close(found.energy, ENERGY(scene, game, found.controls))


def test_agents_without_interaction_do_the_same_as_in_the_open_loop_game() -> None:
    scene, game = meeting(math.pi, 2.5, weight=0.0)
    found = Feedback(**EXACT)(ENERGY, scene, game)
    alone = LevenbergMarquardt(steps=10, step_size=1.0, damping=1.0, adaptive=True, newton_steps=20)
    with torch.no_grad():
        torch.testing.assert_close(found.states, alone(ENERGY, scene, game).states, rtol=0, atol=1e-6)


def test_solutions_have_the_derivative_of_the_fixed_point() -> None:
    """Derivatives by weights and goals, against finite differences."""
    scene, game = meeting(2.3, -2.6)
    solver = Feedback(**EXACT, terms=80)
    weigh = torch.randn(2, 2, 2, HORIZON, 4, dtype=torch.double)
    leaves = leaves_of(game)
    (Implicit()(solver, ENERGY, scene, leaves).states * weigh).sum().backward()
    way = game.map(torch.randn_like)

    def total(step: float) -> torch.Tensor:
        own = {name: weight + step * way.own_weights[name][:, :1] for name, weight in game.own_weights.items()}
        pair = {name: weight + step * way.pair_weights[name][:, :1] for name, weight in game.pair_weights.items()}
        goals = game.goals + step * way.goals[:, :1]
        moved = dataclasses.replace(game, own_weights=own, pair_weights=pair, goals=goals)
        return (solver(ENERGY, scene, moved).states * weigh).sum()

    slope = sum((leaves.own_weights[name].grad * way.own_weights[name][:, :1]).sum() for name in game.own_weights)
    slope = slope + (leaves.pair_weights["clearance"].grad * way.pair_weights["clearance"][:, :1]).sum()
    slope = slope + (leaves.goals.grad * way.goals[:, :1]).sum()
    torch.testing.assert_close(slope, (total(1e-5) - total(-1e-5)) / 2e-5, rtol=1e-4, atol=1e-4)


def test_acceleration_reaches_the_same_equilibria_in_fewer_games(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, game = meeting(math.pi, 2.3, -2.6, 1.2)
    counted: list[int] = []

    class Plain(Anderson):
        def remember(self, *_: torch.Tensor) -> None:
            pass

    def solve(memory: type[Anderson]) -> torch.Tensor:
        counted.append(0)
        monkeypatch.setattr(iteration, "Anderson", memory)
        found = Feedback(**EXACT, backend="pytorch")(ENERGY, scene, game)
        assert (found.status == Status.COMPLETED).all()
        return found.states

    def equilibrium(local: LQGame) -> Policy:
        counted[-1] += len(local.A)
        return one(local)

    one = LQGame.equilibrium
    monkeypatch.setattr(LQGame, "equilibrium", equilibrium)
    torch.testing.assert_close(solve(Anderson), solve(Plain), rtol=0, atol=1e-7)
    assert counted[0] < 0.8 * counted[1]


def test_the_adjoint_is_that_of_the_linear_system() -> None:
    """All steps of GMRES against a dense solution; fewer steps against SciPy's."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(3, 12, 12, generator=generator, dtype=torch.double) / 12 - torch.eye(12, dtype=torch.double)
    cotangent = torch.randn(3, 1, 2, 3, 2, generator=generator, dtype=torch.double)

    def by_controls(covector: torch.Tensor) -> torch.Tensor:
        return (matrix @ covector.flatten(1)[..., None]).view_as(covector)

    flat = cotangent.flatten(1)
    exact = torch.linalg.solve(-matrix, flat)
    torch.testing.assert_close(derivative._gmres(by_controls, cotangent, 12).flatten(1), exact)
    found = derivative._gmres(by_controls, cotangent, 3).flatten(1)
    for system, vector, ours in zip(-matrix, flat, found, strict=True):
        wanted, _ = scipy.sparse.linalg.gmres(system.numpy(), vector.numpy(), restart=3, maxiter=1, rtol=0)
        np.testing.assert_allclose(ours.numpy(), wanted, atol=1e-9)


def test_modes_without_loss_do_not_change_the_gradient_of_the_others() -> None:
    scene, game = meeting(2.3, -2.6)

    def gradient(share: float) -> torch.Tensor:
        leaves = leaves_of(game)
        states = Implicit()(Feedback(**EXACT), ENERGY, scene, leaves).states
        (states[:, 0].sum() + share * states[:, 1].sum()).backward()
        return leaves.goals.grad

    assert (gradient(0.0)[:, 1] == 0).all()
    torch.testing.assert_close(gradient(0.0)[:, 0], gradient(1.0)[:, 0])


def test_more_steps_of_gmres_come_closer_to_the_derivative() -> None:
    scene, game = meeting(2.3)

    def slope(terms: int) -> torch.Tensor:
        leaves = leaves_of(game)
        Implicit()(Feedback(**EXACT, terms=terms), ENERGY, scene, leaves).states[..., :2].sum().backward()
        return leaves.pair_weights["clearance"].grad

    wanted = slope(80)
    missed = [(slope(terms) - wanted).norm() / wanted.norm() for terms in (1, 4, 16)]
    assert missed[0] > 0.05
    assert missed[1] < 0.5 * missed[0]
    assert missed[2] < 0.1 * missed[1]


@pytest.mark.parametrize("backend", ["auto", "pytorch"])
def test_a_scene_with_nan_is_stopped_and_has_no_gradient(backend: str) -> None:
    scene, game = meeting(2.3, -2.6)
    scene.history[1, 0, 0, 0] = torch.nan
    leaves = leaves_of(game)
    found = Implicit()(Feedback(backend=backend), ENERGY, scene, leaves)
    assert (found.status[1] == Status.STOPPED).all()
    found.states[0].sum().backward()
    for gradient in (leaves.goals.grad, leaves.pair_weights["clearance"].grad, leaves.own_weights["vel"].grad):
        assert gradient[0].abs().sum() > 0
        assert (gradient[1] == 0).all()


@pytest.mark.parametrize("backend", ["auto", "pytorch"])
@pytest.mark.parametrize("scale", [1e-200, 1e-5, 1e200])
def test_the_derivative_is_linear_in_the_cotangent_at_all_scales(scale: float, backend: str) -> None:
    scene, game = meeting(2.3)
    slopes = []
    for factor in (1.0, scale):
        leaves = leaves_of(game)
        found = Implicit()(Feedback(backend=backend), ENERGY, scene, leaves)
        found.states.backward(factor * torch.ones(1, 2, 2, HORIZON, 4).double())
        slopes.append(leaves.goals.grad / factor)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-9, atol=0)


@pytest.mark.parametrize("backend", ["auto", "pytorch"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_cotangent_that_is_not_finite_stays_in_its_own_game(value: float, backend: str) -> None:
    scene, game = meeting(2.3, -2.6)
    slopes = []
    for other in (1.0, value):
        leaves = leaves_of(game)
        cotangent = torch.ones(2, 2, 2, HORIZON, 4, dtype=torch.double)
        cotangent[1] = other
        Implicit()(Feedback(backend=backend), ENERGY, scene, leaves).states.backward(cotangent)
        slopes.append(leaves.goals.grad)
    assert torch.equal(slopes[1][0], slopes[0][0])
    assert slopes[0].isfinite().all()
    assert not slopes[1][1].isfinite().all()


def test_the_given_strategies_stay_unchanged() -> None:
    scene, game = meeting(2.3)
    Feedback().descent().near_minimum()(ENERGY, scene, game)
    assert (game.initial_controls == 0).all()


def test_too_few_iterations_are_reported() -> None:
    scene, game = meeting(2.3)
    assert (Feedback(iterations=1, tolerance=1e-9)(ENERGY, scene, game).status == Status.DAMPED).all()


def test_single_precision_and_empty_batches() -> None:
    scene, game = meeting(2.3)
    exact = Feedback()(ENERGY, scene, game)
    found = Feedback()(ENERGY, scene.to(torch.float32), game.to(torch.float32))
    assert found.controls.dtype == torch.float32
    torch.testing.assert_close(found.states.double(), exact.states, rtol=0, atol=1e-2)
    assert Feedback()(ENERGY, scene[[]], game[[]]).states.shape == (0, 2, 2, HORIZON, 4)


def test_steps_after_the_end_of_a_game_have_no_effect() -> None:
    scene, game = meeting(2.3, -2.6)
    solver = Feedback().descent().near_minimum()
    wanted = solver(ENERGY, scene, game)
    longer = torch.nn.functional.pad(game.initial_controls, (0, 0, 0, 30), value=4.0)
    ends = torch.full((2,), HORIZON, dtype=torch.int32)
    found = solver(
        ENERGY, dataclasses.replace(scene, game_steps=ends), dataclasses.replace(game, initial_controls=longer)
    )
    assert torch.equal(found.status, wanted.status)
    torch.testing.assert_close(found.states[..., :HORIZON, :], wanted.states, rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", ["auto", "pytorch"])
def test_controls_after_the_end_of_a_game_have_no_gradient(backend: str) -> None:
    scene, game = meeting(2.3, -2.6)
    leaves, ended = leaves_of(game), dataclasses.replace(scene, game_steps=torch.full((2,), HORIZON - 5))
    Implicit()(Feedback(backend=backend), ENERGY, ended, leaves).controls[..., -5:, :].sum().backward()
    for gradient in (leaves.goals.grad, leaves.pair_weights["clearance"].grad, leaves.own_weights["vel"].grad):
        assert (gradient == 0).all()


def test_a_hessian_without_second_derivatives_is_refused() -> None:
    scene, game = meeting(2.3)
    with pytest.raises(ConfigError, match=r"backward\.hessian=gauss_newton has no effect with solver=feedback"):
        Implicit(hessian="gauss_newton")(Feedback(), ENERGY, scene, leaves_of(game))


def test_a_missing_library_is_named_before_anything_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, parameters = meeting(0.5)
    monkeypatch.setattr(interface, "find", lambda: "it was not built")
    for solver in (Feedback(), Feedback(backend="pytorch"), Feedback().descent()):
        with pytest.raises(ConfigError, match=r"solver=feedback needs the compiled layer .* missing: it was not built"):
            solver(ENERGY, scene, parameters)


def test_only_solved_games_have_a_gradient_and_many_others_a_warning() -> None:
    scene, game = meeting(2.3)
    leaves = leaves_of(game)
    with pytest.warns(UserWarning, match="more than half of the games of a batch are not solved"):
        found = Implicit()(Feedback(iterations=1, tolerance=1e-9), ENERGY, scene, leaves)
    found.states.sum().backward()
    assert (leaves.goals.grad == 0).all()


def test_an_energy_of_pairs_alone_can_be_solved() -> None:
    scene, game = meeting(2.3)
    pairs = dataclasses.replace(ENERGY, own=[])
    found = Feedback()(pairs, scene, dataclasses.replace(game, own_weights={}))
    assert (found.status == Status.COMPLETED).all()
    assert found.states.isfinite().all()
