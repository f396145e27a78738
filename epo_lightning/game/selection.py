"""Some of a batch's games on their own, so that what is wrong with the others stays out of every graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.scene import GameParameters, Scene

Function = Callable[[Scene, GameParameters, Tensor], tuple[Tensor, ...]]
"""(scene, parameters, controls) -> tensors [B, M, ...]."""


def games(parameters: GameParameters, scenes: Int[Tensor, " S"], modes: Int[Tensor, " S"]) -> GameParameters:
    """S games of a batch, each as that of a scene with one mode: [B, M, ...] becomes [S, 1, ...].

    Where one game serves all modes, that one is taken.
    """
    context = parameters.context
    chosen = dataclasses.replace(parameters, context=None).map(
        lambda tensor: tensor[scenes, modes.clamp_max(tensor.shape[1] - 1)][:, None]
    )
    return dataclasses.replace(chosen, context=None if context is None else context[scenes])


def evaluated(
    function: Function,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    chosen: Bool[Tensor, "B M"],
) -> tuple[Tensor, ...]:
    """What a function returns for the chosen games, and zero for the others.

    Masking a value that is no number is not enough where it is differentiated: zero times NaN is NaN. Games that are not
    chosen are therefore not looked at.
    """
    scenes, modes = chosen.nonzero(as_tuple=True)
    some = function(scene[scenes], games(parameters, scenes, modes), controls[scenes, modes][:, None])
    return tuple(part.new_zeros(*chosen.shape, *part.shape[2:]).index_put((scenes, modes), part[:, 0]) for part in some)
