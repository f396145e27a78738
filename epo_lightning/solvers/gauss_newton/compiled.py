"""The compiled backend for CPUs: one call of the kernel takes all steps, another one computes their adjoint.

A *problem* is the game of one scene and mode. Problems are solved side by side, one in each entry (lane) of a vector
register.

Every step is a linear-quadratic problem, which one backward and one forward recursion over time solve in O(K N^3); see
`docs/solver.md` and `kernel/`. The library has a plain C interface: building it needs only a C++ compiler, and one build
works with every version of Python and PyTorch.

The library's threads end before a call returns, and Python handles signals only between calls. An interrupt therefore takes
effect when the call has ended, and no thread can write to memory that was released because of the interrupt.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.kernel.interface import (
    MOST_AGENTS,
    OWN,
    PAIR,
    SIGNALS,
    Address,
    EpoGame,
    EpoGradients,
    EpoRun,
)
from epo_lightning.solvers.general import descent


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot solve a game; None where it can."""
    device = parameters.initial_controls.device
    if device.type != "cpu":
        return f"the compiled layer runs on CPUs, and these tensors are on {device}"
    return unsupported(energy, scene, parameters)


def unsupported(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot solve a game whose tensors are on the CPU, or are copied there; None where it can."""
    controls = parameters.initial_controls
    if controls.dtype not in (torch.float32, torch.float64):
        return f"the compiled layer takes float32 and float64, not {controls.dtype}"
    if energy.dynamics.integrator != "euler":
        return f"the compiled layer integrates by euler, not {energy.dynamics.integrator}"
    for name in (*energy.own, *energy.pair):
        if name not in (*OWN, *PAIR):
            return f"the compiled layer does not know the feature {name!r}"
    if energy.bounded_by_kind:
        return f"the compiled layer takes bounds of all agents, not bounds of {energy.bounded_by_kind[0]!r} by kind"
    if scene.agent_mask.shape[1] > MOST_AGENTS:
        return f"the compiled layer takes up to {MOST_AGENTS} agents, not {scene.agent_mask.shape[1]}"
    library = interface.find()
    return f"the compiled layer is missing: {library}" if isinstance(library, str) else None


@functools.cache
def say_once(reason: str) -> None:
    """Warn once per reason that plain PyTorch replaces the kernel."""
    warnings.warn(
        f"{reason}. Plain PyTorch does the same, 20 to 60 times as slowly; `solver.backend=pytorch` (in Python "
        "`LevenbergMarquardt(backend='pytorch')`) says that this is intended.",
        stacklevel=2,
    )


def solve(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    keep_iterates: bool = False,
    exact: bool = False,
    threads: int | None = None,
) -> Solution:
    """S damped Gauss-Newton steps, as :func:`epo_lightning.solvers.gauss_newton.structured.solve` takes them.

    The solution is differentiable with respect to weights, margins, goals, their headings, reference controls
    and initial controls. Problems
    are shared out among ``threads`` threads, by default ``torch.get_num_threads()``; results do not depend on their number.
    """
    call = _Call(energy, scene, parameters, steps, step_size, damping, keep_iterates, exact=exact, threads=threads)
    return take_steps(call, parameters.initial_controls)


def take_steps(call: Any, initial_controls: Float[Tensor, "B M N K 2"]) -> Solution:
    """The solution of a call of this kernel or of the fused ones, with its derivative if that is wanted."""
    if call.record:
        controls, states, *iterates = _Steps.apply(call, initial_controls, *call.inputs)
    else:
        call.run()
        iterates = list(call.iterates.unbind(0))
        controls, states = iterates[-1], call.states
    return Solution(
        controls=controls,
        states=states,
        initial_energy=call.initial_energy,
        energy=call.energy,
        gradient_norm=call.gradient_norm,
        status=call.status,
        iterates=tuple(iterates) if call.keep_iterates else None,
    )


@torch.no_grad()
def descend(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    exact: bool = False,
    threads: int | None = None,
) -> tuple[Solution, Float[Tensor, "B M *agents"]]:
    """S adaptive steps in one call, without a derivative; see :class:`~.levenberg_marquardt.LevenbergMarquardt`.

    Agents with infinite damping keep their controls.

    Returns:
        the solution, and the damping to continue with.
    """
    call = _Call(
        energy, scene, parameters, steps, step_size, damping, False, exact=exact, adaptive=True, threads=threads
    )
    call.run()
    assert call.states is not None
    solution = Solution(
        controls=call.iterates[0],
        states=call.states,
        initial_energy=call.initial_energy,
        energy=call.energy,
        gradient_norm=call.gradient_norm,
        status=call.status,
    )
    return solution, call.damping


def attach(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    exact: bool,
    threads: int | None = None,
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """The controls of a solution with their implicit derivative, and a status; see :func:`.implicit.attach`.

    The factors are those of one undamped step from the solution, in float64. Its adjoint at a direction of zero is the
    implicit derivative.
    """
    game = dataclasses.replace(parameters, initial_controls=controls.double())
    none = game.initial_controls.new_zeros(controls.shape[:2])
    call = _Call(energy, scene, game, 1, 1.0, none, False, exact=exact, threads=threads)
    if not call.record:
        call.run()
        return controls, _definite(call)
    found, status = _Minimum.apply(call, game.initial_controls, *call.inputs)
    return found.to(controls.dtype), status


class _Tape:
    """Data of a call for its adjoint, in the library's memory, which is freed with this object."""

    def __init__(self) -> None:
        self.address = Address()
        self._release = interface.library().epo_release

    def __del__(self) -> None:
        if self.address:
            self._release(self.address)


class _Call:
    """One call of the kernel: its arguments as C structures, the arrays behind them, and its results."""

    def __init__(
        self,
        energy: FeatureEnergy,
        scene: Scene,
        parameters: GameParameters,
        steps: int,
        step_size: float,
        damping: Tensor,
        keep_iterates: bool,
        exact: bool = False,
        adaptive: bool = False,
        threads: int | None = None,
    ) -> None:
        controls = parameters.initial_controls
        self.threads = threads or torch.get_num_threads()
        self.controls, self.steps, self.keep_iterates = controls, steps, keep_iterates
        self.exact, self.adaptive = exact, adaptive
        self.doubles = controls.dtype == torch.float64
        weights = parameters.own_weights
        if _has_gaps(energy, scene):  # the weight of a line that does not exist is zero
            weights = {**weights, "lane": energy.own_weight(scene, parameters, "lane")}
        self.own = [_as(controls.dtype, weights[name]) for name in energy.own]
        self.pair = [_as(controls.dtype, parameters.pair_weights[name]) for name in energy.pair]
        self.margins = [_as(controls.dtype, parameters.margins[name]) for name in energy.decoded_margins]
        self.goals = [_as(controls.dtype, parameters.goals)] if energy.needs_goals else []  # type: ignore[arg-type]
        headed = energy.needs_goal_headings
        self.headings = [_as(controls.dtype, parameters.goal_headings)] if headed else []  # type: ignore[arg-type]
        referring = energy.needs_reference_controls
        self.references = [_as(controls.dtype, parameters.reference_controls)] if referring else []  # type: ignore[arg-type]
        self.inputs = (*self.own, *self.pair, *self.margins, *self.goals, *self.headings, *self.references)
        self.slots = [OWN.index(name) for name in energy.own]
        self.pair_slots = [PAIR.index(name) for name in energy.pair]
        self.margin_slots = [PAIR.index(name) for name in energy.decoded_margins]
        self.record = torch.is_grad_enabled() and any(x.requires_grad for x in (controls, *self.inputs))
        self.tape = _Tape()
        self._describe(energy, scene, parameters)
        self._reserve(step_size, damping)

    def _describe(self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> None:
        """Fill the kernel's description of the games: sizes, bounds, addresses and strides of its tensors."""
        batch, modes, agents, horizon, _ = self.controls.shape
        like = self.controls.dtype
        kept: list[Tensor] = []

        def hold(tensor: Tensor) -> Tensor:
            # The kernel gets the address alone: the tensor has to live as long as this call.
            kept.append(tensor)
            return tensor

        game = self.game = EpoGame(B=batch, M=modes, N=agents, K=horizon, dt=scene.dt, lane_slides=energy.lane_slides)
        game.pair_stride = min(energy.pair_stride, horizon + 1)
        for index, name in enumerate(SIGNALS):
            if not isinstance(bound := energy.bounds.get(name, {}), Mapping):
                game.bounds[index][:] = bound
        initial = _as(like, scene.current)
        initial = hold(initial if initial.stride(-1) == 1 else initial.contiguous())
        game.initial, (game.initial_b, game.initial_n) = initial.data_ptr(), initial.stride()[:2]
        game.present = hold(scene.agent_mask.contiguous()).data_ptr()
        if scene.size is not None:
            game.size = hold(_as(like, scene.size).contiguous()).data_ptr()
        for slot, weight in zip(self.slots, self.own, strict=True):
            game.own[slot], game.own_strides[slot][:] = weight.data_ptr(), weight.stride()
        if agents > 1:
            for slot, weight in zip(self.pair_slots, self.pair, strict=True):
                game.pair[slot], game.pair_strides[slot][:] = weight.data_ptr(), weight.stride()
            margins = dict(zip(self.margin_slots, self.margins, strict=True))
            for name in energy.margins.keys() & set(energy.pair):
                fixed = hold(self.controls.new_tensor(energy.margins[name]))
                margins[PAIR.index(name)] = fixed.expand(batch, modes, agents * (agents - 1) // 2)
            for slot, margin in margins.items():
                game.margins[slot], game.margin_strides[slot][:] = margin.data_ptr(), margin.stride()
        if self.goals:
            game.goals = self.goals[0].data_ptr()
            game.goals_b, game.goals_m, game.goals_n, game.goals_x = self.goals[0].stride()
        if self.headings:
            game.goal_headings, game.goal_heading_strides[:] = self.headings[0].data_ptr(), self.headings[0].stride()
        if self.references:
            game.reference_controls = hold(self.references[0].contiguous()).data_ptr()
        if scene.game_steps is not None:
            game.ends = hold(_as(torch.int64, scene.game_steps).contiguous()).data_ptr()
        if "lane" in energy.own:
            assert scene.references is not None
            assert parameters.reference is not None
            references = _as(like, scene.references)
            if _has_gaps(energy, scene):
                references = torch.where(scene.reference_mask[..., None, None], references, 0.0)  # type: ignore[index]
            game.references = hold(references.contiguous()).data_ptr()
            game.reference = hold(_as(torch.int64, parameters.reference).contiguous()).data_ptr()
            game.lines, game.points = scene.references.shape[2:4]
        if "velref" in energy.own:
            assert scene.reference_speed is not None
            game.reference_speed = hold(_as(like, scene.reference_speed).contiguous()).data_ptr()
        self.kept = kept

    def _reserve(self, step_size: float, damping: Tensor) -> None:
        """Allocate what the kernel writes: results, and iterates and directions of all steps if they are recorded."""
        controls, shape = self.controls, self.controls.shape
        stacked = self.record or self.keep_iterates
        slots = self.steps + 1 if stacked else 1 + self.adaptive  # adaptive: the best iterate and the trial
        self.iterates = controls.new_empty((slots, *shape))
        self.directions = controls.new_empty((max(self.steps, 1) if self.record else 1, *shape))
        self.states: Tensor | None = controls.new_empty((*shape[:-1], 4))
        self.initial_energy, self.energy, self.gradient_norm = controls.new_empty((3, *shape[:2])).unbind(0)
        self.status = torch.empty(shape[:2], dtype=torch.int64)
        self.damping = _as(controls.dtype, damping).clone(memory_format=torch.contiguous_format)
        by_agent = damping.dim() == 3
        self.start = controls.detach().contiguous()
        self.arguments = EpoRun(
            steps=self.steps,
            step_size=step_size,
            damping=self.damping.data_ptr(),
            damping_problem=shape[2] if by_agent else 1,
            damping_agent=int(by_agent),
            exact=self.exact,
            adaptive=self.adaptive,
            record=self.record,
            start=self.start.data_ptr(),
            iterates=self.iterates.data_ptr(),
            iterate_stride=controls.numel() if stacked or self.adaptive else 0,
            directions=self.directions.data_ptr(),
            states=self.states.data_ptr(),
            initial_energy=self.initial_energy.data_ptr(),
            energy=self.energy.data_ptr(),
            gradient_norm=self.gradient_norm.data_ptr(),
            status=self.status.data_ptr(),
        )

    def run(self) -> None:
        """Take all steps; fills the results.

        Raises:
            MemoryError: the library could not allocate its memory.
        """
        tape = self.tape.address
        interface.check(interface.library().epo_solve(self.doubles, self.game, self.arguments, self.threads, tape))

    def differentiate(self, controls: Tensor, iterates: Tensor | None, states: Tensor | None) -> list[Tensor | None]:
        """Gradients by ``inputs``, for cotangents of the final controls, of all iterates and of the states.

        ``controls`` is overwritten: on return it holds the gradient by the initial controls.
        """
        batch, modes, agents = self.controls.shape[:3]
        new = self.controls.new_zeros
        own = new((len(self.own), batch, modes, agents))
        shared = (batch, modes, agents * (agents - 1) // 2)
        pair, margins = new((len(self.pair), *shared)), new((len(self.margins), *shared))
        goals = [new((batch, modes, agents, 2)) for _ in self.goals]
        headings = [new((batch, modes, agents)) for _ in self.headings]
        references = [new(self.controls.shape) for _ in self.references]
        gradients = EpoGradients(controls=controls.data_ptr())
        if iterates is not None:
            gradients.iterates = iterates.data_ptr()
        if states is not None:
            gradients.states = states.data_ptr()
        for slot, gradient in zip(self.slots, own, strict=True):
            gradients.own[slot] = gradient.data_ptr()
        for slot, gradient in zip(self.pair_slots, pair, strict=True):
            gradients.pair[slot] = gradient.data_ptr()
        for slot, gradient in zip(self.margin_slots, margins, strict=True):
            gradients.margins[slot] = gradient.data_ptr()
        for gradient in goals:
            gradients.goals = gradient.data_ptr()
        for gradient in headings:
            gradients.goal_headings = gradient.data_ptr()
        for gradient in references:
            gradients.reference_controls = gradient.data_ptr()

        interface.check(interface.library().epo_differentiate(self.tape.address, self.game, self.arguments, gradients))
        return [*own.unbind(0), *pair.unbind(0), *margins.unbind(0), *goals, *headings, *references]


def _has_gaps(energy: FeatureEnergy, scene: Scene) -> bool:
    """Whether some reference lines are masked out."""
    return "lane" in energy.own and scene.reference_mask is not None and not scene.reference_mask.all()


class _Steps(torch.autograd.Function):
    """Autograd function of all steps of a call; returns controls, states and, with ``keep_iterates``, every iterate."""

    @staticmethod
    def forward(ctx: Any, call: Any, controls: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        call.run()
        ctx.call = call
        # The kernel reads these tensors again in the backward pass. Because they are saved, autograd raises an error if
        # one of them was changed in place.
        ctx.save_for_backward(*inputs, *call.kept)
        ctx.set_materialize_grads(False)
        iterates = [iterate.clone() for iterate in call.iterates] if call.keep_iterates else []
        # The autograd node would hold its own output, a reference cycle, which only the garbage collector could free.
        states, call.states = call.states, None
        return call.iterates[-1].clone(), states, *iterates

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, controls: Tensor | None, states: Tensor | None, *iterates: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        call = ctx.call
        _ = ctx.saved_tensors
        bar = (
            torch.zeros_like(call.start) if controls is None else controls.clone(memory_format=torch.contiguous_format)
        )
        along = None
        if any(iterate is not None for iterate in iterates):
            along = torch.stack([torch.zeros_like(bar) if iterate is None else iterate for iterate in iterates])
        if states is not None:
            states = states.contiguous()
        gradients = call.differentiate(bar, along, states)
        return None, bar, *gradients


class _Minimum(torch.autograd.Function):
    """Autograd function of the implicit derivative; returns the given controls and a status."""

    @staticmethod
    def forward(ctx: Any, call: _Call, controls: Tensor, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        call.run()
        status = _definite(call)
        descent.warn_if_far(call.initial_energy, (call.initial_energy - call.energy).abs(), status != Status.STOPPED)
        call.directions.zero_()
        call.states = None
        ctx.call, ctx.definite = call, status != Status.STOPPED
        ctx.save_for_backward(*inputs, *call.kept)
        ctx.mark_non_differentiable(status)
        return controls.view_as(controls), status

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        bar = torch.where(ctx.definite[..., None, None, None], cotangent, 0.0).contiguous()
        return None, None, *ctx.call.differentiate(bar, None, None)


def _definite(call: _Call) -> Tensor:
    """STOPPED for problems whose matrix was not positive definite without damping."""
    return torch.where(call.status == Status.SOLVED, Status.SOLVED, Status.STOPPED)


def _as(dtype: torch.dtype, tensor: Tensor) -> Tensor:
    # `to` takes a microsecond even if the type is right already, and there are twenty tensors.
    return tensor if tensor.dtype == dtype else tensor.to(dtype)
