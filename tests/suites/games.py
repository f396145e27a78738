"""Games for any energy: the fields that it needs, and the same game padded or with its agents in another order."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from games import pad, random_scene, reordered, widen

from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import Energy
from epo_lightning.registry import build
from epo_lightning.scene import Scene

WIDTH, HORIZON, MODES = 8, 6, 2


def build_energy(config: dict[str, Any], dynamics: Any = None) -> Energy:
    """An energy in float64, for a horizon of ``HORIZON`` steps and features of size ``WIDTH``."""
    torch.manual_seed(2)
    dynamics = Unicycle() if dynamics is None else dynamics
    energy = build("energy", config, dynamics=dynamics, width=WIDTH, horizon=HORIZON, scale=1.0, shape="disc")
    return energy.double() if isinstance(energy, torch.nn.Module) else energy


def game_of(energy: Energy, scenes: int = 3, agents: int = 3, starts: int = MODES) -> tuple[Scene, GameParameters]:
    """Agents within a few metres of each other, with random weights and all fields that the energy needs."""
    torch.manual_seed(3)
    scene = random_scene(scenes, agents, history=2, horizon=HORIZON, size=1.0, dtype=torch.float64)
    own, pair = energy.weighted
    count = agents * (agents - 1) // 2

    def weight(entries: int) -> torch.Tensor:
        return 0.5 + torch.rand(scenes, MODES, entries, dtype=torch.float64)

    parameters = GameParameters(
        own_weights={name: weight(agents) for name in own},
        pair_weights={name: weight(count) for name in pair},
        initial_controls=0.5 * torch.randn(scenes, starts, agents, HORIZON, 2, dtype=torch.float64),
        goals=torch.randn(scenes, MODES, agents, 2, dtype=torch.float64) if "goals" in energy.needs else None,
        reference=torch.randint(2, (scenes, MODES, agents)) if "reference" in energy.needs else None,
        context=torch.randn(scenes, agents, WIDTH, dtype=torch.float64) if "context" in energy.needs else None,
        order=torch.randn(scenes, MODES, count).sign().double() if "order" in energy.needs else None,
        goal_headings=torch.randn(scenes, MODES, agents, dtype=torch.float64)
        if "goal_headings" in energy.needs
        else None,
        margins={name: weight(count) for name in energy.decoded_margins},
        reference_controls=0.5 * torch.randn(scenes, MODES, agents, HORIZON, 2, dtype=torch.float64)
        if "reference_controls" in energy.needs
        else None,
    )
    return scene, parameters


def padded(scene: Scene, parameters: GameParameters, filling: float, agents: int = 2) -> tuple[Scene, GameParameters]:
    """Game with absent agents appended, whose values are ``filling`` in every tensor."""
    return pad(scene, agents, filling=filling), widen(parameters, agents, filling)


def in_order(
    energy: Energy, scene: Scene, parameters: GameParameters, agents: list[int]
) -> tuple[Scene, GameParameters]:
    """Game with its agents in another order."""
    first, second = torch.triu_indices(len(agents), len(agents), 1)

    def pairs(tensor: torch.Tensor | None, swapped: float = 1.0) -> torch.Tensor | None:
        if tensor is None:
            return None
        table = tensor.new_zeros(*tensor.shape[:2], len(agents), len(agents))
        table[:, :, first, second] = tensor
        table[:, :, second, first] = swapped * tensor
        return table[:, :, agents][:, :, :, agents][:, :, first, second]

    pair_order = energy.pair_order
    changes = dict.fromkeys(("goals", "goal_headings", "reference", "initial_controls", "reference_controls"))
    moved = {name: value[:, :, agents] for name in changes if (value := getattr(parameters, name)) is not None}
    return reordered(scene, agents), dataclasses.replace(
        parameters,
        **moved,
        own_weights={name: weight[:, :, agents] for name, weight in parameters.own_weights.items()},
        pair_weights={name: pairs(weight) for name, weight in parameters.pair_weights.items()},
        margins={name: pairs(margin) for name, margin in parameters.margins.items()},
        context=None if parameters.context is None else parameters.context[:, agents],
        order=pairs(parameters.order, 1.0 if pair_order is None or pair_order.symmetric else -1.0),
    )


def poisoned(scene: Scene) -> Scene:
    """Scenes of which the second has nan as the present states of its agents."""
    history = scene.history.clone()
    history[1, :, -1] = torch.nan
    return dataclasses.replace(scene, history=history)
