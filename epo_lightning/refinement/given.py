"""Checks of what a refinement is given: futures and probabilities of any program, weights, and parts of the game."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from epo_lightning.checks import check_number, is_number
from epo_lightning.doubts import array, contradict
from epo_lightning.game.energy import Energy
from epo_lightning.scene import HEADING, SPEED, Scene
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import Minimiser

JUMP = 5.0
"""Distance [m] from the present position up to which a future may begin, besides three times what the speed explains."""
SUM_TOLERANCE = 1e-3
"""Largest difference from one of the sum of a scene's probabilities; files of predictions are often rounded."""
LARGEST = 1e6
"""Largest weight, margin and inverse temperature: squares and products of larger ones leave the range of float32."""
PARTS = {
    "scene": (Scene, "epo_lightning.Scene"),
    "energy": (Energy, "epo_lightning.game.energy.Energy, such as epo_lightning.FeatureEnergy(...)"),
    "solver": (Minimiser, "epo_lightning.solvers.base.Minimiser, such as epo_lightning.LevenbergMarquardt(...)"),
    "backward": (
        Backward,
        "epo_lightning.solvers.backward.Backward: Implicit(), Unrolled(), Truncated(...) or Detached()",
    ),
}
"""Classes of the arguments of :func:`~epo_lightning.refinement.refine` that are parts, and how to get an instance."""


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


def check_parts(scene: Scene, energy: Energy, solver: Minimiser, backward: Backward) -> None:
    """Check the types of scene and parts.

    Raises:
        TypeError: the argument, its type, and what it takes.
    """
    for name, part in (("scene", scene), ("energy", energy), ("solver", solver), ("backward", backward)):
        kind, example = PARTS[name]
        if not isinstance(part, kind):
            raise TypeError(f"{name} is a {type(part).__name__}; it takes an instance of {example}")


def check_inverse_temperature(value: float | Tensor) -> None:
    """Check an inverse temperature, a number or a tensor with a single entry.

    Raises:
        ValueError: it is negative, above :data:`LARGEST`, or no real number.
    """
    if isinstance(value, Tensor):
        real = value.is_floating_point() and not value.dim()
        if not real or not value.isfinite() or value < 0:
            raise ValueError(f"inverse_temperature must be one finite number, 0 or more, not {value}")
    else:
        check_number("inverse_temperature", value, zero=True)
    if _largest(value) > LARGEST:
        raise ValueError(f"inverse_temperature must be at most {LARGEST:g}, not {_largest(value):g}")


def check_values(what: str, given: Mapping[str, float | Tensor] | None) -> None:
    """Check the sizes of weights or margins by feature; their names and shapes are those of an energy and a scene.

    Raises:
        TypeError: no mapping.
        ValueError: a negative number, or one whose square leaves the range of single precision.
    """
    if given is None:
        return
    if not isinstance(given, Mapping):
        raise TypeError(f"{what} is a {type(given).__name__}; it takes a mapping from names of features to numbers")
    for name, value in given.items():
        known = value.numel() > 0 if isinstance(value, Tensor) else is_number(value)
        if known and not isinstance(value, Tensor) and value < 0:
            raise ValueError(f"{what}[{name!r}] must be 0 or more, not {value:g}")
        if known and LARGEST < _largest(value) < math.inf:
            raise ValueError(f"{what}[{name!r}] must be at most {LARGEST:g} in size, not {_largest(value):g}")


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


def _largest(value: float | Tensor) -> float:
    """The largest absolute value."""
    if isinstance(value, Tensor):
        return float(value.detach().abs().max())
    try:
        return abs(float(value))
    except OverflowError:  # a whole number that no float holds
        return sys.float_info.max
