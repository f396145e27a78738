"""Linear-quadratic games and their feedback Nash equilibria.

The deviations x_k of the agents' states from a trajectory, and u_k of their controls, follow

    x_{k+1} = A_k x_k + B_k u_k,  k = 0 .. K-1,

where A and B have a block for every agent, and agent i minimises the sum over all stages of

    1/2 x_{k+1}' Q_i x_{k+1} + q_i' x_{k+1} + 1/2 u_i' R_i u_i + r_i' u_i + 1/2 rho (|x_{k+1}|^2 + |u_k|^2),

where u_i are its own controls. Q_i and q_i are the sums of its own cost and those of its pairs. In a feedback Nash
equilibrium the agents have affine policies u_k = G_k x_k + f_k: each is the best answer to the policies of the others, from
every state. So an agent counts on the reactions of the others; in an open-loop equilibrium
(:mod:`~epo_lightning.solvers.gauss_newton`) it takes their controls as given.

Letters: n = 4 N joint states, m = 2 N joint controls. Matrices with one more column hold a matrix and a vector:
[Q | q] for a cost, [G | f] for a policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.solvers.feedback import compiled


@dataclass(frozen=True)
class LQGame:
    """Linear-quadratic games.

    Attributes:
        A, B: the dynamics of every agent.
        own_cost: [Q | q] of every agent's own cost, by its state.
        pair_cost: [Q | q] of the cost of every pair, by the states of both agents; each of the two counts it.
        effort, push: R and r of every agent.
        rho: weight of the squared joint states and controls in the cost of every agent; zero after the end of a game.
        free: mask of the controls that are chosen; policies leave the others as they are, such as those after the end.
    """

    A: Float[Tensor, "games N K 4 4"]
    B: Float[Tensor, "games N K 4 2"]
    own_cost: Float[Tensor, "games N K 4 5"]
    pair_cost: Float[Tensor, "games P K 8 9"]
    effort: Float[Tensor, "games N K 2 2"]
    push: Float[Tensor, "games N K 2"]
    rho: float
    free: Bool[Tensor, "games N K"]

    def equilibrium(self) -> Policy:
        """The feedback Nash equilibrium, without a derivative.

        Raises:
            RuntimeError: the library of the compiled layer is missing.
        """
        return Policy(*compiled.equilibria(self._parts(), self.rho, self.free))

    def pull_back(
        self, policy: Policy, cotangent: Float[Tensor, "games N K 2"], inputs: Sequence[Tensor]
    ) -> tuple[Tensor, ...]:
        """The derivative of <cotangent, u> by ``inputs``, tensors from which the game was computed.

        Here u are the controls that the equilibrium's policies choose from x_0 = 0 on. It is right where all offsets are
        zero, as at a solution of the iteration.
        """
        parts, policies = self._parts(), (policy.gains, policy.offsets, policy.unique)
        by_controls = cotangent.transpose(1, 2).flatten(2)
        bars = compiled.pull_back(parts, self.rho, self.free, policies, by_controls)
        known = [(part, bar) for part, bar in zip(parts, bars, strict=True) if part.requires_grad]
        outputs, cotangents = zip(*known, strict=True)
        return torch.autograd.grad(
            outputs, inputs, cotangents, retain_graph=True, allow_unused=True, materialize_grads=True
        )

    def _parts(self) -> tuple[Tensor, ...]:
        return self.A, self.B, self.own_cost, self.pair_cost, self.effort, self.push


@dataclass(frozen=True)
class Policy:
    """Affine policies u_k = G_k x_k + f_k of all agents.

    Attributes:
        gains, offsets: G and f.
        unique: mask of the games whose equilibrium is unique, so that the policies are it.
    """

    gains: Float[Tensor, "games K m n"]
    offsets: Float[Tensor, "games K m"]
    unique: Bool[Tensor, " games"]
