"""On a game with a closed-form equilibrium, every deterministic row finds it, and Nash gaps are those of another minimiser.

Agents are in a row and head along it. On the row, positions are linear in accelerations, so that the game is quadratic as
long as the same agents are too close at the same steps: the equilibrium solves linear equations, the first-order conditions
of all agents. Objectives J_i are written once more here, in NumPy and agent by agent; nothing is taken from an energy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, cached_property
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecast import Equilibrium, GameParameters, JointForecast, Solution
from epo_lightning.game.convex_energy import FLOOR
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.registry import build
from epo_lightning.scene import Scene
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium

STEPS, DT, KEPT = 6, 0.4, 6.0
START, SPEED = np.array([6.6, 0.0, 12.0]), np.array([1.0, 2.0, 1.5])
GOAL, REFERENCE = np.array([10.0, 5.5, 14.5]), np.array([1.2, 2.2, 1.4])
WEIGHT = {"goal": 0.7, "velref": 0.4, "acc": 1.0, "jerk": 0.3, "turnr": 6.0, "pair": 0.6}
ASIDE = {"lateral": 0.5, "lat_vel": 0.8, "lat_acc": 1.1, "lat_jerk": 0.2}


@dataclasses.dataclass(frozen=True)
class Row:
    """The first N agents.

    Attributes:
        agents: number N of agents.
    """

    agents: int

    @cached_property
    def moves(self) -> np.ndarray:
        """Jacobian of positions 1 .. K with respect to accelerations [K, K]: the velocity of a step moves the next one."""
        steps = np.arange(STEPS)
        return DT**2 * np.clip(steps[:, None] - steps, 0, None)

    @cached_property
    def freely(self) -> np.ndarray:
        """Positions of the agents without accelerations [N, K]."""
        return START[: self.agents, None] + DT * SPEED[: self.agents, None] * np.arange(1, STEPS + 1)

    def conditions(self, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """dJ_i/da_i = sum_j M_ij a_j + h_i of all agents, given who is too close to whom when [N, N, K]."""
        n, end = self.agents, self.moves[-1]
        faster = DT * np.tri(STEPS)
        rate = np.diff(np.eye(STEPS), axis=0) / DT
        w = {name: value**2 for name, value in WEIGHT.items()}
        matrix, vector = np.zeros((n, STEPS, n, STEPS)), np.zeros((n, STEPS))
        for i in range(n):
            matrix[i, :, i] = w["goal"] * np.outer(end, end) + w["velref"] * faster.T @ faster
            matrix[i, :, i] += w["acc"] * np.eye(STEPS) + w["jerk"] * rate.T @ rate
            vector[i] = w["goal"] * end * (self.freely[i, -1] - GOAL[i])
            vector[i] += w["velref"] * faster.T @ np.full(STEPS, SPEED[i] - REFERENCE[i])
            for j in range(n):
                if i == j:
                    continue
                ahead = np.sign(START[i] - START[j])  # J_ij = 1/2 w (d - ahead (p_i - p_j))^2
                pull = -ahead * w["pair"] * self.moves.T * active[i, j]
                vector[i] += pull @ (KEPT - ahead * (self.freely[i] - self.freely[j]))
                matrix[i, :, i] -= ahead * pull @ self.moves
                matrix[i, :, j] += ahead * pull @ self.moves
        return matrix.reshape(n * STEPS, -1), vector.reshape(-1)

    @cached_property
    def equilibrium(self) -> np.ndarray:
        """Accelerations [N, K] at which every J_i is stationary, with the assumed pairs of agents too close."""
        active = np.zeros((self.agents, self.agents, STEPS), dtype=bool)
        for _ in range(20):
            matrix, vector = self.conditions(active)
            found = np.linalg.solve(matrix, -vector).reshape(self.agents, STEPS)
            position = self.freely + found @ self.moves.T
            short = KEPT - np.abs(position[:, None] - position)
            if ((short > 0) == active).all():
                break
            active = short > 0
        others = ~np.eye(self.agents, dtype=bool)
        assert ((short > 0) == active).all()
        assert np.abs(short[others]).min() > 1e-3, "nobody is just at the edge"
        assert active[others].any()
        assert not active[others].all()
        assert (np.argsort(position, 0) == np.argsort(START[: self.agents])[:, None]).all()
        return found

    @cached_property
    def scene(self) -> Scene:
        """The agents, each KEPT metres long."""
        state = torch.zeros(1, self.agents, 1, 4, dtype=torch.float64)
        state[0, :, 0, 0], state[0, :, 0, 3] = (torch.from_numpy(each[: self.agents]) for each in (START, SPEED))
        size = torch.full((1, self.agents, 2), KEPT, dtype=torch.float64)
        return Scene(state, DT, size=size, reference_speed=torch.from_numpy(REFERENCE[None, : self.agents]))

    def parameters(self, weights: dict[str, float], pair: str) -> GameParameters:
        """The game; solutions start at controls of zero."""
        n = self.agents
        goals = torch.zeros(1, 1, n, 2, dtype=torch.float64)
        goals[..., 0] = torch.from_numpy(GOAL[:n])
        first, second = pairs(n)
        ahead = torch.from_numpy(START)
        return GameParameters(
            own_weights={name: torch.full((1, 1, n), value, dtype=torch.float64) for name, value in weights.items()},
            pair_weights={pair: torch.full((1, 1, len(first)), WEIGHT["pair"], dtype=torch.float64)},
            initial_controls=torch.zeros(1, 1, n, STEPS, 2, dtype=torch.float64),
            goals=goals,
            order=(ahead[first] - ahead[second]).sign()[None, None],
        )

    @cached_property
    def controls(self) -> torch.Tensor:
        """Controls of the equilibrium, which keep all agents on the row."""
        along = torch.from_numpy(self.equilibrium)
        return torch.stack((along, torch.zeros_like(along)), -1)[None, None]


def own_objective(controls: np.ndarray, i: int, position: np.ndarray, speed: np.ndarray) -> float:
    """Objective of an agent along the row for both kinds of energy, with half the squared distances from its goal."""
    w = {name: 0.5 * value**2 for name, value in WEIGHT.items()}
    way = position[-1] - np.array([GOAL[i], 0.0])
    value = w["goal"] * way @ way + w["velref"] * np.sum((speed - REFERENCE[i]) ** 2)
    rate = np.diff(controls[:, 0]) / DT
    return value + w["acc"] * controls[:, 0] @ controls[:, 0] + w["jerk"] * rate @ rate


def unicycle(controls: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds after every step."""
    place, heading, speed, positions, speeds = np.array([START[i], 0.0]), 0.0, SPEED[i], [], []
    for acceleration, turn_rate in controls:
        place = place + DT * speed * np.array([np.cos(heading), np.sin(heading)])
        heading, speed = heading + DT * turn_rate, speed + DT * acceleration
        positions.append(place)
        speeds.append(speed)
    return np.array(positions), np.array(speeds)


def of_features(controls: np.ndarray, i: int) -> float:
    """J_i [N, K, 2] of named features: discs that overlap."""
    positions = [unicycle(each, j)[0] for j, each in enumerate(controls)]
    value = own_objective(controls[i], i, *unicycle(controls[i], i))
    value += 0.5 * WEIGHT["turnr"] ** 2 * np.sum(controls[i, :, 1] ** 2)
    for j in range(len(controls)):
        if j != i:
            short = KEPT - np.linalg.norm(positions[i] - positions[j], axis=1)
            value += 0.5 * WEIGHT["pair"] ** 2 * np.sum(np.maximum(short, 0.0) ** 2)
    return value


def of_convex(controls: np.ndarray, i: int) -> float:
    """J_i of the convex energy: double integrators that keep their order along the row."""
    n = len(controls)
    velocity = np.cumsum(DT * controls, 1) + np.stack((SPEED[:n], np.zeros(n)), -1)[:, None]
    before = np.concatenate((velocity[:, :1] - DT * controls[:, :1], velocity[:, :-1]), 1)
    positions = np.cumsum(DT * before, 1) + np.stack((START[:n], np.zeros(n)), -1)[:, None]
    value = own_objective(controls[i], i, positions[i], velocity[i, :, 0])
    w = {name: 0.5 * each**2 for name, each in ASIDE.items()}
    aside, rate = controls[i, :, 1], np.diff(controls[i, :, 1]) / DT
    value += w["lateral"] * np.sum(positions[i, :, 1] ** 2) + w["lat_vel"] * np.sum(velocity[i, :, 1] ** 2)
    value += (w["lat_acc"] + 0.5 * FLOOR) * aside @ aside + w["lat_jerk"] * rate @ rate
    for j in range(n):
        if j != i:
            ahead = np.sign(START[i] - START[j])
            short = KEPT - ahead * (positions[i, :, 0] - positions[j, :, 0])
            value += 0.5 * WEIGHT["pair"] ** 2 * np.sum(np.maximum(short, 0.0) ** 2)
    return value


Objective = Callable[[np.ndarray, int], float]


@cache
def written(row: str) -> dict[str, Any]:
    """A row of Table 1 as its file has it."""
    return compose("train", [f"experiment=table1/{row}"])


FEATURES = FeatureEnergy(("goal", "velref", "acc", "jerk", "turnr"), ("proximity",))


def features(row: Row) -> tuple[Energy, Scene, GameParameters]:
    return FEATURES, row.scene, row.parameters({name: WEIGHT[name] for name in FEATURES.own}, "proximity")


def convex(row: Row) -> tuple[Energy, Scene, GameParameters]:
    """TGL's energy; half the lengths and the gap are KEPT."""
    section = written("highway_tgl")
    energy = build("energy", section["energy"], dynamics=build("dynamics", section["dynamics"]))
    weights = {**WEIGHT, **ASIDE}
    scene = dataclasses.replace(row.scene, size=row.scene.size - energy.gap)
    return energy, scene, row.parameters({name: weights[name] for name in energy.weighted[0]}, "order")


def forecast_of(parameters: GameParameters, solution: Solution) -> JointForecast:
    return JointForecast(
        solution.states,
        (-solution.energy).softmax(1),
        parameters=parameters,
        controls=solution.controls,
        solution=solution,
    )


def report(energy: Energy, scene: Scene, parameters: GameParameters, solution: Solution) -> Equilibrium:
    found = equilibrium(energy, scene, forecast_of(parameters, solution))
    assert found is not None
    return found


GAMES = {"features": (features, of_features), "convex": (convex, of_convex)}
AGENTS = pytest.mark.parametrize("agents", [2, 3])
EVERY_GAME = pytest.mark.parametrize("game", GAMES)
TIGHT = {"tolerance": 1e-12}
SPREAD = torch.tensor([0.5, 0.1], dtype=torch.float64)
"""Size of perturbations of accelerations [m/s^2] and turn rates [rad/s], or of accelerations along and across."""
CONVERGED: dict[str, tuple[str, dict[str, Any]]] = {
    "epo": ("features", {"row": "rpi_epo", "steps": 600}),
    "laplace": ("features", {"row": "rpi_laplace", "steps": 40}),
    "ebioc": ("features", {"row": "rpi_ebioc", "steps": 160, "delta": 0.5, "scale": [1.0, 0.2]}),
    "newton": ("features", {"name": "newton", "steps": 50, **TIGHT}),
    "lbfgs": ("features", {"name": "lbfgs", "steps": 200, **TIGHT}),
    "tgl": ("convex", {"row": "highway_tgl", **TIGHT}),
    "tgl, lbfgs": ("convex", {"name": "lbfgs", "steps": 200, **TIGHT}),
}


@AGENTS
@pytest.mark.parametrize("name", CONVERGED)
def test_every_row_converges_to_the_equilibrium_in_closed_form(name: str, agents: int) -> None:
    game, changes = CONVERGED[name]
    changes = dict(changes)
    section = written(changes.pop("row"))["solver"] if "row" in changes else {}
    assert not section or changes.keys() <= section.keys()
    solve = build("solver", {**section, **changes}).for_test()
    row = Row(agents)
    energy, scene, parameters = GAMES[game][0](row)
    start = 0.1 * torch.randn(parameters.initial_controls.shape, dtype=torch.float64)
    parameters = dataclasses.replace(parameters, initial_controls=start)
    solution = solve(energy, scene, parameters)
    torch.testing.assert_close(solution.controls, row.controls, rtol=0, atol=1e-6)
    found = report(energy, scene, parameters, solution)
    assert found.nash_gap.max() < 1e-6
    assert solution.initial_energy.item() > 1.01 * solution.energy.item()
    # No agent was present before.
    begun = dataclasses.replace(solution, controls=start)
    assert report(energy, scene, parameters, begun).nash_gap.min() > 1e-3


@AGENTS
@EVERY_GAME
def test_nash_gaps_are_those_of_another_minimiser(game: str, agents: int) -> None:
    of_game, objective = GAMES[game]
    row = Row(agents)
    energy, scene, parameters = of_game(row)
    away = row.controls + SPREAD * torch.randn(row.controls.shape, dtype=torch.float64)
    states = energy.dynamics.rollout(energy.current_states(scene), away, scene.dt)
    none = torch.zeros(1, 1, dtype=torch.float64)
    found = report(energy, scene, parameters, Solution(away, states, none, none, none, none.long()))
    joint = away[0, 0].numpy()
    for i in range(agents):

        def alone(flat: np.ndarray, i: int = i) -> float:
            return objective(np.concatenate((joint[:i], flat.reshape(1, STEPS, 2), joint[i + 1 :])), i)

        stays = alone(joint[i].ravel())
        assert found.objective[0, i].item() == pytest.approx(stays, rel=1e-12)
        starts = joint[i].ravel(), row.controls[0, 0, i].numpy().ravel()
        best = min(minimize(alone, start, method="BFGS", options={"gtol": 1e-7}).fun for start in starts)
        assert stays - best > 1e-2
        assert found.nash_gap[0, i].item() == pytest.approx(stays - best, rel=1e-6)


@EVERY_GAME
def test_the_closed_form_is_an_equilibrium_of_the_objectives(game: str) -> None:
    """This is about the test itself: no agent's J_i has a slope there."""
    row, objective = Row(3), GAMES[game][1]
    joint = row.controls[0, 0].numpy()
    for i in range(3):
        for step, channel in product(range(STEPS), range(2)):
            sides = []
            for way in (1e-5, -1e-5):
                moved = joint.copy()
                moved[i, step, channel] += way
                sides.append(objective(moved, i))
            assert abs(sides[0] - sides[1]) / 2e-5 < 1e-8


# Finite games: candidates that contain the equilibrium's strategies.


def candidates(row: Row, count: int) -> tuple[torch.Tensor, list[int]]:
    """Controls [1, C, N, K, 2] around the equilibrium, and which of every agent's are its strategy there."""
    options = row.controls + SPREAD * torch.randn(1, count, row.agents, STEPS, 2, dtype=torch.float64)
    where = torch.randint(count, (row.agents,)).tolist()
    for i, k in enumerate(where):
        options[0, k, i] = row.controls[0, 0, i]
    return options, where


@AGENTS
@pytest.mark.parametrize("name", ["jfp", "dsdnet"])
def test_rows_that_choose_find_the_equilibrium_among_candidates(name: str, agents: int) -> None:
    row = Row(agents)
    energy, scene, parameters = features(row)
    section = written(f"rpi_{name}")["solver"]
    options, where = candidates(row, section["candidates"])
    parameters = dataclasses.replace(parameters, initial_controls=options)
    solution = build("solver", section).for_modes(3)(energy, scene, parameters)
    assert solution.assignment is not None
    assert solution.assignment[0, 0].tolist() == where
    torch.testing.assert_close(solution.controls[:, :1], row.controls, rtol=0, atol=0)
    assert (report(energy, scene, parameters, solution).nash_gap == 0).all()

    # Another choice; its gaps equal those of a loop over each agent's candidates.
    choice = [(k + 1 + i) % section["candidates"] for i, k in enumerate(where)]
    other = dataclasses.replace(solution, assignment=torch.tensor(choice)[None, None].expand(1, 3, agents))
    found = report(energy, scene, parameters, other)
    joint = np.stack([options[0, k, i].numpy() for i, k in enumerate(choice)])
    for i in range(agents):
        values = []
        for k in range(section["candidates"]):
            changed = joint.copy()
            changed[i] = options[0, k, i].numpy()
            values.append(of_features(changed, i))
        gap = values[choice[i]] - min(values)
        assert gap > 0
        assert found.nash_gap[0, i].item() == pytest.approx(gap, rel=1e-6)
