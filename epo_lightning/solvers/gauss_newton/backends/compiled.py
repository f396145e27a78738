"""The compiled backend for CPUs: one call of the kernel takes all steps, another one computes their adjoint.

A *problem* is the game of one scene and mode. Problems are solved side by side, one in each entry (lane) of a vector
register.

Every step is a linear-quadratic problem, which one backward and one forward recursion over time solve in O(K N^3); see
`docs/layer.md` and `kernel/`. The library has a plain C interface: building it needs only a C++ compiler, and one build
works with every version of Python and PyTorch.

The library's threads end before a call returns, and Python handles signals only between calls. An interrupt therefore takes
effect when the call has ended, and no thread can write to memory that was released because of the interrupt.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.backends import kernel_games
from epo_lightning.solvers.gauss_newton.backends.game_arrays import GameArrays, as_type
from epo_lightning.solvers.gauss_newton.backends.recorded_steps import take_steps
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.kernel.interface import MOST_AGENTS, Address, EpoGame, EpoRun
from epo_lightning.solvers.general import descent


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot solve a game; None where it can."""
    return elsewhere(parameters) or unsupported(energy, scene, parameters)


def elsewhere(parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot read the tensors of a game; None where they are on the CPU."""
    device = parameters.initial_controls.device
    return None if device.type == "cpu" else f"the compiled layer runs on CPUs, and these tensors are on {device}"


def unsupported(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot solve a game whose tensors are on the CPU, or are copied there; None where it can."""
    reason = kernel_games.unknown(energy, scene, parameters, MOST_AGENTS, "the compiled layer")
    if reason is not None:
        return reason
    library = interface.find()
    return f"the compiled layer is missing: {library}" if isinstance(library, str) else None


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
    """S damped Gauss-Newton steps, as :func:`epo_lightning.solvers.gauss_newton.backends.pytorch.solve` takes them.

    The solution is differentiable with respect to weights, margins, targets and initial controls. Problems are shared out
    among ``threads`` threads, by default ``torch.get_num_threads()``; results do not depend on their number.
    """
    call = Call(energy, scene, parameters, steps, step_size, damping, keep_iterates, exact=exact, threads=threads)
    return take_steps(call, parameters.initial_controls)


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
    call = Call(
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
    call = Call(energy, scene, game, 1, 1.0, none, False, exact=exact, threads=threads)
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


class Given(NamedTuple):
    """Weighted residuals r of features that the kernel does not know.

    Attributes:
        own: residuals of single steps, each with its derivatives by x, y, heading and speed after the step and by the
            acceleration and the turn rate of the step.
        pair: residuals of pairs at the evaluated steps L, each with its derivatives by the states of both agents.
        own_curvature: the sums of r d2r over the own residuals of a step, entries below and on the diagonal; None for steps
            without the Hessian.
        pair_curvature: the same for pairs.
    """

    own: Float[Tensor, "B M N K _ 7"] | None
    pair: Float[Tensor, "B M P L _ 9"] | None
    own_curvature: Float[Tensor, "B M N K 21"] | None = None
    pair_curvature: Float[Tensor, "B M P L 36"] | None = None

    def of_type(self, dtype: torch.dtype) -> Given:
        """The same numbers as the kernel reads them: contiguous tensors of a type."""
        return Given(*(None if one is None else as_type(dtype, one).contiguous() for one in self))

    def describe(self, game: EpoGame) -> None:
        """Write the addresses of the tensors to the structure of a game."""
        game.given, game.given_pairs, game.given_curvature, game.given_pair_curvature = (
            None if one is None else one.data_ptr() for one in self
        )
        game.given_count = 0 if self.own is None else self.own.shape[-2]
        game.given_pair_count = 0 if self.pair is None else self.pair.shape[-2]


class Call:
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
        given: Given | None = None,
        beside: Sequence[Tensor] = (),
    ) -> None:
        """Collect the arguments.

        Args:
            energy, scene, parameters, steps, step_size, damping, keep_iterates, exact, threads: those of :func:`solve`.
            adaptive: whether the steps are adaptive (:func:`descend`).
            given: residuals that the kernel takes as they are. The energy of the last iterate is not computed then, because
                it has other residuals.
            beside: tensors besides ``inputs`` by which the caller differentiates the steps.
        """
        controls = parameters.initial_controls
        self.threads = threads or torch.get_num_threads()
        self.controls, self.steps, self.keep_iterates = controls, steps, keep_iterates
        self.exact, self.adaptive = exact, adaptive
        self.doubles = controls.dtype == torch.float64
        self.arrays = GameArrays(energy, scene, parameters, controls)
        self.game, self.inputs, self.kept = self.arrays.game, self.arrays.inputs, self.arrays.kept
        self.record = torch.is_grad_enabled() and any(x.requires_grad for x in (controls, *self.inputs, *beside))
        self.given = None if given is None else given.of_type(controls.dtype)
        if self.given is not None:
            self.given.describe(self.game)
        self.tape = _Tape()
        self._reserve(step_size, damping)

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
        self.damping = as_type(controls.dtype, damping).clone(memory_format=torch.contiguous_format)
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
            energy=self.energy.data_ptr() if self.given is None or not self.steps else None,
            gradient_norm=self.gradient_norm.data_ptr(),
            status=self.status.data_ptr(),
        )

    def run(self) -> None:
        """Take all steps; fills the results.

        Raises:
            MemoryError: the library could not allocate its memory.
        """
        arguments = (self.doubles, self.game, self.arguments, self.threads, self.tape.address)
        interface.check(interface.library().epo_solve(*arguments))
        if self.given is not None:  # the adjoint needs the factors alone
            Given(None, None).describe(self.game)
            self.given = None

    def differentiate(
        self, controls: Tensor, iterates: Tensor | None, states: Tensor | None, adjoint: Tensor | None = None
    ) -> list[Tensor]:
        """Gradients by ``inputs``, for cotangents of the final controls, of all iterates and of the states.

        ``controls`` is overwritten: on return it holds the gradient by the initial controls. ``adjoint``, zero on entry,
        becomes mu of a single step.
        """
        gradients, found = self.arrays.new_gradients()
        gradients.controls = controls.data_ptr()
        if iterates is not None:
            gradients.iterates = iterates.data_ptr()
        if states is not None:
            gradients.states = states.data_ptr()
        if adjoint is not None:
            gradients.adjoint = adjoint.data_ptr()
        arguments = (self.tape.address, self.game, self.arguments, gradients)
        interface.check(interface.library().epo_differentiate(*arguments))
        return found


class _Minimum(torch.autograd.Function):
    """Autograd function of the implicit derivative; returns the given controls and a status."""

    @staticmethod
    def forward(ctx: Any, call: Call, controls: Tensor, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        call.run()
        status = prepare_minimum(call, call.energy)
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


def _definite(call: Call) -> Tensor:
    """STOPPED for problems whose matrix was not positive definite without damping."""
    return torch.where(call.status == Status.COMPLETED, Status.COMPLETED, Status.STOPPED)


def prepare_minimum(call: Call, after: Float[Tensor, "B M"]) -> Int[Tensor, "B M"]:
    """The status of minima, after a call that took one undamped step from them; ``after`` is the energy after the step.

    The call then has the adjoint of a step of length zero. Warns of games that the step has moved far.
    """
    status = _definite(call)
    descent.warn_if_far(call.initial_energy, (call.initial_energy - after).abs(), status != Status.STOPPED)
    call.directions.zero_()
    return status
