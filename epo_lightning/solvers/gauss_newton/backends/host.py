"""The host backend for tensors on a GPU: the game is copied to the CPU, solved there by the compiled layer, and copied back.

Features of the user are evaluated on the CPU as well (:mod:`.assisted`).

A batch's parameters and controls are some 100 kB. Everything that the kernel reads is packed into one buffer on the device,
which one copy brings into pinned memory; the solution goes back the same way. The backward pass makes one copy of the
cotangents and one of the gradients. The copies have a stream of their own. The host waits for the first copy of each pass,
so that calls cannot be captured in a CUDA graph.

The kernel uses all cores that the process may run on, whatever the number of PyTorch's threads.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.backends import assisted, compiled


@runtime_checkable
class Copies(Protocol):
    """Copies of whole buffers of bytes between a device and the host."""

    def to_host(self, buffer: Tensor) -> Tensor:
        """The bytes of a buffer on the device, in memory of the host; complete on return."""
        ...

    def to_device(self, tensors: Sequence[Tensor]) -> Tensor:
        """The packed bytes of tensors of the host, in a buffer on the device."""
        ...


class PinnedCopies:
    """Copies between a CUDA device and pinned memory, on a stream of their own.

    PyTorch keeps released pinned memory and hands it out again once the copies from and to it have ended.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.stream = _stream(device)
        self.consumer = torch.cuda.current_stream(device)

    def to_host(self, buffer: Tensor) -> Tensor:
        """The bytes of a buffer on the device; the host waits for them."""
        host = torch.empty(buffer.shape, dtype=buffer.dtype, pin_memory=True)
        self.stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(self.stream):
            host.copy_(buffer, non_blocking=True)
            done = self.stream.record_event()
        buffer.record_stream(self.stream)
        done.synchronize()
        return host

    def to_device(self, tensors: Sequence[Tensor]) -> Tensor:
        """The packed bytes of tensors of the host; the device waits for them, and the host does not."""
        parts = _parts(tensors)
        host = torch.empty(sum(part.numel() for part in parts), dtype=torch.uint8, pin_memory=True)
        torch.cat(parts, out=host)
        buffer = torch.empty(host.shape, dtype=torch.uint8, device=self.device)
        current = torch.cuda.current_stream(self.device)
        self.stream.wait_stream(current)  # the memory of the buffer may be in use there
        with torch.cuda.stream(self.stream):
            buffer.copy_(host, non_blocking=True)
        buffer.record_stream(self.stream)
        # In a backward pass this is a thread of the CPU, whose current stream need not be that of the forward pass.
        current.wait_stream(self.stream)
        self.consumer.wait_stream(self.stream)
        return buffer


@functools.cache
def _stream(device: torch.device) -> Any:
    return torch.cuda.Stream(device)


def copies_of(device: torch.device) -> Copies | None:
    """The copies between the host and a device; None where this backend has none."""
    return PinnedCopies(device) if device.type == "cuda" else None


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why a game cannot be solved on the host and copied; None where it can."""
    device = parameters.initial_controls.device
    if copies_of(device) is None:
        return f"the game is copied from CUDA devices, and these tensors are on {device}"
    if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
        return "the host solves the game, and a CUDA graph cannot contain work of the host"
    return cpu_layer(energy).unsupported(energy, scene, parameters)


def cpu_layer(energy: FeatureEnergy) -> ModuleType:
    """The module that solves games of an energy on the CPU."""
    return compiled if energy.custom is None else assisted


def solve(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    keep_iterates: bool = False,
    exact: bool = False,
) -> Solution:
    """S damped Gauss-Newton steps of :func:`.compiled.solve` for tensors on a device; differentiable by the same inputs."""
    transfer = _Transfer(parameters)
    here, game, factor = transfer.to_host(_read(energy, scene), _given(energy, parameters), damping)
    found = cpu_layer(energy).solve(
        energy, here, game, steps, step_size, factor, keep_iterates, exact, threads=_cores()
    )
    return transfer.to_device(found)[0]


def descend(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    exact: bool = False,
) -> tuple[Solution, Float[Tensor, "B M *agents"]]:
    """S adaptive steps of :func:`.compiled.descend` for tensors on a device; the solution, and the damping afterwards."""
    transfer = _Transfer(parameters)
    here, game, factor = transfer.to_host(_read(energy, scene), _given(energy, parameters), damping)
    found, last = cpu_layer(energy).descend(energy, here, game, steps, step_size, factor, exact, threads=_cores())
    solution, damping = transfer.to_device(found, last)
    return solution, damping


def attach(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"], exact: bool
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """The controls of a solution with their implicit derivative, and a status, as :func:`.compiled.attach` returns them."""
    transfer = _Transfer(parameters)
    here, game, copy = transfer.to_host(_read(energy, scene), _given(energy, parameters), controls)
    found, status = transfer.to_device(*cpu_layer(energy).attach(energy, here, game, copy, exact, threads=_cores()))
    return found, status


def _cores() -> int:
    """Number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _read(energy: FeatureEnergy, scene: Scene) -> Scene:
    """The part of a scene that the kernel reads: of the history, only the current states."""
    needs = energy.needs
    on_lines = "reference" in needs
    return Scene(
        history=scene.history[:, :, -1:],
        dt=scene.dt,
        history_mask=scene.history_mask[:, :, -1:],
        agent_mask=scene.agent_mask,
        size=scene.size,
        references=scene.references if on_lines else None,
        reference_mask=scene.reference_mask if on_lines else None,
        reference_speed=scene.reference_speed if "reference_speed" in needs else None,
        game_steps=scene.game_steps,
    )


def _given(energy: FeatureEnergy, parameters: GameParameters) -> GameParameters:
    """The parameters that the kernel reads."""
    return GameParameters(
        own_weights={name: parameters.own_weights[name] for name in energy.own},
        pair_weights={name: parameters.pair_weights[name] for name in energy.pair},
        initial_controls=parameters.initial_controls,
        reference=parameters.reference if "reference" in energy.needs else None,
        margins={name: parameters.margins[name] for name in energy.decoded_margins},
        **{name: getattr(parameters, name) for name in energy.targets},
    )


class _Transfer:
    """The way of a game to the host and of its solution back, on which autograd can follow."""

    def __init__(self, parameters: GameParameters) -> None:
        copies = copies_of(parameters.initial_controls.device)
        assert copies is not None, "see `obstacle`"
        self._copies = copies

    def to_host(self, *things: Any) -> tuple[Any, ...]:
        """Tensors and batches of tensors, by one copy to the host."""
        return self._moved(things, True)

    def to_device(self, *things: Any) -> tuple[Any, ...]:
        """Tensors and batches of tensors, by one copy to the device."""
        return self._moved(things, False)

    def _moved(self, things: Sequence[Any], to_host: bool) -> tuple[Any, ...]:
        tensors = [
            tensor for thing in things for tensor in ((thing,) if isinstance(thing, Tensor) else thing.tensors())
        ]
        moved = iter(_Move.apply(self._copies, to_host, *tensors))
        return tuple(next(moved) if isinstance(thing, Tensor) else thing.map(lambda _: next(moved)) for thing in things)


class _Move(torch.autograd.Function):
    """Autograd function that moves tensors in one copy, and the gradients of those that require them in another one."""

    @staticmethod
    def forward(ctx: Any, copies: Copies, to_host: bool, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.copies, ctx.to_host = copies, to_host
        ctx.set_materialize_grads(False)
        moved = _move(copies, tensors, to_host)
        constant = [m for m, needed in zip(moved, ctx.needs_input_grad[2:], strict=True) if not needed]
        ctx.mark_non_differentiable(*constant)
        return moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        given = [gradient for gradient in gradients if gradient is not None]
        moved = iter(_move(ctx.copies, given, not ctx.to_host) if given else ())
        return None, None, *(None if gradient is None else next(moved) for gradient in gradients)


def _move(copies: Copies, tensors: Sequence[Tensor], to_host: bool) -> tuple[Tensor, ...]:
    """The tensors on the other side, contiguous, after one copy."""
    buffer = copies.to_host(torch.cat(_parts(tensors))) if to_host else copies.to_device(tensors)
    found: list[Tensor] = [buffer] * len(tensors)
    start = 0
    for index in _order(tensors):
        tensor = tensors[index]
        end = start + tensor.numel() * tensor.element_size()
        found[index] = buffer[start:end].view(tensor.dtype).view(tensor.shape)
        start = end
    return tuple(found)


def _order(tensors: Sequence[Tensor]) -> list[int]:
    """Indices of the tensors with the widest numbers first, so that in a packed buffer all numbers are aligned."""
    return sorted(range(len(tensors)), key=lambda index: -tensors[index].element_size())


def _parts(tensors: Sequence[Tensor]) -> list[Tensor]:
    """The bytes of the tensors in the order of a packed buffer."""
    return [tensors[index].detach().contiguous().view(-1).view(torch.uint8) for index in _order(tensors)]
