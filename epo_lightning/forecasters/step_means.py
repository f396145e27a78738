"""Means over the training steps of an epoch."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


class StepMeans:
    """Means of the losses over the scenes of an epoch, by name.

    A step adds to one tensor. Lightning's ``self.log`` would take about 7 % of a training step on a CPU.
    """

    def __init__(self) -> None:
        self._sums: dict[tuple[str, ...], tuple[Tensor, int]] = {}

    def reset(self) -> None:
        """Forget all steps."""
        self._sums.clear()

    def add(self, values: Mapping[str, Tensor], scenes: int) -> None:
        """Add the values of one step.

        Args:
            values: numbers by name, in tensors of one element; they are not kept, so that they may change in place.
            scenes: number of scenes of the step, over which each value is a mean.
        """
        names = tuple(values)
        sums = torch.stack([value.detach().reshape(()) for value in values.values()]) * scenes
        if names in self._sums:
            before, scenes_before = self._sums[names]
            sums, scenes = before + sums, scenes_before + scenes
        self._sums[names] = sums, scenes

    def totals(self) -> dict[str, tuple[Tensor, int]]:
        """The sum over the scenes of all steps since the last reset, and the number of scenes, of every name.

        A name that some steps lack counts the scenes of the others.
        """
        totals: dict[str, tuple[Tensor, int]] = {}
        for names, (sums, scenes) in self._sums.items():
            for name, value in zip(names, sums, strict=True):
                before, scenes_before = totals.get(name, (torch.zeros_like(value), 0))
                totals[name] = before + value, scenes_before + scenes
        return totals

    def means(self) -> dict[str, Tensor]:
        """The means of all steps since the last reset; empty if there was none."""
        return {name: total / scenes for name, (total, scenes) in self.totals().items()}
