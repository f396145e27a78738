"""Checks of the settings of an EPO forecaster: every error names the key and the changes that would work."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from epo_lightning.checks import check_choice, check_number
from epo_lightning.decoders.probabilities import PROBABILITIES
from epo_lightning.forecasters.calibration import Calibration
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import FEATURES, Energy
from epo_lightning.game.features import OWN_FEATURES
from epo_lightning.objectives.base import Objective
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.solvers.base import STATIONARY, TABLES, Minimiser
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.task import Task

WEIGHTS = ("decoded", "shared")
"""Sources of the weights of features: decoded for each agent or pair, or one learned number per feature for all of them."""
INITIAL = ("decoded", "zero", "motions")
"""Sources of the initial strategies: decoded by the network, controls of zero (the paper's ablation "no init"), or a mixture
of motions of the unicycle. For solvers that choose among candidates, these strategies are the candidates."""


def check_needs(energy: Energy, task: Task) -> None:
    """Refuse an energy that needs fields which the data does not provide.

    Raises:
        ConfigError: the message names the features, the missing fields, and rows for such data.
    """
    known = {"size", "context", "order", "reference_controls"} | (
        {"goals", "goal_headings"} if task.candidates else set()
    )
    lacking = energy.needs - known - ({"reference", "reference_speed"} if task.candidates > 1 else set())
    if lacking:
        names = [name for name in energy.own if name in OWN_FEATURES and OWN_FEATURES[name].needs in lacking]
        rows = "rpi/..." if task.candidates else "dut/... or ucy/..."
        raise ConfigError(
            f"features of energy.own ({', '.join(names)}) need {', '.join(sorted(lacking))}, which this data does not "
            f"provide: choose a row for such data, experiment={rows} (without experiment=, the energy is RPI's), leave the "
            "features out, or choose data with a map"
        )


def check_horizon(game_horizon: int, energy: Energy, objective: Objective, task: Task) -> None:
    """Refuse a game that ends before the forecast, and objectives that cannot learn from a game that goes on after it.

    Raises:
        ConfigError: see above, or the energy cannot be evaluated over so few steps.
    """
    if game_horizon < task.horizon:
        raise ConfigError(
            f"forecaster.game_horizon must be {task.horizon} or more, the steps of the forecast, not {game_horizon}"
        )
    energy.check_horizon(game_horizon)
    learns_from_beginning = objective.through_solution and TABLES not in objective.needs_from_solver
    if game_horizon > task.horizon and not learns_from_beginning:
        raise ConfigError(
            "a game that goes on after the forecast (forecaster.game_horizon) needs objective=imitation, which learns from "
            "the beginning of the solution: the others compare whole games with the observed future, which ends earlier"
        )


def check_modes(modes: int, one_game: bool, solver: Minimiser) -> None:
    """Refuse a number of modes below one, and one game for all modes where the modes are choices.

    Raises:
        ConfigError: see above.
    """
    if modes < 1:
        raise ConfigError(f"forecaster.modes must be 1 or more, not {modes}")
    if one_game and TABLES in solver.provides:
        raise ConfigError(
            "forecaster.one_game=true needs a solver that begins at initial strategies: choices among candidates are modes "
            "of one game already"
        )


def check_initial(initial: str, modes: int, one_game: bool, energy: Energy, solver: Minimiser) -> None:
    """Refuse initial strategies with which the modes or the candidates would all be the same, and unknown ones.

    Raises:
        ConfigError: see above, or motions of another model than the unicycle.
    """
    check_choice("forecaster.initial", initial, INITIAL)
    if one_game and initial == "zero" and solver.strategies(modes) > 1 and energy.pair_order is None:
        raise ConfigError(
            "all modes would be the same: forecaster.one_game=true gives them one game, and forecaster.initial=zero one "
            "start. Use solver=both_sides, which finds several equilibria from one start, or initial=decoded"
        )
    if TABLES in solver.provides and initial == "zero":
        raise ConfigError(
            "the solver chooses among candidates, which forecaster.initial=zero makes all the same: use decoded, which "
            "learns them, or motions"
        )
    if initial == "motions" and not isinstance(energy.dynamics, Unicycle):
        raise ConfigError(
            f"forecaster.initial=motions needs dynamics=unicycle, not {type(energy.dynamics).__name__}: "
            "the motions are those of a unicycle; choose decoded or zero"
        )


def check_calibration(
    calibration: Mapping[str, float | Sequence[float]] | None, energy: Energy, solver: Minimiser
) -> Calibration | None:
    """The configured calibration, if any.

    Raises:
        ConfigError: an unknown key; a solver that does not lead to a minimum, or takes fixed steps, which need not; a game
            with decoded reference controls, or with reference lines; or as
            :class:`~epo_lightning.forecasters.calibration.Calibration`.
    """
    if calibration is None:
        return None
    if "reference_controls" in energy.needs:
        raise ConfigError(
            "forecaster.calibration poses the game at the first observed state, for which no reference controls are "
            "decoded: leave accref and turnrref out of energy.own, or set calibration to null"
        )
    if "reference" in energy.needs:
        raise ConfigError(
            "forecaster.calibration poses the game at the first observed state, and reference lines begin near t0, so that "
            "the feature lane would pull agents forwards: leave it out of energy.own, or set calibration to null"
        )
    fixed = isinstance(solver, LevenbergMarquardt) and not solver.adaptive
    if STATIONARY not in solver.provides or fixed:
        raise ConfigError(
            "forecaster.calibration needs a solver that leads to a minimum, such as both_sides, game or converging"
            + (", or solver.adaptive=true" if fixed else "")
            + "; set forecaster.calibration to null for this one"
        )
    known = [field.name for field in dataclasses.fields(Calibration)]
    for name in calibration:
        if name not in known:
            raise ConfigError(f"unknown key forecaster.calibration.{name}: {nearest(str(name), known)}")
    return Calibration(**calibration)  # type: ignore[arg-type]


def check_gate(gate: Mapping[str, Any] | None, energy: Energy) -> None:
    """Refuse settings without a gate, and a gate for energies without pair features that vanish with their weight.

    Raises:
        ConfigError: see above.
    """
    if gate is None:
        return
    if isinstance(gate, Mapping) and gate and "name" not in gate:
        raise ConfigError(
            f"{', '.join(f'forecaster.gate.{key}' for key in gate)} has no effect without a gate: choose one by "
            "gate=radius, nearest or attention (in Python, by its name), or set forecaster.gate to null"
        )
    if FEATURES not in energy.offers:
        raise ConfigError(
            "forecaster.gate leaves pairs out of an energy of named features, such as energy=exid, rpi or pedestrians; "
            "set it to null for this one"
        )
    if not energy.pair:
        raise ConfigError("forecaster.gate chooses pairs, but energy.pair is empty: set forecaster.gate to null")


def decodes_probabilities(probabilities: str, energy: Energy, solver: Minimiser) -> bool:
    """Whether the network decodes the modes' probabilities; otherwise energies of choices or orders of agents define them.

    Raises:
        ConfigError: an unknown decoder, or a chosen one where none is used.
    """
    check_choice("forecaster.probabilities", probabilities, PROBABILITIES)
    chooses = TABLES in solver.provides
    defined = chooses or energy.pair_order is not None
    if defined and probabilities != "linear":
        raise ConfigError(
            f"forecaster.probabilities={probabilities} has no effect here, because the "
            f"{'energies of choices' if chooses else 'orders of agents'} define the probabilities: leave it out"
        )
    return not defined


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
    if not isinstance(start, Mapping):
        check_number("forecaster.own_start", start)
        return start
    known = {*features, *OWN_FEATURES}
    for name, value in start.items():
        if name in all_features and name not in features:
            raise ConfigError(
                f"forecaster.own_start.{name} has no effect: this energy fixes the weight of {name}; it decodes weights "
                f"of {', '.join(features) or 'no feature'}"
            )
        if name not in known:
            raise ConfigError(f"unknown feature forecaster.own_start.{name}: {nearest(name, known)}")
        check_number(f"forecaster.own_start.{name}", value)
    return start


def check_pair_start(start: float, positive: bool) -> None:
    """Refuse an initial pair weight that is not finite, or not positive where weights are start * exp(network output).

    From a start of zero, such weights would stay zero, and agents would never interact.

    Raises:
        ConfigError: see above.
    """
    if positive:
        check_number("forecaster.pair_start", start)
    elif not math.isfinite(start):
        raise ConfigError(f"forecaster.pair_start must be finite, not {start}")
