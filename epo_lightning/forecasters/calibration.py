"""Calibration of an inferred game on the observed history: the pair weights under which the game explains what was seen.

The agents played the game before t0 as well. A game that is posed at the first observed state, with the inferred weights,
therefore has to lead through the observed history. How much it misses tells how far the pair weights are off. This is an
inverse game (Peters et al., "Inferring objectives in continuous dynamic games from noise-corrupted partial state
observations", RSS 2021) with one unknown per game: the logarithm s of a factor of all pair weights, which minimises

    |x(s) - observed|^2 / noise^2 + s^2 / spread^2

over the positions x of the history, so that weights without any effect on the history stay as the network decoded them.
A game may change its passing order or lose an equilibrium as s grows, and this cost jumps there. A descent from one start
may end on the wrong side of a jump; therefore several starts may be tried.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from epo_lightning.checks import check_number, check_whole, is_number
from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import controls_between
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, Scene, wrapped
from epo_lightning.solvers.base import Minimiser

_DIFFERENCE = 0.05
"""Change of s in the finite difference of the positions."""
_LARGEST_STEP = 1.0
"""Largest change of s in one step; a factor of e."""
_CONVERGED = 1e-3
"""A step of this size or less is the last one."""
_LARGE = 0.05
"""After the usual number of steps, a game goes on while its last step was an improvement of this size or more."""
_FURTHER = 20
"""Largest number of steps beyond the usual ones; weights that are off by a large factor need them."""


@dataclass(frozen=True)
class Calibration:
    """Gauss-Newton steps on the logarithm s of the factor, in float64 and without a gradient.

    Attributes:
        steps: usual number of steps; zero leaves the pair weights as they are. A game whose last step was an
            improvement and changed its weights by 5 % or more takes up to 20 further ones.
        noise: standard deviation [m] of the observed positions.
        spread: standard deviation of s before the history is seen.
        starts: values of s with which the game is solved first. The steps begin at the one with the lowest cost.
    """

    steps: int = 6
    noise: float = 0.001
    spread: float = 1.0
    starts: Sequence[float] = (0.0,)

    def __post_init__(self) -> None:
        known = isinstance(self.starts, Sequence) and not isinstance(self.starts, str) and len(self.starts) > 0
        if not known or not all(is_number(start) and math.isfinite(start) for start in self.starts):
            raise ConfigError(f"calibration.starts must be a list of finite numbers, at least one, not {self.starts!r}")
        check_whole("calibration.steps", self.steps, least=0)
        check_number("calibration.noise", self.noise)
        check_number("calibration.spread", self.spread)

    @torch.no_grad()
    def __call__(
        self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters
    ) -> GameParameters:
        """The game with calibrated pair weights. Scenes with gaps in the history of an agent keep their weights.

        Args:
            minimiser, energy: solver and energy of the forecast.
            scene: the scene, whose game ends ``game_steps`` after t0.
            parameters: the inferred game.
        """
        if self.steps == 0 or scene.history.shape[2] == 1 or not parameters.pair_weights:
            return parameters
        game = parameters.map(lambda t: t.double() if t.is_floating_point() else t)
        past = _PastGame(energy, _at_first_step(scene).to(torch.double), game, self.noise)
        descent = minimiser.descent()
        s, start = past.first_guess(self.starts, self.spread, descent)
        s = self._descend(past, s, start, descent if len(self.starts) == 1 else descent.near_minimum())
        complete = (scene.history_mask | ~scene.agent_mask[..., None]).all(-1).all(-1)
        factor = torch.where(complete[:, None] & s.isfinite(), s, 0.0).exp()[..., None]
        weights = {name: weight * factor.to(weight.dtype) for name, weight in parameters.pair_weights.items()}
        return dataclasses.replace(parameters, pair_weights=weights)

    def _descend(
        self, past: _PastGame, s: Float[Tensor, "B M"], start: Float[Tensor, "B _ N T 2"], first: Minimiser
    ) -> Float[Tensor, "B M"]:
        """s after the Gauss-Newton steps, of which every scene takes as many as it needs; zero where no game was solved.

        Args:
            past: the games.
            s: where the steps begin.
            start: strategies of both copies (:meth:`_PastGame.misses`) from which the first minimum is sought.
            first: its minimiser; later minima are near earlier ones.
        """
        every = torch.arange(len(s), device=s.device)
        missed, change, controls = past.misses(s, start, first, every)
        near = first.near_minimum()
        damping = torch.ones_like(s)
        done = torch.zeros_like(s, dtype=torch.bool)
        for taken in range(1, self.steps + _FURTHER + 1):
            slope = (change * missed).sum(-1) + s / self.spread**2
            curvature = change.square().sum(-1) + 1.0 / self.spread**2
            trial = s + (-slope / (damping * curvature)).clamp(-_LARGEST_STEP, _LARGEST_STEP)
            # A scene ends on its own, so that it does not depend on the other scenes of its batch.
            size = (trial - s).abs()
            converged = ~(size >= _CONVERGED) & ~done
            s = torch.where(converged & trial.isfinite(), trial, s)
            done = done | converged
            going = (~done).any(1).nonzero()[:, 0]
            if not len(going):
                break
            solved = past.misses(trial[going], controls[going], near, going)
            # Scenes that have ended are not solved again; nothing of them is better.
            found = [old.index_copy(0, going, new) for old, new in zip((missed, change, controls), solved, strict=True)]
            better = (_cost(found[0], trial, self.spread) < _cost(missed, s, self.spread)) & ~done
            damping = torch.where(better, (damping / 3.0).clamp_min(1.0), damping * 4.0)
            s = torch.where(better, trial, s)
            missed = torch.where(better[..., None], found[0], missed)
            change = torch.where(better[..., None], found[1], change)
            both = torch.cat((better, better), 1)[..., None, None, None]
            controls = torch.where(both, found[2], controls)
            if taken >= self.steps:
                done = done | ~(better & (size >= _LARGE))
        return torch.where(_cost(missed, s, self.spread).isfinite(), s, 0.0)


@dataclass(frozen=True)
class _PastGame:
    """The inferred games, posed at the first observed state, whose solutions have to lead through the history.

    Attributes:
        energy: the energy of the games.
        past: the scenes at their first observed step, whose future is the rest of the history.
        game: the inferred games.
        noise: standard deviation [m] of the observed positions.
    """

    energy: Energy
    past: Scene
    game: GameParameters
    noise: float

    @property
    def games(self) -> int:
        """Number of games M of a scene."""
        return next(iter(self.game.pair_weights.values())).shape[1]

    def solve(
        self,
        s: Float[Tensor, "scenes C"],
        start: Float[Tensor, "scenes C N T 2"],
        minimiser: Minimiser,
        scenes: Int[Tensor, " scenes"],
    ) -> tuple[Float[Tensor, "scenes C R"], Float[Tensor, "scenes C N T 2"]]:
        """Misses of the history, in units of the noise, and strategies, of copies of the games of some scenes.

        Args:
            s: for every copy; C is a multiple of the number of games. Copies are solved at once, as modes.
            start: initial strategies.
            minimiser: the solver.
            scenes: the scenes to which these belong.
        """
        of_scenes, past = self.game[scenes], self.past[scenes]
        count = s.shape[1] // self.games
        copies = dataclasses.replace(of_scenes.map(lambda t: torch.cat(count * (t,), 1)), context=of_scenes.context)
        weights = {name: weight * s.exp()[..., None] for name, weight in copies.pair_weights.items()}
        found = minimiser(self.energy, past, dataclasses.replace(copies, pair_weights=weights, initial_controls=start))
        assert past.future is not None
        observed = past.future[:, None, :, :, :2]
        missed = found.states[..., : observed.shape[3], :2] - observed
        present = past.agent_mask[:, None, :, None, None]
        return torch.where(present, missed, 0.0).flatten(2) / self.noise, found.controls

    def misses(
        self, s: Float[Tensor, "scenes M"], start: Tensor, minimiser: Minimiser, scenes: Tensor
    ) -> tuple[Float[Tensor, "scenes M R"], Float[Tensor, "scenes M R"], Float[Tensor, "scenes _ N T 2"]]:
        """Misses, their derivative by s, and the strategies of two copies of every game: at s, and beside it."""
        missed, controls = self.solve(torch.cat((s, s + _DIFFERENCE), 1), start, minimiser, scenes)
        here, beside = missed.chunk(2, 1)
        return here, (beside - here) / _DIFFERENCE, controls

    def first_guess(
        self, starts: Sequence[float], spread: float, minimiser: Minimiser
    ) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B _ N T 2"]]:
        """The start with the lowest cost, and the strategies of two copies of every game from which to go on."""
        observed = _with_history(self.past, self.game.initial_controls.shape[3])
        every = torch.arange(len(observed), device=observed.device)
        s = observed.new_tensor(starts).repeat_interleave(self.games).expand(len(observed), -1)
        controls = observed.expand(-1, s.shape[1], -1, -1, -1)
        if len(starts) > 1:
            missed, controls = self.solve(s, controls, minimiser, every)
            least = _cost(missed, s, spread).unflatten(1, (-1, self.games)).argmin(1)
            chosen = least * self.games + torch.arange(self.games, device=s.device)
            s, controls = s.gather(1, chosen), controls[every[:, None], chosen]
        return s, torch.cat((controls, controls), 1)


def _cost(
    missed: Float[Tensor, "scenes M R"], s: Float[Tensor, "scenes M"], spread: float
) -> Float[Tensor, "scenes M"]:
    """Cost that a calibration minimises; infinite where a game has no solution."""
    cost = missed.square().sum(-1) + s.square() / spread**2
    return torch.where(cost.isfinite(), cost, math.inf)


def _at_first_step(scene: Scene) -> Scene:
    """The scene at its first observed step: the rest of the history is its future, and its game ends as much later.

    Headings lead continuously to those at t0, from which the headings wanted at the goals are counted.
    """
    before = scene.history.shape[2] - 1
    steps = None if scene.game_steps is None else scene.game_steps + before
    history = scene.history.clone()
    turns = wrapped(history[..., HEADING].diff(dim=-1))
    history[..., :-1, HEADING] = history[..., -1:, HEADING] - turns.flip(-1).cumsum(-1).flip(-1)
    return dataclasses.replace(
        scene,
        history=history[:, :, :1],
        history_mask=scene.history_mask[:, :, :1],
        future=history[:, :, 1:],
        future_mask=scene.history_mask[:, :, 1:],
        game_steps=steps,
    )


def _with_history(past: Scene, ahead: int) -> Float[Tensor, "B 1 N T 2"]:
    """The observed controls, followed by zeros for the steps after t0: the start of the game at the first observed step."""
    assert past.future is not None
    seen = torch.cat((past.history, past.future), 2)
    driven = torch.where(past.agent_mask[..., None, None], controls_between(seen, past.dt), 0.0)
    return F.pad(driven, (0, 0, 0, ahead))[:, None]
