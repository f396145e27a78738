"""Checks of feature energies: their configuration, and the inputs of their features."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from epo_lightning.checks import is_number
from epo_lightning.forecast import GameParameters
from epo_lightning.game.energy import check_names
from epo_lightning.game.features import BUILT_IN, OWN_FEATURES, PAIR_FEATURES, OwnFeature, PairFeature
from epo_lightning.game.game_end import check_game_steps
from epo_lightning.game.limits import check_bound
from epo_lightning.game.pairs import pair_mask
from epo_lightning.host import readable
from epo_lightning.registry import ConfigError, nearest, place
from epo_lightning.scene import Scene

if TYPE_CHECKING:
    from epo_lightning.game.feature_energy import FeatureEnergy

_FEATURES: Mapping[str, Mapping[str, OwnFeature | PairFeature]] = {"own": OWN_FEATURES, "pair": PAIR_FEATURES}


def check_inputs(energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
    """Check that scene and parameters have all inputs of the features, with the shapes that the controls ask for.

    Raises:
        ValueError: see :meth:`~epo_lightning.game.feature_energy.FeatureEnergy.validate`.
    """
    batch, agents = scene.agent_mask.shape
    modes, steps = controls.shape[1], controls.shape[3]
    energy.check_horizon(steps)
    for part, names, given, count in (
        ("own_weights", energy.own, parameters.own_weights, agents),
        ("pair_weights", energy.pair, parameters.pair_weights, agents * (agents - 1) // 2),
    ):
        for name in names:
            if name not in given:
                raise ValueError(f"{part} lacks the feature {name!r}; it has {sorted(given)}")
            shape = list(given[name].shape) if isinstance(given[name], Tensor) else given[name]
            if shape not in ([batch, modes, count], [batch, 1, count]):
                raise ValueError(f"{part}[{name!r}] has shape {shape}; these controls take {[batch, modes, count]}")
    needed: dict[str, tuple[tuple[str, Tensor | None], ...]] = {
        "goals": (("parameters.goals", parameters.goals),),
        "goal_headings": (("parameters.goal_headings", parameters.goal_headings),),
        "reference": (("scene.references", scene.references), ("parameters.reference", parameters.reference)),
        "reference_speed": (("scene.reference_speed", scene.reference_speed),),
        "reference_controls": (("parameters.reference_controls", parameters.reference_controls),),
        "size": (("scene.size", scene.size),),
    }
    if energy.bounded_by_kind and scene.kind is None:
        raise ValueError(f"the bounds of {energy.bounded_by_kind[0]!r} are by kind of agent, but scene.kind is None")
    for name, feature in energy.own_features.items():
        for what, value in needed[feature.needs] if feature.needs else ():
            if value is None:
                raise ValueError(f"the energy has the feature {name!r}, but {what} is None")
            per_agent = {
                "goals": [agents, 2],
                "goal_headings": [agents],
                "reference": [agents],
                "reference_controls": [agents, steps, 2],
            }
            takes = per_agent.get(what.removeprefix("parameters."))
            if takes and list(value.shape) not in ([batch, modes, *takes], [batch, 1, *takes]):
                raise ValueError(f"{what} has shape {list(value.shape)}; these controls take {[batch, modes, *takes]}")
    _check_decoded_margins(energy, scene, parameters, controls)
    check_game_steps(scene, steps)
    if "reference" in energy.needs and parameters.reference.is_floating_point():  # type: ignore[union-attr]
        raise ValueError("parameters.reference holds indices of lines: it takes whole numbers, not floats")
    if "reference" in energy.needs and readable(controls):  # on a GPU, the check would make the host wait
        assert scene.references is not None
        assert parameters.reference is not None
        lines = scene.references.shape[2]
        index = torch.where(scene.agent_mask[:, None], parameters.reference, 0)
        if (scene.agent_mask[:, None] & ((index < 0) | (index >= lines))).any():
            raise ValueError(
                f"parameters.reference must be indices 0 .. {lines - 1} of the R = {lines} lines of scene.references"
            )
    if (energy.needs_reach or energy.needs_shape) and scene.size is None:
        what = "sizes" if energy.needs_shape else "radii"
        raise ValueError(f"pair features take the agents' {what} from scene.size [B, N, 2], which is None")


def _check_decoded_margins(energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
    """Check the margins of those pair features whose margin is not fixed.

    Raises:
        ValueError: a missing margin, a wrong shape, or, on a CPU, a negative value.
    """
    if not energy.decoded_margins:
        return
    modes, exists = controls.shape[1], pair_mask(scene)
    batch, count = exists.shape
    for name in energy.decoded_margins:
        margin = parameters.margins.get(name)
        if margin is None:
            raise ValueError(
                f"the pair feature {name!r} takes a margin, but parameters.margins lacks it; it has "
                f"{sorted(parameters.margins)}. energy.margins.{name} fixes one for all pairs [m]"
            )
        if list(margin.shape) not in ([batch, modes, count], [batch, 1, count]):
            raise ValueError(
                f"margins[{name!r}] has shape {list(margin.shape)}; these controls take {[batch, modes, count]}"
            )
        if readable(margin) and ((margin < 0) & exists[:, None]).any():
            raise ValueError(f"margins[{name!r}] must be 0 or more [m], but the least one is {float(margin.min())}")


def check_features(own: Any, pair: Any) -> None:
    """Check the names of an energy's features.

    Raises:
        ConfigError: see :func:`~epo_lightning.game.energy.check_names`; or a name in both lists, because residuals and
            energies are known by their names.
    """
    for key, names in (("own", own), ("pair", pair)):
        check_names(key, names, _FEATURES[key], "feature", functools.partial(_advice, key))
    both = set(own) & set(pair)
    if both:
        raise ConfigError(f"energy.own and energy.pair both have a feature called {min(both)!r}: rename one")


def _advice(key: str, name: str) -> str:
    """Advice on an unknown name in ``energy.own`` or ``energy.pair``."""
    other = "pair" if key == "own" else "own"
    if name in _FEATURES[other]:
        return f"the {other} features have it, so it belongs in energy.{other}"
    known = nearest(name, _FEATURES[key])
    new = f'. A new one has @{key}_feature("{name}") above its function, in a file of epo_lightning/game'
    return known if known.startswith("did you mean") else known + new


def check_bounds(bounds: Any) -> None:
    """Check the bounds of signals.

    Raises:
        ConfigError: no mapping, an unknown signal, or bounds that :func:`~epo_lightning.game.limits.check_bound` refuses.
    """
    signals = {feature.signal for feature in OWN_FEATURES.values() if feature.bounded}
    if not isinstance(bounds, Mapping):
        raise ConfigError(f"energy.bounds must map signals to [lowest, highest], such as vel: [0, 30], not {bounds!r}")
    for name, bound in bounds.items():
        if name not in signals:
            raise ConfigError(f"unknown signal energy.bounds.{name}: {nearest(str(name), signals)}")
        check_bound(name, bound)


def check_margins(margins: Any) -> None:
    """Check fixed margins. A margin of a pair feature that the energy does not have, has no effect.

    Raises:
        ConfigError: no mapping, an unknown pair feature, one that takes no margin, or a negative value.
    """
    if not isinstance(margins, Mapping):
        raise ConfigError(f"energy.margins must map pair features to metres, such as clearance: 0.5, not {margins!r}")
    takes = [name for name, feature in PAIR_FEATURES.items() if feature.margin]
    for name, margin in margins.items():
        if name not in takes:
            raise ConfigError(
                f"energy.margins.{name}: no pair feature with a margin has this name; {nearest(name, takes)}"
            )
        if not is_number(margin) or not 0 <= margin < math.inf:
            raise ConfigError(f"energy.margins.{name} must be a number of metres, 0 or more, not {margin!r}")


def refuse_flaws(kind: str, name: str, feature: OwnFeature | PairFeature) -> None:
    """Refuse a feature whose function cannot work, or costs the two agents of a pair different amounts.

    Raises:
        ConfigError: the message names the feature and its file, and says what is wrong.
    """
    if name not in BUILT_IN and feature.flaw is not None:
        raise ConfigError(f"{kind} feature {name!r} ({place(feature.function)}) {feature.flaw}")
    costs = None
    try:
        costs = feature.asymmetry if isinstance(feature, PairFeature) else None
    except (RuntimeError, ValueError) as error:
        warnings.warn(
            f"whether the pair feature {name!r} ({place(feature.function)}) is symmetric could not be tried: "
            f"{type(error).__name__}: {error}. An asymmetric one has no potential, and its energy no equilibria",
            stacklevel=2,
        )
    if costs is not None:
        raise ConfigError(
            f"pair feature {name!r} is not symmetric: for two trial agents 1/2 |r|^2 is {costs[0]:.4g}, and {costs[1]:.4g} "
            "when they are swapped, so the game has no potential, and minimising the energy would not give its equilibria. "
            "Make the feature symmetric, for instance by returning the residuals of both orders. If the agents only weigh "
            "it differently (a_i E_ij with a_i > 0), keep E_ij symmetric: dividing the own terms of agent i by a_i gives "
            "the same game, and the decoded own weights can learn this"
        )
