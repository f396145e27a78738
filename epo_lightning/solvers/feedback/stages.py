"""The linear-quadratic game around a trajectory: dynamics and costs of every agent, stage by stage.

The cost of agent i is its own features and those of all its pairs, J_i = E_i + sum_j E_ij (Theorem 1). A stage is a time
step: the control u_k, and the state x_{k+1} that it leads to. So features must be sums over stages: those of controls,
speeds, positions, goals and distances are. Rates couple the controls of two stages, and a steering angle a turn rate with
the speed before it; these are not taken here. Second derivatives of residuals are left out (Gauss-Newton), so that all costs
are convex.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OwnFeature, Source
from epo_lightning.game.game_end import free_controls
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import HEADING, SPEED, Scene, X, Y, heading_vector
from epo_lightning.solvers.feedback.compiled import CONTROL, STATE
from epo_lightning.solvers.feedback.lq_game import LQGame

_AT_THE_END = (Source.FINAL_POSITION, Source.FINAL_HEADING)


def lq_game(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    states: Float[Tensor, "B M N K 4"],
    controls: Float[Tensor, "B M N K 2"],
    rho: float,
) -> LQGame:
    """The linear-quadratic games around joint trajectories, one per scene and mode, `games` = B M. Differentiable.

    Args:
        energy, scene, parameters: the game.
        states, controls: the trajectories.
        rho: weight of squared deviations of the joint states and controls, in the cost of every agent.
    """
    modes, horizon = controls.shape[1], controls.shape[3]
    own_cost, effort, push = _own_costs(energy, scene, parameters, states, controls)
    start = energy.current_states(scene)[..., None, :].expand_as(states[..., :1, :])
    A, B = _dynamics(energy.dynamics, torch.cat((start, states), -2), scene.dt)
    return LQGame(
        A=A.flatten(0, 1),
        B=B.flatten(0, 1),
        own_cost=own_cost.flatten(0, 1),
        pair_cost=_pair_costs(energy, scene, parameters, states).flatten(0, 1),
        effort=effort.flatten(0, 1),
        push=push.flatten(0, 1),
        rho=rho,
        free=free_controls(scene, horizon)[:, None].expand(-1, modes, -1, -1).flatten(0, 1),
    )


def _own_costs(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, states: Tensor, controls: Tensor
) -> tuple[Float[Tensor, "B M N K 4 5"], Float[Tensor, "B M N K 2 2"], Float[Tensor, "B M N K 2"]]:
    """[Q | q] of every agent's own cost by its state, and R and r by its controls."""
    horizon = controls.shape[3]
    around = energy.surroundings(scene, parameters)
    ends = scene.game_steps
    if ends is None:
        ends = torch.full((len(controls),), horizon, device=controls.device)
    last = F.one_hot(ends.long() - 1, horizon).to(controls.dtype)[:, None, None, :, None]
    costs = _Quadratic(STATE + CONTROL, controls[..., 0])
    for name, feature in energy.own_features.items():
        entries = _entries(feature)
        moved = costs.moved(entries, states, controls)
        residual, change = energy.own_residual(name, scene, parameters, around, (states, controls), moved)
        if feature.source in _AT_THE_END:
            residual, change = residual[..., None, :] * last, change[..., None, :] * last
        else:
            residual, change = residual.unflatten(-1, (horizon, -1)), change.unflatten(-1, (horizon, -1))
        costs.add(entries, residual, change)
    by_controls = costs.block(range(STATE, STATE + CONTROL))
    return costs.block(range(STATE)), by_controls[..., :CONTROL], by_controls[..., CONTROL]


def _entries(feature: OwnFeature) -> Sequence[int]:
    """The entries of (x, y, heading, speed, acceleration, turn rate) on which a feature of single time steps depends."""
    match feature.source:
        case Source.CONTROL:
            return (STATE + feature.channel,)
        case Source.SPEED:
            return (SPEED,)
        case Source.FINAL_HEADING:
            return (HEADING,)
        case Source.POSITION | Source.FINAL_POSITION:
            return (X, Y)
    raise AssertionError(feature)


def _pair_costs(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, states: Tensor
) -> Float[Tensor, "B M P K 8 9"]:
    """[Q | q] of the cost of every pair by the states of both agents."""
    batch, modes, agents, horizon = states.shape[:4]
    first, second = pairs(agents, states.device)
    none = states.new_zeros(batch, modes, len(first), horizon, 2 * STATE, 2 * STATE + 1)
    if not energy.pair or not len(first):
        return none
    steps = torch.arange(horizon, device=states.device)[energy.pair_stride - 1 :: energy.pair_stride]
    both = states[:, :, first], states[:, :, second]
    costs = _Quadratic(2 * STATE, both[0][..., steps, 0])
    distances = all(feature.declared for feature in energy.pair_features.values())
    entries = (X, Y, STATE + X, STATE + Y) if distances else range(2 * STATE)
    moved = costs.moved(entries, *both)
    for _, residual, change in energy.pair_residuals(scene, parameters, both, moved):
        costs.add(entries, residual[..., None], change[..., None])
    cost = costs.block(range(2 * STATE))
    return cost if energy.pair_stride == 1 else none.index_copy(3, steps, cost)


class _Quadratic:
    """[J' J | J' r], the Gauss-Newton matrix and the gradient of 1/2 |r|^2, entry by entry: most are zero."""

    def __init__(self, size: int, like: Float[Tensor, "*batch"]) -> None:
        self._size = size
        self._unit = torch.eye(size, dtype=like.dtype, device=like.device)[:, None, None, None, None]
        self._zero = torch.zeros_like(like)
        self._found: dict[tuple[int, int], Tensor] = {}

    def moved(self, entries: Sequence[int], first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of two arrays [..., d] and [..., e] by one in each of D entries, counted through both: [D, ...]."""
        mine, others = self._unit[list(entries)].split((first.shape[-1], second.shape[-1]), -1)
        return mine.expand(-1, *first.shape), others.expand(-1, *second.shape)

    def add(
        self, entries: Sequence[int], residual: Float[Tensor, "*batch R"], change: Float[Tensor, "D *batch R"]
    ) -> None:
        """Add 1/2 |r|^2 of a residual r, from its derivatives by the entries on which it depends."""
        along = dict(zip(entries, change, strict=True))
        for a in entries:
            self._add(a, self._size, _product(along[a], residual))
            for b in entries:
                if b >= a:
                    self._add(a, b, _product(along[a], along[b]))

    def block(self, entries: range) -> Float[Tensor, "*batch d d1"]:
        """Rows and columns of some entries, and their gradient as the last column."""
        rows = [self._found.get((min(a, b), max(a, b)), self._zero) for a in entries for b in (*entries, self._size)]
        return torch.stack(rows, -1).unflatten(-1, (len(entries), len(entries) + 1))

    def _add(self, row: int, column: int, cost: Tensor) -> None:
        known = self._found.get((row, column))
        self._found[row, column] = cost if known is None else known + cost


def _product(one: Float[Tensor, "*batch R"], other: Float[Tensor, "*batch R"]) -> Float[Tensor, "*batch"]:
    """The scalar product of the last dimension; a sum over R = 1 entries would copy them."""
    products = one * other
    return products.squeeze(-1) if products.shape[-1] == 1 else products.sum(-1)


def _dynamics(
    unicycle: Unicycle, states: Float[Tensor, "B M N K1 4"], dt: float
) -> tuple[Float[Tensor, "B M N K 4 4"], Float[Tensor, "B M N K 4 2"]]:
    """Derivatives of every agent's next state by its state and by its control, along x_0 .. x_K."""
    heading, speed = states[..., HEADING], states[..., SPEED]
    ahead = heading_vector(heading)
    aside = speed[..., None] * torch.stack((-heading.sin(), heading.cos()), -1)
    # The displacement is dt (beta v_k e_k + (1 - beta) v_{k+1} e_{k+1}); column 0: by the heading, column 1: by the speed.
    by_node = dt * torch.stack((aside, ahead), -1)
    before, after = unicycle.beta * by_node[..., :-1, :, :], (1.0 - unicycle.beta) * by_node[..., 1:, :, :]
    A = torch.eye(STATE, dtype=states.dtype, device=states.device) + F.pad(before + after, (2, 0, 0, 2))
    turned = dt * torch.eye(2, dtype=states.dtype, device=states.device).expand_as(after)
    # Controls are the acceleration, which changes the speed, and the turn rate.
    return A, torch.cat((dt * after, turned), -2).flip(-1)
