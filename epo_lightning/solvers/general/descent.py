"""What minimisers by descent have in common: where they begin, which steps they accept, and what they return.

Every scene and mode goes its own way: it accepts its own steps and has its own memory. Once it has converged, its controls
stay bit for bit as they are. On CPUs the loop ends with the last of them; elsewhere the host would have to wait to know.
"""

from __future__ import annotations

import warnings

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.energy import Energy
from epo_lightning.scene import GameParameters, Scene, Solution, Status

_FAR, _TINY = 1e-3, 1e-6
"""Share of the energy, and energy, that a minimum's Newton decrement stays below."""
_said = False
_ROUNDING = 8.0
"""Roundings by which an energy may seem to rise over a step that lowers its gradient."""


def begin(energy: Energy, scene: Scene, parameters: GameParameters) -> tuple[Scene, Float[Tensor, "B M N K 2"]]:
    """The scene in the precision of the controls, and the initial controls, zero for absent agents.

    Raises:
        ValueError: scene and parameters do not fit together, or controls are of another type than float32 and float64.
    """
    start = parameters.initial_controls.detach()
    energy.validate(scene, parameters, start)
    if start.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"initial_controls are of type {start.dtype}; the solver takes float32 and float64")
    if scene.history.dtype != start.dtype:
        scene = scene.to(start.dtype)
    return scene, torch.where(scene.agent_mask[:, None, :, None, None], start, 0.0)


def largest(controls: Float[Tensor, "B M N K 2"]) -> Float[Tensor, "B M"]:
    """The largest absolute entry of every sample; zero where there is none."""
    flat = controls.flatten(2).abs()
    return flat.amax(-1) if flat.shape[-1] else flat.sum(-1)


def finite(value: Float[Tensor, "B M"], slope: Float[Tensor, "B M N K 2"]) -> Bool[Tensor, "B M"]:
    """Whose energy and gradient are numbers."""
    return value.isfinite() & slope.flatten(2).isfinite().all(-1)


def level(
    value: Float[Tensor, "B M"],
    slope: Float[Tensor, "B M N K 2"],
    trial_value: Float[Tensor, "B M"],
    trial_slope: Float[Tensor, "B M N K 2"],
) -> Bool[Tensor, "B M"]:
    """Whose energy is the same up to rounding, and whose gradient is smaller.

    Close to a minimum, energies tell points apart that are the root of the machine's precision away from each other, and
    gradients tell apart what is nearer (Hager and Zhang 2005, approximate Wolfe conditions).
    """
    flatter = trial_slope.flatten(2).norm(dim=-1) < slope.flatten(2).norm(dim=-1)
    return (trial_value <= value + rounding(value)) & flatter


def rounding(value: Float[Tensor, "B M"]) -> Float[Tensor, "B M"]:
    """Differences of energies that mean nothing."""
    return _ROUNDING * torch.finfo(value.dtype).eps * value.abs()


def ended(done: Bool[Tensor, "B M"]) -> bool:
    """Whether every sample has converged, where looking costs nothing."""
    return done.device.type == "cpu" and bool(done.all())


def nothing(controls: Float[Tensor, "B M N K 2"]) -> Solution:
    """The solution of no game at all: no scene, no mode, no agent or no step."""
    none = controls.new_zeros(controls.shape[:2])
    return Solution(controls, controls.new_zeros(*controls.shape[:-1], 4), none, none, none, none.long())


def solution(
    energy: Energy,
    scene: Scene,
    controls: Float[Tensor, "B M N K 2"],
    energies: tuple[Float[Tensor, "B M"], Float[Tensor, "B M"]],
    slope: Float[Tensor, "B M N K 2"],
    status: Tensor,
) -> Solution:
    """The solution with these controls, of these energies before and after."""
    return Solution(
        controls=controls,
        states=energy.dynamics.rollout(energy.initial(scene), controls, scene.dt),
        initial_energy=energies[0],
        energy=energies[1],
        gradient_norm=slope.flatten(2).norm(dim=-1),
        status=status,
    )


def first_status(sound: Bool[Tensor, "B M"]) -> Tensor:
    """STOPPED where there is no number to begin with."""
    return torch.where(sound, int(Status.SOLVED), int(Status.STOPPED))


def say_if_far(
    value: Float[Tensor, "*batch"],
    slope: Float[Tensor, "*batch n"],
    step: Float[Tensor, "*batch n"],
    sound: Bool[Tensor, "*batch"],
) -> None:
    """Warn, once per process, if more than half of the solutions that are differentiated as minima are none.

    The Newton decrement 1/2 g . H^-1 g is what a quadratic model says is left to gain. Looked at on CPUs only: elsewhere the
    host would have to wait.

    Args:
        value: E at the solutions.
        slope: its gradient g.
        step: H^-1 g.
        sound: whether H is positive definite.
    """
    global _said
    if _said or not sound.numel() or sound.device.type != "cpu":
        return
    with torch.no_grad():
        left = 0.5 * (slope * step).sum(-1)
        far = ~(sound & (left <= _FAR * value.abs() + _TINY))
        share = far.double().mean().item()
    if share > 0.5:
        _said = True
        warnings.warn(
            f"backward=implicit: {100 * share:.0f} % of the solutions of a batch are no minima (a Newton decrement of more "
            f"than {100 * _FAR:g} % of the energy, or a Hessian that is not positive definite). What is learned through "
            "them is not right: take more solver.steps, solver.adaptive=true where the solver has it, or backward=unrolled",
            stacklevel=2,
        )
