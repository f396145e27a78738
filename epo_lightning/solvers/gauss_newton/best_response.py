"""Decentralised solution of a game: every agent improves its own strategy and tells the others its plan.

No agent has to solve the whole game. In a round, each takes damped Gauss-Newton steps of its own strategy while the others
keep their last plans. E is a potential of the game: what such a step takes from the agent's objective

    J_i = E_i + sum_j E_ij,

it takes from E (Theorem 1), and where no agent can improve, the strategies are an open-loop Nash equilibrium. In turn
(Gauss-Seidel), E falls with every step. All at once (Jacobi), a round is one exchange of plans, but agents that answer the
same old plans may both give way: together they go the largest share 1, 1/2, 1/4, .. of their steps with which E falls, for
which they add up their parts of E.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.checks import check_choice, check_number, check_whole
from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import FEATURES, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general import descent

ORDERS = ("in_turn", "at_once")
_HALVINGS = 8
"""Largest number of times that a joint step is halved."""
_QUIET = 2
"""Number of rounds in a row without a fall of the energy after which a game counts as solved. The first may have had too
little damping, which rises before the second."""


@register("solver", "best_response")
@dataclass(frozen=True)
class BestResponse(Minimiser):
    """Rounds of best responses to the others' last plans; solutions are constants, so learn with ``backward=implicit``.

    A scene of N agents exchanges at most N plans per round, in either order.

    Attributes:
        rounds: largest number of rounds; a game ends earlier when its energy falls no more.
        order: ``in_turn`` or ``at_once``.
        steps: number of Gauss-Newton steps of an agent in a round. A step that does not lower the energy is rejected.
        damping: lambda of an agent's first step. It is divided by 10 after an accepted step, and multiplied by 10 after a
            rejected one.
        tolerance: relative fall of the energy in a round that counts as none.
        backend: that of :class:`~.levenberg_marquardt.LevenbergMarquardt`.
    """

    needs_from_energy = frozenset({FEATURES})
    provides = frozenset({STATIONARY})

    rounds: int = 50
    order: str = "in_turn"
    steps: int = 2
    damping: float = 1.0
    tolerance: float = 1e-7
    backend: str = "auto"

    def __post_init__(self) -> None:
        check_whole("solver.rounds", self.rounds, least=0)
        check_whole("solver.steps", self.steps, least=1)
        check_number("solver.tolerance", self.tolerance, zero=True)
        self.inner()  # checks its settings
        check_choice("solver.order", self.order, ORDERS)

    @property
    def on_host(self) -> bool:
        """Whether the steps of games on a GPU are taken on the host."""
        return self.inner().on_host

    def inner(self) -> LevenbergMarquardt:
        """The steps of an agent."""
        return LevenbergMarquardt(step_size=1.0, damping=self.damping, adaptive=True, backend=self.backend)

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Rounds until no game's energy falls any more.

        Raises:
            ValueError: as :meth:`~.levenberg_marquardt.LevenbergMarquardt.run`.
        """
        if not isinstance(energy, FeatureEnergy):
            raise ValueError(f"solver=best_response takes energy=features, not {type(energy).__name__}")
        scene, start = descent.begin(energy, scene, parameters)
        if start.numel() == 0:
            return descent.nothing(start)
        game = _Game(energy, scene, parameters.for_every_mode(start.shape[1]), self.inner())
        begun = game.at(start)
        value, usable = begun.energy, (begun.status != Status.STOPPED) & begun.energy.isfinite()
        damping = start.new_full(start.shape[:3], self.damping)
        now = _Plans(start, value, damping)
        quiet = torch.where(usable, 0, _QUIET)
        for _ in range(self.rounds):
            going = quiet < _QUIET
            if descent.ended(~going):
                break
            then = (_in_turn if self.order == "in_turn" else _at_once)(game, now, self.steps)
            fell = now.value - then.value > self.tolerance * now.value
            now = then.where(going, now)
            quiet = torch.where(going, torch.where(fell, 0, quiet + 1), quiet)
        last = game.at(now.controls)
        return dataclasses.replace(
            last,
            initial_energy=value,
            status=torch.where(usable, int(Status.COMPLETED), int(Status.STOPPED)),
        )


@dataclass(frozen=True)
class _Plans:
    """The plans of all agents [B, M, N, K, 2], their energy [B, M], and the damping of every agent [B, M, N]."""

    controls: Tensor
    value: Tensor
    damping: Tensor

    def where(self, which: Tensor, other: _Plans) -> _Plans:
        """These plans for some games [B, M], the other ones elsewhere."""
        return _Plans(
            torch.where(descent.wide(which), self.controls, other.controls),
            torch.where(which, self.value, other.value),
            torch.where(which[..., None], self.damping, other.damping),
        )


@dataclass(frozen=True)
class _Game:
    """The games of a batch, and the solver that takes steps in them."""

    energy: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    solver: LevenbergMarquardt

    def descend(self, controls: Tensor, steps: int, damping: Tensor) -> tuple[Solution, Tensor]:
        """Adaptive steps from given controls, and the damping afterwards; agents with infinite damping are held."""
        parameters = dataclasses.replace(self.parameters, initial_controls=controls)
        return self.solver.run(self.energy, self.scene, parameters, steps, damping)

    def at(self, controls: Tensor) -> Solution:
        """The energy at given controls."""
        return self.descend(controls, 0, torch.ones_like(controls[:, :, 0, 0, 0]))[0]

    def copies_per_agent(self, agents: int) -> _Game:
        """A copy of every scene for each of its agents [B * N]."""

        def repeated(tensor: Tensor) -> Tensor:
            return tensor.repeat_interleave(agents, 0)

        return dataclasses.replace(self, scene=self.scene.map(repeated), parameters=self.parameters.map(repeated))


def _response(game: _Game, now: _Plans, mine: Tensor, steps: int) -> _Plans:
    """The plans after steps of one agent of each scene, ``mine`` [B, 1, N], with the others held."""
    found, damping = game.descend(now.controls, steps, torch.where(mine, now.damping, torch.inf))
    return _Plans(found.controls, found.energy, torch.where(mine, damping, now.damping))


def _in_turn(game: _Game, now: _Plans, steps: int) -> _Plans:
    """A round in which each agent knows the new plans of those before it."""
    agents = now.controls.shape[2]
    for mine in torch.eye(agents, dtype=torch.bool, device=now.controls.device):
        now = _response(game, now, mine, steps)
    return now


def _at_once(game: _Game, now: _Plans, steps: int) -> _Plans:
    """A round in which all agents know the plans of the round before."""
    batch, modes, agents = now.damping.shape
    mine = torch.eye(agents, dtype=torch.bool, device=now.controls.device).repeat(batch, 1)[:, None]
    before = _Plans(*(tensor.repeat_interleave(agents, 0) for tensor in vars(now).values()))
    answers = _response(game.copies_per_agent(agents), before, mine, steps)
    own = torch.arange(agents, device=now.controls.device)
    plans = answers.controls.view(batch, agents, *now.controls.shape[1:])[:, own, :, own].permute(1, 2, 0, 3, 4)
    damping = answers.damping.view(batch, agents, modes, agents)[:, own, :, own].permute(1, 2, 0)
    now, open_ = dataclasses.replace(now, damping=damping), torch.ones_like(now.value, dtype=torch.bool)
    start, move, share = now.controls, plans - now.controls, 1.0
    for _ in range(_HALVINGS):
        trial = game.at(start + share * move)
        better = open_ & (trial.energy < now.value)
        now = _Plans(trial.controls, trial.energy, damping).where(better, now)
        open_, share = open_ & ~better, share / 2.0
        if descent.ended(~open_):
            break
    return now
