"""Refinement: the game on top of any frozen forecaster.

A forecaster of any kind gives M joint futures of a scene, whose agents may drive into each other because they were forecast
independently. The refinement takes them as the agents' intentions:

1. Tracking finds the controls u_ref whose rollout follows every future (:mod:`~epo_lightning.game.flatness`).
2. The game of every mode is solved from u_ref. Its own terms hold each agent near its intention, its pair terms make
   agents give way to each other:

       E(u) = 1/2 sum_i |w_i (u_i - u_ref,i)|^2 + 1/2 sum_{i<j} |w_ij d(u_i, u_j)|^2.

3. Modes that needed much correction become less likely:

       p'_m  ~  p_m exp(-beta (E_m - min_m E_m)),

   with the energy E_m of the solution of mode m and the inverse temperature beta.

Where agents do not interact, the refined futures are the tracked ones.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.checks import check_number, is_number
from epo_lightning.doubts import array, contradict
from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.game.dynamics import Dynamics, Unicycle, controls_between
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.flatness import followed_controls
from epo_lightning.game.pairs import pair_mask
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import HEADING, SPEED, Scene
from epo_lightning.solvers.backward import Backward, Implicit
from epo_lightning.solvers.base import TABLES, Minimiser
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

PROVIDED = frozenset({"reference_controls", "reference_speed", "size"})
"""Inputs of energies that a refinement has: the tracked strategies, and what the scene says about its agents."""
ENERGY = FeatureEnergy(own=("accref", "turnrref"), pair=("circles",))
"""The energy of :func:`refine` unless another one is given: intentions, and bodies of vehicles that do not overlap."""
WEIGHTS = {"accref": 1.0, "turnrref": 20.0, "circles": 10.0}
"""Weights of :data:`ENERGY`. At 20 m/s, a turn rate of 0.05 rad/s is felt as an acceleration of 1 m/s^2."""
SOLVER = LevenbergMarquardt(steps=10, step_size=1.0, damping=1.0, adaptive=True)
"""The solver of :func:`refine` unless another one is given."""
INVERSE_TEMPERATURE = 0.03
"""beta of :func:`refine` unless another one is given, chosen on validation data (docs/refine.md)."""
NOISE = 0.1
"""Standard deviation [m] of given positions around a smooth motion, unless another one is given."""
OBEYS = 1e-3
"""Difference [m] of positions up to which futures with headings and speeds obey the dynamics."""
LARGEST = 1e6
"""Largest weight, margin and inverse temperature: squares and products of larger ones leave the range of float32."""
JUMP = 5.0
"""Distance [m] from the present position up to which a future may begin, besides three times what the speed explains."""
FAR, RESOLUTION = 1000.0, 0.01
"""Distance [m] from the origin above which a scene is moved to it, and the coarsest resolution [m] without a warning."""
EXAMPLES = {
    "energy": "epo_lightning.game.energy.Energy, such as epo_lightning.FeatureEnergy(...)",
    "solver": "epo_lightning.solvers.base.Minimiser, such as epo_lightning.LevenbergMarquardt(...)",
    "backward": "epo_lightning.solvers.backward.Backward: Implicit(), Unrolled(), Truncated(...) or Detached()",
}
"""What the arguments of :func:`refine` are instances of."""
SUM_TOLERANCE = 1e-3
"""Largest difference from one of the sum of a scene's probabilities; files of predictions are often rounded."""


def refine(
    states: Tensor,
    probabilities: Tensor,
    scene: Scene,
    energy: Energy = ENERGY,
    weights: Mapping[str, float | Tensor] | None = None,
    *,
    margins: Mapping[str, float | Tensor] | None = None,
    inverse_temperature: float | Tensor = INVERSE_TEMPERATURE,
    noise: float = NOISE,
    solver: Minimiser = SOLVER,
    backward: Backward | None = None,
) -> JointForecast:
    """Scene-consistent futures and probabilities from the futures and probabilities of any forecaster.

    The solution is differentiable with respect to weights, margins and inverse temperature, not to the given futures.

    Args:
        states: futures [B, M, N, K, 4] with x, y [m], heading [rad], speed [m/s], or [B, M, N, K, 2] with x, y only; the
            first step is one time step ``scene.dt`` after t0. Futures of absent agents are ignored.
        probabilities: probabilities [B, M] of the joint modes.
        scene: the scenes of the forecasts: present states, and sizes if the energy has features of bodies. Pair
            features need no sizes where no scene has two agents.
        energy: the energy; it may need nothing but sizes, reference speeds and reference controls.
        weights: weight of each of the energy's features, a number, or a tensor that can be expanded to [B, M, N] for
            features of agents and to [B, M, P] for those of pairs. Features of the default energy that are left out have
            :data:`WEIGHTS`; another energy needs all of its weights.
        margins: the same for margins [m] of pair features that the energy does not fix.
        inverse_temperature: beta >= 0, by which energies reweight the probabilities; 0 keeps them.
        noise: standard deviation [m] of the positions around a smooth motion, which tracking removes; 0 for none.
        solver: the minimiser of the energy.
        backward: the derivative of the solution; None for the implicit one.

    Returns:
        the refined forecast; ``initial_states`` are the rollouts of the tracked strategies.

    Raises:
        TypeError: futures or probabilities that are no tensors in single or double precision, a scene that is none, or
            weights or margins that are no mappings.
        ValueError: a shape, value, weight or feature that cannot be used; the message names it.

    Example:
        Two cars whose paths cross at the same time:

        >>> start = torch.tensor([[[-20.0, 0.0, 0.0, 10.0]], [[0.0, -20.0, torch.pi / 2, 10.0]]])
        >>> scene = Scene(start[None], dt=0.2, size=torch.tensor([[[4.0, 2.0], [4.0, 2.0]]]))
        >>> way = 2.0 * torch.arange(1.0, 21.0)
        >>> given = torch.stack((torch.stack((way - 20.0, 0.0 * way), -1), torch.stack((0.0 * way, way - 20.0), -1)))
        >>> apart = lambda states: (states[0, 0, 0] - states[0, 0, 1])[:, :2].norm(dim=-1).min()
        >>> refined = refine(given[None, None], torch.ones(1, 1), scene)
        >>> bool(apart(given[None, None]) < 0.1), bool(apart(refined.states) > 2.0)
        (True, True)
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is a {type(scene).__name__}; refine() takes an epo_lightning.Scene")
    for what, part, kind in (
        ("energy", energy, Energy),
        ("solver", solver, Minimiser),
        ("backward", backward if backward is not None else Implicit(), Backward),
    ):
        if not isinstance(part, kind):
            raise TypeError(f"{what} is a {type(part).__name__}; it takes an instance of {EXAMPLES[what]}")
    scene.validate_values()
    check_forecast(states, probabilities, scene)
    check_number("noise", noise, zero=True)
    if isinstance(inverse_temperature, Tensor):
        real = inverse_temperature.is_floating_point() and not inverse_temperature.dim()
        if not real or not inverse_temperature.isfinite() or inverse_temperature < 0:
            raise ValueError(f"inverse_temperature must be one finite number, 0 or more, not {inverse_temperature}")
    else:
        check_number("inverse_temperature", inverse_temperature, zero=True)
    for name, values in (("weights", weights), ("margins", margins)):
        if values is not None and not isinstance(values, Mapping):
            raise TypeError(
                f"{name} is a {type(values).__name__}; it takes a mapping from names of features to numbers"
            )
    if _largest(inverse_temperature) > LARGEST:
        raise ValueError(f"inverse_temperature must be at most {LARGEST:g}, not {_largest(inverse_temperature):g}")
    if energy is not ENERGY and weights is None:
        names = [name for part in energy.weighted for name in part]
        raise ValueError(
            f"an energy of your own needs weights=, a number for each of {', '.join(names) or 'its features'}"
        )
    weights, margins = {**(WEIGHTS if energy is ENERGY else {}), **(weights or {})}, dict(margins or {})
    for what, given in (("weights", weights), ("margins", margins)):
        for name, value in given.items():
            known = value.numel() > 0 if isinstance(value, Tensor) else is_number(value)
            if known and not isinstance(value, Tensor) and value < 0:
                raise ValueError(f"{what}[{name!r}] must be 0 or more, not {value:g}")
            if known and LARGEST < _largest(value) < math.inf:
                raise ValueError(f"{what}[{name!r}] must be at most {LARGEST:g} in size, not {_largest(value):g}")
    learned = (*weights.values(), *margins.values(), inverse_temperature)
    origin = _origin(states, scene)
    if origin is not None:
        near = dataclasses.replace(scene, history=_moved(scene.history, -origin[:, None, None]))
    with torch.set_grad_enabled(torch.is_grad_enabled() and any(_requires_grad(value) for value in learned)):
        forecast = refined(
            states if origin is None else _moved(states, -origin[:, None, None, None]),
            probabilities.log(),
            scene if origin is None else near,
            energy,
            weights,
            margins,
            inverse_temperature,
            noise,
            solver,
            Implicit() if backward is None else backward,
        )
    return forecast if origin is None else _moved_back(forecast, origin[:, None, None, None])


def _origin(states: Tensor, scene: Scene) -> Float[Tensor, "B 2"] | None:
    """The mean present position of the agents of scenes in coordinates of a map; None if all scenes are near the origin.

    Such coordinates have few digits in single precision, and the game does not depend on the origin.
    """
    if float(scene.current[..., :2].abs().sum()) <= FAR:  # a quick answer for most scenes
        return None
    farthest = float(scene.current_or_zero[..., :2].abs().max())
    if farthest <= FAR:
        return None
    resolution = farthest * max(torch.finfo(tensor.dtype).eps for tensor in (states, scene.history))
    if resolution > RESOLUTION:
        warnings.warn(
            f"positions are up to {farthest:.0f} m from the origin, where single precision has a resolution of "
            f"{resolution:.2g} m: give scene and futures in double precision, or subtract an origin",
            stacklevel=3,
        )
    return scene.current_or_zero[..., :2].sum(1) / scene.agent_mask.sum(-1, keepdim=True).clamp_min(1)


def _moved(states: Float[Tensor, "*batch X"], by: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch X"]:
    """States with other positions."""
    return torch.cat((states[..., :2] + by.to(states.dtype), states[..., 2:]), -1)


def _moved_back(forecast: JointForecast, by: Float[Tensor, "B 1 1 1 2"]) -> JointForecast:
    """A forecast with other positions."""
    assert forecast.initial_states is not None
    assert forecast.solution is not None
    return dataclasses.replace(
        forecast,
        states=_moved(forecast.states, by),
        initial_states=_moved(forecast.initial_states, by),
        solution=dataclasses.replace(forecast.solution, states=_moved(forecast.solution.states, by)),
    )


def _largest(value: float | Tensor) -> float:
    """The largest absolute value."""
    if isinstance(value, Tensor):
        return float(value.detach().abs().max())
    try:
        return abs(float(value))
    except OverflowError:  # a whole number that no float holds
        return sys.float_info.max


def _requires_grad(value: float | Tensor) -> bool:
    return isinstance(value, Tensor) and value.requires_grad


def refined(
    states: Tensor,
    log_probabilities: Tensor,
    scene: Scene,
    energy: Energy,
    weights: Mapping[str, float | Tensor],
    margins: Mapping[str, float | Tensor],
    inverse_temperature: float | Tensor,
    noise: float,
    solver: Minimiser,
    backward: Backward,
) -> JointForecast:
    """:func:`refine` without checks of values: futures that are not finite give a forecast that is not.

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
        initial_controls=controls,
        reference_controls=controls,
    )
    solution = backward(solver, energy, scene, parameters)
    least = solution.energy
    if torch.is_grad_enabled() and not least.requires_grad:
        # At a minimum, the derivative of its energy is the one at constant strategies (envelope theorem).
        least = energy(scene, parameters, solution.controls.detach())
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


@torch.no_grad()
def track(states: Tensor, scene: Scene, dynamics: Dynamics, noise: float) -> Float[Tensor, "B M N K 2"]:
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
        told = controls_between(torch.cat((current[..., None, :], states), -2), scene.dt)
        missed = (dynamics.rollout(current, told, scene.dt) - states)[..., :2].abs().amax((-2, -1))
        controls = torch.where((missed < OBEYS)[..., None, None], told, controls)
    return torch.where(present[..., None], controls, 0.0)


def check_forecast(states: Tensor, probabilities: Tensor, scene: Scene) -> None:
    """Check that futures and probabilities are those of a scene.

    Raises:
        TypeError: no tensors of floating-point numbers.
        ValueError: a shape that does not fit, futures that are not finite, or probabilities that are none.

    Warns:
        UserWarning: futures that begin far from the agents.
    """
    for name, value in (("states", states), ("probabilities", probabilities)):
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} is a {type(value).__name__}; convert it with torch.as_tensor")
        if value.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name} is of type {value.dtype}, expected floating-point numbers: float32 or float64")
    batch, agents = scene.agent_mask.shape
    if states.dim() != 5 or states.shape[0] != batch or states.shape[2] != agents or states.shape[4] not in (2, 4):
        raise ValueError(
            f"states has shape {list(states.shape)}; this scene takes [{batch}, M, {agents}, K, 2 or 4]: x, y [m], and "
            "perhaps heading [rad] and speed [m/s]"
        )
    modes, steps = states.shape[1], states.shape[3]
    if modes < 1 or steps < 2:
        raise ValueError(f"states has M = {modes} mode(s) of K = {steps} step(s); a refinement takes at least 1 and 2")
    if list(probabilities.shape) != [batch, modes]:
        raise ValueError(f"probabilities has shape {list(probabilities.shape)}; these states take [{batch}, {modes}]")
    broken = ~states.isfinite().all(-1) & scene.agent_mask[:, None, :, None]
    if broken.any():
        at = broken.nonzero()[0].tolist()
        raise ValueError(
            f"states{at} is {states[tuple(at)].tolist()}, which is not finite: leave the scene out, or mark the agent as "
            "absent (scene.agent_mask)"
        )
    lost = ~scene.current.isfinite().all(-1) & scene.agent_mask
    if lost.any():
        at = lost.nonzero()[0].tolist()
        raise ValueError(
            f"the present state scene.history[{at[0]}, {at[1]}, -1] is not finite: mark the agent as absent"
        )
    _warn_of_beginnings(states, scene)
    bad = ~(probabilities >= 0).all(1) | ((probabilities.sum(1) - 1).abs() > SUM_TOLERANCE)
    if bad.any():
        where = int(bad.nonzero()[0])
        raise ValueError(
            f"probabilities[{where}] is {probabilities[where].tolist()}; the probabilities of a scene's joint modes are 0 "
            "or more and sum to 1"
        )


def _warn_of_beginnings(states: Tensor, scene: Scene) -> None:
    """Warn of futures that begin far from the present positions, or with another velocity than the present one.

    Computed in numpy: for single scenes, every operation of PyTorch takes several times as long.
    """
    current, first = array(scene.current), array(states[..., 0, :2])
    present = array(scene.agent_mask)[:, None]
    with np.errstate(invalid="ignore", over="ignore"):  # absent agents may have any numbers
        place, velocity = (
            current[..., 0] + 1j * current[..., 1],
            current[..., SPEED] * np.exp(1j * current[..., HEADING]),
        )
        moved = first[..., 0] + 1j * first[..., 1] - place[:, None]  # in the plane, as complex numbers
        gap, own = abs(moved), scene.dt * abs(velocity)
        torn = (gap > JUMP + 3.0 * own[:, None]) & present
        wrong = torn | (contradict(moved / scene.dt, velocity[:, None], scene.dt) & present)
    if not wrong.any():
        return
    number, mode, agent = np.argwhere(torn if torn.any() else wrong)[0].tolist()
    if torn.any():
        said = (
            f"states[{number}, {mode}, {agent}] begins {gap[number, mode, agent]:.1f} m from the agent's present position, "
            f"of which its speed explains {own[number, agent]:.1f} m: are futures and histories in the same coordinates? "
            "The first step is one dt after the present"
        )
    else:
        said = (
            f"{wrong.sum()} of the given futures of agents do not continue their present motion, the first one "
            f"states[{number}, {mode}, {agent}]: are headings [rad], speeds [m/s] and dt [s] right, and is the first step "
            "one dt after the present?"
        )
    warnings.warn(said, stacklevel=4)


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
            "a refinement descends from the given futures, and this solver chooses among candidates: use solver=converging"
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
