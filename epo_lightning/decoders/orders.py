"""Orders as modes: the agent of every pair that goes first, or the side on which they pass (TGL's subspace predictor).

A game that is convex given the orders has one solution for each of them, so the joint modes are the M most likely orders.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn
from torch.nn import functional as F

from epo_lightning.decoders.mlp import MLP
from epo_lightning.game.pairs import of_pairs, pairs


class DecodedOrders(NamedTuple):
    """The M most likely orders of all pairs.

    Attributes:
        order: +1 or -1 for every pair and mode.
        log_probability: log-probability of every mode's order.
        logits: logit of every pair's order being +1, zero for pairs whose order does not matter.
    """

    order: Float[Tensor, "B M P"]
    log_probability: Float[Tensor, "B M"]
    logits: Float[Tensor, "B P"]


class Orders(nn.Module):
    """phi_order: probability that the order of a pair is +1, from the features of both agents; one network for all pairs.

    p(s_ij = +1) = sigmoid(l_ij), and pairs are independent of each other given the features. If the order says which agent
    goes first, it changes its sign when the two agents are swapped, so the logit is l_ij = f(z_i, z_j) - f(z_j, z_i). If it
    says on which side they pass, it does not change, and the logit is l_ij = f(z_i, z_j) + f(z_j, z_i).

    Args:
        width: size of the agent features.
        variants: number of choices of orders: one for each mode, or a single one.
        symmetric: whether the order keeps its sign when the two agents are swapped
            (:attr:`~epo_lightning.game.pair_order.PairOrder.symmetric`).
    """

    def __init__(self, width: int, variants: int, symmetric: bool = False) -> None:
        super().__init__()
        if variants < 1:
            raise ValueError(f"the number of variants must be 1 or more, not {variants}")
        self.variants, self.symmetric = variants, symmetric
        self.mlp = MLP(2 * width, 64, 1, norm="layer", bias=symmetric)  # the difference cancels a bias

    def forward(
        self, z: Float[Tensor, "B N D"], mask: Bool[Tensor, "B N"], matter: Bool[Tensor, "B P"]
    ) -> DecodedOrders:
        """The M most likely orders with their log-probabilities and logits.

        Args:
            z: features of the agents.
            mask: agents that are present.
            matter: pairs whose order matters (:meth:`~epo_lightning.game.pair_order.PairOrder.matters`); others keep +1 and
                do not count in the probability.
        """
        first, second = pairs(z.shape[1], z.device)
        z = torch.where(mask[..., None], z, 0.0)
        agents = of_pairs(z)
        forth, back = (self.mlp(ends.flatten(-2))[..., 0] for ends in (agents, agents.flip(-2)))
        matter = matter & mask[:, first] & mask[:, second]
        logits = torch.where(matter, forth + back if self.symmetric else forth - back, 0.0)
        order = most_likely(logits, matter, self.variants)
        log_probability = torch.where(matter[:, None], F.logsigmoid(order * logits[:, None]), 0.0).sum(-1)
        return DecodedOrders(order, log_probability, logits)


def repeated(modes: Shaped[Tensor, "B M D"]) -> Bool[Tensor, "B M"]:
    """Mask of the modes that repeat the choices of an earlier mode, which happens if there are fewer than M choices.

    Repeated modes get a probability of zero, so that no outcome is counted twice.
    """
    same = (modes[:, :, None] == modes[:, None]).all(-1)
    return same.tril(-1).any(-1)


@torch.no_grad()
def most_likely(logits: Float[Tensor, "B P"], matter: Bool[Tensor, "B P"], modes: int) -> Float[Tensor, "B M P"]:
    """The M most likely orders of independent pairs, most likely first; where there are fewer, they repeat in turn.

    The most likely order has the sign of every logit. Turning the sign of a pair lowers the log-probability by |l|. The M
    sets of turned signs with the lowest total cost are found pair by pair: each of the M best sets of the first p pairs is
    one of the M best sets of the first p - 1 pairs, with or without pair p. Pairs that do not matter keep +1.
    """
    batch, count = logits.shape
    cost = logits.new_full((batch, modes), torch.inf)
    cost[:, 0] = 0.0
    turned = torch.zeros(batch, modes, count, dtype=torch.bool, device=logits.device)
    price = torch.where(matter, logits.abs(), torch.inf)
    for pair in range(count):
        both = torch.cat((cost, cost + price[:, pair, None]), 1)
        cost, kept = both.sort(dim=1, stable=True)
        cost, kept = cost[:, :modes], kept[:, :modes]
        turned = turned.gather(1, (kept % modes)[..., None].expand_as(turned))
        turned[:, :, pair] = kept >= modes
    rank = torch.arange(modes, device=logits.device) % (cost < torch.inf).sum(1, keepdim=True)
    turned = turned.gather(1, rank[..., None].expand_as(turned))
    likeliest = torch.where(matter & (logits < 0), -1.0, 1.0).to(logits.dtype)[:, None]
    return torch.where(turned, -likeliest, likeliest)


def order_loss(
    logits: Float[Tensor, "B P"], order: Float[Tensor, "B P"], known: Bool[Tensor, "B P"]
) -> Float[Tensor, ""]:
    """Cross entropy of the observed orders: mean over scenes of the mean over pairs whose order is known."""
    entropy = torch.where(known, -F.logsigmoid(order * torch.where(known, logits, 0.0)), 0.0)
    return (entropy.sum(-1) / known.sum(-1).clamp_min(1)).mean()
