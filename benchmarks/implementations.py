"""Implementations of the layer: functions from the parameters of a game to its controls, with forward and backward calls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from benchmarks import peer, reference
from benchmarks.games import Game
from epo_lightning.forecast import GameParameters
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

NAMES = ("peer", "reference", "pytorch", "compiled", "cuda")
"""Theseus; plain autograd; this project's layer in plain PyTorch, as compiled code, and in PyTorch on a GPU."""


class Missing(Exception):
    """An implementation cannot run here; the message says why."""


@dataclass(frozen=True)
class Implementation:
    """One way to solve one game.

    Attributes:
        name: one of :data:`NAMES`.
        game: the problems, on the device of the implementation.
        solve: from parameters to controls [B, M, N, K, 2].
    """

    name: str
    game: Game
    solve: Callable[[GameParameters], Tensor]

    def forward(self) -> Tensor:
        """The controls, computed without a graph."""
        with torch.no_grad():
            controls = self.solve(self.game.parameters)
        self._wait()
        return controls

    def forward_backward(self) -> tuple[Tensor, ...]:
        """Controls, and gradients by all weights, goals and initial controls, for a fixed random cotangent."""
        parameters = self.game.parameters.map(
            lambda tensor: tensor.detach().requires_grad_() if tensor.is_floating_point() else tensor
        )
        inputs = [*parameters.own_weights.values(), *parameters.pair_weights.values(), parameters.initial_controls]
        if parameters.goals is not None:
            inputs.append(parameters.goals)
        controls = self.solve(parameters)
        gradients = torch.autograd.grad(controls, inputs, self.cotangent)
        self._wait()
        return controls.detach(), *gradients

    @cached_property
    def cotangent(self) -> Tensor:
        """Fixed random cotangent of the controls."""
        like = self.game.parameters.initial_controls
        return torch.randn(like.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(like)

    def _wait(self) -> None:
        if self.game.parameters.initial_controls.is_cuda:
            torch.cuda.synchronize()


def prepare(name: str, game: Game, linear_solver: str = peer.LINEAR_SOLVERS[0]) -> Implementation:
    """The implementation called ``name`` for a game.

    Args:
        linear_solver: linear solver of the peer, one of :data:`benchmarks.peer.LINEAR_SOLVERS`.

    Raises:
        Missing: it cannot run here.
    """
    match name:
        case "peer":
            try:
                return Implementation(name, game, peer.prepare(game, linear_solver))
            except ImportError as error:
                raise Missing("Theseus is not installed: see docs/benchmarks.md") from error
        case "reference":
            return Implementation(name, game, reference.prepare(game))
        case "cuda":
            if not torch.cuda.is_available():
                raise Missing("no CUDA device")
            game = game.to("cuda")
    backend = "compiled" if name == "compiled" else "pytorch"
    layer = LevenbergMarquardt(game.steps, game.step_size, game.damping, backend=backend)
    try:
        layer(game.energy, game.scene[0], game.parameters[0])
    except ValueError as error:
        raise Missing(str(error)) from error
    return Implementation(name, game, lambda parameters: layer(game.energy, game.scene, parameters).controls)


def disagreement(implementation: Implementation, tolerance: float = 1e-5) -> str | None:
    """Difference of controls and gradients from the reference's in float64 as a message; None within the tolerance.

    Controls are compared by difference, gradients by difference relative to their largest entry.
    """
    few = min(4, implementation.game.sizes["B"])
    game = implementation.game
    game = dataclasses.replace(game, scene=game.scene[list(range(few))], parameters=game.parameters[list(range(few))])
    game = game.to("cpu").to(torch.float64)
    found = prepare(implementation.name, game).forward_backward()
    expected = Implementation("reference", game, reference.prepare(game)).forward_backward()
    worst = max(
        (a.cpu() - b).abs().max().item() / (1.0 if i == 0 else max(1e-3, b.abs().max().item()))
        for i, (a, b) in enumerate(zip(found, expected, strict=True))
    )
    if worst <= tolerance:  # false for NaN
        return None
    return f"{implementation.name} differs from the reference by {worst:.1e} in float64"
