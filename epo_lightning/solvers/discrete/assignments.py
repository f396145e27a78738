"""Joint assignments k of candidates to agents: the density p(k) = exp(-E(k)) / Z, and the assignments of lowest energy.

    E(k) = sum_i unary_i(k_i) + sum_{i<j} pair_ij(k_i, k_j)

These are functions of energy tables alone (:class:`~epo_lightning.forecast.Tables`), differentiable with respect to them. An
energy of plus infinity marks an impossible candidate or pair of candidates: its probability and its gradient are zero.
Absent agents take their first candidate at no cost, whatever their entries are.
"""

from __future__ import annotations

from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.game.pairs import pairs

LIMIT = 4096
"""Largest number C^N of joint assignments that are enumerated."""
BEAM = 256
"""Number of partial assignments that the beam search keeps."""


def enumerable(agents: int, candidates: int) -> bool:
    """Whether all joint assignments can be enumerated. Absent agents count, so that this is known from the shapes."""
    return candidates**agents <= LIMIT


def settle(
    unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
) -> tuple[Float[Tensor, "B N C"], Float[Tensor, "B P C C"]]:
    """The tables with absent agents fixed: their first candidate costs nothing, and the others are impossible."""
    first, second = pairs(mask.shape[1], mask.device)
    idle = unary.new_full(unary.shape[-1:], torch.inf)
    idle[:1] = 0.0
    both = (mask[:, first] & mask[:, second])[..., None, None]
    return torch.where(mask[..., None], unary, idle), torch.where(both, pair, 0.0)


def energies(
    unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], assignments: Int[Tensor, "B A N"]
) -> Float[Tensor, "B A"]:
    """E of joint assignments, from tables that :func:`settle` returned."""
    chosen = assignments.transpose(1, 2)
    first, second = pairs(unary.shape[1], unary.device)
    both = chosen[:, first] * unary.shape[2] + chosen[:, second]
    return unary.gather(2, chosen).sum(1) + pair.flatten(2).gather(2, both).sum(1)


def enumerate_(
    unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
    """log p(k_i) and log Z by enumeration of all joint assignments; both -inf where none is possible.

    Raises:
        ValueError: there are more than :data:`LIMIT`.
    """
    batch, agents, count = unary.shape
    if not enumerable(agents, count):
        raise ValueError(
            f"{count} candidates of {agents} agents make more than {LIMIT} joint assignments; use sum_product"
        )
    unary, pair = settle(unary, pair, mask)
    likelihood = -_all_energies(unary, pair)
    total = log_sum_exp(likelihood, (1,))
    # Views with three dimensions of choices: of the agents before i, of agent i, and of the agents after it.
    digits = [likelihood.view(batch, count**i, count, count ** (agents - 1 - i)) for i in range(agents)]
    marginals = [log_sum_exp(digit, (1, 3)) for digit in digits]
    stacked = torch.stack(marginals, 1) if marginals else unary
    return stacked - _finite_or_zero(total)[:, None, None], total


def sum_product(
    unary: Float[Tensor, "B N C"],
    pair: Float[Tensor, "B P C C"],
    mask: Bool[Tensor, "B N"],
    iterations: int = 10,
    damping: float = 0.0,
) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
    """log p(k_i) and log Z by messages between agents (DSDNet, Zeng et al., ECCV 2020), Bethe's approximation of both.

        m_ij(l) ~ sum_k exp(-unary_i(k) - pair_ij(k, l)) prod_{n != j} m_ni(k)
        p(k_i)  ~ exp(-unary_i(k_i)) prod_n m_ni(k_i)
        log Z   = sum_{i<j} log Z_ij + sum_i (1 - d_i) log Z_i

    with the normalisers Z_i and Z_ij of the beliefs about agents and pairs, and the number d_i of i's neighbours. All
    messages are updated in every iteration. The result is exact if the interacting pairs form a tree and there are at least
    as many iterations as its diameter. For other graphs it is accurate for small pair energies and biased for large ones,
    with which it may not converge without damping.

    Args:
        unary, pair, mask: the tables, and the mask of present agents.
        iterations: number of message updates.
        damping: weight of the old log-message in the new one, in [0, 1).
    """
    unary, pair = settle(unary, pair, mask)
    batch, agents, count = unary.shape
    first, second = pairs(agents, unary.device)
    linked = (mask[:, first] & mask[:, second])[..., None]
    # Shifting every agent's lowest energy to zero changes neither log Z nor the marginals, but reduces rounding errors.
    lowest = _finite_or_zero(unary.detach().amin(2))
    local = lowest[..., None] - unary
    forth = back = unary.new_zeros(batch, len(first), count)
    for _ in range(iterations):
        from_first, from_second = _cavities(local, forth, back, first, second)
        sent_forth = _normalised(log_sum_exp(from_first[..., None] - pair, (2,)))
        sent_back = _normalised(log_sum_exp(from_second[..., None, :] - pair, (3,)))
        if damping:
            sent_forth = (1.0 - damping) * sent_forth + damping * forth
            sent_back = (1.0 - damping) * sent_back + damping * back
        # Messages from and to absent agents are exactly zero.
        forth, back = torch.where(linked, sent_forth, 0.0), torch.where(linked, sent_back, 0.0)
    belief = local + _inbox(forth, back, first, second, agents).sum(2)
    of_agents = log_sum_exp(belief, (2,))
    from_first, from_second = _cavities(local, forth, back, first, second)
    of_pairs = log_sum_exp(from_first[..., :, None] + from_second[..., None, :] - pair, (2, 3))
    degrees = torch.zeros_like(of_agents)
    degrees = degrees.index_add(1, first, linked[..., 0].to(unary)).index_add(1, second, linked[..., 0].to(unary))
    bethe = torch.where(linked[..., 0], _finite_or_zero(of_pairs), 0.0).sum(1) + (
        (1.0 - degrees) * _finite_or_zero(of_agents)
    ).sum(1)
    possible = of_agents.isfinite().all(1) & (of_pairs.isfinite() | ~linked[..., 0]).all(1)
    total = torch.where(possible, bethe - lowest.sum(1), -torch.inf)
    return belief - _finite_or_zero(of_agents)[..., None], total


def partition(
    unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"], mask: Bool[Tensor, "B N"]
) -> tuple[Float[Tensor, "B N C"], Float[Tensor, " B"]]:
    """log p(k_i) and log Z: exact where all assignments can be enumerated, from ten message updates elsewhere."""
    if enumerable(unary.shape[1], unary.shape[2]):
        return enumerate_(unary, pair, mask)
    return sum_product(unary, pair, mask)


def best(
    unary: Float[Tensor, "B N C"],
    pair: Float[Tensor, "B P C C"],
    mask: Bool[Tensor, "B N"],
    modes: int,
    states: Float[Tensor, "B C N K 4"] | None = None,
    apart: float = 0.0,
) -> tuple[Int[Tensor, "B M N"], Float[Tensor, "B M"]]:
    """The M joint assignments of lowest energy, lowest first; if fewer are possible, they are repeated in order.

    Exact up to :data:`LIMIT` assignments. Beyond that it is a beam search: agents are added one after the other, and the
    :data:`BEAM` partial assignments of lowest energy are kept.

    Args:
        unary, pair, mask: the tables, and the mask of present agents.
        modes: M.
        states: states of the candidates, for ``apart``.
        apart: distance [m], mean over agents and steps, between modes where possible: each further mode is the best of the
            assignments at this distance from all modes before, or the best of the others if there is none (DSDNet's
            suppression). Only the :data:`BEAM` best assignments are considered.
    """
    unary, pair = settle(unary, pair, mask)
    with torch.no_grad():
        _, agents, count = unary.shape
        if enumerable(agents, count):
            # Assignments are numbers of N digits in base C, the last agent's choice being the last digit.
            number = _all_energies(unary, pair).sort(dim=1, stable=True).indices[:, : max(BEAM, modes)]
            digit = torch.tensor([count ** (agents - 1 - agent) for agent in range(agents)], device=number.device)
            found = number[..., None] // digit.long() % count
        else:
            found = _beam(unary, pair)
        energy, order = energies(unary, pair, found).sort(dim=1, stable=True)
        found = found.gather(1, order[..., None].expand(-1, -1, agents))
        possible = energy < torch.inf
        if apart > 0 and states is not None:
            rank = _spread(found, possible, _distances(states, mask), modes, apart)
        else:
            rank = torch.arange(modes, device=unary.device) % possible.sum(1, keepdim=True).clamp_min(1)
        chosen = found.gather(1, rank[..., None].expand(-1, -1, agents))
    return chosen, energies(unary, pair, chosen)


def log_sum_exp(values: Float[Tensor, "..."], dims: tuple[int, ...]) -> Float[Tensor, "..."]:
    """log sum exp, with a gradient of zero where all entries are -inf (PyTorch's gradient is NaN there)."""
    top = _finite_or_zero(values.detach().amax(dims, keepdim=True))
    total = (values - top).exp().sum(dims)
    none = total == 0
    return torch.where(none, -torch.inf, torch.where(none, 1.0, total).log() + top.view(total.shape))


def _finite_or_zero(values: Tensor) -> Tensor:
    """The values with zero in place of infinities and NaN."""
    return torch.where(values.isfinite(), values, 0.0)


def _normalised(message: Float[Tensor, "B P C"]) -> Float[Tensor, "B P C"]:
    return message - _finite_or_zero(log_sum_exp(message, (2,)))[..., None]


@cache
def _numbers(agents: int) -> dict[tuple[int, int], int]:
    """Index of the pair of agents i < j, by (i, j)."""
    first, second = (side.tolist() for side in pairs(agents))
    return {both: number for number, both in enumerate(zip(first, second, strict=True))}


def _all_energies(unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"]) -> Float[Tensor, "B A"]:
    """E of all C^N joint assignments, the last agent's choice changing fastest."""
    batch, agents, count = unary.shape
    number = _numbers(agents)
    energy = unary.new_zeros(batch, 1)
    for agent in range(agents):
        energy = energy[..., None] + unary[:, None, agent]
        for other in range(agent):
            by_other = energy.view(batch, count**other, count, count ** (agent - 1 - other), count)
            cost = pair[:, number[other, agent]]
            energy = (by_other + cost[:, None, :, None, :]).view(batch, count**agent, count)
        energy = energy.flatten(1)
    return energy


def _inbox(forth: Tensor, back: Tensor, first: Tensor, second: Tensor, agents: int) -> Float[Tensor, "B N N C"]:
    """Messages by receiver and sender."""
    batch, _, count = forth.shape
    inbox = forth.new_zeros(batch, agents * agents, count)
    inbox = inbox.index_copy(1, second * agents + first, forth).index_copy(1, first * agents + second, back)
    return inbox.unflatten(1, (agents, agents))


def _cavities(
    local: Float[Tensor, "B N C"],
    forth: Float[Tensor, "B P C"],
    back: Float[Tensor, "B P C"],
    first: Tensor,
    second: Tensor,
) -> tuple[Float[Tensor, "B P C"], Float[Tensor, "B P C"]]:
    """The cavity beliefs of both agents of every pair: their beliefs without the message from the other one.

    They are sums over all other messages instead of differences, because inf - inf is NaN.
    """
    inbox = _inbox(forth, back, first, second, local.shape[1])
    none = torch.zeros_like(inbox[:, :, :1])
    before = torch.cat((none, inbox.cumsum(2)[:, :, :-1]), 2)
    after = torch.cat((inbox.flip(2).cumsum(2).flip(2)[:, :, 1:], none), 2)
    others = local[:, :, None] + before + after
    return others[:, first, second], others[:, second, first]


def _beam(unary: Float[Tensor, "B N C"], pair: Float[Tensor, "B P C C"]) -> Int[Tensor, "B A N"]:
    """Joint assignments of low energy, agent by agent."""
    batch, agents, count = unary.shape
    number = _numbers(agents)
    energy = unary.new_zeros(batch, 1)
    chosen = torch.zeros(batch, 1, 0, dtype=torch.long, device=unary.device)
    for agent in range(agents):
        cost = energy[..., None] + unary[:, None, agent]
        for other in range(agent):
            taken = chosen[..., other, None].expand(-1, -1, count)
            cost = cost + pair[:, number[other, agent]].gather(1, taken)
        energy, order = cost.flatten(1).sort(dim=1, stable=True)
        energy, order = energy[:, :BEAM], order[:, :BEAM]
        whose = (order // count)[..., None].expand(-1, -1, agent)
        chosen = torch.cat((chosen.gather(1, whose), (order % count)[..., None]), -1)
    return chosen


def _distances(states: Float[Tensor, "B C N K 4"], mask: Bool[Tensor, "B N"]) -> Float[Tensor, "B N C C"]:
    """Contributions of the agents to the mean distance of two joint assignments, by their candidates; zero if absent."""
    position = torch.where(mask[:, None, :, None, None], states[..., :2], 0.0).transpose(1, 2)
    steps = position.shape[3]
    # Candidate by candidate, because all at once would take C times the memory.
    way = [torch.linalg.vector_norm(position - one[:, :, None], dim=-1).sum(-1) for one in position.unbind(2)]
    return torch.stack(way, 2) / (steps * mask.sum(1).clamp_min(1))[:, None, None, None]


def _spread(
    found: Int[Tensor, "B A N"],
    possible: Bool[Tensor, "B A"],
    distances: Float[Tensor, "B N C C"],
    modes: int,
    apart: float,
) -> Int[Tensor, "B M"]:
    """Indices of the assignments that become modes, best first, at the distance ``apart`` where possible."""
    free, far = possible, torch.ones_like(possible)
    choices = found.transpose(1, 2)
    ranks: list[Tensor] = []
    for mode in range(modes):
        preferred = free & far
        # The first True of each row.
        pick = torch.where(preferred.any(1), preferred.int().argmax(1), free.int().argmax(1))
        if ranks:
            first = (mode % possible.sum(1).clamp_min(1)).clamp_max(mode - 1)
            again = torch.stack(ranks, 1).gather(1, first[:, None])[:, 0]
            pick = torch.where(free.any(1), pick, again)
        ranks.append(pick)
        taken = choices.gather(2, pick[:, None, None].expand(-1, choices.shape[1], 1))
        rows = distances.gather(2, taken[..., None].expand(-1, -1, 1, distances.shape[3]))[:, :, 0]
        far = far & (rows.gather(2, choices).sum(1) >= apart)
        free = free.scatter(1, pick[:, None], False)
    return torch.stack(ranks, 1)
