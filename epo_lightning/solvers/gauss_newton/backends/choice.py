"""The implementations of damped steps, and the choice of one of them for a game.

- ``compiled``: the kernel for CPUs (:mod:`.compiled`). PyTorch helps it with features of the user (:mod:`.assisted`).
- ``host``: the same kernel for games on a GPU, which are copied (:mod:`.host`); on a CPU it is ``compiled``.
- ``warp``: fused kernels on a GPU (:mod:`.warp`).
- ``pytorch``: operations of PyTorch, anywhere and for every game (:mod:`.pytorch`).
"""

from __future__ import annotations

import functools
import warnings
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.backends import assisted, compiled, host, kernel_games, pytorch, warp
from epo_lightning.warp_kernels import installed

NAMES = ("auto", "pytorch", "compiled", "host", "warp")


@runtime_checkable
class Backend(Protocol):
    """A module that takes damped steps."""

    def solve(
        self,
        energy: FeatureEnergy,
        scene: Scene,
        parameters: GameParameters,
        steps: int,
        step_size: float,
        damping: Tensor,
        keep_iterates: bool = False,
        exact: bool = False,
    ) -> Solution:
        """S steps from the initial controls, as :func:`.pytorch.solve` takes them.

        The damping is that of every game [B, M] or agent [B, M, N]. An agent with infinite damping keeps its controls
        exactly; its trajectory is then a constant for the other agents.
        """


@runtime_checkable
class KernelBackend(Backend, Protocol):
    """A module whose kernel also takes adaptive steps and differentiates minima."""

    def descend(
        self,
        energy: FeatureEnergy,
        scene: Scene,
        parameters: GameParameters,
        steps: int,
        step_size: float,
        damping: Tensor,
        exact: bool = False,
    ) -> tuple[Solution, Tensor]:
        """S adaptive steps without a derivative; returns the solution and the damping to continue with."""

    def attach(
        self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: Tensor, exact: bool
    ) -> tuple[Tensor, Tensor]:
        """The controls of a solution with their implicit derivative, and a status."""


def with_kernel(backend: Backend) -> KernelBackend | None:
    """The backend, if its kernel takes adaptive steps and differentiates minima."""
    return next((one for one in (compiled, host, assisted) if one is backend), None)


def choose(
    name: str,
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    fixed: bool = False,
) -> Backend:
    """The backend for a game.

    Args:
        name: the setting ``backend``. ``auto`` is ``compiled`` for tensors on a CPU. For those on a GPU it is ``warp`` if
            that can solve the game and the steps are ``fixed``, and else ``host``: adaptive steps of many games end at
            different times, of which only the host makes use. Where neither can solve the game, it is ``pytorch``, and
            also for ``fixed`` steps on a GPU with features of the user, which a CUDA graph can contain then.
        energy, scene, parameters: the game.
        fixed: whether all steps are Gauss-Newton steps with the same damping.

    Raises:
        ValueError: the backend of this name cannot solve the game.
    """
    if name == "pytorch":
        return pytorch
    layer, on_cpu = host.cpu_layer(energy), parameters.initial_controls.device.type == "cpu"
    chosen = {"compiled": layer, "host": layer if on_cpu else host, "warp": warp}.get(name)
    if chosen is None and on_cpu:
        chosen = layer
    elif chosen is None and fixed and energy.custom is not None:
        reason = kernel_games.unknown(energy, scene, parameters, warp.SIZES[-1], "the fused layer")
        assert reason is not None
        return _replaced(reason)
    elif chosen is None:
        chosen = warp if fixed and warp.obstacle(energy, scene, parameters) is None else host
    obstacle = chosen.obstacle(energy, scene, parameters)
    if obstacle is None:
        return chosen
    if name != "auto":
        raise ValueError(f"solver.backend is {name!r}, but {obstacle}; 'auto' and 'pytorch' can solve this game")
    return _replaced(obstacle)


def _replaced(reason: str) -> Backend:
    """Plain PyTorch in the place of a kernel, with a warning of the reason."""
    if not torch.compiler.is_exporting():
        say_once(reason)
    return pytorch


def on_host(name: str, fixed: bool) -> bool:
    """Whether the host solves games on a GPU (:func:`choose`); those that only PyTorch can solve stay on the GPU."""
    return name in ("compiled", "host") or (name == "auto" and not (fixed and installed()))


@functools.cache
def say_once(reason: str) -> None:
    """Warn once per reason that plain PyTorch replaces the kernel."""
    warnings.warn(
        f"{reason}. Plain PyTorch does the same, 20 to 60 times as slowly; `solver.backend=pytorch` (in Python "
        "`LevenbergMarquardt(backend='pytorch')`) says that this is intended.",
        stacklevel=2,
    )
