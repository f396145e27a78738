"""Iterated linear-quadratic games: from a trajectory to a feedback equilibrium (Fridovich-Keil et al., "Efficient iterative
linear-quadratic approximations for nonlinear multi-player general-sum differential games", ICRA 2020).

In every iteration the LQ game around the trajectory is solved, and the agents follow its policies to the next trajectory.
Anderson acceleration saves a part of the LQ games: it guesses a better next trajectory. Where a guess is too far away, the
agents follow the policies with their offsets multiplied by a step length. The iteration ends after a trajectory from which
the policies deviate by less than a tolerance; the next one, which is nearly always closer to the equilibrium, is the
solution. This is the version for all energies; :mod:`~epo_lightning.solvers.feedback.kernel` does the same in C++.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.game_end import free_controls
from epo_lightning.game.selection import games
from epo_lightning.scene import Scene
from epo_lightning.solvers.feedback import compiled
from epo_lightning.solvers.feedback.anderson import Anderson
from epo_lightning.solvers.feedback.lq_game import LQGame, Policy
from epo_lightning.solvers.feedback.stages import lq_game

LARGEST_MOVE = 1.5
"""Largest change of a state in one iteration [m, rad, m/s], as in GameInference.jl (Peters, 2020)."""
TRIALS = 20
"""Largest number of step lengths that are tried."""
SHORTEST = 0.5
"""Step length of a game whose changes do not become smaller. Shorter ones creep."""
REMEMBERED = 3
"""Number of trajectories of Anderson acceleration."""


@dataclass(frozen=True)
class FeedbackGame:
    """The games of a batch, in double precision on a CPU.

    Attributes:
        energy, scene, parameters: the game of every scene and mode.
        rho: see :func:`~epo_lightning.solvers.feedback.stages.lq_game`.
    """

    energy: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    rho: float

    def one_by_one(self, modes: int) -> FeedbackGame:
        """The B M games as B M scenes with one mode each."""
        scenes = torch.arange(len(self.scene.history)).repeat_interleave(modes)
        parameters = games(self.parameters, scenes, torch.arange(modes).repeat(len(self.scene.history)))
        return dataclasses.replace(self, scene=self.scene[scenes], parameters=parameters)

    def __getitem__(self, rows: Tensor) -> FeedbackGame:
        """The games of some scenes."""
        return dataclasses.replace(self, scene=self.scene[rows], parameters=self.parameters[rows])

    def linearised(self, states: Float[Tensor, "B M N K 4"], controls: Float[Tensor, "B M N K 2"]) -> LQGame:
        """The LQ games around trajectories."""
        return lq_game(self.energy, self.scene, self.parameters, states, controls, self.rho)

    def states(self, controls: Float[Tensor, "B M N K 2"]) -> Float[Tensor, "B M N K 4"]:
        """The trajectories of controls."""
        return self.energy.dynamics.rollout(self.energy.current_states(self.scene), controls, self.scene.dt)

    def follow(
        self, states: Tensor, controls: Tensor, policy: Policy, length: Float[Tensor, " games"]
    ) -> tuple[Float[Tensor, "B M N K 4"], Float[Tensor, "B M N K 2"]]:
        """States and controls of agents that follow the policies around trajectories, each with its step length."""
        start = self.energy.current_states(self.scene).expand_as(states[..., 0, :])
        visited, chosen = compiled.follow(
            start.flatten(0, 1),
            states.flatten(0, 1),
            controls.flatten(0, 1),
            policy.gains,
            policy.offsets,
            length,
            self.scene.dt,
            self.energy.dynamics.beta,
        )
        return visited.view_as(states), chosen.view_as(controls)

    def change(self, states: Float[Tensor, "B M N K 4"], others: Float[Tensor, "B M N K 4"]) -> Float[Tensor, " B"]:
        """The largest change of a state. What happens after the end of a game does not count."""
        counts = free_controls(self.scene, states.shape[3])[:, None, :, :, None]
        return torch.where(counts, others - states, 0.0).flatten(1).abs().amax(-1)


@torch.no_grad()
def iterate(
    game: FeedbackGame, controls: Float[Tensor, "B M N K 2"], iterations: int, tolerance: float
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """Iterate LQ games until their policies want to change no state by ``tolerance`` or more, and take this last step.

    Returns:
        the controls, and a status: COMPLETED where the iteration has ended, DAMPED where it has not, STOPPED where an LQ
        game has no unique equilibrium or the next trajectory is not finite; such a game keeps its last trajectory.
    """
    batch, modes = controls.shape[:2]
    game, controls = game.one_by_one(modes), controls.flatten(0, 1)[:, None].clone()
    states = game.states(controls)
    status = torch.full((len(controls),), int(Status.DAMPED), device=controls.device)
    length = controls.new_ones(len(controls))
    before = torch.full_like(length, torch.inf)
    memory = Anderson(len(controls), REMEMBERED, controls[0].numel())
    for _ in range(iterations):
        going = (status == Status.DAMPED).nonzero()[:, 0]
        if not len(going):
            break
        some = game[going]
        step = _step(some, states[going], controls[going], length[going])
        status[going[step.wanted < tolerance]] = int(Status.COMPLETED)
        status[going[~step.usable]] = int(Status.STOPPED)
        # Policies that answer each other may oscillate: acceleration begins anew, and steps without it are shorter.
        slower = going[~(step.wanted < before[going])]
        length[slower] = (0.5 * length[slower]).clamp_min(SHORTEST)
        memory.forget(slower)
        before[going] = step.wanted
        flat, deviations = controls[going].flatten(1), step.deviations.flatten(1)
        guess = memory.next(going, flat, deviations).view_as(step.controls)
        memory.remember(going, flat, deviations)
        states[going], controls[going] = _guarded(some, states[going], step, guess)
    return controls.view(batch, modes, *controls.shape[2:]), status.view(batch, modes)


@dataclass(frozen=True)
class _Step:
    """A step of some games.

    Attributes:
        states, controls: the next trajectories.
        deviations: the changes of the controls that the policies want.
        wanted: the largest change of a state that they want.
        usable: mask of the games that have a next trajectory; the others stay where they are.
    """

    states: Float[Tensor, "games 1 N K 4"]
    controls: Float[Tensor, "games 1 N K 2"]
    deviations: Float[Tensor, "games 1 N K 2"]
    wanted: Float[Tensor, " games"]
    usable: Bool[Tensor, " games"]


def _step(game: FeedbackGame, states: Tensor, controls: Tensor, length: Float[Tensor, " games"]) -> _Step:
    """The step that the policies of the LQ games suggest, halved until it changes no state by too much."""
    policy = game.linearised(states, controls).equilibrium()
    for _ in range(TRIALS):
        trial, chosen = game.follow(states, controls, policy, length)
        change = game.change(states, trial)
        far = ~(change <= LARGEST_MOVE)
        if not far.any():
            break
        length = torch.where(far, 0.5 * length, length)
    usable = policy.unique & ~far
    known = usable[:, None, None, None, None]
    trial, chosen = torch.where(known, trial, states), torch.where(known, chosen, controls)
    deviations = (chosen - controls) / length[:, None, None, None, None]
    return _Step(trial, chosen, deviations, torch.where(usable, change / length, torch.inf), usable)


def _guarded(
    game: FeedbackGame, states: Tensor, step: _Step, guess: Tensor
) -> tuple[Float[Tensor, "games 1 N K 4"], Float[Tensor, "games 1 N K 2"]]:
    """The trajectories of guessed controls, and those of the step where these are too far."""
    guessed = game.states(guess)
    near = (game.change(states, guessed) <= LARGEST_MOVE)[:, None, None, None, None]
    return torch.where(near, guessed, step.states), torch.where(near, guess, step.controls)
