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
from collections.abc import Mapping

import torch
from torch import Tensor

from epo_lightning.checks import check_number
from epo_lightning.forecast import JointForecast
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.refinement.game import NOISE, refined
from epo_lightning.refinement.given import check_forecast, check_inverse_temperature, check_parts, check_values
from epo_lightning.refinement.origin import moved, moved_back, origin_of
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Backward, Implicit
from epo_lightning.solvers.base import Minimiser
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

ENERGY = FeatureEnergy(own=("accref", "turnrref"), pair=("circles",))
"""The energy of :func:`refine` unless another one is given: intentions, and bodies of vehicles that do not overlap."""
WEIGHTS = {"accref": 1.0, "turnrref": 20.0, "circles": 10.0}
"""Weights of :data:`ENERGY`. At 20 m/s, a turn rate of 0.05 rad/s is felt as an acceleration of 1 m/s^2."""
SOLVER = LevenbergMarquardt(steps=50, step_size=1.0, damping=1.0, adaptive=True)
"""The solver of :func:`refine` unless another one is given. Modes take no further steps once they have arrived."""
INVERSE_TEMPERATURE = 0.03
"""beta of :func:`refine` unless another one is given, chosen on validation data (docs/refine.md)."""


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
    backward = Implicit() if backward is None else backward
    check_parts(scene, energy, solver, backward)
    scene.validate_values()
    check_forecast(states, probabilities, scene)
    check_number("noise", noise, zero=True)
    check_inverse_temperature(inverse_temperature)
    check_values("weights", weights)
    check_values("margins", margins)
    if energy is not ENERGY and weights is None:
        names = [name for part in energy.weighted for name in part]
        raise ValueError(
            f"an energy of your own needs weights=, a number for each of {', '.join(names) or 'its features'}"
        )
    weights, margins = {**(WEIGHTS if energy is ENERGY else {}), **(weights or {})}, dict(margins or {})
    learned = (*weights.values(), *margins.values(), inverse_temperature)
    origin = origin_of(scene, states.dtype)
    if origin is not None:
        scene = dataclasses.replace(scene, history=moved(scene.history, -origin[:, None, None]))
        states = moved(states, -origin[:, None, None, None])
    with torch.set_grad_enabled(torch.is_grad_enabled() and any(_requires_grad(value) for value in learned)):
        forecast = refined(
            states,
            probabilities.log(),
            scene,
            energy,
            weights,
            margins,
            inverse_temperature,
            noise,
            solver,
            backward,
        )
    return forecast if origin is None else moved_back(forecast, origin[:, None, None, None])


def _requires_grad(value: float | Tensor) -> bool:
    return isinstance(value, Tensor) and value.requires_grad
