"""Optimisers and learning-rate schedules by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from epo_lightning.checks import check_choice, check_number
from epo_lightning.registry import ConfigError, register

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
        shared_factor: the learning rate of cost weights that all scenes share is ``lr`` times this factor
            (:class:`~epo_lightning.decoders.weights.SharedWeights`). Other numbers, such as a temperature, keep ``lr``.
            A step of Adam changes every number by about its learning rate, whatever the gradient is; a few numbers that
            all scenes determine can take longer steps than a network.
        schedule: ``constant`` or ``cosine``.
        clip: largest norm of the gradient; longer gradients are scaled down to it (gradient clipping); None for no limit.
    """

    lr: float = 5e-5
    shared_factor: float = 1.0
    schedule: str = "constant"
    clip: float | None = None

    def __post_init__(self) -> None:
        check_number("optimizer.lr", self.lr)
        check_number("optimizer.shared_factor", self.shared_factor)
        check_number("optimizer.clip", self.clip, finite=False, null=True)
        check_choice("optimizer.schedule", self.schedule, _SCHEDULES)

    def configure(
        self, parameters: Iterable[nn.Parameter], total_steps: float, shared: Sequence[nn.Parameter] = ()
    ) -> dict[str, Any]:
        """Optimizer and schedule for Lightning's ``configure_optimizers``.

        Args:
            parameters: the parameters to learn.
            total_steps: number of steps that the schedule lasts.
            shared: those of ``parameters`` whose learning rate is multiplied by ``shared_factor``.

        Raises:
            ConfigError: ``shared_factor`` would have no effect.
        """
        if self.shared_factor != 1 and not shared:
            raise ConfigError(
                f"optimizer.shared_factor={self.shared_factor:g} has no effect: this forecaster has no cost weights that "
                "all scenes share. Set it to 1, or share weights: forecaster.own_weights=shared, or pair_weights"
            )
        # fused: one call for all parameters, not a dozen for each
        adam = torch.optim.Adam(self._groups(parameters, shared), lr=self.lr, fused=True)
        shape = _SCHEDULES[self.schedule]
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: shape(step / total_steps))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _groups(self, parameters: Iterable[nn.Parameter], shared: Sequence[nn.Parameter]) -> list[dict[str, Any]]:
        if self.shared_factor == 1:
            return [{"params": parameters}]
        faster = {id(parameter) for parameter in shared}
        others = [parameter for parameter in parameters if id(parameter) not in faster]
        fast: dict[str, Any] = {"params": shared, "lr": self.lr * self.shared_factor}
        return [{"params": others}, fast] if others else [fast]
