"""Distance of a forecast from an open-loop Nash equilibrium of its inferred game, comparable between rows of a table.

In an equilibrium no agent can lower its objective by changing only its own strategy. The Nash gap of agent i is the largest
decrease of its objective J_i = E_i + sum_j E_ij that it can reach while the others keep their strategies. Because E is a
potential, E decreases by the same amount (Theorem 1):

    gap_i(u) = J_i(u) - min over u_i' of J_i(u_i', u_-i) = E(u) - min over u_i' of E(u_i', u_-i).

For controls, local minima are found with a small tolerance: the *best response* of an agent is the better result of two
minimisations, which start at its own strategy and at its strategy in the optimum, so that the gap is a lower bound. For
candidates, the minimum over a row of a table is exact.

Only the most likely joint mode is evaluated, as for overlap rates. Every best response is a *world*: a copy of the scene in
which one agent moves and the others are held. All worlds of a batch are solved in parallel, and converged ones are left out.

Networks may be unbounded from below: if a minimisation ends while the energy is still falling fast, no minimum is known, and
the optimum and the gaps of that scene are NaN.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.forecast import Equilibrium, GameParameters, JointForecast, Solution, Tables
from epo_lightning.game.energy import FEATURES, GRADIENT, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import Scene
from epo_lightning.solvers.diagnostics import quasi_newton
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

_GAUSS_NEWTON, _NEWTON = 20, 60
"""Largest numbers of steps. Gauss-Newton steps are cheap; Newton steps converge where residuals stay large."""
_START = 1e-2
"""Initial damping."""
_SWEEPS = 100
"""Largest number of sweeps of coordinate descent over candidates; it ends earlier when no choice changes."""


@torch.no_grad()
def equilibrium(energy: Energy, scene: Scene, forecast: JointForecast) -> Equilibrium | None:
    """The equilibrium report of the most likely joint mode of every scene, in float64.

    - Feature energies: damped Gauss-Newton and Newton steps of one agent, with infinite damping of the others.
    - Solutions that are choices among candidates (``tables`` and ``assignment``): exact, from the tables. The optimum is the
      best result of coordinate descent, agent by agent, from all joint modes.
    - Any other energy with a gradient: quasi-Newton steps (:mod:`~epo_lightning.solvers.diagnostics.quasi_newton`).

    Feature energies are sums of squares and always have a minimum. For other energies 300 evaluations may find none:
    ``optimum`` and the gaps of such a scene are NaN, and its other values are reported.

    A scene with NaN or infinite values has no finite report, and does not affect the others.

    Solutions with hard constraints have no report: the weights of their constraints have no effect on the strategies, so the
    energy of all features with their weights is that of another game.

    Args:
        energy: the minimised energy.
        scene: the scene.
        forecast: a forecast with the game (``parameters``) and its ``solution``.

    Returns:
        the report; None if the forecast has no game or no solution, if the solution has hard constraints, or if the energy
        offers no gradient and the solution has no tables.
    """
    parameters, solution = forecast.parameters, forecast.solution
    if parameters is None or solution is None or solution.constraints is not None:
        return None
    mode = forecast.probabilities.argmax(1)
    initial = _of_mode(solution.initial_energy, mode)[:, 0].double()
    if solution.tables is not None and solution.assignment is not None:
        return _of_candidates(scene.agent_mask, solution.tables, solution.assignment, mode, initial)
    if GRADIENT not in energy.offers:
        return None
    descend: Descend = descend_features if FEATURES in energy.offers else _descend_any
    if isinstance(energy, torch.nn.Module):
        energy = copy.deepcopy(energy).double()
    return _smooth(
        descend, energy, _relevant(scene).to(torch.float64), _game(scene, parameters, solution, mode), initial
    )


@dataclass(frozen=True)
class Descent:
    """The result of a minimisation in W worlds: values before and after, controls after, gradient norm before, and a mask
    of the worlds where a minimum was found."""

    before: Float[Tensor, " W"]
    after: Float[Tensor, " W"]
    controls: Float[Tensor, "W 1 N K 2"]
    slope: Float[Tensor, " W"]
    found: Bool[Tensor, " W"]


Descend = Callable[[Energy, Scene, GameParameters, Tensor | None], Descent]
"""(energy, scene, game, agent [W]) -> minimisation of E over all controls, or of J_i over one agent's controls per world."""


def _smooth(
    descend: Descend, energy: Energy, scene: Scene, game: GameParameters, initial: Float[Tensor, " B"]
) -> Equilibrium:
    """The report for controls as strategies, with a method to minimise."""
    optimum = descend(energy, scene, game, None)
    origin, agent = scene.agent_mask.nonzero(as_tuple=True)
    worlds, games = scene[origin], game[origin]
    stayed = descend(energy, worlds, games, agent)
    moves = _only(agent, scene.agent_mask.shape[1])[:, None, :, None, None]
    tried = torch.where(moves, optimum.controls[origin], games.initial_controls)
    moved = descend(energy, worlds, dataclasses.replace(games, initial_controls=tried), agent)
    gap = (stayed.before - stayed.after.fmin(moved.after)).clamp_min(0.0)
    none = initial.new_zeros(scene.agent_mask.shape)
    lost = torch.zeros_like(scene.agent_mask).index_put((origin, agent), ~(stayed.found & moved.found))
    lost = lost.any(1) | ~optimum.found
    return Equilibrium(
        initial_energy=initial,
        energy=optimum.before,
        optimum=torch.where(lost, torch.nan, optimum.after),
        gradient_norm=optimum.slope,
        nash_gap=torch.where(lost[:, None] & scene.agent_mask, torch.nan, none.index_put((origin, agent), gap)),
        objective=none.index_put((origin, agent), stayed.before),
    )


def descend_features(energy: Energy, scene: Scene, game: GameParameters, agent: Int[Tensor, " W"] | None) -> Descent:
    """Minimisation of E over all controls, or of J_i over one agent's controls in every world, from the initial strategies.

    Damped Gauss-Newton and then Newton steps, until no step lowers the value by more than rounding. J_i is the energy of a
    game in which only agent i and its pairs have weights, so the result is a local best response of that agent.

    Args:
        energy: an energy of named features.
        scene, game: the worlds, with one mode each, in float64.
        agent: the agent that moves in each world; the others keep their initial strategies. None for all agents.
    """
    assert isinstance(energy, FeatureEnergy)
    start = game.initial_controls
    held = None
    if agent is not None:
        agents = start.shape[2]
        mine = _only(agent, agents)[:, None]
        first, second = pairs(agents, start.device)
        own = {name: torch.where(mine, weight, 0.0) for name, weight in game.own_weights.items()}
        pair = {
            name: torch.where(mine[..., first] | mine[..., second], weight, 0.0)
            for name, weight in game.pair_weights.items()
        }
        game, held = dataclasses.replace(game, own_weights=own, pair_weights=pair), ~mine
    if start.numel() == 0:
        return _nowhere(start)
    damping = start.new_full(start.shape[:3], _START)
    if held is not None:
        damping = damping.masked_fill(held, torch.inf)
    solver = LevenbergMarquardt(steps=0, step_size=1.0, adaptive=True)
    here = solver(energy, scene, game)
    far, damping = solver.run(energy, scene, game, _GAUSS_NEWTON, damping)
    there = dataclasses.replace(game, initial_controls=far.controls)
    near, _ = solver.run(energy, scene, there, _NEWTON, damping, exact=True)
    value = near.energy[:, 0]
    return Descent(here.energy[:, 0], value, near.controls, here.gradient_norm[:, 0], value.isfinite())


def _descend_any(energy: Energy, scene: Scene, game: GameParameters, agent: Int[Tensor, " W"] | None) -> Descent:
    """Quasi-Newton steps with gradients by automatic differentiation."""
    start = game.initial_controls
    if start.numel() == 0:
        return _nowhere(start)
    chosen = torch.arange(len(start), device=start.device)

    def evaluate(index: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
        some, these = scene[index], game[index]
        with torch.enable_grad():
            leaf = free.detach().requires_grad_()
            if agent is None:
                controls = leaf.view(len(index), *start.shape[1:])
                value = energy(some, these, controls)[:, 0]
            else:
                whose = agent[index]
                rest = these.initial_controls
                mine = leaf.view(len(index), 1, 1, *start.shape[3:])
                moves = _only(whose, start.shape[2])[:, None, :, None, None]
                controls = torch.where(moves, mine, rest)
                value = energy.objectives(some, these, controls)[chosen[: len(index)], 0, whose]
            (slope,) = torch.autograd.grad(value.sum(), leaf)
        return value.detach(), slope

    free = start[:, 0].flatten(1) if agent is None else start[chosen, 0, agent].flatten(1)
    found = quasi_newton.minimise(evaluate, free)
    if agent is None:
        controls = found.point.view(start.shape)
    else:
        controls = start.clone()
        controls[chosen, 0, agent] = found.point.view(-1, *start.shape[3:])
    return Descent(found.before, found.after, controls, found.slope, found.found)


def _of_candidates(
    mask: Bool[Tensor, "B N"],
    tables: Tables,
    assignment: Int[Tensor, "B M N"],
    mode: Int[Tensor, " B"],
    initial: Float[Tensor, " B"],
) -> Equilibrium:
    """The report for choices among candidates."""
    options = _options(mask, tables, assignment)  # of all modes
    energy = _chosen_energy(mask, tables, assignment, options)
    by_mode = [_of_mode(each, mode)[:, 0] for each in (energy, options, assignment)]
    solved, mine, choice = by_mode
    objective = mine.gather(2, _valid(mask, choice)[..., None])[..., 0]
    lowest = mine.amin(2)
    gap = torch.where(objective == lowest, 0.0, objective - lowest)  # also for infinite energies
    # Coordinate descent, agent by agent, from every mode.
    assignment = _valid(mask[:, None], assignment)
    for _ in range(_SWEEPS):
        before = assignment
        for agent in range(mask.shape[1]):
            options = _options(mask, tables, assignment)[:, :, agent]
            current = options.gather(2, assignment[:, :, agent, None])[..., 0]
            lower, best = options.min(2)
            better = torch.where(lower < current, best, assignment[:, :, agent])
            assignment = torch.cat((assignment[:, :, :agent], better[..., None], assignment[:, :, agent + 1 :]), 2)
        if torch.equal(before, assignment):
            break
    settled = _chosen_energy(mask, tables, assignment, _options(mask, tables, assignment)).amin(1)
    return Equilibrium(
        initial_energy=initial,
        energy=solved,
        optimum=torch.minimum(solved, settled),  # they may differ by rounding errors
        gradient_norm=torch.full_like(solved, torch.nan),
        nash_gap=torch.where(mask, gap, 0.0),
        objective=torch.where(mask, objective, 0.0),
    )


def _options(mask: Bool[Tensor, "B N"], tables: Tables, assignment: Int[Tensor, "B M N"]) -> Float[Tensor, "B M N C"]:
    """J_i for every candidate of every agent while the others keep theirs."""
    batch, modes, agents = assignment.shape
    choice = _valid(mask[:, None], assignment)
    first, second = pairs(agents, mask.device)
    scenes = torch.arange(batch, device=mask.device)[:, None, None]
    which = torch.arange(len(first), device=mask.device)
    both = (mask[:, first] & mask[:, second])[:, None, :, None]
    of_first = tables.pair[scenes, which, :, choice[..., second]].double()  # [B, M, P, C]
    of_second = tables.pair.transpose(2, 3)[scenes, which, :, choice[..., first]].double()
    own = torch.where(mask[..., None], tables.unary, 0.0).double()[:, None].expand(-1, modes, -1, -1)
    options = own.index_add(2, first, torch.where(both, of_first, 0.0))
    return options.index_add(2, second, torch.where(both, of_second, 0.0))


def _chosen_energy(
    mask: Bool[Tensor, "B N"],
    tables: Tables,
    assignment: Int[Tensor, "B M N"],
    options: Float[Tensor, "B M N C"],
) -> Float[Tensor, "B M"]:
    """E of an assignment, 1/2 sum_i (J_i + E_i), because a pair term is in the objectives of both agents."""
    choice = _valid(mask[:, None], assignment)[..., None]
    objective = options.gather(3, choice)[..., 0]
    own = torch.where(mask[..., None], tables.unary, 0.0).double()[:, None]
    return 0.5 * (objective + own.expand(options.shape).gather(3, choice)[..., 0]).sum(2)


def _valid(mask: Bool[Tensor, "*#batch N"], assignment: Int[Tensor, "*batch N"]) -> Int[Tensor, "*batch N"]:
    """The assignment with 0 for absent agents, whose entries may be no valid index."""
    return torch.where(mask, assignment, 0)


def _relevant(scene: Scene) -> Scene:
    """The fields of a scene that an energy may use; others are dropped, because worlds copy the scene for every agent."""
    return Scene(
        history=scene.history[:, :, -1:],
        dt=scene.dt,
        agent_mask=scene.agent_mask,
        size=scene.size,
        kind=scene.kind,
        references=scene.references,
        reference_mask=scene.reference_mask,
        reference_speed=scene.reference_speed,
        game_steps=scene.game_steps,
    )


def _game(scene: Scene, parameters: GameParameters, solution: Solution, mode: Int[Tensor, " B"]) -> GameParameters:
    """The game of one mode in every scene, with its solution as initial strategies."""
    game = dataclasses.replace(parameters, context=None).map(lambda tensor: _of_mode(tensor, mode))
    controls = _of_mode(solution.controls, mode)
    controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
    return dataclasses.replace(game, context=parameters.context, initial_controls=controls).to(torch.float64)


def _of_mode(values: Tensor, mode: Int[Tensor, " B"]) -> Tensor:
    """The values of one mode per scene, [B, 1, ..]; values shared by all modes are taken as they are."""
    scenes = torch.arange(len(mode), device=mode.device)
    return values[scenes, mode.clamp_max(values.shape[1] - 1)][:, None]


def _only(agent: Int[Tensor, " W"], agents: int) -> Bool[Tensor, "W N"]:
    """Mask of the moving agent of each world."""
    return agent[:, None] == torch.arange(agents, device=agent.device)


def _nowhere(controls: Float[Tensor, "W 1 N K 2"]) -> Descent:
    """The result for empty controls."""
    none = controls.new_zeros(len(controls))
    return Descent(none, none, controls, none, none == 0)
