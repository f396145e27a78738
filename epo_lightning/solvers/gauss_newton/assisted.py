"""The compiled backend for energies with features of the user: PyTorch evaluates these, and the kernel takes the steps.

In a Gauss-Newton step, a residual counts by its value and its derivatives at the present iterate alone. For features of
single time steps (:attr:`~epo_lightning.game.features.Source.STEP`, or a declared control or speed) these are seven numbers
per agent and time step. The kernel takes them as they are (``given`` in `kernel/game.hpp`), beside its own features. It is
called once per Gauss-Newton step, because they change with the iterate.

The derivative of a step is that of :mod:`.structured`: with mu, the adjoint of the step, which the kernel returns,
phi = -<J mu, r + J d> has a part of the kernel's features and one of the user's. PyTorch differentiates the latter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import Source
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton import compiled
from epo_lightning.solvers.gauss_newton.kernel.interface import GIVEN
from epo_lightning.solvers.gauss_newton.structured import pullback_undeclared

_SOURCES = (Source.CONTROL, Source.SPEED, Source.STEP)
"""Sources of features with one residual per step, which depends on this step alone."""


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the kernel cannot solve a game with the help of PyTorch; None where it can."""
    custom, known = energy.custom, energy.built_in
    if custom is None or known is None:
        return "the compiled layer needs a built-in feature beside those of the user, such as acc with a small weight"
    if custom.pair:
        return f"the compiled layer does not know the pair feature {custom.pair[0]!r}"
    for name, feature in custom.own_features.items():
        if feature.source not in _SOURCES:
            return (
                f"the compiled layer does not know the feature {name!r}; it takes functions of single steps that are "
                "declared as such (Source.STEP, docs/extend.md)"
            )
    return compiled.obstacle(known, scene, parameters)


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
    """S damped Gauss-Newton steps; arguments and solution are those of :func:`.structured.solve`.

    Raises:
        ValueError: weights that are not those of B scenes and M modes; or steps with the Hessian, which the kernel does not
            get from PyTorch.
    """
    if exact:
        raise ValueError("steps with the Hessian need features that the kernel knows")
    assert energy.custom is not None
    assert energy.built_in is not None
    game = _Game(energy.custom, energy.built_in, scene, parameters, step_size, damping)
    wrong = [list(weight.shape) for weight in game.weights if weight.shape[:2] != parameters.initial_controls.shape[:2]]
    if wrong:
        raise ValueError(f"weights of the shape {wrong[0]} for controls of {list(parameters.initial_controls.shape)}")
    controls = torch.where(scene.agent_mask[:, None, :, None, None], parameters.initial_controls, 0.0)
    status = torch.full(controls.shape[:2], Status.SOLVED)
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


@dataclasses.dataclass(frozen=True)
class _Game:
    """A game in two parts, the user's features and the kernel's, with the step size and the damping of its steps."""

    custom: FeatureEnergy
    built_in: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    step_size: float
    damping: Tensor

    @property
    def weights(self) -> list[Tensor]:
        """The weights of the user's features."""
        return [self.parameters.own_weights[name] for name in self.custom.own]

    def call(self, controls: Float[Tensor, "B M N K 2"], steps: int) -> compiled.Call:
        """A call of the kernel that takes one step from ``controls``, or none, which evaluates them."""
        game = dataclasses.replace(self.parameters, initial_controls=controls)
        return compiled.Call(
            self.built_in,
            self.scene,
            game,
            steps,
            self.step_size,
            self.damping,
            keep_iterates=False,
            given=self._given(controls),
            beside=self.weights,
        )

    @torch.no_grad()
    def _given(self, controls: Tensor) -> Float[Tensor, "B M N K R 7"]:
        """Weighted residuals of the user's features, with their derivatives by states and controls."""
        custom, scene = self.custom, self.scene
        around = custom.surroundings(scene, self.parameters)
        states = custom.dynamics.rollout(custom.current_states(scene), controls, scene.dt)
        unit = torch.eye(GIVEN - 1, dtype=controls.dtype)[:, None, None, None, None]
        moved = unit[..., :4].expand(-1, *states.shape), unit[..., 4:].expand(-1, *controls.shape)
        rows = []
        for name in custom.own:
            value, by = custom.own_residual(name, scene, self.parameters, around, (states, controls), moved)
            rows.append(torch.cat((value[None], by)).movedim(0, -1))
        return torch.stack(rows, -2)

    def with_weights(self, weights: Sequence[Tensor]) -> GameParameters:
        """The game's parameters with other weights of the user's features."""
        return dataclasses.replace(self.parameters, own_weights=dict(zip(self.custom.own, weights, strict=True)))


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
        weights, directions = tensors[: len(game.custom.own)], torch.stack((adjoint, step))
        by_controls, by = pullback_undeclared(game.custom, game.scene, game.with_weights, controls, weights, directions)
        bar = bar + torch.where(taken[..., None, None, None], by_controls, 0.0)
        return None, None, bar, *(torch.where(taken[..., None], one, 0.0) for one in by), *gradients
