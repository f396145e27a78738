"""Functions shared by the descent methods: initial controls, acceptance of steps, and the solution.

Every scene and mode accepts its own steps and has its own memory. Once a sample has converged, its controls stay the same
bit for bit. On CPUs the loop ends when all have converged; on other devices this test would make the host wait.
"""

from __future__ import annotations

import warnings

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import Energy
from epo_lightning.host import readable
from epo_lightning.scene import Scene

_LARGEST_DECREMENT, _TINY = 1e-3, 1e-6
"""Largest Newton decrement of a minimum: relative to the energy, and absolute."""
_warned = False
_ROUNDING = 8.0
"""Largest rise of an energy, in units of its rounding error, that is accepted if the gradient becomes smaller."""


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


def wide(samples: Shaped[Tensor, "B M"], dimensions: int = 3) -> Shaped[Tensor, "B M *ones"]:
    """Values of samples that broadcast with controls, or with other tensors that have these more dimensions."""
    return samples[(..., *[None] * dimensions)]


def largest(values: Float[Tensor, "B M *some"]) -> Float[Tensor, "B M"]:
    """The largest absolute entry of every sample; zero where there is none."""
    flat = values.flatten(2).abs()
    return flat.amax(-1) if flat.shape[-1] else flat.sum(-1)


def both_finite(value: Float[Tensor, "B M"], slope: Float[Tensor, "B M N K 2"]) -> Bool[Tensor, "B M"]:
    """Mask of the samples with finite energy and gradient."""
    return value.isfinite() & slope.flatten(2).isfinite().all(-1)


def level(
    value: Float[Tensor, "B M"],
    slope: Float[Tensor, "B M N K 2"],
    trial_value: Float[Tensor, "B M"],
    trial_slope: Float[Tensor, "B M N K 2"],
) -> Bool[Tensor, "B M"]:
    """Mask of the samples whose energy is equal up to rounding and whose gradient is smaller.

    Close to a minimum, rounding errors hide changes of the energy for steps below about the square root of the machine
    precision; the gradient still shows them (Hager and Zhang 2005, approximate Wolfe conditions).
    """
    flatter = trial_slope.flatten(2).norm(dim=-1) < slope.flatten(2).norm(dim=-1)
    return (trial_value <= value + rounding(value)) & flatter


def rounding(value: Float[Tensor, "B M"]) -> Float[Tensor, "B M"]:
    """Differences of energies below rounding error."""
    return _ROUNDING * torch.finfo(value.dtype).eps * value.abs()


def ended(done: Bool[Tensor, "B M"]) -> bool:
    """Whether every sample has converged; False on devices where the test would make the host wait."""
    return readable(done) and bool(done.all())


def nothing(controls: Float[Tensor, "B M N K 2"]) -> Solution:
    """The solution of an empty game: no scene, mode, agent or step."""
    none = controls.new_zeros(controls.shape[:2])
    return Solution(controls, controls.new_zeros(*controls.shape[:-1], 4), none, none, none, none.long())


def solution(
    energy: Energy,
    scene: Scene,
    controls: Float[Tensor, "B M N K 2"],
    energies: tuple[Float[Tensor, "B M"], Float[Tensor, "B M"]],
    slope: Float[Tensor, "B M N K 2"],
    status: Int[Tensor, "B M"],
) -> Solution:
    """The solution with these controls, and the energies before and after the minimisation."""
    return Solution(
        controls=controls,
        states=energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt),
        initial_energy=energies[0],
        energy=energies[1],
        gradient_norm=slope.flatten(2).norm(dim=-1),
        status=status,
    )


def first_status(is_finite: Bool[Tensor, "B M"]) -> Int[Tensor, "B M"]:
    """The initial status: COMPLETED, or STOPPED where energy or gradient are not finite at the start."""
    return torch.where(is_finite, int(Status.COMPLETED), int(Status.STOPPED))


def warn_if_far(
    value: Float[Tensor, "*batch"],
    decrement: Float[Tensor, "*batch"],
    definite: Bool[Tensor, "*batch"],
) -> None:
    """Warn, once per process, if more than half of the implicitly differentiated solutions are no minima.

    The test runs on CPUs only; on other devices it would make the host wait.

    Args:
        value: E at the solutions.
        decrement: the Newton decrement 1/2 g . H^-1 g, the decrease that a quadratic model still predicts.
        definite: whether H is positive definite.
    """
    global _warned
    if _warned or not definite.numel() or not readable(definite):
        return
    with torch.no_grad():
        far = ~(definite & (decrement <= _LARGEST_DECREMENT * value.abs() + _TINY))
        share = far.double().mean().item()
    if share > 0.5:
        _warned = True
        warnings.warn(
            f"backward=implicit: {100 * share:.0f} % of the solutions of a batch are no minima (a Newton decrement of more "
            f"than {100 * _LARGEST_DECREMENT:g} % of the energy, or a Hessian that is not positive definite), so their "
            "gradients are wrong: increase solver.steps, set solver.adaptive=true where the solver has it, or choose "
            "backward=unrolled",
            stacklevel=2,
        )
