"""Random games that are convex given the order."""

from __future__ import annotations

import dataclasses

import torch
from games import random_game, random_scene, widen

from epo_lightning.forecast import GameParameters
from epo_lightning.game.convex_energy import ConvexEnergy
from epo_lightning.scene import Scene

OWN = ("goal", "lateral", "velref", "lat_vel", "acc", "lat_acc", "jerk", "lat_jerk")
"""Every own term."""


class Unaware(ConvexEnergy):
    """Convex energy without its closed-form Hessian, so that solvers use automatic differentiation."""

    hessian = None


def unaware(energy: ConvexEnergy) -> Unaware:
    return Unaware(energy.own, energy.pair, energy.gap, energy.direction, energy.within, energy.dynamics, energy.lane)


def convex_energy(
    own=OWN, direction: str = "along", gap: float = 0.5, within: float = 5.0, pair=("order",), lane=None
) -> ConvexEnergy:
    return ConvexEnergy(list(own), list(pair), gap, direction, within, lane=lane)


def convex_game(
    scenes: int = 2, agents: int = 3, modes: int = 2, horizon: int = 6, dtype: torch.dtype = torch.float64
) -> tuple[Scene, GameParameters]:
    """Agents within a few metres of each other, and orders at random."""
    scene = random_scene(scenes, agents, history=2, dtype=dtype)
    game = random_game(scene, modes, horizon, own=OWN)
    weight = game.pair_weights["proximity"]
    order = torch.where(torch.rand_like(weight) < 0.5, -1.0, 1.0).to(dtype)
    return scene, dataclasses.replace(game, pair_weights={"order": weight}, order=order, reference=None)


def widen_convex(parameters: GameParameters, agents: int, filling: float = float("nan")) -> GameParameters:
    """The game of a scene that ``pad`` gave absent agents."""
    wide = widen(parameters, agents, filling)
    as_weight = widen(dataclasses.replace(parameters, pair_weights={"order": parameters.order}), agents, filling)
    return dataclasses.replace(wide, order=as_weight.pair_weights["order"])
