"""Decoders of :class:`~epo_lightning.forecasters.epo.EPO`: for every part of a game, the one that the settings choose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from epo_lightning.decoders.goals import GivenGoals, GoalDecoder, NoGoals
from epo_lightning.decoders.motions import Motions
from epo_lightning.decoders.strategies import InitialStrategies, ZeroStrategies
from epo_lightning.decoders.weights import OwnWeights, PairWeights, SharedOwnWeights, SharedPairWeights
from epo_lightning.forecasters.epo_settings import check_motions
from epo_lightning.game.energy import Energy
from epo_lightning.task import Task


def own_weights_decoder(
    setting: str, width: int, games: int, features: Sequence[str], start: float | Mapping[str, float]
) -> OwnWeights | SharedOwnWeights:
    """The decoder of own weights for ``forecaster.own_weights``, ``decoded`` or ``shared``."""
    if setting == "shared":
        return SharedOwnWeights(games, features, start)
    return OwnWeights(width, games, features, start)


def pair_weights_decoder(
    setting: str, width: int, games: int, features: Sequence[str], start: float, symmetric: bool, positive: bool
) -> PairWeights | SharedPairWeights:
    """The decoder of pair weights for ``forecaster.pair_weights``, ``decoded`` or ``shared``."""
    if setting == "shared":
        return SharedPairWeights(games, features, start)
    return PairWeights(width, games, features, start, symmetric, positive)


def strategies_decoder(
    setting: str, width: int, count: int, horizon: int, control_scale: float, motions: Mapping[str, float] | None
) -> InitialStrategies | ZeroStrategies | Motions:
    """The decoder of initial strategies for ``forecaster.initial``, ``decoded``, ``zero`` or ``motions``.

    Raises:
        ConfigError: ``motions`` has impossible ranges.
    """
    ranges = {} if motions is None and setting != "motions" else check_motions(motions)
    if setting == "decoded":
        return InitialStrategies(width, count, horizon, control_scale)
    return ZeroStrategies(count, horizon) if setting == "zero" else Motions(count, horizon, **ranges)


def goals_decoder(energy: Energy, task: Task, width: int, variants: int) -> GoalDecoder | GivenGoals | NoGoals:
    """The decoder of goals: they are chosen among the candidates of the data, given by it, or not in the energy."""
    if task.candidates > 1 and energy.needs & {"goals", "goal_headings", "reference"}:
        return GoalDecoder(width, task.scale, variants)
    return GivenGoals(variants) if energy.needs & {"goals", "goal_headings"} else NoGoals()
