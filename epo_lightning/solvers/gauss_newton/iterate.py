"""An iterate of a Gauss-Newton solver: joint strategies, their trajectories, and the maps between controls and nodes.

The solver's unknowns are not the controls u but the speeds and headings z_l = z_0 + dt sum_{j<l} u_j after every step,
called nodes l = 1 .. K, because the second derivatives by z have a simple structure (:mod:`.quadratic_model`). (The
features z of the backbone are something else.) With e_l the unit vector of the heading and e'_l the unit vector to its
left, a position changes as

    dp_k = dt sum_{l<k} M_l dz_l,   M_l = [e_l, v_l e'_l]     (explicit Euler; other integrators include l = k).

Arrays are laid out [problems, N, component, K]. Component 0 is speed (of z) or acceleration (of u), component
1 is heading or turn rate. (The kernel and `docs/layer.md` have heading first, and their M_l contains the factor dt.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_derivatives import Surroundings
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import HEADING, SPEED, TURN_RATE, Scene


def suffix_sums(values: Float[Tensor, "*rest K"]) -> Float[Tensor, "*rest K"]:
    """Reverse cumulative sums: entry k of the result is the sum of the entries k .. K of the last dimension."""
    return values.flip(-1).cumsum(-1).flip(-1)


def following(values: Float[Tensor, "*rest K"]) -> Float[Tensor, "*rest K"]:
    """The next entry of the last dimension, zero after the last one."""
    return torch.nn.functional.pad(values[..., 1:], (0, 1))


@dataclass(frozen=True)
class Iterate:
    """Joint strategies of a game, with their trajectories in the layout of the solver.

    Attributes:
        energy, scene, parameters: the game.
        controls, states: joint strategies and trajectories, as the energy takes them.
        around: inputs of the own features besides the trajectory.
        u, x: controls and states, by problem.
        unit, left: unit vectors of the headings, and those to their left.
        moves: M_l, laid out [problems, N, component, axis, K]: the derivatives of velocities (x, y) by speed and by heading.
    """

    energy: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    controls: Float[Tensor, "B M N K 2"]
    states: Float[Tensor, "B M N K 4"]
    around: Surroundings
    u: Float[Tensor, "problems N 2 K"]
    x: Float[Tensor, "problems N 4 K"]
    unit: Float[Tensor, "problems N 2 K"]
    left: Float[Tensor, "problems N 2 K"]
    moves: Float[Tensor, "problems N 2 2 K"]

    @classmethod
    def of(cls, energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: Tensor) -> Iterate:
        """The iterate at joint strategies u, which are zero for absent agents."""
        around = energy.surroundings(scene, parameters)
        states = energy.dynamics.rollout(around.initial, controls, scene.dt)
        u = controls.flatten(0, 1).transpose(-1, -2).contiguous()
        x = states.flatten(0, 1).transpose(-1, -2).contiguous()
        heading, speed = x[:, :, HEADING], x[:, :, SPEED]
        unit = torch.stack((heading.cos(), heading.sin()), 2)
        left = torch.stack((-unit[:, :, 1], unit[:, :, 0]), 2)
        moves = torch.stack((unit, speed[:, :, None] * left), 2)
        return cls(energy, scene, parameters, controls, states, around, u, x, unit, left, moves)

    @property
    def problems(self) -> int:
        """Number B M of problems."""
        return self.u.shape[0]

    @property
    def agents(self) -> int:
        """Number N of agents."""
        return self.u.shape[1]

    @property
    def horizon(self) -> int:
        """Number K of steps of the game."""
        return self.u.shape[3]

    @property
    def modes(self) -> int:
        """Number M of modes."""
        return self.controls.shape[1]

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return self.scene.dt

    @property
    def beta(self) -> float:
        """A step moves by dt (beta velocity before + (1 - beta) velocity after)."""
        return self.energy.dynamics.beta

    @property
    def speed(self) -> Float[Tensor, "problems N K"]:
        """Speeds at the nodes 1 .. K."""
        return self.x[:, :, SPEED]

    @cached_property
    def within_game(self) -> Bool[Tensor, "problems 1 1 K"] | None:
        """Mask of the steps of each game (``scene.game_steps``); None if all games have K steps."""
        if self.around.ends is None:
            return None
        ends = self.around.ends.repeat_interleave(self.modes)[:, None, None, None]
        return torch.arange(self.horizon, device=ends.device) < ends

    @cached_property
    def _last(self) -> Bool[Tensor, "problems 1 1 K"] | None:
        """Mask of the last step of each game; None if all games have K steps."""
        return (
            None
            if self.within_game is None
            else self.within_game & (self.within_game.cumsum(-1) == self.within_game.sum(-1, keepdim=True))
        )

    def last(self, values: Float[Tensor, "problems N c K"]) -> Float[Tensor, "problems N c"]:
        """The entries of the last step of every game."""
        return values[..., -1] if self._last is None else values.where(self._last, 0.0).sum(-1)

    def add_last_(self, onto: Float[Tensor, "problems N c K"], values: Float[Tensor, "problems N #c"]) -> None:
        """Add values to the entries of the last step of every game, in place."""
        if self._last is None:
            onto[..., -1] += values
        else:
            onto += self._last * values[..., None]

    @property
    def present(self) -> Bool[Tensor, "problems N"]:
        """Mask of the present agents."""
        return self.by_problem(self.scene.agent_mask[:, None])[..., 0]

    def by_problem(self, values: Tensor | None) -> Float[Tensor, "problems N 1"] | Bool[Tensor, "problems N 1"]:
        """Values [B, 1 or M, N] of agents, by problem."""
        assert values is not None
        return values.expand(values.shape[0], self.modes, self.agents).reshape(self.problems, self.agents, 1)

    def steered(self) -> tuple[Tensor, Tensor, Tensor]:
        """Turn rates, the speeds before them, and wheelbases: the arguments of a steering angle."""
        start = self.by_problem(self.around.initial[..., SPEED])
        before = torch.cat((start, self.x[:, :, SPEED, :-1]), -1)
        return self.u[:, :, TURN_RATE], before, self.by_problem(self.around.wheelbase)

    def to_nodes(self, covector: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """The gradient by the nodes z that follows from a gradient by the controls, because u_l = (z_{l+1} - z_l) / dt."""
        return (covector - following(covector)) / self.dt

    def to_controls(self, change: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """The change of the controls that causes a given change of the nodes."""
        return torch.diff(change, dim=-1, prepend=torch.zeros_like(change[..., :1])) / self.dt

    def to_positions(self, velocity: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """The change of the positions that a change of the velocities at the nodes causes."""
        sums = velocity.cumsum(-1)
        before = torch.nn.functional.pad(sums[..., :-1], (1, 0))
        return self.dt * (before if self.beta == 1.0 else self.beta * before + (1.0 - self.beta) * sums)

    def to_velocities(self, gradient: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """The gradient by the velocities at the nodes that follows from a gradient by positions.

        This is the adjoint of :meth:`to_positions`.
        """
        sums = suffix_sums(gradient)
        if self.beta == 1.0:
            return self.dt * following(sums)
        return self.dt * (self.beta * following(sums) + (1.0 - self.beta) * sums)

    def node_directions(self) -> Float[Tensor, "D B M N K 2"]:
        """The D = 2 K changes of controls that each move a single entry of z: all speeds first, then all headings."""
        unit = torch.eye(2 * self.horizon, dtype=self.u.dtype, device=self.u.device)
        unit = self.to_controls(unit.view(-1, 1, 1, 1, 2, self.horizon)).transpose(-1, -2)
        return unit.expand(-1, *self.controls.shape)

    def at_every_step(self, values: Float[Tensor, "E c L"]) -> Float[Tensor, "E c K"]:
        """Values at the steps at which pairs are evaluated, and zeros in between."""
        stride = self.energy.pair_stride
        if stride == 1:
            return values
        every = values.new_zeros(*values.shape[:2], self.horizon)
        every[..., stride - 1 :: stride] = values
        return every
