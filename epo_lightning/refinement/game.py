"""The game of a refinement: its inputs, its energy and its solution, from the tracked strategies of given futures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.checks import is_number
from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.game.dynamics import Dynamics, Unicycle, controls_between
from epo_lightning.game.energy import Energy
from epo_lightning.game.flatness import followed_controls
from epo_lightning.game.pairs import pair_mask
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import HEADING, Scene, heading_vector
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import TABLES, Minimiser

PROVIDED = frozenset({"reference_controls", "reference_speed", "size"})
"""Inputs of energies that a refinement has: the tracked strategies, and what the scene says about its agents."""
NOISE = 0.1
"""Standard deviation [m] of given positions around a smooth motion, unless another one is given."""
OBEYS = 1e-3
"""Difference [m] of positions up to which futures with headings and speeds obey the dynamics."""
ON_A_LINE = 1e-4
"""Offset [m] and sine of an angle up to which agents drive on one line."""
SWERVE = 1e-3
"""Turn rate [rad/s] with which agents on one line begin to avoid each other."""


def refined(
    states: Float[Tensor, "B M N K _"],
    log_probabilities: Float[Tensor, "B M"],
    scene: Scene,
    energy: Energy,
    weights: Mapping[str, float | Tensor],
    margins: Mapping[str, float | Tensor],
    inverse_temperature: float | Tensor,
    noise: float,
    solver: Minimiser,
    backward: Backward,
) -> JointForecast:
    """:func:`~epo_lightning.refinement.refine` without checks of values.

    Futures that are not finite give a forecast that is not.

    Args:
        states: the given futures, x and y [m], or all four entries of the states.
        log_probabilities: logarithms of their probabilities.
        scene: the scenes, in the same coordinates.
        energy: the game that is solved from the given futures.
        weights, margins: those of the energy, by name: a number for all, or a tensor [B, M, N] or [B, M, P].
        inverse_temperature: beta, by which an energy above the least one lowers a probability.
        noise: standard deviation [m] of the given positions.
        solver, backward: solver of the game and derivative of its solution.

    Raises:
        ValueError: an energy, a solver, weights or margins that cannot be used.
    """
    check_energy(energy, solver)
    scene = _of_game(scene, states.dtype, energy)
    controls = track(states, scene, energy.dynamics, noise)
    batch, modes, agents = controls.shape[:3]
    own, pair = energy.weighted
    pairs = agents * (agents - 1) // 2
    _check_names("weights", weights, (*own, *pair))
    _check_names("margins", margins, energy.decoded_margins)
    parameters = GameParameters(
        own_weights={
            name: _expanded(f"weights[{name!r}]", weights[name], (batch, modes, agents), states) for name in own
        },
        pair_weights={
            name: _expanded(f"weights[{name!r}]", weights[name], (batch, modes, pairs), states) for name in pair
        },
        margins={
            name: _expanded(f"margins[{name!r}]", margins[name], (batch, modes, pairs), states)
            for name in energy.decoded_margins
        },
        initial_controls=controls + swerve(scene)[:, None, :, None],
        reference_controls=controls,
    )
    solution = backward(solver, energy, scene, parameters)
    least = solution.energy
    if torch.is_grad_enabled() and not least.requires_grad:
        # Strategies could be held constant at a minimum of the energy only (envelope theorem). A few steps need not reach
        # one, and under hard constraints the strategies move with the margins.
        least = energy(scene, parameters, solution.controls)
    logits = log_probabilities - inverse_temperature * (least - least.amin(1, keepdim=True))
    return JointForecast(
        states=solution.states,
        probabilities=logits.softmax(1),
        controls=solution.controls,
        initial_states=energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt),
        parameters=parameters,
        solution=solution,
        logits=logits,
    )


@torch.no_grad()
def track(
    states: Float[Tensor, "B M N K _"], scene: Scene, dynamics: Dynamics, noise: float
) -> Float[Tensor, "B M N K 2"]:
    """Controls whose rollouts follow the given futures; zero for absent agents.

    Futures with headings and speeds that obey the dynamics are followed exactly, others as closely as ``noise`` asks for.

    Raises:
        ConfigError: other dynamics than a unicycle with explicit Euler steps.
    """
    if not isinstance(dynamics, Unicycle) or dynamics.integrator != "euler":
        raise ConfigError(
            "a refinement tracks futures by dynamics=unicycle with dynamics.integrator=euler, not by others"
        )
    present = scene.agent_mask[:, None, :, None]
    current = torch.where(present, scene.current[:, None], 0.0).expand(-1, states.shape[1], -1, -1)
    states = torch.where(present[..., None], states, current[..., None, : states.shape[-1]])
    controls = followed_controls(states[..., :2], current, scene.dt, noise)
    if states.shape[-1] == 4:
        stated = controls_between(torch.cat((current[..., None, :], states), -2), scene.dt)
        missed = (dynamics.rollout(current, stated, scene.dt) - states)[..., :2].abs().amax((-2, -1))
        controls = torch.where((missed < OBEYS)[..., None, None], stated, controls)
    return torch.where(present[..., None], controls, 0.0)


def swerve(scene: Scene) -> Float[Tensor, "B N 2"]:
    """Turn rates [rad/s], as controls, that take agents on exactly one line off it; zero for all others.

    On the line no energy has a derivative to the side, and a vehicle that follows it could only drive through the one ahead.
    To break this tie, a vehicle behind turns to its left, one in front to its right, and both of two that approach each
    other to their right. Among several others on the line, the nearest ones decide.
    """
    position, heading = scene.current[..., :2], scene.current[..., HEADING]
    offset = position[:, None] - position[:, :, None]  # [B, N, N, 2]: of every agent j from every agent i
    ahead = heading_vector(heading)[:, :, None]
    along = (offset * ahead).sum(-1)
    across = ahead[..., 0] * offset[..., 1] - ahead[..., 1] * offset[..., 0]
    angle = heading[:, None] - heading[:, :, None]
    both_exist = scene.agent_mask[:, None] & scene.agent_mask[:, :, None]
    on_a_line = both_exist & (across.abs() < ON_A_LINE) & (angle.sin().abs() < ON_A_LINE) & (along != 0)
    distance = torch.where(on_a_line, along.abs(), torch.inf)
    share = torch.where(on_a_line, (distance.amin(-1, keepdim=True) / distance) ** 4, 0.0)
    side = torch.where(on_a_line, angle.cos() * along.sign() * share, 0.0).sum(-1)
    return torch.stack((torch.zeros_like(side), SWERVE * side), -1)


def check_energy(energy: Energy, solver: Minimiser) -> None:
    """Refuse an energy with inputs that a refinement does not have, and solvers that choose among candidates.

    Raises:
        ConfigError: see above; the message names the features or inputs.
    """
    lacking = energy.needs - PROVIDED
    if lacking:
        raise ConfigError(
            f"a refinement knows no {', '.join(sorted(lacking))}, which this energy needs: leave out the features of "
            "goals, lines and networks, as conf/energy/refinement.yaml does"
        )
    if energy.pair_order is not None:
        raise ConfigError("a refinement decodes no orders of agents, which this energy needs: use energy=refinement")
    if "reference_controls" not in energy.needs:
        raise ConfigError(
            "no feature of this energy holds agents near the given futures, so a refinement would forget them: add accref "
            "and turnrref to energy.own"
        )
    if TABLES in solver.provides:
        raise ConfigError(
            "a refinement descends from the given futures, and this solver chooses among candidates: use solver=refinement"
        )


def _of_game(scene: Scene, dtype: torch.dtype, energy: Energy) -> Scene:
    """The scene of the game, which ends with the forecast: histories, maps and ``game_steps`` are left out."""

    def floats(value: Tensor | None) -> Tensor | None:
        return None if value is None else value.to(dtype)

    size = scene.size
    if size is None and "size" not in energy.needs and not pair_mask(scene).any():
        size = scene.current.new_zeros(*scene.agent_mask.shape, 2)  # only pair features read it, and there is no pair
    return Scene(
        history=scene.history[:, :, -1:].to(dtype),
        dt=scene.dt,
        agent_mask=scene.agent_mask,
        size=floats(size),
        kind=scene.kind,
        reference_speed=floats(scene.reference_speed),
    )


def _check_names(what: str, given: Mapping[str, float | Tensor], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"unknown feature {what}[{name!r}] of this energy: {nearest(str(name), known)}")
    for name in known:
        if name not in given:
            raise ValueError(f"{what} lacks the feature {name!r}; it has {sorted(given)}")


def _expanded(what: str, value: float | Tensor, shape: tuple[int, int, int], like: Tensor) -> Tensor:
    """A weight or margin for every mode and agent or pair.

    Raises:
        ValueError: no finite number, or a tensor of another shape.
    """
    if not isinstance(value, Tensor):
        if not is_number(value) or not math.isfinite(value):
            raise ValueError(f"{what} must be a finite number or a tensor, not {value!r}")
        return like.new_full((), float(value)).expand(shape)
    if value.is_complex() or value.dtype == torch.bool:
        raise ValueError(f"{what} is of type {value.dtype}, expected real numbers")
    if not value.isfinite().all():
        raise ValueError(f"{what} has entries that are not finite")
    try:
        return value.to(like).expand(shape)
    except RuntimeError:
        raise ValueError(f"{what} has shape {list(value.shape)}, which cannot be expanded to {list(shape)}") from None
