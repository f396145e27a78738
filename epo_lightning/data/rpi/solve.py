"""Two solvers of the game from a start strategy, compiled.

``potential``: open-loop Nash equilibrium, as the minimiser of the exact potential (iterative LQR).
``feedback``: feedback Nash equilibrium, by the general-sum iterative linear-quadratic game of Fridovich-Keil et al. (2020)
with the settings of Peters (2020). Its tolerance of 5 cm leaves solutions that depend on the start strategy.
``feedback_converged``: the same with a tolerance of 1 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from epo_lightning.data.rpi import kernels as game
from epo_lightning.data.rpi.game import Array
from epo_lightning.data.rpi.lq import lq_game, lq_minimum


class PotentialSettings(NamedTuple):
    """Settings of the potential solver. Compiled functions read named tuples by attribute.

    Attributes:
        tolerance: largest absolute entry of the gradient at which the solver stops.
        iterations: largest number of iterations.
        exact_from, exact_below: iteration, or largest entry of the gradient, from which the exact Hessian of costs and
            dynamics replaces that of Gauss-Newton. The latter is robust far from a solution; the exact one converges
            quadratically, also near the saddle between two modes.
    """

    tolerance: float = 1e-4
    iterations: int = 100
    exact_from: int = 25
    exact_below: float = 20.0


class FeedbackSettings(NamedTuple):
    """Settings of the feedback solver, by default those of Peters (2020).

    Attributes:
        step: initial step length of an iteration; it is halved until the change of the states is small enough.
        halvings: largest number of halvings.
        largest_move: largest change of an element of the states in one iteration.
        tolerance: largest change of an element of the states at which the solver stops.
        iterations: largest number of iterations.
        regularisation: multiple of the identity added to the Hessians of states and controls.
    """

    step: float = 0.5
    halvings: int = 20
    largest_move: float = 1.5
    tolerance: float = 0.05
    iterations: int = 200
    regularisation: float = 5.0


SETTINGS: Mapping[str, PotentialSettings | FeedbackSettings] = {
    "potential": PotentialSettings(),
    "feedback": FeedbackSettings(),
    "feedback_converged": FeedbackSettings(tolerance=1e-3, iterations=1000),
}
"""Settings by the name of a solver (``data.solver``)."""


@njit(cache=True)
def follow(x: Array, u: Array, gains: Array, offsets: Array, scale: float, dt: float) -> tuple[Array, Array]:
    """States and controls of the affine policy around (x, u): u_k + scale * offset_k + gain_k (new x_k - x_k)."""
    new_x, new_u = np.empty_like(x), u.copy()
    new_x[0] = x[0]
    for k in range(len(u)):
        for i in range(4):
            change = scale * offsets[k, i]
            for j in range(8):
                change += gains[k, i, j] * (new_x[k, j] - x[k, j])
            new_u[k, i] += change
        game.step(new_x[k], new_u[k], dt, new_x[k + 1])
    return new_x, new_u


@njit(cache=True)
def total(x: Array, u: Array, c: Array, goals: Array, w: float) -> float:
    """The potential: own costs plus the shared cost once."""
    robot, pedestrian, pair = game.costs(x, u, c, goals, w)
    return robot + pedestrian + pair


@njit(cache=True)
def solve_potential(
    start: Array, u: Array, c: Array, goals: Array, w: float, moves: Array, settings: PotentialSettings
) -> tuple[Array, Array, bool, int]:
    """Minimum of the potential over the controls of the agents whose entry of ``moves`` is 1.

    With [1, 1] it is an open-loop Nash equilibrium, with [1, 0] a best response of the first agent.

    Iterative LQR: the minimiser of a quadratic model around the trajectory gives a policy, followed by a line search. The
    controls are damped (Levenberg) where the model is not convex or the line search fails.

    Returns:
        states [K+1, 8], controls [K, 4], whether the gradient fell below the tolerance, iterations.
    """
    steps = len(u)
    A, B = np.empty((steps, 8, 8)), np.empty((steps, 8, 4))
    Q, q = np.empty((steps + 1, 8, 8)), np.empty((steps + 1, 8))
    R, r = np.empty((steps, 4, 4)), np.empty((steps, 4))
    x = game.rollout(start, u, c[game.DT])
    cost = total(x, u, c, goals, w)
    damping = 0.0
    exact = False
    for iteration in range(settings.iterations + 1):
        game.linearise(x, c, moves, A, B)
        Q[:], q[:], R[:], r[:] = 0.0, 0.0, 0.0, 0.0
        for i in range(2):
            game.add_own(i, x, u, c, goals, Q, q, R, r)
            if moves[i] == 0.0:
                r[:, 2 * i : 2 * i + 2] = 0.0
        game.add_pair(x, c, w, exact, Q, q)
        gradient, costates = game.adjoint(A, B, q, r)
        size = np.abs(gradient).max()
        if size < settings.tolerance:
            return x, u, True, iteration
        if exact:
            game.add_curvature(x, c, costates, Q)
        exact = size < settings.exact_below or iteration + 1 >= settings.exact_from
        moved = False
        while not moved and damping < 1e8 and iteration < settings.iterations:
            convex, gains, offsets, promised = lq_minimum(A, B, Q, q, R, r, damping)
            scale = 1.0
            while convex and not moved and scale > 1e-3:
                new_x, new_u = follow(x, u, gains, offsets, scale, c[game.DT])
                new_cost = total(new_x, new_u, c, goals, w)
                if new_cost < cost - 1e-4 * scale * promised:
                    x, u, cost, moved = new_x, new_u, new_cost, True
                scale *= 0.5
            damping = (damping / 10.0 if damping > 1.0 else 0.0) if moved else max(10.0 * damping, 1.0)
        if not moved:
            return x, u, False, iteration
    return x, u, False, settings.iterations


@njit(cache=True)
def solve_feedback(
    start: Array, u: Array, c: Array, goals: Array, w: float, settings: FeedbackSettings
) -> tuple[Array, Array, bool, int]:
    """Approximate feedback Nash equilibrium: LQ games around the trajectory are solved until it stops changing.

    Returns:
        states [K+1, 8], controls [K, 4], whether it converged, iterations.
    """
    steps = len(u)
    owner = np.array([0, 0, 1, 1])
    A, B = np.empty((steps, 8, 8)), np.empty((steps, 8, 4))
    Q, q = np.empty((2, steps + 1, 8, 8)), np.empty((2, steps + 1, 8))
    R, r = np.empty((2, steps, 4, 4)), np.empty((2, steps, 4))
    x = game.rollout(start, u, c[game.DT])
    for iteration in range(settings.iterations):
        game.linearise(x, c, np.ones(2), A, B)
        Q[:], q[:], R[:], r[:] = 0.0, 0.0, 0.0, 0.0
        for i in range(2):
            game.add_own(i, x, u, c, goals, Q[i], q[i], R[i], r[i])
            game.add_pair(x, c, w, False, Q[i], q[i])
            for j in range(8):
                Q[i, :, j, j] += settings.regularisation
            for j in range(4):
                R[i, :, j, j] += settings.regularisation
        unique, gains, offsets = lq_game(A, B, Q, q, R, r, owner)
        if not unique:
            return x, u, False, iteration
        scale, change = settings.step, np.inf
        for _ in range(settings.halvings + 1):
            new_x, new_u = follow(x, u, gains, offsets, scale, c[game.DT])
            change = np.abs(new_x - x).max()
            if change <= settings.largest_move:
                break
            scale *= 0.5
        if not change <= settings.largest_move:
            return x, u, False, iteration
        x, u = new_x, new_u
        if change < settings.tolerance:
            return x, u, True, iteration + 1
    return x, u, False, settings.iterations


@dataclass(frozen=True)
class Solutions:
    """Solutions from some start strategies.

    Attributes:
        states [starts, K+1, 8], controls [starts, K, 4]: the trajectories.
        converged [starts]: whether the solver stopped at its tolerance.
        agent_costs [starts, 2], potential [starts]: cost of each agent, and the potential.
        distance [starts], rotation [starts], speed [starts]: smallest distance [m], rotation of the line of sight [rad]
            and smallest speed [m/s] along the trajectory.
        iterations [starts]: number of iterations.
    """

    states: Array
    controls: Array
    converged: NDArray[np.bool_]
    agent_costs: Array
    potential: Array
    distance: Array
    rotation: Array
    speed: Array
    iterations: Array


def solve(
    start: Array, starts: Array, constants: Array, goals: Array, weight: float, solver: str = "potential"
) -> Solutions:
    """Solutions of the game with the start state ``start`` [8] from start strategies [starts, K, 4].

    The loop over the starts is not compiled, because compiling it would compile both solvers again.
    """
    settings, both = SETTINGS[solver], np.ones(2)
    count, steps = starts.shape[:2]
    states, controls = np.empty((count, steps + 1, 8)), np.empty((count, steps, 4))
    converged, facts = np.empty(count, dtype=np.bool_), np.empty((count, 7))
    for s, strategy in enumerate(np.ascontiguousarray(starts)):
        if isinstance(settings, FeedbackSettings):
            x, u, done, iterations = solve_feedback(start, strategy, constants, goals, weight, settings)
        else:
            x, u, done, iterations = solve_potential(start, strategy, constants, goals, weight, both, settings)
        states[s], controls[s], converged[s] = x, u, done
        robot, pedestrian, pair = game.costs(x, u, constants, goals, weight)
        smallest, _, rotation, slowest = game.passage(x)
        facts[s] = robot + pair, pedestrian + pair, robot + pedestrian + pair, smallest, rotation, slowest, iterations
    return Solutions(states, controls, converged, facts[:, :2], *facts[:, 2:].T)
