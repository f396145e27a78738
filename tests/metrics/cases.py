"""Random scenes for the tests of metrics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from hypothesis import strategies as st
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.scene import Scene


@dataclass
class Case:
    """Tensors of one random batch, float64."""

    states: Tensor
    probabilities: Tensor
    agent_probabilities: Tensor
    future: Tensor
    mask: Tensor
    agent_mask: Tensor
    size: Tensor

    def forecast(self, initial: bool = False) -> JointForecast:
        return JointForecast(self.states, self.probabilities, initial_states=self.states + 0.1 if initial else None)

    def scene(self, subset: Tensor | None = None) -> Scene:
        return Scene(
            history=self.future[:, :, :1],
            dt=0.1,
            agent_mask=self.agent_mask,
            future=self.future,
            future_mask=self.mask,
            size=self.size,
            subset=subset,
        )


def make_case(seed: int, scenes: int = 3, modes: int = 2, agents: int = 3, steps: int = 4) -> Case:
    """Agents of 0.5 to 2.5 m, crowded enough that about half of the scenes overlap; garbage behind the masks."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random, dtype=torch.float64)

    span = 3.0 * agents**0.5
    states = uniform(scenes, modes, agents, steps, 4) * torch.tensor([span, span, 6.3, 2.0])
    future = uniform(scenes, agents, steps, 4) * torch.tensor([span, span, 6.3, 2.0])
    agent_mask = uniform(scenes, agents) < 0.8
    mask = (uniform(scenes, agents, steps) < 0.7) & agent_mask[..., None]
    future[~mask] = torch.nan
    return Case(
        states=states.masked_fill(~agent_mask[:, None, :, None, None], torch.nan),
        probabilities=uniform(scenes, modes).softmax(-1),
        agent_probabilities=uniform(scenes, modes, agents).softmax(1),
        future=future,
        mask=mask,
        agent_mask=agent_mask,
        size=0.5 + 2 * uniform(scenes, agents, 2),
    )


cases = st.builds(
    make_case,
    seed=st.integers(0, 2**31),
    scenes=st.integers(1, 5),
    modes=st.integers(1, 4),
    agents=st.integers(1, 4),
    steps=st.integers(1, 5),
)
