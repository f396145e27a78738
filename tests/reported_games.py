"""Games and forecasts whose equilibria are reported."""

from __future__ import annotations

import torch

from epo_lightning.forecast import JointForecast, Solution
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium

OWN = ("goal", "acc", "turnr")


STEPS = 7


class Opaque(Energy):
    """A feature energy that does not declare its features, so that no solver knows its structure."""

    offers = frozenset({GRADIENT})

    def __init__(self, features: FeatureEnergy) -> None:
        self.features, self.own, self.pair, self.dynamics = features, features.own, features.pair, features.dynamics

    def own_terms(self, scene, parameters, states, controls):
        return self.features.own_terms(scene, parameters, states, controls)

    def pair_terms(self, scene, parameters, first, second):
        return self.features.pair_terms(scene, parameters, first, second)


class Valued(Opaque):
    """An energy without derivatives."""

    offers = frozenset()


def forecast_of(energy, scene, parameters, controls, probabilities=None, **solution) -> JointForecast:
    """The forecast of these strategies."""
    states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
    shape = controls.shape[:2]
    value = torch.zeros(shape, dtype=controls.dtype)
    found = Solution(controls, states, value - 7.0, value, value, value.long(), **solution)
    if probabilities is None:
        probabilities = torch.full(shape, 1.0 / shape[1], dtype=controls.dtype)
    return JointForecast(states, probabilities, parameters=parameters, solution=found)


def report(energy, scene, parameters, controls, **options):
    return equilibrium(energy, scene, forecast_of(energy, scene, parameters, controls, **options))


def value(tables, mask, b, choice, without=None):
    """E of a joint choice in scene b, without the terms that an agent has no part in."""
    agents = [i for i in range(mask.shape[1]) if mask[b, i]]
    total = sum(tables.unary[b, i, choice[i]].item() for i in agents if without in (None, i))
    for p, (i, j) in enumerate(zip(*(index.tolist() for index in pairs(mask.shape[1])), strict=True)):
        if i in agents and j in agents and without in (None, i, j):
            total += tables.pair[b, p, choice[i], choice[j]].item()
    return total
