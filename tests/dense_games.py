"""Games of features and of networks, for dense solvers."""

from __future__ import annotations

import dataclasses

import torch
from games import random_game, random_scene
from torch import nn

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pair_mask

FEATURES = FeatureEnergy(["goal", "vel", "acc", "turnr"], ["proximity"])


def feature_game(scenes=2, agents=3, modes=2, horizon=5):
    """Agents that overlap, and a game that has a minimum."""
    scene = random_scene(scenes, agents, history=2, size=2.0, dtype=torch.float64)
    scene = dataclasses.replace(scene, dt=0.3)
    return scene, dataclasses.replace(random_game(scene, modes, horizon, FEATURES.own, spread=0.1), reference=None)


class Learned(Energy):
    """A network's energy: convex in the controls, and with weights that its minimum depends on."""

    offers = frozenset({GRADIENT})
    own, pair = ("net", "acc"), ("near",)
    dynamics = Unicycle()

    def __init__(self):
        self.net = nn.Linear(4, 3).double()
        self.touch = nn.Linear(2, 1).double()

    def own_terms(self, scene, parameters, states, controls):
        context = torch.where(scene.agent_mask[..., None], parameters.context, 0.0)[:, None, :, None]
        features = torch.cat((controls, context.expand(*controls.shape[:-1], 2)), -1)
        net = nn.functional.softplus(self.net(features)).sum((-1, -2))
        return {"net": torch.where(scene.agent_mask[:, None], net, 0.0), "acc": 0.5 * controls.square().sum((-1, -2))}

    def pair_terms(self, scene, parameters, first, second):
        way = (first - second)[..., :2].square().sum(-1, keepdim=True)
        near = nn.functional.softplus(self.touch(torch.cat((way, (1.0 + way).sqrt()), -1))).sum((-1, -2))
        return {"near": torch.where(pair_mask(scene)[:, None], 0.01 * near, 0.0)}


def learned_game():
    scene, game = feature_game()
    return scene, dataclasses.replace(game, context=torch.randn(2, 3, 2, dtype=torch.float64))
