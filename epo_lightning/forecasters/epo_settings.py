"""Checks of the settings of an EPO forecaster."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from epo_lightning.game.energy import Energy
from epo_lightning.game.features import OWN_FEATURES
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.task import Task


def check_needs(energy: Energy, task: Task) -> None:
    """Refuse an energy that needs fields which the data does not provide.

    Raises:
        ConfigError: the message names the missing fields.
    """
    known = {"size", "context", "order"} | ({"goals", "goal_headings"} if task.candidates else set())
    lacking = energy.needs - known - ({"reference", "reference_speed"} if task.candidates > 1 else set())
    if lacking:
        raise ConfigError(
            f"features of energy.own need {', '.join(sorted(lacking))}, which this data does not provide: leave the "
            "features out, or choose data with a map"
        )


def check_motions(motions: Mapping[str, float] | None) -> dict[str, float]:
    """Largest acceleration and curvature of initial motions.

    Raises:
        ConfigError: a missing or unknown name.
    """
    known, given = ("acceleration", "curvature"), dict(motions or {})
    if set(given) != set(known):
        raise ConfigError(
            "forecaster.motions must name acceleration [m/s^2] and curvature [1/m] for initial=motions, not "
            f"{', '.join(sorted(map(str, given))) or 'nothing'}"
        )
    return given


def check_margin(margin: Mapping[str, float] | None) -> dict[str, float]:
    """Limits of decoded margins: ``largest`` and ``start``.

    Raises:
        ConfigError: an unknown name, or numbers that are not 0 < start < largest.
    """
    limits = {"largest": 2.0, "start": 0.5, **(margin or {})}
    if set(limits) != {"largest", "start"}:
        raise ConfigError(
            f"forecaster.margin has the keys largest and start [m], not {', '.join(map(str, margin or ()))}"
        )
    if not 0 < limits["start"] < limits["largest"] < math.inf:
        raise ConfigError(f"forecaster.margin takes 0 < start < largest [m], not {dict(limits)}")
    return limits


def check_start(
    start: float | Mapping[str, float], features: Sequence[str], all_features: Sequence[str]
) -> float | Mapping[str, float]:
    """The configured ``own_start`` after a check. Names of features that are not in this energy have no effect.

    Args:
        start: the configured value.
        features: own terms whose weight is decoded.
        all_features: all own terms of the energy.

    Raises:
        ConfigError: an unknown feature, a feature whose weight is fixed, or a weight that is not positive and finite.
    """
    named, known = start if isinstance(start, Mapping) else {"all": start}, {"all", *features, *OWN_FEATURES}
    for name, value in named.items():
        if name in all_features and name not in features:
            raise ConfigError(
                f"forecaster.own_start.{name} has no effect: this energy fixes the weight of {name}; it decodes weights "
                f"of {', '.join(features) or 'no feature'}"
            )
        if name not in known:
            raise ConfigError(f"unknown feature forecaster.own_start.{name}: {nearest(name, known)}")
        if not 0 < value < math.inf:
            raise ConfigError(f"forecaster.own_start must be positive and finite, but {name} would start at {value}")
    return start
