"""Iterated linear-quadratic games: from a trajectory to a feedback equilibrium (Fridovich-Keil et al., "Efficient iterative
linear-quadratic approximations for nonlinear multi-player general-sum differential games", ICRA 2020).

In every iteration the LQ game around the trajectory is solved, and the agents follow its policies, with their offsets
multiplied by a step length, to the next trajectory. The iteration ends at a trajectory from which the policies of the LQ
game around it deviate by less than a tolerance.

The derivative is that of this fixed point. Let D(u, p) be the deviation from the controls u that the LQ game suggests. At a
solution D(u, p) = 0, so du/dp = -D_u^-1 D_p (implicit function theorem).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.game_end import free_controls
from epo_lightning.game.selection import games
from epo_lightning.scene import Scene
from epo_lightning.solvers.feedback import compiled
from epo_lightning.solvers.feedback.lq_game import LQGame, Policy
from epo_lightning.solvers.feedback.stages import lq_game

_LARGEST_MOVE = 1.5
"""Largest change of a state in one iteration [m, rad, m/s], as in GameInference.jl (Peters, 2020)."""
_HALVINGS = 20
_SHORTEST = 0.5
"""Step length of a game whose changes do not become smaller. Shorter ones creep."""


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
        """The S = B M games as S scenes with one mode each."""
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
        self, states: Tensor, controls: Tensor, policy: Policy, length: Float[Tensor, " S"]
    ) -> tuple[Float[Tensor, "B M N K 4"], Float[Tensor, "B M N K 2"]]:
        """States and controls of agents that follow the policies around trajectories, each with its step length."""
        start = self.energy.current_states(self.scene).expand_as(states[..., 0, :])
        given = (*(part.flatten(0, 1) for part in (start, states, controls)), policy.gains, policy.offsets, length)
        arrays: list[Any] = [part.contiguous().numpy() for part in given]
        arrays += [self.scene.dt, self.energy.dynamics.beta]
        visited, chosen = compiled.follow(*arrays)
        return torch.from_numpy(visited).view_as(states), torch.from_numpy(chosen).view_as(controls)


@torch.no_grad()
def iterate(
    game: FeedbackGame, controls: Float[Tensor, "B M N K 2"], iterations: int, tolerance: float
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """Iterate LQ games until their policies want to change no state by ``tolerance`` or more.

    Returns:
        the controls, and a status: SOLVED where the iteration has ended, DAMPED where it has not, STOPPED where an LQ game
        has no unique equilibrium or the next trajectory is not finite; such a game keeps its last trajectory.
    """
    batch, modes = controls.shape[:2]
    game, controls = game.one_by_one(modes), controls.flatten(0, 1)[:, None].clone()
    states = game.states(controls)
    status = torch.full((len(controls),), int(Status.DAMPED), device=controls.device)
    length = controls.new_ones(len(controls))
    before = torch.full_like(length, torch.inf)
    for _ in range(iterations):
        going = (status == Status.DAMPED).nonzero()[:, 0]
        if not len(going):
            break
        trial, chosen, wanted, usable = _step(game[going], states[going], controls[going], length[going])
        moved = going[usable]
        states[moved], controls[moved] = trial[usable], chosen[usable]
        status[moved] = torch.where(wanted[usable] < tolerance, int(Status.SOLVED), int(Status.DAMPED))
        status[going[~usable]] = int(Status.STOPPED)
        # Policies that answer each other may oscillate.
        slower = going[~(wanted < before[going])]
        length[slower] = (0.5 * length[slower]).clamp_min(_SHORTEST)
        before[going] = wanted
    return controls.view(batch, modes, *controls.shape[2:]), status.view(batch, modes)


def _step(
    game: FeedbackGame, states: Tensor, controls: Tensor, length: Float[Tensor, " S"]
) -> tuple[Float[Tensor, "S 1 N K 4"], Float[Tensor, "S 1 N K 2"], Float[Tensor, " S"], Bool[Tensor, " S"]]:
    """The next trajectories, the largest change of a state that the policies want, and a mask of the usable steps.

    Steps are halved until they change no state by too much. What happens after the end of a game does not count.
    """
    policy = game.linearised(states, controls).equilibrium()
    counts = free_controls(game.scene, states.shape[3])[:, None, :, :, None]
    for _ in range(_HALVINGS):
        trial, chosen = game.follow(states, controls, policy, length)
        change = torch.where(counts, trial - states, 0.0).flatten(1).abs().amax(-1)
        far = ~(change <= _LARGEST_MOVE)
        if not far.any():
            break
        length = torch.where(far, 0.5 * length, length)
    return trial, chosen, change / length, policy.unique & ~far


def attach(
    game: FeedbackGame, controls: Float[Tensor, "B M N K 2"], solved: Bool[Tensor, "B M"], terms: int
) -> Float[Tensor, "B M N K 2"]:
    """The controls of a solution, with the derivative of the fixed point by the parameters of the game.

    The linear system with D_u is solved by a Neumann series, which is the adjoint of the iteration.

    Args:
        game: the game.
        controls: its solution.
        solved: mask of the games that are solved; the derivative of the others is zero.
        terms: largest number of terms of the series. A single one is the derivative of one iteration.
    """
    tensors: list[Tensor] = []

    def collect(tensor: Tensor) -> Tensor:
        tensors.append(tensor)
        return tensor

    game.parameters.map(collect)
    return _Attach.apply(game, solved, terms, controls, *tensors)


class _Attach(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, game: FeedbackGame, solved: Tensor, terms: int, controls: Tensor, *tensors: Tensor) -> Tensor:
        ctx.game, ctx.terms = game, terms
        ctx.save_for_backward(solved, controls, *tensors)
        return controls.view_as(controls)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        solved, controls, *given = ctx.saved_tensors
        tensors = [tensor.detach().requires_grad_(tensor.is_floating_point()) for tensor in given]
        rest = iter(tensors)
        game = dataclasses.replace(ctx.game, parameters=ctx.game.parameters.map(lambda _: next(rest)))
        rows = solved.flatten().nonzero()[:, 0]
        at = controls.flatten(0, 1)[rows][:, None].requires_grad_()
        with torch.enable_grad():
            some = game.one_by_one(solved.shape[1])[rows]
            local = some.linearised(some.states(at), at)
        policy = local.equilibrium()

        def pull_back(covector: Tensor, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
            """D_u' or D_p' times a covector of the controls."""
            return local.pull_back(policy, covector[:, 0], inputs)

        wanted = _adjoint(lambda v: pull_back(v, [at])[0], cotangent.flatten(0, 1)[rows][:, None], ctx.terms)
        found = iter(pull_back(wanted, [tensor for tensor in tensors if tensor.requires_grad]))
        return None, None, None, None, *(next(found) if tensor.requires_grad else None for tensor in tensors)


def _adjoint(by_controls: Callable[[Tensor], Tensor], cotangent: Tensor, terms: int) -> Float[Tensor, "S 1 N K 2"]:
    """The solution y of -D_u' y = v for a cotangent v, where ``by_controls`` multiplies by D_u'.

    A game whose sum gets no closer to the solution gets no further terms.
    """
    total, least = cotangent, cotangent.flatten(1).norm(dim=-1)
    for _ in range(terms - 1):
        missing = cotangent + by_controls(total)
        size = missing.flatten(1).norm(dim=-1)
        total = torch.where((size < least)[:, None, None, None, None], total + missing, total)
        least = torch.where(size < least, size, 0.0)
    return total
