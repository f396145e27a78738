"""A stand-in for CUDA graphs, for tests without a GPU."""

from __future__ import annotations

from typing import Any

import torch


class Again:
    """Stand-in for a recorder: a replay computes the step again and overwrites the tensors of its first result."""

    def __init__(self, device: torch.device) -> None:
        self.runs = self.replays = 0

    def run(self, step: Any) -> Any:
        self.runs += 1
        return step()

    def record(self, step: Any) -> Any:
        kept: list[Any] = []

        def replay() -> Any:
            self.replays += 1
            found = step()
            if not kept:
                kept.append(found)
            kept[0].losses.copy_(found.losses)
            for static, gradient in zip(kept[0].gradients, found.gradients, strict=True):
                if static is not None:
                    static.copy_(gradient)
            return kept[0]

        return replay
