"""From marginal predictions, one distribution per agent, to joint ones."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def marginal_to_joint(
    states: Float[Tensor, "B M N K X"], agent_probabilities: Float[Tensor, "B M N"]
) -> tuple[Float[Tensor, "B M N K X"], Float[Tensor, "B M N"]]:
    """Order every agent's modes by decreasing probability: joint mode k is everyone's k-th most likely one.

    This is how the joint metrics of a marginal forecaster are defined (Section 5, Metrics). Equally likely modes keep
    their order.

    Args:
        states: the modes of each agent, not belonging together yet.
        agent_probabilities: of each agent's own modes.

    Returns:
        The states and the probabilities in the new order.
    """
    order = agent_probabilities.argsort(dim=1, descending=True, stable=True)
    index = order[..., None, None].expand(-1, -1, -1, *states.shape[-2:])
    return states.gather(1, index), agent_probabilities.gather(1, order)
