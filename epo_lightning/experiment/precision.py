"""Precisions of a run (``trainer.precision``), by Lightning's names."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch.plugins import DoublePrecision, Precision
from torch import nn

from epo_lightning.backbones.base import Backbone


class Double(DoublePrecision):
    """Lightning's double precision, extended to scenes: its own conversion refuses frozen data classes."""

    def convert_input(self, data: Any) -> Any:
        return data.to(torch.double)


class Mixed(Precision):
    """Backbones in bfloat16, all else in single precision.

    Lightning's own plugin would also round the games and their solvers, which factorise matrices: 16 bits have too few
    digits for that. Weights, gradients and optimizer keep 32 bits.
    """

    precision = "bf16-mixed"

    def convert_module(self, module: nn.Module) -> nn.Module:
        for part in module.modules():
            if isinstance(part, Backbone):
                part.rounded_to = torch.bfloat16
        return module


PLUGINS: dict[str, type[Precision]] = {"32-true": Precision, "64-true": Double, "bf16-mixed": Mixed}
"""Lightning's plugin of each precision that a run may have."""
