"""Who is measured: functions from the parameters of a game to its controls, and what is asked of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks import peer, reference
from benchmarks.games import Game
from benchmarks.measure import interleaved
from epo_lightning.scene import GameParameters
from epo_lightning.solvers import compiled
from epo_lightning.solvers.levenberg_marquardt import LevenbergMarquardt

NAMES = ("peer", "reference", "pytorch", "compiled", "cuda")
"""Theseus; plain autograd; this project's layer in plain PyTorch, as compiled code, and in PyTorch on a GPU."""


class Missing(Exception):
    """An implementation that cannot run here; the message says why."""


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
        """The controls, without a graph."""
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

    @property
    def cotangent(self) -> Tensor:
        """What gradients are contracted with."""
        like = self.game.parameters.initial_controls
        return torch.randn(like.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(like)

    def _wait(self) -> None:
        if self.game.parameters.initial_controls.is_cuda:
            torch.cuda.synchronize()


def prepare(name: str, game: Game, linear_solver: str = "LUDenseSolver") -> Implementation:
    """The implementation called ``name`` for a game.

    Args:
        linear_solver: the peer's, see :func:`faster_linear_solver`.

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
        case "compiled":
            reason = compiled.obstacle(game.energy, game.scene, game.parameters)
            if reason or not compiled.available():
                raise Missing(reason or "the kernel was not built: no C++ compiler was found at installation")
    if "backend" not in LevenbergMarquardt.__dataclass_fields__ and name == "compiled":
        raise Missing("the solver has no such backend yet")
    backend = {"backend": "compiled" if name == "compiled" else "pytorch"}
    if "backend" not in LevenbergMarquardt.__dataclass_fields__:
        backend = {}
    layer = LevenbergMarquardt(game.steps, game.step_size, game.damping, **backend)  # type: ignore[arg-type]
    return Implementation(name, game, lambda parameters: layer(game.energy, game.scene, parameters).controls)


def faster_linear_solver(game: Game) -> str:
    """Which of the peer's dense linear solvers takes less time for this game, forward and backward.

    Raises:
        Missing: the peer is not installed.
    """
    candidates = {name: prepare("peer", game, name).forward_backward for name in peer.LINEAR_SOLVERS}
    times = interleaved(candidates, 3)
    return min(times, key=lambda linear_solver: times[linear_solver].cpu)


def disagreement(implementation: Implementation, tolerance: float = 1e-5) -> str | None:
    """How far controls and gradients are from those of the plain reference, if too far; solved in float64.

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
