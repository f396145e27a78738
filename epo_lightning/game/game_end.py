"""Ends of games: the scenes of a batch may have games of different lengths (``Scene.game_steps``).

A game that ends after T steps has no cost at later steps: terms of the controls u_T, .., u_{K-1}, of their rates (including
the rate from u_{T-1} to u_T) and of the states x_{T+1}, .., x_K vanish, and the terms of goals are those of the state x_T.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.game.features import Source
from epo_lightning.host import readable
from epo_lightning.scene import Scene


def check_game_steps(scene: Scene, steps: int) -> None:
    """Check that every game ends within the K = ``steps`` steps of the controls. (Not on a GPU: the host would wait.)

    Raises:
        ValueError: a game that ends earlier or later; the message names the first such scene.
    """
    ends = scene.game_steps
    if ends is None or not readable(ends):
        return
    bad = (ends < 1) | (ends > steps)
    if bad.any():
        first = int(bad.nonzero()[0, 0])
        raise ValueError(
            f"scene.game_steps[{first}] is {int(ends[first])}: a game ends after 1 to K = {steps} steps, the steps of the "
            "controls"
        )


def free_controls(scene: Scene, steps: int) -> Bool[Tensor, "B N K"]:
    """Mask of the controls on which a game depends: those of present agents, before the end of the game."""
    present = scene.agent_mask[..., None].expand(-1, -1, steps)
    if scene.game_steps is None:
        return present
    return present & (torch.arange(steps, device=present.device) < scene.game_steps[:, None, None])


def residual_mask(source: Source, ends: Int[Tensor, " B"], steps: int) -> Bool[Tensor, "B 1 1 R"] | None:
    """Mask of the residuals of an own feature that belong to the game; None for features of the last state.

    Args:
        source: the declared source of the feature.
        ends: number of steps of every game.
        steps: number K of steps of the controls.
    """
    if source in (Source.FINAL_POSITION, Source.FINAL_HEADING):
        return None
    within = torch.arange(steps, device=ends.device) < ends[:, None, None, None]
    if source is Source.RATE:  # entry l is the rate from control l to control l + 1
        return within[..., 1:]
    return within.repeat_interleave(2, -1) if source is Source.POSITION else within  # x and y of every position


def at_end(values: Float[Tensor, "*lead B C N K X"], ends: Int[Tensor, " B"] | None) -> Float[Tensor, "*lead B C N X"]:
    """The entries of the last step of every game."""
    if ends is None:
        return values[..., -1, :]
    return torch.take_along_dim(values, (ends.long() - 1).view(*[1] * (values.dim() - 5), -1, 1, 1, 1, 1), -2)[
        ..., 0, :
    ]


def until(function: Callable[..., Tensor], ends: Int[Tensor, " E"] | None) -> Callable[..., Float[Tensor, "E *rest R"]]:
    """A function of trajectories, evaluated in every game on the steps up to its end only.

    Residuals of short games are followed by zeros, because a batch has the number R of residuals of its longest game. Games
    of equal length are evaluated together. The host waits for the lengths.

    Args:
        function: function of two tensors of steps [E, .., K, X], and of further tensors [E, ..], to residuals [E, .., R].
        ends: number of steps of the game in each of the E rows; None for all steps.
    """
    if ends is None:
        return function

    rows = {length: (ends == length).nonzero()[:, 0] for length in ends.unique().tolist()}
    missing = rows.pop(0, ends.new_zeros(0))
    order = torch.cat([*rows.values(), missing]).argsort()

    def shortened(*given: Tensor) -> Tensor:
        parts = []
        for length, row in rows.items():
            some = [tensor.index_select(0, row) if len(tensor) == len(ends) else tensor for tensor in given]
            some[:2] = [tensor[..., :length, :] for tensor in some[:2]]
            parts.append(function(*some))
        if not parts:
            return given[0][..., 0, :0]
        most = max(part.shape[-1] for part in parts)
        parts = [torch.nn.functional.pad(part, (0, most - part.shape[-1])) for part in parts]
        parts.append(parts[0].new_zeros(len(missing), *parts[0].shape[1:]))
        return torch.cat(parts).index_select(0, order)

    return shortened
