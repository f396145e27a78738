"""Linear-quadratic games in the library of the compiled layer (`lq_game.cpp`): their equilibria, the derivative, and
trajectories that follow policies.

Several games are solved side by side, one in each lane of a vector register, on ``torch.get_num_threads()`` threads. The
result of a game depends neither on the other games nor on the number of threads.

Letters and shapes are those of :mod:`~epo_lightning.solvers.feedback.lq_game`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.kernel.interface import EpoLQGames, EpoLQGradients, EpoPolicies

STATE, CONTROL = 4, 2
"""Numbers of an agent's state and control."""

Policies = tuple[Float[Tensor, "games K m n"], Float[Tensor, "games K m"], Bool[Tensor, " games"]]
"""Gains, offsets, and a mask of the games whose equilibrium is unique."""


def equilibria(parts: Sequence[Tensor], rho: float, free: Bool[Tensor, "games N K"]) -> Policies:
    """Feedback Nash equilibria, by the coupled Riccati recursion (Basar and Olsder, Dynamic Noncooperative Game Theory,
    Corollary 6.1).

    From the last stage to the first: the stationarity conditions of all agents are linear in the joint policy and are solved
    together; then the cost-to-go of every agent is updated.

    Args:
        parts: A, B, own_cost, pair_cost, effort and push of the games, in float64.
        rho, free: those of the games.

    Raises:
        RuntimeError: the library is missing.
        MemoryError: there is not enough memory.
    """
    count, agents, horizon = free.shape
    found = (
        parts[0].new_empty(count, horizon, CONTROL * agents, STATE * agents),
        parts[0].new_empty(count, horizon, CONTROL * agents),
        torch.empty(count, dtype=torch.bool),
    )
    *parts, free = _contiguous((*parts, free))
    _call("epo_lq_equilibria", _games(parts, rho, free, found))
    return found


def pull_back(
    parts: Sequence[Tensor],
    rho: float,
    free: Bool[Tensor, "games N K"],
    policies: Policies,
    controls: Float[Tensor, "games K m"],
) -> tuple[Tensor, ...]:
    """The derivative of <controls, u> by the parts of the games.

    Here u are the controls that the equilibria's policies choose from x_0 = 0 on. The derivative is right where all offsets
    are zero, as at a solution of the iteration: there u is zero, and depends on the gains and the dynamics only through the
    offsets. Games without a unique equilibrium have zeros.

    Args:
        parts, rho, free: the games, as for :func:`equilibria`.
        policies: their equilibria.
        controls: the cotangent.

    Raises:
        RuntimeError: the library is missing.
        MemoryError: there is not enough memory.
    """
    *parts, free, controls = _contiguous((*parts, free, controls))
    bars = tuple(map(torch.empty_like, parts))
    gradients = EpoLQGradients(*(tensor.data_ptr() for tensor in (controls, *bars)))
    _call("epo_lq_pull_back", _games(parts, rho, free, policies), gradients)
    return bars


def follow(
    start: Float[Tensor, "games N 4"],
    states: Float[Tensor, "games N K 4"],
    controls: Float[Tensor, "games N K 2"],
    gains: Float[Tensor, "games K m n"],
    offsets: Float[Tensor, "games K m"],
    length: Float[Tensor, " games"],
    dt: float,
    beta: float,
) -> tuple[Float[Tensor, "games N K 4"], Float[Tensor, "games N K 2"]]:
    """States and controls of unicycles that follow policies around given trajectories.

    Args:
        start: states x_0.
        states, controls: the given trajectories.
        gains, offsets: the policies.
        length: factor of the offsets.
        dt, beta: time step [s], and the share of the velocity before a step in its displacement.

    Raises:
        RuntimeError: the library is missing.
        MemoryError: there is not enough memory.
    """
    given = _contiguous((start, states, controls, gains, offsets, length))
    visited, chosen = torch.empty_like(given[1]), torch.empty_like(given[2])
    addresses = (tensor.data_ptr() for tensor in (*given, visited, chosen))
    _call("epo_lq_follow", EpoPolicies(*controls.shape[:3], dt, beta, *addresses))
    return visited, chosen


def _contiguous(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    return tuple(tensor.detach().contiguous() for tensor in tensors)


def _games(parts: Sequence[Tensor], rho: float, free: Tensor, policies: Policies) -> EpoLQGames:
    """The games as the library reads them: addresses of contiguous tensors, which have to live as long as the call."""
    return EpoLQGames(*free.shape, rho, *(tensor.data_ptr() for tensor in (*parts, free, *policies)))


def _call(name: str, *structures: EpoLQGames | EpoLQGradients | EpoPolicies) -> None:
    interface.check(getattr(interface.library(), name)(*structures, torch.get_num_threads()))
