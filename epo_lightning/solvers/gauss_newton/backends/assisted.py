"""The compiled backend for energies with features of the user: PyTorch evaluates these, and the kernel takes the steps.

In a Gauss-Newton step, a residual counts by its value and its derivatives at the present iterate alone. For features of
single time steps (:attr:`~epo_lightning.game.features.Source.STEP`, or a declared control, speed or distance) these are
seven numbers per agent and time step, and nine per pair. The kernel takes them as they are (``given`` and ``given_pairs`` in
`kernel/game.hpp`), beside its own features. It is called once per step, because they change with the iterate. Newton steps
also take the second derivatives by the same numbers.

The derivative of a step is that of :mod:`.pytorch`: with mu, the adjoint of the step, which the kernel returns,
phi = -<J mu, r + J d> has a part of the kernel's features and one of the user's. PyTorch differentiates the latter. The
derivative of a minimum (:mod:`.implicit`) is the same with the Hessian and d = 0.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_derivatives import unit_directions
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import Source
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton import adaptive
from epo_lightning.solvers.gauss_newton.backends import compiled
from epo_lightning.solvers.gauss_newton.backends.pytorch import pullback_undeclared

_SOURCES = (Source.CONTROL, Source.SPEED, Source.STEP, Source.DISTANCE)
"""Sources of features with one residual per step, which depends on this step alone."""


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot solve a game with the help of PyTorch; None where it can."""
    return compiled.elsewhere(parameters) or unsupported(energy, scene, parameters)


def unsupported(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason as of :func:`obstacle` for a game whose tensors are on the CPU, or are copied there."""
    custom, known = energy.custom, energy.built_in
    if custom is None or known is None:
        return "the compiled layer needs a built-in feature beside those of the user, such as acc with a small weight"
    for name, source in custom.sources:
        if source not in _SOURCES:
            return (
                f"the compiled layer does not know the feature {name!r}; it takes functions of single steps that are "
                "declared as such (Source.STEP, docs/extend.md)"
            )
    return compiled.unsupported(known, scene, parameters)


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
    """S damped steps; arguments and solution are those of :func:`.compiled.solve`.

    Raises:
        ValueError: weights that are not those of B scenes and M modes.
    """
    game = _Game.of(energy, scene, parameters, step_size, damping, exact, threads)
    controls = torch.where(scene.agent_mask[:, None, :, None, None], parameters.initial_controls, 0.0)
    status = torch.where(game.finite_inputs, Status.COMPLETED, Status.STOPPED)
    iterates, initial_energy = [controls], None
    for _ in range(steps):
        call = game.call(controls, 1)
        controls = _Step.apply(game, call, controls, *game.weights, *call.inputs)
        initial_energy = call.initial_energy if initial_energy is None else initial_energy
        status = torch.maximum(status, call.status)
        iterates.append(controls)
    with torch.no_grad():
        last = game.call(controls, 0)
        last.run()
    states = last.states
    if controls.requires_grad:
        states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
    assert states is not None
    return Solution(
        controls=controls,
        states=states,
        initial_energy=last.energy if initial_energy is None else initial_energy,
        energy=last.energy,
        gradient_norm=last.gradient_norm,
        status=torch.maximum(status, last.status),
        iterates=tuple(iterates) if keep_iterates else None,
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
    """S adaptive steps without a derivative, as :func:`.compiled.descend` takes them, by a call of the kernel for each."""
    calls = functools.partial(solve, threads=threads)
    return adaptive.descend_by_calls(calls, energy, scene, parameters, steps, step_size, damping, exact)


def attach(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    exact: bool,
    threads: int | None = None,
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """The controls of a solution with their implicit derivative, and a status; see :func:`.implicit.attach`.

    As in :func:`.compiled.attach`, the factors are those of one undamped step from the solution, in float64.
    """
    start, none = controls.double(), controls.new_zeros(controls.shape[:2], dtype=torch.float64)
    parameters = dataclasses.replace(parameters.to(torch.float64), initial_controls=start)
    game = _Game.of(energy, scene.to(torch.float64), parameters, 1.0, none, exact, threads)
    call = game.call(start, 1)
    found, status = _Minimum.apply(game, call, start, *game.weights, *call.inputs)
    return found.to(controls.dtype), status


@dataclasses.dataclass(frozen=True)
class _Game:
    """A game in two parts, the user's features and the kernel's, with the step size, damping and kind of its steps."""

    custom: FeatureEnergy
    built_in: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    step_size: float
    damping: Tensor
    exact: bool
    threads: int | None

    @classmethod
    def of(
        cls,
        energy: FeatureEnergy,
        scene: Scene,
        parameters: GameParameters,
        step_size: float,
        damping: Tensor,
        exact: bool,
        threads: int | None,
    ) -> _Game:
        """The parts of a game.

        Raises:
            ValueError: weights that are not those of B scenes and M modes.
        """
        assert energy.custom is not None
        assert energy.built_in is not None
        game = cls(energy.custom, energy.built_in, scene, parameters, step_size, damping, exact, threads)
        shape = parameters.initial_controls.shape
        wrong = [list(weight.shape) for weight in game.weights if weight.shape[:2] != shape[:2]]
        if wrong:
            raise ValueError(f"weights of the shape {wrong[0]} for controls of {list(shape)}")
        return game

    @property
    def weights(self) -> list[Tensor]:
        """The weights of the user's features, and the margins of pairs."""
        own, pair, margins = self.parameters.own_weights, self.parameters.pair_weights, self.parameters.margins
        names = self.custom.own, self.custom.pair, self.custom.decoded_margins
        return [of[name] for of, some in zip((own, pair, margins), names, strict=True) for name in some]

    @cached_property
    def finite_inputs(self) -> Bool[Tensor, "B M"]:
        """Mask of the games whose inputs are finite."""
        return self.custom.finite_inputs(self.scene, self.parameters)

    @cached_property
    def _stopping(self) -> Float[Tensor, "B M *agents"]:
        """The damping, with NaN where inputs are not finite: it stops a game, of whose inputs the kernel knows only the
        residuals."""
        return torch.where(
            self.finite_inputs if self.damping.dim() == 2 else self.finite_inputs[..., None], self.damping, torch.nan
        )

    def call(self, controls: Float[Tensor, "B M N K 2"], steps: int) -> compiled.Call:
        """A call of the kernel that takes one step from ``controls``, or none, which evaluates them."""
        game = dataclasses.replace(self.parameters, initial_controls=controls)
        return compiled.Call(
            self.built_in,
            self.scene,
            game,
            steps,
            self.step_size,
            self._stopping,
            keep_iterates=False,
            exact=self.exact,
            threads=self.threads,
            given=self._given(controls, curved=self.exact and steps > 0),
            beside=self.weights,
        )

    @torch.no_grad()
    def _given(self, controls: Float[Tensor, "B M N K 2"], curved: bool) -> compiled.Given:
        """Weighted residuals of the user's features with their derivatives, of second order as well if ``curved``."""
        states = self.custom.dynamics.rollout(self.custom.current_states(self.scene), controls, self.scene.dt)
        first, second = pairs(states.shape[2], states.device)
        at, both = (states, controls), (states[:, :, first], states[:, :, second])
        own = _rows(self._own(at, unit_directions(at)))
        pair = _rows(self._pair(both, unit_directions(both)))
        if not curved:
            return compiled.Given(own, pair)
        by_both = None if pair is None else _curvature(self._pair, both)
        return compiled.Given(
            own,
            pair,
            None if own is None else _curvature(self._own, at),
            None if by_both is None else self.custom.at_pair_steps(by_both),
        )

    def _own(self, at: tuple[Tensor, Tensor], moved: tuple[Tensor, Tensor]) -> list[tuple[Tensor, Tensor]]:
        """Residuals of the user's own features, with their changes along directions."""
        custom, scene, game = self.custom, self.scene, self.parameters
        around = custom.surroundings(scene, game)
        return [custom.own_residual(name, scene, game, around, at, moved) for name in custom.own]

    def _pair(self, both: tuple[Tensor, Tensor], moved: tuple[Tensor, Tensor]) -> list[tuple[Tensor, Tensor]]:
        """The same for the user's pair features."""
        found = self.custom.pair_residuals(self.scene, self.parameters, both, moved)
        return [(residual, change) for _, residual, change in found]

    def with_weights(self, weights: Sequence[Tensor]) -> GameParameters:
        """The game's parameters with other weights and margins of the user's features."""
        names, values = (self.custom.own, self.custom.pair, self.custom.decoded_margins), iter(weights)
        own, pair, margins = ({name: next(values) for name in some} for some in names)
        return dataclasses.replace(self.parameters, own_weights=own, pair_weights=pair, margins=margins)

    def gradient_of_phi(
        self, controls: Tensor, tensors: Sequence[Tensor], adjoint: Tensor, step: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """The part of the user's features in the gradient of phi, by the controls and by the first tensors, the weights."""
        weights, directions = tensors[: len(self.weights)], torch.stack((adjoint, step))
        return pullback_undeclared(self.custom, self.scene, self.with_weights, controls, weights, directions)


def _rows(found: Sequence[tuple[Tensor, Tensor]]) -> Float[Tensor, "*batch R D"] | None:
    """Residuals [.., K] of R features with their derivatives [D - 1, .., K] in the kernel's order; None for no features."""
    if not found:
        return None
    return torch.stack([torch.cat((value[None], by)).movedim(0, -1) for value, by in found], -2)


def _curvature(
    residuals: Callable[[tuple[Tensor, Tensor], tuple[Tensor, Tensor]], list[tuple[Tensor, Tensor]]],
    at: tuple[Tensor, Tensor],
) -> Float[Tensor, "*batch K E"]:
    """The sums of r d2r over residuals of single steps, by the numbers of each step in two tensors: lower triangles."""
    with torch.enable_grad():
        at = (at[0].detach().requires_grad_(), at[1].detach().requires_grad_())
        still = at[0].new_zeros(0, *at[0].shape), at[1].new_zeros(0, *at[1].shape)
        half = torch.stack([(value.detach() * value).sum() for value, _ in residuals(at, still)]).sum()
        slope = _gradients(half, at)
        rows = [_gradients(by.sum(), at) for by in slope.unbind(-1)]
    below = torch.tril_indices(len(rows), len(rows))
    return torch.stack(rows, -2)[..., below[0], below[1]]


def _gradients(value: Tensor, by: tuple[Tensor, Tensor]) -> Float[Tensor, "*batch K D"]:
    """Gradients of a scalar by two tensors, side by side; zero where it depends on neither."""
    if not value.requires_grad:
        return torch.cat([torch.zeros_like(one) for one in by], -1)
    return torch.cat(torch.autograd.grad(value, by, create_graph=True, materialize_grads=True), -1)


class _Step(torch.autograd.Function):
    """Autograd function of one step: of the controls, the weights of the user's features and the inputs of the kernel."""

    @staticmethod
    def forward(ctx: Any, game: _Game, call: compiled.Call, controls: Tensor, *tensors: Tensor) -> Tensor:
        call.run()
        ctx.game, ctx.call = game, call
        # Autograd raises an error if one of the tensors that the backward pass reads was changed in place.
        ctx.save_for_backward(controls, *tensors, *call.kept, *game.scene.tensors())
        return call.iterates[-1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        game, call = ctx.game, ctx.call
        controls, *tensors = ctx.saved_tensors
        bar, adjoint = cotangent.clone(memory_format=torch.contiguous_format), torch.zeros_like(call.start)
        gradients = call.differentiate(bar, None, None, adjoint)
        taken = call.status != Status.STOPPED
        step = torch.where(taken[..., None, None, None], call.directions[0], 0.0)
        by_controls, by = game.gradient_of_phi(controls, tensors, adjoint, step)
        bar = bar + torch.where(taken[..., None, None, None], by_controls, 0.0)
        return None, None, bar, *(torch.where(taken[..., None], one, 0.0) for one in by), *gradients


class _Minimum(torch.autograd.Function):
    """Autograd function of the implicit derivative; returns the given controls and a status."""

    @staticmethod
    def forward(
        ctx: Any, game: _Game, call: compiled.Call, controls: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        call.run()
        after = game.call(call.iterates[-1], 0)
        after.run()
        status = compiled.prepare_minimum(call, after.energy)
        ctx.game, ctx.call, ctx.definite = game, call, status != Status.STOPPED
        ctx.save_for_backward(controls, *tensors, *call.kept, *game.scene.tensors())
        ctx.mark_non_differentiable(status)
        return controls.view_as(controls), status

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        controls, *tensors = ctx.saved_tensors
        bar = torch.where(ctx.definite[..., None, None, None], cotangent, 0.0).contiguous()
        adjoint, still = torch.zeros_like(bar), torch.zeros_like(bar)
        gradients = ctx.call.differentiate(bar, None, None, adjoint)
        _, by = ctx.game.gradient_of_phi(controls, tensors, adjoint, still)
        return None, None, None, *(torch.where(ctx.definite[..., None], one, 0.0) for one in by), *gradients
