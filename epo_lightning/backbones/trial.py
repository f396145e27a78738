"""A trial call of a backbone, which tells what is wrong with it before a training begins."""

from __future__ import annotations

import torch

from epo_lightning.backbones.base import Backbone
from epo_lightning.registry import ConfigError, failing_place, kind_and_message, place
from epo_lightning.scene import Scene
from epo_lightning.task import Task

SCENES, AGENTS, LANES, VECTORS = 2, 3, 4, 5
"""Sizes of the trial scenes, all different, so that mixed dimensions are errors."""
HISTORY = 10
"""Observed steps where the task does not know their number."""


def trial_scene(task: Task) -> Scene:
    """Random scenes with all fields of a task that backbones read, the same at every call."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> torch.Tensor:
        return task.scale * (2.0 * torch.rand(*shape, generator=generator) - 1.0)

    history = drawn(SCENES, AGENTS, task.history or HISTORY, 4)
    goals = drawn(SCENES, AGENTS, task.candidates, 2) if task.candidates else None
    lanes = drawn(SCENES, LANES, VECTORS, 4) if task.map else None
    kind = torch.zeros(SCENES, AGENTS, dtype=torch.long)
    return Scene(history, task.dt, goal_candidates=goals, lanes=lanes, size=torch.ones(SCENES, AGENTS, 2), kind=kind)


def try_backbone(backbone: Backbone, task: Task) -> None:
    """Call a backbone once, without an effect on random states or on its weights. Lazy layers get their sizes.

    Raises:
        ConfigError: an exception in its ``forward``, features of another shape, or learned weights that none of its
            features depends on.
    """
    training = [module for module in backbone.modules() if module.training]
    name = type(backbone).__name__
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        try:
            z = backbone.eval()(trial_scene(task))
        except ConfigError:
            raise
        except Exception as error:
            raise ConfigError(
                f"the backbone {name} fails at {failing_place(error, type(backbone))} on trial scenes of {AGENTS} agents: "
                f"{kind_and_message(error)}; --traceback shows more"
            ) from error
        finally:
            for module in training:
                module.training = True
    if any(weights.requires_grad for weights in backbone.parameters()) and not z.requires_grad:
        raise ConfigError(
            f"the backbone {name} ({place(type(backbone))}) would not learn: its features do not depend on its "
            "weights, because they are detached, as by detach(), torch.no_grad() or numpy. Freeze weights that must not "
            "learn by requires_grad_(False)"
        )
