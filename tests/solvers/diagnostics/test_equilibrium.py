"""The equilibrium report against closed forms, other minimisers, loops over tables, and held agents."""

from __future__ import annotations

import dataclasses
import importlib
from itertools import product

import numpy as np
import pytest
import torch
from backends import stacked
from games import ALL, BOUNDS, leaves_of, nearest_points_held, pad, random_game, random_scene, widen
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from epo_lightning.forecast import GameParameters, JointForecast, Solution, Status, Tables
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.metrics.forecast import equilibrium_values
from epo_lightning.scene import Scene
from epo_lightning.solvers.diagnostics import quasi_newton
from epo_lightning.solvers.diagnostics.equilibrium import Descent, equilibrium
from epo_lightning.solvers.gauss_newton import backends, compiled, structured
from epo_lightning.solvers.gauss_newton.augmented_lagrangian import AugmentedLagrangian
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OWN = ("goal", "acc", "turnr")
STEPS = 7
SLOW = settings(max_examples=12, suppress_health_check=[HealthCheck.differing_executors])


class Opaque(Energy):
    """A feature energy that does not declare its features, so that no solver knows its structure."""

    offers = frozenset({GRADIENT})

    def __init__(self, features: FeatureEnergy) -> None:
        self.features, self.own, self.pair, self.dynamics = features, features.own, features.pair, features.dynamics

    def own_terms(self, scene, parameters, states, controls):
        return self.features.own_terms(scene, parameters, states, controls)

    def pair_terms(self, scene, parameters, first, second):
        return self.features.pair_terms(scene, parameters, first, second)


class Valued(Opaque):
    """An energy without derivatives."""

    offers = frozenset()


KINDS = pytest.mark.parametrize("kind", [lambda energy: energy, Opaque], ids=["features", "any"])


def forecast_of(energy, scene, parameters, controls, probabilities=None, **solution) -> JointForecast:
    """The forecast of these strategies."""
    states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
    shape = controls.shape[:2]
    value = torch.zeros(shape, dtype=controls.dtype)
    found = Solution(controls, states, value - 7.0, value, value, value.long(), **solution)
    if probabilities is None:
        probabilities = torch.full(shape, 1.0 / shape[1], dtype=controls.dtype)
    return JointForecast(states, probabilities, parameters=parameters, solution=found)


def report(energy, scene, parameters, controls, **options):
    return equilibrium(energy, scene, forecast_of(energy, scene, parameters, controls, **options))


# Agents in a row, all of them heading along it: turn rates stay zero, and while all hinges are active, and none changes its
# side, the game is linear-quadratic.


@dataclasses.dataclass(frozen=True)
class Row:
    """Three agents in a row: positions are linear in accelerations, p = start + moves a."""

    scene: Scene
    parameters: GameParameters
    start: np.ndarray  # [N, K]
    moves: np.ndarray  # [K, K]
    energy = FeatureEnergy(["goal", "acc", "turnr"], ["proximity"])
    dt, weight, goals = 0.2, {"goal": 0.7, "acc": 1.3, "turnr": 9.0, "proximity": 0.6}, (1.0, 1.5, 3.0)

    @classmethod
    def make(cls) -> Row:
        state = torch.zeros(1, 3, 1, 4, dtype=torch.float64)
        state[0, :, 0, 0], state[0, :, 0, 3] = torch.tensor([0.0, 1.0, 2.2]), torch.tensor([0.3, 0.2, 0.4])
        scene = Scene(state, dt=cls.dt, size=torch.full((1, 3, 2), 6.0, dtype=torch.float64))
        goals = torch.zeros(1, 1, 3, 2, dtype=torch.float64)
        goals[..., 0] = torch.tensor(cls.goals)
        ones = torch.ones(1, 1, 3, dtype=torch.float64)
        own = {name: cls.weight[name] * ones for name in cls.energy.own}
        pair = {"proximity": cls.weight["proximity"] * ones}
        parameters = GameParameters(own, pair, torch.zeros(1, 1, 3, STEPS, 2, dtype=torch.float64), goals)
        k = np.arange(1, STEPS + 1)
        moves = cls.dt**2 * np.clip(k[:, None] - 1 - np.arange(STEPS), 0, None)
        begin = state[0, :, 0].numpy()
        return cls(scene, parameters, begin[:, :1] + begin[:, 3:] * cls.dt * k, moves)

    def system(self) -> tuple[np.ndarray, np.ndarray]:
        """dE/da = H a + h, agents one after the other."""
        n, w = len(self.start), {name: value**2 for name, value in self.weight.items()}
        matrix, vector = np.zeros((n, STEPS, n, STEPS)), np.zeros((n, STEPS))
        for i in range(n):
            end = self.moves[-1]
            matrix[i, :, i] += w["acc"] * np.eye(STEPS) + w["goal"] * np.outer(end, end)
            vector[i] += w["goal"] * end * (self.start[i, -1] - self.goals[i])
            for j in range(i + 1, n):  # 1/2 w (6 - (p_j - p_i))^2
                gap = 6.0 - (self.start[j] - self.start[i])
                both = w["proximity"] * self.moves.T @ self.moves
                for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                    matrix[a, :, b] += sign * both
                vector[i] += w["proximity"] * self.moves.T @ gap
                vector[j] -= w["proximity"] * self.moves.T @ gap
        return matrix.reshape(n * STEPS, -1), vector.reshape(-1)

    def controls(self, acceleration: np.ndarray) -> torch.Tensor:
        controls = torch.zeros(1, 1, 3, STEPS, 2, dtype=torch.float64)
        controls[0, 0, :, :, 0] = torch.from_numpy(acceleration.reshape(3, STEPS))
        return controls


@KINDS
def test_the_equilibrium_of_a_linear_quadratic_game_has_no_gap(kind):
    game = Row.make()
    matrix, vector = game.system()
    solved = game.controls(np.linalg.solve(matrix, -vector))
    depths = game.energy.residuals(game.scene, game.parameters, solved)["proximity"]
    assert (depths > 0).all(), "all hinges are active"
    found = report(kind(game.energy), game.scene, game.parameters, solved)
    assert found.nash_gap.max() < 1e-9
    assert found.gradient_norm.item() < 1e-9
    assert found.energy.item() == pytest.approx(game.energy(game.scene, game.parameters, solved).item(), rel=1e-12)
    assert found.optimum.item() == pytest.approx(found.energy.item(), rel=1e-10)
    assert found.initial.item() == -7.0, "as the solver says"


@KINDS
def test_gaps_of_a_linear_quadratic_game_are_those_of_the_closed_form(kind):
    game = Row.make()
    matrix, vector = game.system()
    solved = np.linalg.solve(matrix, -vector)
    away = solved + 0.3 * np.random.default_rng(0).standard_normal(len(solved))
    slope = matrix @ away + vector
    found = report(kind(game.energy), game.scene, game.parameters, game.controls(away))
    for i in range(3):
        of = slice(i * STEPS, (i + 1) * STEPS)
        gain = 0.5 * slope[of] @ np.linalg.solve(matrix[of, of], slope[of])
        assert found.nash_gap[0, i].item() == pytest.approx(gain, rel=1e-6)
    saved = 0.5 * slope @ np.linalg.solve(matrix, slope)
    assert (found.energy - found.optimum).item() == pytest.approx(saved, rel=1e-6)
    # Turn rates have zero gradients, as all agents are on the row.
    assert found.gradient_norm.item() == pytest.approx(np.linalg.norm(slope), rel=1e-10)


@KINDS
@pytest.mark.parametrize("agents", [1, 3])
def test_gaps_equal_those_of_another_minimiser(kind, agents):
    scene = random_scene(2, agents, history=2, size=1.0, dtype=torch.float64)
    parameters = random_game(scene, 1, STEPS, own=OWN)
    energy = FeatureEnergy(OWN, ["proximity"])
    controls = 0.3 * parameters.initial_controls
    found = report(kind(energy), scene, parameters, controls)
    torch.testing.assert_close(found.energy, energy(scene, parameters, controls)[:, 0])
    torch.testing.assert_close(found.objective, energy.objectives(scene, parameters, controls)[:, 0])
    leaf = controls.clone().requires_grad_()
    (slope,) = torch.autograd.grad(energy(scene, parameters, leaf).sum(), leaf)
    torch.testing.assert_close(found.gradient_norm, slope.flatten(1).norm(dim=1))
    for b, i in product(range(2), range(agents)):

        def objective(flat, b=b, i=i):
            changed = controls[[b]].clone()
            changed[0, 0, i] = torch.from_numpy(flat).view(STEPS, 2)
            changed.requires_grad_()
            value = energy.objectives(scene[b], parameters[b], changed)[0, 0, i]
            (slope,) = torch.autograd.grad(value, changed)
            return value.item(), slope[0, 0, i].flatten().numpy()

        own = controls[b, 0, i].flatten().numpy()
        best = minimize(objective, own, jac=True, method="BFGS", options={"gtol": 1e-9, "maxiter": 2000})
        assert found.nash_gap[b, i].item() == pytest.approx(objective(own)[0] - best.fun, rel=1e-6)
    if agents == 1:
        torch.testing.assert_close(found.energy - found.optimum, found.nash_gap[:, 0], rtol=1e-8, atol=0)


def test_gaps_vanish_at_solved_games():
    scene = random_scene(24, 3, history=2, size=1.0, dtype=torch.float64)
    parameters = random_game(scene, 1, STEPS, spread=0.1)
    energy = FeatureEnergy(("goal", "vel", "acc", "turnr", "jerk"))
    solve = LevenbergMarquardt(steps=400, step_size=1.0, damping=1.0, adaptive=True)
    solution = solve(energy, scene, parameters)
    found = report(energy, scene, parameters, solution.controls)
    assert (solution.initial_energy > 1.1 * solution.energy).all()
    assert (found.energy - found.optimum < 1e-6).all()
    assert (found.nash_gap < 1e-6).all()


@KINDS
def test_optima_are_never_above_the_forecast_and_gaps_never_negative(kind):
    scene = random_scene(16, 3, history=2, size=1.5, dtype=torch.float64)
    parameters = random_game(scene, 1, 4)
    energy = kind(FeatureEnergy([*OWN, "velb", "jerk"], bounds=BOUNDS))
    found = report(energy, scene, parameters, parameters.initial_controls)
    assert (found.optimum <= found.energy).all()
    assert (found.optimum < 0.7 * found.energy).any()
    assert (found.nash_gap >= 0).all()
    assert (found.nash_gap <= found.objective).all()


def test_the_most_likely_mode_is_examined():
    scene = random_scene(4, 2, history=2, size=1.5, dtype=torch.float64)
    parameters = random_game(scene, 3, STEPS)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    likely = torch.tensor([2, 0, 1, 1])
    probabilities = torch.nn.functional.one_hot(likely, 3).double()
    controls = parameters.initial_controls
    found = report(energy, scene, parameters, controls, probabilities=probabilities)
    rows = torch.arange(4)
    torch.testing.assert_close(found.energy, energy(scene, parameters, controls)[rows, likely])
    torch.testing.assert_close(found.objective, energy.objectives(scene, parameters, controls)[rows, likely])
    one = parameters.map(lambda tensor: tensor[rows, likely][:, None])
    alone = report(energy, scene, one, controls[rows, likely][:, None])
    torch.testing.assert_close(found.nash_gap, alone.nash_gap, rtol=0, atol=0)


def test_a_game_shared_by_all_modes_equals_one_per_mode():
    scene = random_scene(4, 2, history=2, size=1.5, dtype=torch.float64)
    parameters = random_game(scene, 1, STEPS)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    controls = 0.3 * torch.randn(4, 3, 2, STEPS, 2, dtype=torch.float64)
    probabilities = torch.tensor([[0.1, 0.2, 0.7]], dtype=torch.float64).expand(4, 3)
    found = report(energy, scene, parameters, controls, probabilities=probabilities)
    torch.testing.assert_close(found.energy, energy(scene, parameters, controls[:, 2:])[:, 0])


FIELDS = ("initial", "energy", "optimum", "gradient_norm", "nash_gap", "objective")


@KINDS
@pytest.mark.parametrize("filling", [float("nan"), 1e6])
def test_reports_do_not_depend_on_padding_or_batch(kind, filling):
    scene = random_scene(7, 3, history=2, size=1.5, dtype=torch.float64)
    parameters = random_game(scene, 1, 4, own=OWN)
    energy = kind(FeatureEnergy(OWN))
    controls = parameters.initial_controls
    together = report(energy, scene, parameters, controls)
    few = report(energy, scene[[5, 2]], parameters[[5, 2]], controls[[5, 2]])
    wide = widen(parameters, filling=filling)
    padded = report(energy, pad(scene, filling=filling), wide, wide.initial_controls)
    exact = isinstance(energy, FeatureEnergy)
    tolerance = {"rtol": 0.0, "atol": 0.0} if exact else {"rtol": 1e-7, "atol": 1e-9}
    for name in FIELDS:
        whole = getattr(together, name)
        torch.testing.assert_close(getattr(few, name), whole[[5, 2]], **tolerance, msg=name)
        found = getattr(padded, name)
        if found.dim() == 2:
            assert (found[:, 3:] == 0).all()
            found = found[:, :3]
        torch.testing.assert_close(found, whole, **tolerance, msg=name)


@KINDS
def test_a_nan_scene_has_no_finite_report_and_leaves_the_others_unchanged(kind):
    scene = random_scene(3, 2, history=2, size=1.5, dtype=torch.float64)
    parameters = random_game(scene, 1, STEPS, own=OWN)
    energy = kind(FeatureEnergy(OWN))
    sound = report(energy, scene, parameters, parameters.initial_controls)
    controls = parameters.initial_controls.clone()
    controls[1] = torch.nan
    broken = report(energy, scene, parameters, controls)
    for name in FIELDS[1:]:
        assert not getattr(broken, name)[1].isfinite().any(), name
        torch.testing.assert_close(getattr(broken, name)[[0, 2]], getattr(sound, name)[[0, 2]], msg=name)


def test_there_is_no_report_without_a_game_or_a_solution():
    scene = random_scene(2, 2, history=2)
    parameters = random_game(scene, 1, STEPS, own=OWN)
    energy = FeatureEnergy(OWN)
    forecast = forecast_of(energy, scene, parameters, parameters.initial_controls)
    assert equilibrium(energy, scene, forecast) is not None
    assert equilibrium(energy, scene, dataclasses.replace(forecast, solution=None)) is None
    assert equilibrium(energy, scene, dataclasses.replace(forecast, parameters=None)) is None
    assert equilibrium(Valued(energy), scene, forecast) is None


def test_there_is_no_report_of_games_with_hard_constraints():
    """Their weights have no effect on the strategies, so that the game of soft terms with these weights is another one."""
    scene = random_scene(2, 2, history=2, size=0.5, dtype=torch.float64)
    parameters = random_game(scene, 1, STEPS, own=OWN)
    energy = FeatureEnergy(OWN, pair=("proximity",))
    solution = AugmentedLagrangian(rounds=3)(energy, scene, parameters)
    probabilities = torch.ones(2, 1, dtype=torch.float64)
    forecast = JointForecast(solution.states, probabilities, parameters=parameters, solution=solution)
    assert equilibrium(energy, scene, forecast) is None
    soft = dataclasses.replace(forecast, solution=dataclasses.replace(solution, constraints=None))
    assert equilibrium(energy, scene, soft) is not None


def test_scenes_without_agents_have_zero_gaps():
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    scene = dataclasses.replace(scene, agent_mask=torch.tensor([[False, False], [True, True]]))
    parameters = random_game(scene, 1, STEPS, own=OWN)
    for energy in (FeatureEnergy(OWN), Opaque(FeatureEnergy(OWN))):
        found = report(energy, scene, parameters, parameters.initial_controls)
        assert found.energy[0] == found.optimum[0] == found.gradient_norm[0] == 0
        assert (found.nash_gap[0] == 0).all()
        assert (found.nash_gap[1] > 0).all()


def test_games_unknown_to_the_kernel_are_supported():
    scene = random_scene(2, 2, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, 1, 4, own=OWN)
    energy = FeatureEnergy(OWN, ["proximity"], dynamics=Unicycle("heun"))
    backends.say_once.cache_clear()
    with pytest.warns(UserWarning, match="compiled"):
        found = report(energy, scene, parameters, parameters.initial_controls)
    torch.testing.assert_close(found.energy, energy(scene, parameters, parameters.initial_controls)[:, 0])
    assert (found.optimum < found.energy).all()
    assert ((found.nash_gap > 0) & (found.nash_gap < found.objective)).all()


# Finite games, against loops.


def finite_game(scenes, agents, candidates, modes, seed=0):
    torch.manual_seed(seed)
    scene = random_scene(scenes, agents, history=2, dtype=torch.float64)
    mask = torch.rand(scenes, agents) < 0.8
    mask[0] = True
    scene = dataclasses.replace(scene, agent_mask=mask)
    first, second = pairs(agents)
    unary = torch.randn(scenes, agents, candidates, dtype=torch.float64).masked_fill(~mask[..., None], torch.nan)
    pair = torch.randn(scenes, len(first), candidates, candidates, dtype=torch.float64)
    pair[~(mask[:, first] & mask[:, second])] = torch.nan
    assignment = torch.randint(candidates, (scenes, modes, agents))
    states = torch.zeros(scenes, candidates, agents, 4, 4, dtype=torch.float64)
    tables = Tables(states, unary, pair, torch.zeros_like(unary), torch.zeros(scenes, dtype=torch.float64))
    return scene, tables, assignment


def value(tables, mask, b, choice, without=None):
    """E of a joint choice in scene b, without the terms that an agent has no part in."""
    agents = [i for i in range(mask.shape[1]) if mask[b, i]]
    total = sum(tables.unary[b, i, choice[i]].item() for i in agents if without in (None, i))
    for p, (i, j) in enumerate(zip(*(index.tolist() for index in pairs(mask.shape[1])), strict=True)):
        if i in agents and j in agents and without in (None, i, j):
            total += tables.pair[b, p, choice[i], choice[j]].item()
    return total


@SLOW
@given(agents=st.integers(1, 4), candidates=st.integers(1, 4), modes=st.integers(1, 3), seed=st.integers(0, 999))
def test_finite_games_are_reported_exactly(agents, candidates, modes, seed):
    scene, tables, assignment = finite_game(4, agents, candidates, modes, seed)
    mask = scene.agent_mask
    assignment = torch.where(mask[:, None], assignment, -99)
    probabilities = torch.rand(4, modes, dtype=torch.float64)
    controls = torch.zeros(4, modes, agents, 4, 2, dtype=torch.float64)
    energy = FeatureEnergy(OWN)
    parameters = random_game(scene, 1, 4, own=OWN)
    forecast = forecast_of(energy, scene, parameters, controls, probabilities, tables=tables, assignment=assignment)
    found = equilibrium(Valued(energy), scene, forecast)
    assert found.gradient_norm.isnan().all()
    for b in range(4):
        choice = assignment[b, probabilities[b].argmax()].tolist()
        assert found.energy[b].item() == pytest.approx(value(tables, mask, b, choice))
        for i in range(agents):
            if not mask[b, i]:
                assert found.nash_gap[b, i] == found.objective[b, i] == 0
                continue
            others = [[*choice[:i], k, *choice[i + 1 :]] for k in range(candidates)]
            stays = value(tables, mask, b, choice, without=i)
            best = min(value(tables, mask, b, other, without=i) for other in others)
            assert found.objective[b, i].item() == pytest.approx(stays)
            assert found.nash_gap[b, i].item() == pytest.approx(stays - best, abs=1e-12)
        lowest = min(value(tables, mask, b, joint) for joint in product(range(candidates), repeat=agents))
        seen = min(value(tables, mask, b, mode) for mode in assignment[b].tolist())
        assert lowest - 1e-9 <= found.optimum[b].item() <= min(seen, found.energy[b].item()) + 1e-9
        if agents == 1:
            assert found.optimum[b].item() == pytest.approx(lowest)


def test_at_the_lowest_joint_choice_there_is_no_gap_and_other_modes_lead_there():
    scene, tables, _ = finite_game(1, 3, 4, 1)
    joint = list(product(range(4), repeat=3))
    values = [value(tables, scene.agent_mask, 0, choice) for choice in joint]
    order = np.argsort(values)
    assignment = torch.tensor([[joint[order[-1]], joint[order[0]]]])
    energy, parameters = FeatureEnergy(OWN), random_game(scene, 1, 4, own=OWN)
    controls = torch.zeros(1, 2, 3, 4, 2, dtype=torch.float64)
    for likely in range(2):
        probabilities = torch.nn.functional.one_hot(torch.tensor([likely]), 2).double()
        forecast = forecast_of(energy, scene, parameters, controls, probabilities, tables=tables, assignment=assignment)
        found = equilibrium(energy, scene, forecast)
        assert found.optimum.item() == pytest.approx(values[order[0]]), "the lowest is one of the modes"
        assert (found.nash_gap.max() > 0) == (likely == 0)


def test_infinitely_expensive_choices_have_infinite_gaps():
    scene, tables, assignment = finite_game(1, 2, 3, 1)
    assignment = torch.zeros_like(assignment)
    energy, parameters = FeatureEnergy(OWN), random_game(scene, 1, 4, own=OWN)
    controls = torch.zeros(1, 1, 2, 4, 2, dtype=torch.float64)
    unary = tables.unary.clone()
    unary[0, 0] = torch.inf  # whatever the first one does
    unary[0, 1, 0] = torch.inf
    forecast = forecast_of(
        energy, scene, parameters, controls, tables=dataclasses.replace(tables, unary=unary), assignment=assignment
    )
    found = equilibrium(energy, scene, forecast)
    assert found.nash_gap.tolist() == [[0.0, torch.inf]]


# Holding agents.

SOLVERS = [compiled.solve] if not isinstance(interface.find(), str) else []
SOLVERS += [structured.solve, lambda *a, **o: structured.solve(*a, split=False, **o)]


def reduced(energy, scene, parameters, steps, step_size, damping, held):
    """Damped Gauss-Newton steps of the agents that are not held, by a dense matrix of their controls, game by game."""
    controls = parameters.initial_controls
    free = ~held[..., None, None].expand(controls.shape)
    for _ in range(steps):
        with nearest_points_held():
            jacobian = torch.func.jacfwd(lambda u: stacked(energy, scene, parameters, u).sum((0, 1)))(controls)
        jacobian = jacobian.permute(1, 2, 0, 3, 4, 5).flatten(3)
        residual = stacked(energy, scene, parameters, controls)
        each = damping[..., None, None].expand(controls.shape)
        moved = torch.zeros_like(controls)
        for b, m in product(*map(range, controls.shape[:2])):
            some = free[b, m].flatten()
            slopes = jacobian[b, m][:, some]
            matrix = slopes.mT @ slopes + torch.diag(each[b, m].flatten()[some])
            step = torch.zeros(len(some), dtype=controls.dtype)
            step = step.masked_scatter(some, -torch.linalg.solve(matrix, slopes.mT @ residual[b, m]))
            moved[b, m] = step.view(controls.shape[2:])
        controls = controls + step_size * moved
    return controls


@pytest.mark.parametrize("solve", SOLVERS, ids=["compiled", "structured", "whole"][-len(SOLVERS) :])
@pytest.mark.parametrize(("agents", "size"), [(1, 1.0), (2, 2.0), (4, 1.5), (5, 3.0)])
def test_held_agents_keep_their_controls_while_the_others_are_solved(solve, agents, size):
    scene = random_scene(3, agents, history=2, size=size, dtype=torch.float64)
    parameters = random_game(scene, 2, 6)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    damping = 1.0 + torch.rand(3, 2, agents, dtype=torch.float64)
    held = torch.rand(3, 2, agents) < 0.5
    held[0, 0], held[0, 1] = False, True
    damping = damping.masked_fill(held, torch.inf)
    ours, theirs = leaves_of(parameters), leaves_of(parameters)
    solution = solve(energy, scene, ours, 2, 0.5, damping)
    expected = reduced(energy, scene, theirs, 2, 0.5, damping, held)
    assert (solution.status == Status.SOLVED).all()
    assert torch.equal(solution.controls[held], parameters.initial_controls[held]), "not by a single bit"
    torch.testing.assert_close(solution.controls, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(solution.energy, energy(scene, parameters, expected.detach()))
    weigh = torch.randn_like(expected)
    for controls in (solution.controls, expected):
        (weigh * controls).sum().backward()
    torch.testing.assert_close(ours.initial_controls.grad, theirs.initial_controls.grad, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(ours.goals.grad, theirs.goals.grad, rtol=1e-8, atol=1e-8)
    for name in energy.own:
        mine, other = ours.own_weights[name].grad, theirs.own_weights[name].grad
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-8, msg=name)


@pytest.mark.parametrize("solve", SOLVERS, ids=["compiled", "structured", "whole"][-len(SOLVERS) :])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_dampings_of_all_agents_equal_one_damping_bit_for_bit(solve, dtype):
    scene = random_scene(5, 3, history=2, size=1.5, dtype=dtype)
    parameters = random_game(scene, 2, 7)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    damping = 1.0 + torch.rand(5, 2, dtype=dtype)
    one = solve(energy, scene, parameters, 2, 0.3, damping)
    other = solve(energy, scene, parameters, 2, 0.3, damping[..., None].expand(-1, -1, 3))
    assert torch.equal(one.controls, other.controls)
    assert torch.equal(one.energy, other.energy)


# Many functions at once.


def test_rosenbrock_functions_are_minimised():
    starts = torch.tensor([[-1.2, 1.0, -1.0], [2.0, -3.0, 0.5], [1.0, 1.0, 1.0], [torch.nan, 0.0, 0.0]]).double()
    height = torch.tensor([100.0, 10.0, 100.0, 1.0]).double()

    def evaluate(index, point):
        with torch.enable_grad():
            x = point.clone().requires_grad_()
            first, second = x[:, :-1], x[:, 1:]
            value = (height[index, None] * (second - first**2) ** 2 + (1 - first) ** 2).sum(1)
            (slope,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), slope

    found = quasi_newton.minimise(evaluate, starts)
    torch.testing.assert_close(found.point[:3], torch.ones(3, 3).double(), rtol=0, atol=1e-5)
    assert found.after[:3].max() < 1e-9
    assert torch.equal(found.point[2], starts[2]), "there already"
    assert found.after[3].isnan()
    first, _ = evaluate(torch.arange(4), starts)
    assert torch.equal(found.before[:3], first[:3])
    assert quasi_newton.minimise(evaluate, starts[:0]).after.shape == (0,)


def test_unbounded_descent_is_given_up_and_slow_convergence_is_not():
    # Down a slope for ever, towards a bound that is never reached, along a parabola, and a quartic with a flat ground.
    def evaluate(index, point):
        with torch.enable_grad():
            x = point.clone().requires_grad_()
            every = torch.stack(
                (-torch.nn.functional.softplus(x).sum(1), torch.exp(-x).sum(1), x.square().sum(1), (x**4).sum(1))
            )
            value = every[index, torch.arange(len(index))]
            (slope,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), slope

    found = quasi_newton.minimise(evaluate, torch.full((4, 3), 2.0).double())
    assert found.found.tolist() == [False, True, True, True]
    assert found.after[0] < -100.0
    assert found.after[1:].max() < 1e-6
    alone = quasi_newton.minimise(lambda index, point: evaluate(index * 0, point), torch.full((1, 3), 2.0).double())
    assert not alone.found.item()


class Downhill(Opaque):
    """An energy that is unbounded from below in the accelerations of agents that start to the right of the origin."""

    def own_terms(self, scene, parameters, states, controls):
        terms = self.features.own_terms(scene, parameters, states, controls)
        right = self.current_states(scene)[..., 0] > 0
        return {**terms, "acc": torch.where(right, -controls[..., 0].sum(-1), terms["acc"])}


def test_energies_without_a_minimum_have_no_optimum_and_no_gap(monkeypatch):
    monkeypatch.setattr(quasi_newton, "_EVALUATIONS", 80)  # so that it does not take long
    scene = random_scene(3, 2, history=2, size=1.5, dtype=torch.float64)
    history = scene.history.clone()
    history[..., 0] = -history[..., 0].abs() - 1.0
    history[1, 1, :, 0] = 3.0
    scene = pad(dataclasses.replace(scene, history=history))
    parameters = widen(random_game(random_scene(3, 2, history=2, dtype=torch.float64), 1, STEPS, own=("acc", "turnr")))
    features = FeatureEnergy(("acc", "turnr"), ["proximity"])
    energy = Downhill(features)
    forecast = forecast_of(energy, scene, parameters, parameters.initial_controls)
    found = equilibrium(energy, scene, forecast)
    assert found.optimum.isnan().tolist() == [False, True, False]
    assert found.nash_gap.isnan()[:, :2].all(1).tolist() == [False, True, False]
    assert not found.nash_gap[[0, 2]].isnan().any()
    assert (found.nash_gap[:, 2:] == 0).all()
    assert found.energy.isfinite().all()
    assert found.gradient_norm.isfinite().all()
    metrics = equilibrium_values(dataclasses.replace(forecast, equilibrium=found))
    names = [name for name, value in metrics.items() if value[1].isnan()]
    assert names == ["energy_optimum", "nash_gap", "nash_gap_relative"]


def test_a_best_response_is_the_better_of_two_minima_and_unknown_without_an_optimum(monkeypatch):
    """With given minima instead of a minimiser: three scenes of two agents, in the second one no optimum is found."""
    scene = random_scene(3, 2, dtype=torch.float64)
    energy, parameters = FeatureEnergy(OWN, ["proximity"]), random_game(scene, 1, STEPS, own=OWN)
    best = torch.randn_like(parameters.initial_controls)
    starts = []

    def values(*numbers):
        return torch.tensor(numbers, dtype=torch.float64)

    def descend(energy, scene, game, agent):
        starts.append((game.initial_controls, agent))
        if agent is None:
            optimum, found = values(1.0, 1.5, 2.0), torch.tensor([True, False, True])
            return Descent(values(9.0, 9.0, 9.0), optimum, best, values(0.0, 0.0, 0.0), found)
        before = values(5.0, 6.0, 5.0, 5.0, 7.0, 5.0)
        from_own, from_optimum = values(3.0, 1.0, 2.0, 2.0, 7.5, 4.0), values(2.0, 4.0, 2.0, 2.0, 7.2, torch.nan)
        after = from_own if len(starts) == 2 else from_optimum
        return Descent(before, after, game.initial_controls, before, torch.ones(6, dtype=torch.bool))

    monkeypatch.setattr(importlib.import_module(equilibrium.__module__), "descend_features", descend)
    found = report(energy, scene, parameters, parameters.initial_controls)
    expected = values(5.0 - 2.0, 6.0 - 1.0, torch.nan, torch.nan, 0.0, 1.0).view(3, 2)
    torch.testing.assert_close(found.nash_gap, expected, equal_nan=True)
    torch.testing.assert_close(found.optimum, values(1.0, torch.nan, 2.0), equal_nan=True)
    # The second minimisation starts at the agent's own strategy in the optimum; the other agent keeps its strategy.
    (_, none), (first, agents), (second, _) = starts
    assert none is None
    assert agents.tolist() == [0, 1] * 3
    solved = parameters.initial_controls
    for world in range(6):
        origin, mine = divmod(world, 2)
        assert torch.equal(first[world], solved[origin])
        assert torch.equal(second[world, 0, mine], best[origin, 0, mine])
        assert torch.equal(second[world, 0, 1 - mine], solved[origin, 0, 1 - mine])
