"""Optimisers and learning-rate schedules by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from epo_lightning.registry import ConfigError, nearest, register

_SCHEDULES: dict[str, Callable[[float], float]] = {
    "constant": lambda progress: 1.0,
    "cosine": lambda progress: 0.5 * (1.0 + math.cos(math.pi * min(progress, 1.0))),
}


@register("optimizer", "adam")
@dataclass(frozen=True)
class Adam:
    """Adam (Appendix E.4), at a constant learning rate as in the paper or with cosine decay to zero.

    Attributes:
        lr: learning rate.
        schedule: ``constant`` or ``cosine``.
        clip: largest norm of the gradient; longer gradients are scaled down to it (gradient clipping); None for no limit.
    """

    lr: float = 5e-5
    schedule: str = "constant"
    clip: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.lr < float("inf"):
            raise ConfigError(f"optimizer.lr must be positive and finite, not {self.lr}")
        if self.clip is not None and not self.clip > 0:
            raise ConfigError(f"optimizer.clip must be positive or null, not {self.clip}")
        if self.schedule not in _SCHEDULES:
            raise ConfigError(f"unknown optimizer.schedule {self.schedule!r}: {nearest(self.schedule, _SCHEDULES)}")

    def configure(self, parameters: Iterable[nn.Parameter], total_steps: float) -> dict[str, Any]:
        """Optimizer and schedule for Lightning's ``configure_optimizers``; the schedule lasts ``total_steps`` steps."""
        adam = torch.optim.Adam(parameters, lr=self.lr, fused=True)  # one call for all parameters, not a dozen for each
        shape = _SCHEDULES[self.schedule]
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: shape(step / total_steps))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
