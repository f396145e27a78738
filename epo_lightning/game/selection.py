"""Selection of some games of a batch, so that NaN in the other games does not reach any gradient."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.scene import Scene

Function = Callable[[Scene, GameParameters, Tensor], tuple[Tensor, ...]]
"""(scene, parameters, controls) -> tensors [B, M, ...]."""


def games(parameters: GameParameters, scenes: Int[Tensor, " games"], modes: Int[Tensor, " games"]) -> GameParameters:
    """Some games of a batch, each as a scene with one mode: [B, M, ...] becomes [games, 1, ...].

    A tensor with one entry for all modes, [B, 1, ...], is used for every chosen mode.
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
    """A function's results for the chosen games, and zero for the others.

    Masking a NaN is not enough where it is differentiated, because zero times NaN is NaN. The function is therefore not
    evaluated for the other games.
    """
    scenes, modes = chosen.nonzero(as_tuple=True)
    some = function(scene[scenes], games(parameters, scenes, modes), controls[scenes, modes][:, None])
    return tuple(part.new_zeros(*chosen.shape, *part.shape[2:]).index_put((scenes, modes), part[:, 0]) for part in some)
