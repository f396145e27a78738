"""Hard constraints by an augmented Lagrangian: closed forms, SciPy's solver, optimality conditions, derivatives."""

from __future__ import annotations

import dataclasses
import math
import warnings

import pytest
import torch
from scipy.optimize import minimize

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.forecasters.combination import Combination
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.objectives.imitation import Imitation
from epo_lightning.registry import ConfigError, build
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.gauss_newton.augmented_lagrangian import AugmentedLagrangian
from epo_lightning.solvers.gauss_newton.constrained_game import ConstrainedGame
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OWN = {"goal": 3.0, "vel": 0.5, "acc": 1.0, "turnr": 1.0, "accb": 5.0}
ENERGY = FeatureEnergy(own=list(OWN), pair=["proximity"], bounds={"acc": (-0.3, 0.25)})
EXACT = AugmentedLagrangian(tolerance=1e-8)


def meeting(agents: int = 2, steps: int = 8, modes: int = 1, side: float = 0.05) -> tuple[Scene, GameParameters]:
    """Agents on a circle of 1 m that walk to the other side, each a little beside the middle."""
    angle = 2 * math.pi * torch.arange(agents, dtype=torch.double) / agents
    place = torch.stack((angle.cos(), angle.sin()), -1)
    left = torch.stack((-angle.sin(), angle.cos()), -1)
    place = place + side * left
    current = torch.cat((place, (angle + math.pi)[:, None], torch.ones(agents, 1, dtype=torch.double)), -1)
    scene = Scene(current[None, :, None], dt=0.25, size=torch.full((1, agents, 2), 0.6, dtype=torch.double))
    given = {
        name: torch.full((1, modes, agents), weight, dtype=torch.double) * (1 + 0.1 * torch.arange(agents))
        for name, weight in OWN.items()
    }
    pairs = agents * (agents - 1) // 2
    return scene, GameParameters(
        own_weights=given,
        pair_weights={"proximity": torch.full((1, modes, pairs), 5.0, dtype=torch.double)},
        goals=-(place - 2 * side * left).expand(1, modes, -1, -1).clone(),
        initial_controls=torch.zeros(1, modes, agents, steps, 2, dtype=torch.double),
    )


def least_distance(states: torch.Tensor) -> float:
    position = states[..., :2]
    apart = (position[:, :, :, None] - position[:, :, None]).norm(dim=-1)
    return float(apart[:, :, *torch.triu_indices(states.shape[2], states.shape[2], 1)].min())


def test_a_start_with_a_small_gradient_does_not_ask_for_more_than_double_precision_gives():
    """Three cars that drive straight on to their goals at first: at the solution, the constraints balance a steep gradient
    of E, whose rounding is above a bound relative to the start alone."""
    current = torch.tensor(
        [[-10.0, 0.0, 0.0, 5.0], [10.0, 0.4, math.pi, 5.0], [0.3, -12.0, math.pi / 2, 5.0]], dtype=torch.double
    )
    size = torch.tensor([4.5, 1.9], dtype=torch.double).expand(1, 3, 2)
    scene = Scene(current[None, :, None], dt=0.2, size=size)
    turning = torch.tensor([0.0, 0.001], dtype=torch.double)
    parameters = GameParameters(
        own_weights={
            name: torch.full((1, 1, 3), weight).double() for name, weight in (("goal", 1), ("acc", 1), ("turnr", 5))
        },
        pair_weights={"proximity": torch.ones(1, 1, 3, dtype=torch.double)},
        goals=torch.tensor([[[[10.0, 0.0], [-10.0, 0.4], [0.3, 10.0]]]], dtype=torch.double),
        initial_controls=turning.expand(1, 1, 3, 20, 2).clone(),
    )
    energy = FeatureEnergy(["goal", "acc", "turnr"])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # rounding, and with it the number of rounds, depends on the number of threads
    try:
        solution = AugmentedLagrangian()(energy, scene, parameters)
    finally:
        torch.set_num_threads(threads)
    assert solution.constraints is not None
    assert solution.status.item() == Status.COMPLETED
    assert solution.constraints.rounds.item() < 60


def test_a_bound_has_the_multiplier_of_the_closed_form():
    """min 1/2 w^2 (a - 2)^2 with a <= 0.5: a = 0.5 and lambda = w^2 (2 - 0.5)."""
    energy = FeatureEnergy(own=["accref", "turnrref", "accb"], pair=[], bounds={"acc": (-1.0, 0.5)})
    scene = Scene(torch.zeros(1, 1, 1, 4, dtype=torch.double), dt=0.1)
    weight = {name: torch.full((1, 1, 1), 3.0, dtype=torch.double) for name in energy.own}
    wanted = torch.tensor([2.0, 0.0], dtype=torch.double).expand(1, 1, 1, 4, 2)
    game = GameParameters(weight, {}, torch.zeros_like(wanted), reference_controls=wanted)
    found = EXACT(energy, scene, game)
    torch.testing.assert_close(found.controls[..., 0], torch.full((1, 1, 1, 4), 0.5, dtype=torch.double))
    multipliers = found.constraints.multipliers
    torch.testing.assert_close(multipliers["accb, upper"], torch.full((1, 1, 1, 4), 13.5, dtype=torch.double))
    assert (multipliers["accb, lower"] == 0).all()


@pytest.mark.parametrize("agents", [2, 3])
def test_the_solution_is_the_one_of_scipy(agents):
    """SLSQP on the same objective and constraints, with gradients by automatic differentiation, from the same start."""
    scene, parameters = meeting(agents)
    found = EXACT(ENERGY, scene, parameters)
    assert (found.status == Status.COMPLETED).all()
    game, shape = ConstrainedGame(ENERGY, EXACT.hard(ENERGY), scene, parameters), parameters.initial_controls.shape

    def objective(flat):
        leaf = torch.tensor(flat).view(shape).requires_grad_()
        value = game.objective(scene, parameters, leaf).sum()
        value.backward()
        return value.item(), leaf.grad.flatten().numpy()

    def slack(flat):
        return -torch.cat([h.flatten() for h in game.excess(torch.tensor(flat).view(shape)).values()]).numpy()

    def slopes(flat):
        return -game.jacobian(torch.tensor(flat).view(shape))[0, 0].numpy()

    with warnings.catch_warnings(action="ignore"):
        theirs = minimize(
            objective,
            found.controls.flatten().numpy() * 0.9,
            jac=True,
            method="SLSQP",
            constraints={"type": "ineq", "fun": slack, "jac": slopes},
            options={"maxiter": 300, "ftol": 1e-13},
        )
    assert theirs.success
    assert game.objective(scene, parameters, found.controls).item() == pytest.approx(theirs.fun, rel=1e-7)
    torch.testing.assert_close(found.controls.flatten(), torch.tensor(theirs.x), rtol=0, atol=1e-4)


def test_the_optimality_conditions_hold():
    scene, parameters = meeting(3, steps=10)
    found = EXACT(ENERGY, scene, parameters)
    game = ConstrainedGame(ENERGY, EXACT.hard(ENERGY), scene, parameters)
    excess = torch.cat([h.flatten(2) for h in game.excess(found.controls).values()], -1)
    multipliers = torch.cat([value.flatten(2) for value in found.constraints.multipliers.values()], -1)
    assert excess.max() <= 1e-8
    assert (multipliers >= 0).all()
    assert (multipliers > 0).sum() > 3
    assert (multipliers * excess).abs().max() < 1e-6
    leaf = found.controls.clone().requires_grad_()
    game.objective(scene, parameters, leaf).sum().backward()
    pushed = (game.jacobian(found.controls).mT @ multipliers[..., None])[..., 0]
    assert (leaf.grad.flatten(2) + pushed).abs().max() < 1e-6


def test_the_jacobian_of_the_constraints_is_that_of_automatic_differentiation():
    scene, parameters = meeting(3, steps=5)
    energy = dataclasses.replace(
        ENERGY, own=[*OWN, "jerkb", "velb"], bounds={"acc": (-1, 1), "jerk": (-1, 1), "vel": (0, 1)}
    )
    more = {name: torch.ones(1, 1, 3, dtype=torch.double) for name in ("jerkb", "velb")}
    parameters = dataclasses.replace(parameters, own_weights={**parameters.own_weights, **more})
    game = ConstrainedGame(energy, AugmentedLagrangian().hard(energy), scene, parameters)
    controls = 0.3 * torch.randn(1, 1, 3, 5, 2, dtype=torch.double, generator=torch.Generator().manual_seed(0))

    def values(given):
        return torch.cat([h.flatten() for h in game.excess(given.view_as(controls)).values()])

    expected = torch.autograd.functional.jacobian(values, controls.flatten())
    torch.testing.assert_close(game.jacobian(controls)[0, 0], expected)


def test_the_game_of_a_round_has_the_augmented_lagrangian_as_its_energy():
    """E + mu/2 sum max(0, h + lambda / mu)^2; also for three agents, whose pairs are as many as numbers of steps may be."""
    scene, parameters = meeting(3, steps=3)
    game = ConstrainedGame(ENERGY, AugmentedLagrangian().hard(ENERGY), scene, parameters)
    draw = torch.Generator().manual_seed(0)
    controls = 0.3 * torch.randn(1, 1, 3, 3, 2, dtype=torch.double, generator=draw)
    excess = game.excess(controls)
    multipliers = {name: torch.rand(h.shape, dtype=torch.double, generator=draw) for name, h in excess.items()}
    penalty = torch.full((1, 1), 7.0, dtype=torch.double)
    energy, *augmented = game.augmented(multipliers, penalty, controls)
    beyond = [(h + multipliers[name] / 7.0).clamp_min(0).square().sum() for name, h in excess.items()]
    expected = game.objective(scene, parameters, controls) + 3.5 * torch.stack(beyond).sum()
    torch.testing.assert_close(energy(*augmented, controls), expected)


def test_agents_keep_apart_where_soft_ones_overlap():
    scene, parameters = meeting(4, steps=10)
    soft = LevenbergMarquardt(steps=40, step_size=1.0, damping=1.0, adaptive=True, newton_steps=20)
    with torch.no_grad():
        before = soft(ENERGY, scene, parameters)
    after = AugmentedLagrangian()(ENERGY, scene, parameters)
    assert least_distance(before.states) < 0.58
    assert least_distance(after.states) > 0.599
    assert after.controls[..., 0].max() < 0.251
    assert after.constraints.violation.max() <= 1e-3
    torch.testing.assert_close(after.energy, ENERGY(scene, parameters, after.controls))


def test_the_derivative_is_that_of_finite_differences():
    scene, parameters = meeting(2)
    energy = dataclasses.replace(ENERGY, pair=["clearance"])
    margin = torch.full((1, 1, 1), 0.05, dtype=torch.double)
    weights = parameters.pair_weights["proximity"]
    parameters = dataclasses.replace(parameters, pair_weights={"clearance": weights}, margins={"clearance": margin})
    generator = torch.Generator().manual_seed(0)
    solve = AugmentedLagrangian(tolerance=1e-10)
    leaves = parameters.map(lambda tensor: tensor.clone().requires_grad_())
    found = Implicit()(solve, energy, scene, leaves)
    assert sum((value > 0).sum() for value in found.constraints.multipliers.values()) >= 2
    cotangent = torch.randn(found.states.shape, dtype=torch.double, generator=generator)
    (found.states * cotangent).sum().backward()
    near, step = dataclasses.replace(parameters, initial_controls=found.controls.detach()), 1e-5
    along = parameters.map(lambda tensor: torch.randn(tensor.shape, dtype=torch.double, generator=generator))
    slope = torch.zeros((), dtype=torch.double)
    for taught, way in (
        *((leaves.own_weights[name], along.own_weights[name]) for name in OWN if name != "accb"),
        (leaves.margins["clearance"], along.margins["clearance"]),
        (leaves.goals, along.goals),
    ):
        slope += (taught.grad * way).sum()

    def total(sign):
        own = {name: value + sign * step * along.own_weights[name] for name, value in near.own_weights.items()}
        margins = {"clearance": near.margins["clearance"] + sign * step * along.margins["clearance"]}
        goals = near.goals + sign * step * along.goals
        moved = dataclasses.replace(near, own_weights=own, margins=margins, goals=goals)
        return (solve(energy, scene, moved).states * cotangent).sum()

    torch.testing.assert_close(slope, (total(1) - total(-1)) / (2 * step), rtol=1e-4, atol=0)
    assert leaves.pair_weights["clearance"].grad is None or not leaves.pair_weights["clearance"].grad.any()


def test_a_game_in_which_no_constraint_binds_is_that_of_the_layer():
    scene, parameters = meeting(2, side=1.0)
    parameters = dataclasses.replace(parameters, goals=parameters.goals / 4)
    free = dataclasses.replace(ENERGY, bounds={"acc": (-30.0, 30.0)})
    leaves = [parameters.map(lambda tensor: tensor.clone().requires_grad_()) for _ in range(2)]
    soft = LevenbergMarquardt(steps=40, step_size=1.0, damping=1.0, adaptive=True, newton_steps=20)
    one, other = (Implicit()(solver, free, scene, given) for solver, given in zip((EXACT, soft), leaves, strict=True))
    torch.testing.assert_close(one.controls, other.controls, rtol=0, atol=1e-6)
    for solution in (one, other):
        solution.states.square().sum().backward()
    for name in ("goal", "acc"):
        torch.testing.assert_close(
            leaves[0].own_weights[name].grad, leaves[1].own_weights[name].grad, rtol=1e-5, atol=1e-8
        )


def test_too_few_rounds_are_no_solution():
    scene, parameters = meeting(2)
    found = AugmentedLagrangian(rounds=2, penalty=1e5)(ENERGY, scene, parameters)
    assert found.constraints.violation.item() < 1e-3
    assert found.status.item() == Status.STOPPED


def test_the_weight_of_a_constraint_does_not_change_the_strategies():
    scene, parameters = meeting(2)
    one, other = (
        AugmentedLagrangian()(
            ENERGY,
            scene,
            dataclasses.replace(parameters, pair_weights={"proximity": torch.full((1, 1, 1), weight).double()}),
        )
        for weight in (5.0, 1000.0)
    )
    assert torch.equal(one.controls, other.controls)


def test_agents_that_overlap_from_the_beginning_are_stopped_and_disturb_no_other_scene():
    scene, parameters = meeting(2, side=0.05)
    history = scene.history.clone()
    history[..., :2] *= 0.1
    both = Scene(torch.cat((scene.history, history)), dt=scene.dt, size=scene.size.expand(2, -1, -1))
    doubled = parameters.map(lambda tensor: torch.cat((tensor, tensor)).requires_grad_())
    solve = AugmentedLagrangian(rounds=15)
    found = Implicit()(solve, ENERGY, both, doubled)
    assert found.status.flatten().tolist() == [Status.COMPLETED, Status.STOPPED]
    assert found.constraints.violation[1] > 0.1
    alone = solve(ENERGY, scene, parameters)
    torch.testing.assert_close(found.controls[:1], alone.controls, rtol=0, atol=1e-9)
    found.states.sum().backward()
    assert doubled.own_weights["goal"].grad[0].abs().sum() > 0
    assert not doubled.own_weights["goal"].grad[1].any()


def test_absent_agents_and_pairs_without_weight_have_no_constraint():
    scene, parameters = meeting(3)
    expected = AugmentedLagrangian()(ENERGY, *meeting(3))
    off = dataclasses.replace(parameters, pair_weights={"proximity": 0.0 * parameters.pair_weights["proximity"]})
    free = AugmentedLagrangian()(ENERGY, scene, off)
    assert least_distance(free.states) < 0.55 < 0.599 < least_distance(expected.states)
    mask = torch.tensor([[True, True, False]])
    poisoned = scene.history.clone()
    poisoned[:, 2] = torch.nan
    absent = AugmentedLagrangian()(ENERGY, dataclasses.replace(scene, history=poisoned, agent_mask=mask), parameters)
    assert absent.controls.isfinite().all()
    assert (absent.status == Status.COMPLETED).all()
    assert (absent.constraints.multipliers["proximity"][:, :, 1:] == 0).all()


def test_settings_and_games_that_cannot_be_used_are_refused():
    scene, parameters = meeting(2)
    for setting, message in (
        ({"penalty": 0.0}, "penalty"),
        ({"growth": 0.5}, "growth"),
        ({"newton_steps": 0}, "newton_steps"),
        ({"constraints": []}, "empty"),
    ):
        with pytest.raises(ConfigError, match=message):
            AugmentedLagrangian(**setting)
    with pytest.raises(ValueError, match=r"'goal' is no feature .* that can be a constraint"):
        AugmentedLagrangian(constraints=["goal"])(ENERGY, scene, parameters)
    plain = FeatureEnergy(own=["goal", "vel"], pair=["circles"])
    with pytest.raises(ValueError, match="needs an energy with constraints"):
        AugmentedLagrangian()(plain, scene, parameters)
    with pytest.raises(ValueError, match="a feature besides the constraints"):
        AugmentedLagrangian()(FeatureEnergy(own=[], pair=["proximity"]), scene, parameters)
    assert isinstance(build("solver", {"name": "augmented_lagrangian"}), AugmentedLagrangian)


def test_constraints_that_the_energy_lacks_are_refused_before_anything_is_solved():
    parts = {"energy": ENERGY, "backward": Implicit(), "objective": Imitation}
    Combination.of(solver=AugmentedLagrangian(constraints=["accb"]), **parts).check()
    with pytest.raises(ConfigError, match=r"solver\.constraints: 'clearance' is no feature of this energy"):
        Combination.of(solver=AugmentedLagrangian(constraints=["clearance"]), **parts).check()


def test_games_that_end_early_have_the_derivative_of_finite_differences():
    scene, parameters = meeting(3, steps=8)
    scene = dataclasses.replace(
        scene.map(lambda value: value.expand(2, *value.shape[1:])), game_steps=torch.tensor([6, 8])
    )
    parameters = parameters.map(lambda value: value.expand(2, *value.shape[1:]).clone())
    goals = parameters.goals.clone().requires_grad_()
    found = Implicit()(EXACT, ENERGY, scene, dataclasses.replace(parameters, goals=goals))
    assert (found.status == Status.COMPLETED).all()
    generator = torch.Generator().manual_seed(0)
    cotangent = torch.randn(found.controls.shape, dtype=torch.double, generator=generator)
    (slope,) = torch.autograd.grad((found.controls * cotangent).sum(), goals)
    along, step = torch.randn(goals.shape, dtype=torch.double, generator=generator), 1e-5

    def total(sign):
        near = dataclasses.replace(
            parameters, goals=goals.detach() + sign * step * along, initial_controls=found.controls.detach()
        )
        return (EXACT(ENERGY, scene, near).controls * cotangent).sum((1, 2, 3, 4))

    expected = (total(1) - total(-1)) / (2 * step)
    assert (expected.abs() > 1e-3).all()
    torch.testing.assert_close((slope * along).sum((1, 2, 3)), expected, rtol=1e-4, atol=0)


def test_moved_limits_reach_pairs_that_are_apart():
    """Three agents, 1.7 m apart with discs of 0.6 m: limits that are moved by 1.5 m are violated, and by 0.5 m not."""
    scene, parameters = meeting(3, steps=4)
    controls = parameters.initial_controls
    scene = dataclasses.replace(scene, history=scene.history * torch.tensor([1.0, 1.0, 1.0, 0.0], dtype=torch.double))
    game = ConstrainedGame(ENERGY, ("proximity",), scene, parameters)
    penalty = torch.full((1, 1), 10.0, dtype=torch.double)
    apart = float((scene.current[0, 0, :2] - scene.current[0, 1, :2]).norm())
    alone = float(game.objective(scene, parameters, controls))
    for shift in (0.5, 1.5):
        moved = {name: torch.full_like(value, 10.0 * shift) for name, value in game.excess(controls).items()}
        augmented = game.augmented(moved, penalty, controls)
        found = LevenbergMarquardt(steps=0, backend="pytorch")(*augmented)
        violation = max(0.0, 0.6 + shift - apart)
        assert float(found.energy) == pytest.approx(alone + 3 * 4 * 0.5 * 10.0 * violation**2)
        assert (violation > 0) == (shift > 1)


@pytest.mark.parametrize(("moved", "limit"), [("lower", 0.7), ("upper", -0.75)])
def test_of_limits_that_have_passed_each_other_the_one_with_a_multiplier_counts(moved, limit):
    """Limits -0.3 and 0.25, one of which is moved by 1 beyond the other one: what remains is the distance from it."""
    scene, parameters = meeting(2, steps=3)
    game = ConstrainedGame(ENERGY, ("accb",), scene, parameters)
    for acceleration in (-1.0, -0.5, 0.0, 0.5, 1.0):
        controls = torch.zeros_like(parameters.initial_controls)
        controls[..., 0] = acceleration
        multipliers = {name: torch.zeros_like(value) for name, value in game.excess(controls).items()}
        multipliers[f"accb, {moved}"] += 10.0
        energy, *augmented = game.augmented(multipliers, torch.full((1, 1), 10.0, dtype=torch.double), controls)
        added = energy(*augmented, controls) - game.objective(scene, parameters, controls)
        assert float(added) == pytest.approx(2 * 3 * 0.5 * 10.0 * (acceleration - limit) ** 2)


def test_there_are_no_constraints_after_the_end_of_a_game():
    scene, parameters = meeting(2, steps=5)
    scene = dataclasses.replace(scene, game_steps=torch.tensor([3]))
    game = ConstrainedGame(ENERGY, AugmentedLagrangian().hard(ENERGY), scene, parameters)
    controls = torch.ones_like(parameters.initial_controls)
    assert len(game.excess(controls)) == 3
    for name, excess in game.excess(controls).items():
        assert excess[..., :3].isfinite().all(), name
        assert (excess[..., 3:] == -torch.inf).all(), name
    later = controls.clone().requires_grad_()
    torch.cat([h[h.isfinite()] for h in game.excess(later).values()]).sum().backward()
    assert (later.grad[..., 3:, :] == 0).all()
    assert (later.grad[..., :3, :] != 0).any()
