"""Joint predictions from marginal ones, which have one distribution per agent."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def marginal_to_joint(
    states: Float[Tensor, "B M N K X"], agent_probabilities: Float[Tensor, "B M N"], *others: Float[Tensor, "B M N"]
) -> tuple[Float[Tensor, "B M N K X"] | Float[Tensor, "B M N"], ...]:
    """Order every agent's modes by decreasing probability, so that joint mode k is every agent's k-th most likely mode.

    The joint metrics of a marginal forecaster are defined like this (Section 5, Metrics). Equally likely modes keep
    their order.

    Args:
        states: the modes of each agent, independent of those of the other agents.
        agent_probabilities: each agent's probabilities of its own modes.
        others: further values of the modes, such as logits.

    Returns:
        The states, the probabilities and the other values in the new order.

    Example:
        >>> import torch
        >>> states = torch.tensor([[1.0, 2.0], [3.0, 4.0]]).view(1, 2, 2, 1, 1)  # modes 1, 3 and 2, 4 of two agents
        >>> probabilities = torch.tensor([[[0.9, 0.2], [0.1, 0.8]]])
        >>> states, probabilities = marginal_to_joint(states, probabilities)
        >>> states.flatten(1), probabilities
        (tensor([[1., 4., 3., 2.]]), tensor([[[0.9000, 0.8000],
                 [0.1000, 0.2000]]]))
    """
    order = agent_probabilities.argsort(dim=1, descending=True, stable=True)
    index = order[..., None, None].expand(-1, -1, -1, *states.shape[-2:])
    return states.gather(1, index), *(values.gather(1, order) for values in (agent_probabilities, *others))
