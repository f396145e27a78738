"""Pair features that depend on the order of the two agents define no potential game and are refused."""

from __future__ import annotations

import pytest
import torch

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import PAIR_FEATURES, Source, pair_feature
from epo_lightning.game.neural_energy import NeuralEnergy
from epo_lightning.registry import ConfigError


@pytest.fixture(autouse=True)
def forgotten():
    before = set(PAIR_FEATURES)
    yield
    for name in set(PAIR_FEATURES) - before:
        del PAIR_FEATURES[name]


def distance(first, second):
    return (first[..., :2] - second[..., :2]).norm(dim=-1)


def behind(first, second):
    """A cost of the first agent alone: to keep five metres from the agent ahead of it."""
    heading = torch.stack((first[..., 2].cos(), first[..., 2].sin()), -1)
    ahead = ((second[..., :2] - first[..., :2]) * heading).sum(-1)
    return torch.relu(5.0 - ahead) * (ahead > 0) * (distance(first, second) < 5.0)


ASYMMETRIC = {
    "behind": behind,
    "yields": lambda first, second: torch.relu(2.0 - distance(first, second)) * first[..., 3],
    "one speed": lambda first, second: first[..., 3],
    "order": lambda first, second: torch.relu(first[..., 0] - second[..., 0]),
    "hardly": lambda first, second: distance(first, second) + 1e-4 * first[..., 3],
}
SYMMETRIC = {
    "both ways": lambda first, second: torch.cat((behind(first, second), behind(second, first)), -1),
    "apart": lambda first, second: torch.exp(-distance(first, second)),
    "difference": lambda first, second: first[..., 3] - second[..., 3],  # changes its sign, which squares do not see
    "final": lambda first, second: first[..., -1, :2] - second[..., -1, :2],
    "broken": lambda first, second: first[..., 0] * torch.nan,
    "pole": lambda first, second: (1.0 / (first[..., 2] * 0.0)).sum(-1, keepdim=True),
}


@pytest.mark.parametrize("name", ASYMMETRIC)
def test_features_that_depend_on_the_order_are_refused(name):
    pair_feature(name)(ASYMMETRIC[name])
    with pytest.raises(
        ConfigError, match=f"pair feature '{name}' is not symmetric.*the game has no potential.*a_i > 0"
    ):
        FeatureEnergy(["acc"], [name])
    with pytest.raises(ConfigError, match=f"'{name}' is not symmetric"):
        NeuralEnergy(Unicycle(), 4, 5, 1.0, pair=["proximity", name])


@pytest.mark.parametrize("name", SYMMETRIC)
def test_symmetric_features_are_accepted(name):
    pair_feature(name)(SYMMETRIC[name])
    assert FeatureEnergy(["acc"], [name]).pair == [name]


def test_sizes_are_swapped_with_their_agents():
    @pair_feature("sum", needs="size")
    def sum_of_sizes(first, second, first_size, second_size):
        return torch.relu(first_size[..., 0] + second_size[..., 0] - distance(first, second))

    @pair_feature("mine", needs="size")
    def mine(first, second, first_size, second_size):
        return torch.relu(3.0 * first_size[..., 0] - distance(first, second))

    assert FeatureEnergy(["acc"], ["sum"]).pair == ["sum"]
    with pytest.raises(ConfigError, match="'mine' is not symmetric"):
        FeatureEnergy(["acc"], ["mine"])


def test_the_built_in_features_are_symmetric():
    assert any(feature.source is Source.STEP for feature in PAIR_FEATURES.values())
    assert all(feature.asymmetry is None for feature in PAIR_FEATURES.values())


def test_a_function_is_tried_once_and_draws_nothing():
    calls = []

    @pair_feature("counted")
    def counted(first, second):
        calls.append(first)
        return distance(first, second)

    before = torch.get_rng_state()
    for _ in range(3):
        FeatureEnergy(["acc"], ["counted"])
    assert len(calls) == 8, "two for the order of the agents, and six for the function itself"
    assert (torch.get_rng_state() == before).all()
