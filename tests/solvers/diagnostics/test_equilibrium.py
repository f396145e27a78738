"""The equilibrium report against closed forms and other minimisers, its batches, and games without a report."""

from __future__ import annotations

import dataclasses
from itertools import product

import numpy as np
import pytest
import torch
from games import ALL, BOUNDS, pad, random_game, random_scene, widen
from reported_games import OWN, STEPS, Opaque, Valued, forecast_of, report
from scipy.optimize import minimize

from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import KINDS as KINDS_OF_AGENTS
from epo_lightning.scene import Scene
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium
from epo_lightning.solvers.gauss_newton.augmented_lagrangian import AugmentedLagrangian
from epo_lightning.solvers.gauss_newton.backends import choice
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

KINDS = pytest.mark.parametrize("kind", [lambda energy: energy, Opaque], ids=["features", "any"])


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
    assert found.initial_energy.item() == -7.0, "as the solver says"


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


FIELDS = ("initial_energy", "energy", "optimum", "gradient_norm", "nash_gap", "objective")


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


def test_ends_of_games_missing_lines_and_kinds_of_agents_are_those_of_the_scene():
    scene = dataclasses.replace(
        random_scene(4, 2, history=2, size=1.5, dtype=torch.float64),
        game_steps=torch.tensor([STEPS, 1, 2, STEPS]),
        reference_mask=torch.tensor([True, False]).expand(4, 2, 2),
        kind=torch.tensor([[KINDS_OF_AGENTS.index("car"), KINDS_OF_AGENTS.index("bicycle")]]).expand(4, 2),
    )
    parameters = random_game(scene, 1, STEPS)
    energy = FeatureEnergy(
        [*OWN, "lane", "velb"], bounds=BOUNDS | {"vel": {"bicycle": [0.0, 0.1], "default": [0.0, 2.0]}}
    )
    found = report(energy, scene, parameters, parameters.initial_controls)
    torch.testing.assert_close(found.energy, energy(scene, parameters, parameters.initial_controls)[:, 0])
    for field in ("game_steps", "reference_mask", "kind"):
        other = dataclasses.replace(scene, **{field: getattr(scene, field).flip(-1)})
        assert (found.energy - energy(other, parameters, parameters.initial_controls)[:, 0]).abs().max() > 1e-3


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
    choice.say_once.cache_clear()
    with pytest.warns(UserWarning, match="compiled"):
        found = report(energy, scene, parameters, parameters.initial_controls)
    torch.testing.assert_close(found.energy, energy(scene, parameters, parameters.initial_controls)[:, 0])
    assert (found.optimum < found.energy).all()
    assert ((found.nash_gap > 0) & (found.nash_gap < found.objective)).all()
