"""The layer as compiled code for CPUs: all steps in one call, their adjoint in another, a problem per vector lane.

Every step is a linear-quadratic problem that one backward and one forward recursion over time solve in O(K N^3); see
`docs/solver.md` and `kernel/`. The library has a plain C interface, so that building it needs a C++ compiler and nothing
else, and one build serves every version of Python and PyTorch.
"""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import GameParameters, Scene, Solution
from epo_lightning.solvers.gauss_newton.kernel.build import load

OWN = (
    "goal",
    "lane",
    "velref",
    "vel",
    "acc",
    "turnr",
    "jerk",
    "turnacc",
    "steer",
    "velb",
    "accb",
    "turnrb",
    "jerkb",
    "turnaccb",
)
"""Own features in the kernel's order."""
SIGNALS = ("vel", "acc", "turnr", "jerk", "turnacc")
"""Signals with bounds in the kernel's order."""
MOST_AGENTS = 64
"""The kernel keeps who touches whom as bits of a word."""

_Address, _Integer, _Real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class _Game(ctypes.Structure):
    _fields_ = (
        *((name, _Integer) for name in ("B", "M", "N", "K", "lines", "points", "pair_stride")),
        ("dt", _Real),
        ("bounds", _Real * 2 * len(SIGNALS)),
        ("initial", _Address),
        ("initial_strides", _Integer * 2),
        ("present", _Address),
        ("size", _Address),
        ("own", _Address * len(OWN)),
        ("own_strides", _Integer * 3 * len(OWN)),
        ("pair", _Address),
        ("pair_strides", _Integer * 3),
        ("goals", _Address),
        ("goals_strides", _Integer * 4),
        ("references", _Address),
        ("reference", _Address),
        ("reference_speed", _Address),
    )


class _Run(ctypes.Structure):
    _fields_ = (
        ("steps", _Integer),
        ("step_size", _Real),
        ("damping", _Address),
        ("damping_strides", _Integer * 2),
        ("record", _Integer),
        ("start", _Address),
        ("iterates", _Address),
        ("iterate_stride", _Integer),
        *((name, _Address) for name in ("directions", "states", "initial_energy", "energy", "gradient_norm", "status")),
    )


class _Gradients(ctypes.Structure):
    _fields_ = (
        ("controls", _Address),
        ("iterates", _Address),
        ("states", _Address),
        ("own", _Address * len(OWN)),
        ("pair", _Address),
        ("goals", _Address),
    )


@functools.cache
def _find() -> ctypes.CDLL | str:
    """The library, or why there is none."""
    try:
        library = load()
    except OSError as error:
        return (
            f"{error}; with a C++ compiler on the path, "
            "`python -m epo_lightning.solvers.gauss_newton.kernel.build` builds it"
        )
    run = (ctypes.POINTER(_Game), ctypes.POINTER(_Run))
    library.epo_solve.argtypes = (_Integer, *run, _Integer, _Integer, ctypes.POINTER(_Address))
    library.epo_differentiate.argtypes = (_Address, *run, ctypes.POINTER(_Gradients))
    library.epo_release.argtypes, library.epo_release.restype = (_Address,), None
    for name in ("epo_solve", "epo_differentiate", "epo_lanes", "epo_levels"):
        getattr(library, name).restype = _Integer
    library.epo_choose.argtypes, library.epo_choose.restype = (_Integer,), None
    return library


def _library() -> ctypes.CDLL:
    library = _find()
    if isinstance(library, str):
        raise RuntimeError(f"the compiled layer is missing: {library}")
    return library


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Why the kernel cannot solve a game; None where it can."""
    controls = parameters.initial_controls
    if controls.device.type != "cpu":
        return f"the compiled layer runs on CPUs, and these tensors are on {controls.device}"
    if controls.dtype not in (torch.float32, torch.float64):
        return f"the compiled layer takes float32 and float64, not {controls.dtype}"
    if energy.dynamics.integrator != "euler":
        return f"the compiled layer integrates by euler, not {energy.dynamics.integrator}"
    for name in (*energy.own, *energy.pair):
        if name not in OWN and name != "proximity":
            return f"the compiled layer does not know the feature {name!r}"
    if scene.agent_mask.shape[1] > MOST_AGENTS:
        return f"the compiled layer takes up to {MOST_AGENTS} agents, not {scene.agent_mask.shape[1]}"
    library = _find()
    return f"the compiled layer is missing: {library}" if isinstance(library, str) else None


@functools.cache
def say_once(reason: str) -> None:
    """Make it visible that plain PyTorch takes the kernel's place."""
    warnings.warn(
        f"{reason}. Plain PyTorch does the same, at a tenth of the speed or less; solver.backend=pytorch asks for it.",
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
) -> Solution:
    """S damped Gauss-Newton steps, as :func:`epo_lightning.solvers.gauss_newton.structured.solve` takes them.

    Differentiable with respect to weights, goals and initial controls. Problems are shared out among
    ``torch.get_num_threads()`` threads; results do not depend on how many there are.
    """
    call = _Call(energy, scene, parameters, steps, step_size, damping, keep_iterates)
    if call.record:
        controls, states, *iterates = _Unrolled.apply(call, parameters.initial_controls, *call.inputs)
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
        iterates=tuple(iterates) if keep_iterates else None,
    )


@dataclass
class _Tape:
    """What a range of problems leaves for the adjoint; owned by the library until released."""

    address: int

    def __del__(self) -> None:
        _library().epo_release(self.address)


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
    ) -> None:
        controls = parameters.initial_controls
        self.controls, self.steps, self.keep_iterates = controls, steps, keep_iterates
        self.doubles = controls.dtype == torch.float64
        weights = parameters.own_weights
        if _has_gaps(energy, scene):  # a line that does not exist pulls nobody
            weights = {**weights, "lane": energy.own_weight(scene, parameters, "lane")}
        self.own = [_as(controls.dtype, weights[name]) for name in energy.own]
        self.pair = [_as(controls.dtype, parameters.pair_weights[name]) for name in energy.pair]
        self.goals = [_as(controls.dtype, parameters.goals)] if energy.needs_goals else []  # type: ignore[arg-type]
        self.inputs = (*self.own, *self.pair, *self.goals)
        self.slots = [OWN.index(name) for name in energy.own]
        self.record = torch.is_grad_enabled() and any(x.requires_grad for x in (controls, *self.inputs))
        self.tapes: list[_Tape] = []
        self._describe(energy, scene, parameters)
        self._reserve(step_size, damping)

    def _describe(self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> None:
        batch, modes, agents, horizon, _ = self.controls.shape
        like = self.controls.dtype
        kept: list[Tensor] = []

        def hold(tensor: Tensor) -> Tensor:
            # Only the address travels: the tensor has to live as long as this call.
            kept.append(tensor)
            return tensor

        game = self.game = _Game(B=batch, M=modes, N=agents, K=horizon, dt=scene.dt)
        game.pair_stride = min(energy.pair_stride, horizon + 1)
        for index, name in enumerate(SIGNALS):
            if name in energy.bounds:
                game.bounds[index][:] = energy.bounds[name]
        initial = _as(like, scene.current)
        initial = hold(initial if initial.stride(-1) == 1 else initial.contiguous())
        game.initial, game.initial_strides[:] = initial.data_ptr(), initial.stride()[:2]
        game.present = hold(scene.agent_mask.contiguous()).data_ptr()
        if scene.size is not None:
            game.size = hold(_as(like, scene.size).contiguous()).data_ptr()
        for slot, weight in zip(self.slots, self.own, strict=True):
            game.own[slot], game.own_strides[slot][:] = weight.data_ptr(), weight.stride()
        if self.pair and agents > 1:
            game.pair, game.pair_strides[:] = self.pair[0].data_ptr(), self.pair[0].stride()
        if self.goals:
            game.goals, game.goals_strides[:] = self.goals[0].data_ptr(), self.goals[0].stride()
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
        controls, shape = self.controls, self.controls.shape
        stacked = self.record or self.keep_iterates
        self.iterates = controls.new_empty((self.steps + 1 if stacked else 1, *shape))
        self.directions = controls.new_empty((max(self.steps, 1) if self.record else 1, *shape))
        self.states: Tensor | None = controls.new_empty((*shape[:-1], 4))
        self.initial_energy, self.energy, self.gradient_norm = controls.new_empty((3, *shape[:2])).unbind(0)
        self.status = torch.empty(shape[:2], dtype=torch.int64)
        self.damping = _as(controls.dtype, damping).contiguous()
        by_agent = damping.dim() == 3
        self.start = controls.detach().contiguous()
        self.arguments = _Run(
            steps=self.steps,
            step_size=step_size,
            damping=self.damping.data_ptr(),
            damping_strides=(shape[2], 1) if by_agent else (1, 0),
            record=self.record,
            start=self.start.data_ptr(),
            iterates=self.iterates.data_ptr(),
            iterate_stride=controls.numel() if stacked else 0,
            directions=self.directions.data_ptr(),
            states=self.states.data_ptr(),
            initial_energy=self.initial_energy.data_ptr(),
            energy=self.energy.data_ptr(),
            gradient_norm=self.gradient_norm.data_ptr(),
            status=self.status.data_ptr(),
        )

    def run(self) -> None:
        library = _library()
        problems = self.controls.shape[0] * self.controls.shape[1]

        def part(bounds: tuple[int, int]) -> None:
            tape = _Address()
            _check(library.epo_solve(self.doubles, self.game, self.arguments, *bounds, tape))
            if tape.value:
                self.tapes.append(_Tape(tape.value))

        _in_parallel(part, _parts(problems, library.epo_lanes()))

    def differentiate(self, controls: Tensor, iterates: Tensor | None, states: Tensor | None) -> list[Tensor | None]:
        library = _library()
        batch, modes, agents = self.controls.shape[:3]
        new = self.controls.new_zeros
        own = new((len(self.own), batch, modes, agents))
        pair = new((batch, modes, agents * (agents - 1) // 2)) if self.pair else None
        goals = new((batch, modes, agents, 2)) if self.goals else None
        gradients = _Gradients(controls=controls.data_ptr())
        if iterates is not None:
            gradients.iterates = iterates.data_ptr()
        if states is not None:
            gradients.states = states.data_ptr()
        for slot, gradient in zip(self.slots, own, strict=True):
            gradients.own[slot] = gradient.data_ptr()
        if pair is not None:
            gradients.pair = pair.data_ptr()
        if goals is not None:
            gradients.goals = goals.data_ptr()

        def part(tape: _Tape) -> None:
            _check(library.epo_differentiate(tape.address, self.game, self.arguments, gradients))

        _in_parallel(part, self.tapes)
        return [*own.unbind(0), *([pair] if pair is not None else []), *([goals] if goals is not None else [])]


def _has_gaps(energy: FeatureEnergy, scene: Scene) -> bool:
    """Whether there are reference lines that do not exist."""
    return "lane" in energy.own and scene.reference_mask is not None and not scene.reference_mask.all()


class _Unrolled(torch.autograd.Function):
    """All steps as one node of the graph: controls, states and, when asked for, every iterate."""

    @staticmethod
    def forward(ctx: Any, call: _Call, controls: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        call.run()
        ctx.call = call
        # The kernel holds addresses: saving the tensors makes sure that nobody changes them in between.
        ctx.save_for_backward(*inputs, *call.kept)
        ctx.set_materialize_grads(False)
        iterates = [iterate.clone() for iterate in call.iterates] if call.keep_iterates else []
        # An output that the node holds would be a cycle: its memory would wait for the garbage collector.
        states, call.states = call.states, None
        return call.iterates[-1].clone(), states, *iterates

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, controls: Tensor | None, states: Tensor | None, *iterates: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        call: _Call = ctx.call
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


def _as(dtype: torch.dtype, tensor: Tensor) -> Tensor:
    # `to` takes a microsecond even where it has nothing to do, and there are twenty tensors.
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


def _parts(problems: int, lanes: int) -> list[tuple[int, int]]:
    """Ranges of problems for the threads, in whole registers of lanes."""
    registers = -(-problems // lanes)
    threads = max(1, min(torch.get_num_threads(), registers))
    edges = [min(problems, lanes * (registers * t // threads)) for t in range(threads + 1)]
    return list(pairwise(edges))


def _check(outcome: int) -> None:
    if outcome:
        raise MemoryError("there is not enough memory for the compiled layer: solve fewer scenes or modes at a time")


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="epo")


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork, but their pool would, and wait for them for ever.
    os.register_at_fork(after_in_child=_threads.cache_clear)


def _in_parallel(body: Callable[[Any], None], parts: Sequence[Any]) -> None:
    # The library lets go of Python's lock while it works.
    rest: list[Future[None]] = []
    try:
        rest.extend(_threads().submit(body, part) for part in parts[1:])
        body(parts[0])
    finally:
        # Whatever happens here, the others write to memory that this call holds: it must not return before they do.
        wait(rest)
    for future in rest:
        future.result()
