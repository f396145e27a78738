"""All metrics of a forecast at once, on all scenes and on named subsets of the data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

from epo_lightning.checks import check_choice
from epo_lightning.forecast import JointForecast, Status
from epo_lightning.metrics.functional import expected_calibration_error, reliability
from epo_lightning.metrics.functional.calibration import BINS
from epo_lightning.metrics.functional.displacement import Errors
from epo_lightning.metrics.functional.overlap import overlap_rates
from epo_lightning.registry import ConfigError, failing_place, parts, place
from epo_lightning.scene import SHAPES, Scene, observed_future

METRICS = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp", "overlap_authors")
"""Scores of every forecaster; displacements in m, overlaps as rates."""
INITIAL_METRICS = ("initial/minSADE", "initial/minSFDE")
"""Scores of the strategies from which the solver started (the paper's figure over the number of steps S)."""
EQUILIBRIUM_METRICS = (
    "energy_initial",
    "energy_solved",
    "energy_optimum",
    "gradient_norm",
    "nash_gap",
    "nash_gap_relative",
)
"""Distance of the most likely joint mode from an equilibrium of its game (:class:`~epo_lightning.forecast.Equilibrium`).
``nash_gap`` is the largest gap of an agent, ``nash_gap_relative`` the largest gap divided by the agent's J_i."""
MODE_METRICS = tuple(f"minSADE_{k}" for k in range(1, 17))
"""The minSADE among the k most likely joint modes, k = 1 .. 16, for forecasts with several modes."""
PROBABILITY_METRICS = ("brier_minSADE",)
"""Scores of displacements and probabilities together, for forecasts with several modes."""
COLLAPSE_METRICS = ("missed",)
"""Scores of subsets alone: the share of a subset's scenes in which no mode is near the future."""
PAIR_METRICS = ("pair_effect",)
"""Mean displacement [m] between the most likely joint mode and the solution of the same game without its pair terms."""
STOPPED = "stopped"
CONSTRAINT_METRICS = (STOPPED,)
"""Share of the joint modes whose hard constraints were not met (status ``STOPPED``), for solutions with hard constraints."""
COLUMNS = (
    *METRICS,
    *INITIAL_METRICS,
    *EQUILIBRIUM_METRICS,
    *MODE_METRICS,
    *PROBABILITY_METRICS,
    *COLLAPSE_METRICS,
    *PAIR_METRICS,
    *CONSTRAINT_METRICS,
)
"""Scores that are means over scenes."""
LARGEST_EXCESS = 1e-2
"""Largest difference from one of the sum of probabilities, which half precision rounds."""
OWN = "own/"
"""Beginning of the names of registered metrics (:func:`own_values`)."""


def columns() -> tuple[str, ...]:
    """Names of all scores that are means over scenes, with those of registered metrics."""
    return (*COLUMNS, *(OWN + name for name in parts("metric")))


def scores() -> tuple[str, ...]:
    """Names of all scores.

    ``ECE`` is the calibration error of the probabilities of several modes
    (:mod:`~epo_lightning.metrics.functional.calibration`).
    """
    return (*columns(), "ECE")


def of_subsets(metric: str) -> bool:
    """Whether the scenes of a subset have a score of their own."""
    return metric not in EQUILIBRIUM_METRICS and metric not in MODE_METRICS[1:]


class ForecastMetrics(Metric):
    """Means over scenes of all metrics of the tables in Section 5, as a torchmetrics Metric.

    Absent agents (``Scene.agent_mask``) and unobserved steps (``Scene.future_mask``) do not count. Sums are kept in double
    precision, so that the mean does not depend on sizes of batches or numbers of processes: a float32 sum over the 60 000
    scenes of a data set loses digits that tables print.

    Forecasts with several modes have scores of their probabilities as well (``minSADE_1``, ``brier_minSADE``, ``ECE``), and
    subsets the share of scenes without any mode near the future (``missed``). Metrics that are registered
    (:func:`own_values`) follow, as ``own/<name>``.

    If a forecast has a measured equilibrium, its energies and Nash gaps are averaged as well, over all scenes but not by
    subset. Values that are not finite (a game that overflows) are left out, because one of them would make the mean
    infinite. Broken forecasts are still visible: their displacements are infinite.

    Args:
        subsets: names of the subsets that ``Scene.subset`` numbers, e.g. ``("executed", "alternative")`` for RPI. Each
            gets its own scores, ``"executed/minADE"``; a scene with another number belongs to no subset.
        shape: outline of the agents in overlap rates, ``disc`` or ``box``.

    Example:
        One scene, one mode, two agents that stand still, and a forecast that is 0.3 m off for one of them:

        >>> from epo_lightning.forecast import JointForecast
        >>> from epo_lightning.scene import Scene
        >>> states = torch.tensor([[0.0, 0.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0]]).view(1, 2, 1, 4)
        >>> scene = Scene(history=states, dt=0.1, future=states, size=torch.ones(1, 2, 2))
        >>> predicted = states[:, None].clone()
        >>> predicted[0, 0, 0, 0, 0] = 0.3
        >>> forecast = JointForecast(predicted, probabilities=torch.ones(1, 1))
        >>> metrics = ForecastMetrics()
        >>> metrics.update(forecast, scene)
        >>> {name: round(float(score), 3) for name, score in metrics.compute().items()}  # doctest: +NORMALIZE_WHITESPACE
        {'minADE': 0.15, 'minFDE': 0.15, 'minSADE': 0.15, 'minSFDE': 0.15,
         'overlap_jfp': 0.0, 'overlap_authors': 0.0}
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    total: Tensor
    count: Tensor
    bins: Tensor

    def __init__(self, subsets: Sequence[str] = (), shape: str = "disc", **options: Any) -> None:
        super().__init__(**options)
        check_choice("shape", shape, SHAPES, of="agents")
        self.subsets, self.shape = tuple(subsets), shape
        self.columns = columns()
        # The first row is for all scenes, the others for one subset each.
        zeros = torch.zeros(1 + len(self.subsets), len(self.columns), dtype=torch.float64)
        self.add_state("total", zeros, dist_reduce_fx="sum")
        self.add_state("count", zeros.clone(), dist_reduce_fx="sum")
        bins = torch.zeros(len(zeros), BINS, 3, dtype=torch.float64)
        self.add_state("bins", bins, dist_reduce_fx="sum")

    def update(self, forecast: JointForecast, scene: Scene) -> None:
        """Count a batch of scenes.

        Raises:
            ValueError: the scene has no future or no sizes, or another number of agents or steps than the forecast; states
                without headings; or probabilities of another shape, below zero, or that do not sum to one (their values are
                not checked on a GPU, which would have to wait).
        """
        if forecast.states.shape[-1] != 4:
            raise ValueError(
                f"forecast.states has shape {list(forecast.states.shape)}; it takes [B, M, N, K, 4]: x, y, heading, speed"
            )
        probabilities, shape = forecast.probabilities, list(forecast.states.shape[:2])
        if list(probabilities.shape) != shape:
            raise ValueError(f"forecast.probabilities has shape {list(probabilities.shape)}; these states take {shape}")
        total = probabilities.sum(1)
        if total.device.type == "cpu" and (((total - 1).abs() > LARGEST_EXCESS).any() or (probabilities < 0).any()):
            raise ValueError(
                "forecast.probabilities [B, M] must be 0 or more and sum to one for every scene; the first ones sum to "
                f"{total.tolist()[:4]}"
            )
        average = Errors.average(forecast.states, *observed_future(scene, "displacements need"))
        found = {**forecast_values(forecast, scene, average, self.shape), **own_values(forecast, scene)}
        none = torch.full_like(found["minADE"], torch.nan)
        values = torch.stack([found.get(name, none).double() for name in self.columns], dim=1)
        groups = torch.ones(len(values), 1, dtype=torch.bool, device=values.device)
        if self.subsets:
            numbers = torch.arange(len(self.subsets), device=values.device)
            subset = torch.full_like(numbers[:1], -1).expand(len(values)) if scene.subset is None else scene.subset
            groups = torch.cat([groups, subset[:, None] == numbers], dim=1)
        counted = groups[:, :, None] & ~values.isnan()[:, None]  # scene, group, metric
        counted[:, :1] &= torch.tensor([name not in COLLAPSE_METRICS for name in self.columns], device=values.device)
        counted[:, 1:] &= torch.tensor([of_subsets(name) for name in self.columns], device=values.device)
        self.total += torch.where(counted, values[:, None], 0.0).sum(0)
        self.count += counted.sum(0)
        self.bins += torch.einsum("bg,bnx->gnx", groups.double(), calibration_values(forecast.probabilities, average))

    def compute(self) -> dict[str, Tensor]:
        """Scores by name.

        The six metrics over all scenes are always present, NaN before the first scene; the scores of a subset, of initial
        strategies, of equilibria, of the most likely modes and of probabilities are present where there was a scene that has
        them.
        """
        mean, calibration = self.total / self.count, expected_calibration_error(self.bins)
        scores = dict(zip(METRICS, mean[0], strict=False))
        for row, prefix in enumerate(("", *(f"{name}/" for name in self.subsets))):
            for column, metric in enumerate(self.columns):
                if self.count[row, column] > 0:
                    scores[prefix + metric] = mean[row, column]
            if self.bins[row].any():
                scores[f"{prefix}ECE"] = calibration[row]
        return scores


def forecast_values(
    forecast: JointForecast, scene: Scene, average: Errors, shape: str
) -> dict[str, Float[Tensor, " B"]]:
    """Metrics of every scene by name, NaN where a scene has no value; without those that the forecast cannot have.

    Args:
        forecast, scene: a batch.
        average: the forecast's errors as averages over steps.
        shape: outline of the agents in overlap rates.

    Raises:
        ValueError: the scene has no future or no sizes.
    """
    if scene.size is None:
        raise ValueError("overlap rates need scene.size [B, N, 2], which is None")
    states, probabilities = forecast.states, forecast.probabilities
    future, mask = observed_future(scene, "displacements need")
    final = Errors.final(states, future, mask)
    values = {
        "minADE": average.marginal(),
        "minFDE": final.marginal(),
        "minSADE": average.joint(),
        "minSFDE": final.joint(),
        "missed": average.missed(),
        "pair_effect": pair_effect(forecast, scene.agent_mask),
        **equilibrium_values(forecast),
    }
    overlaps = overlap_rates(states, probabilities, scene.size, scene.agent_mask, shape)
    values["overlap_jfp"], values["overlap_authors"] = overlaps
    if (initial := forecast.initial_states) is not None:
        values["initial/minSADE"] = Errors.average(initial, future, mask).joint()
        values["initial/minSFDE"] = Errors.final(initial, future, mask).joint()
    if states.shape[1] > 1:
        values |= dict(zip(MODE_METRICS, average.joint_of_likely(probabilities).unbind(1), strict=False))
        values["brier_minSADE"] = average.brier(probabilities)
    if (lost := stopped(forecast)) is not None:
        values[STOPPED] = lost.double().mean(1)
    return values


def own_values(forecast: JointForecast, scene: Scene) -> dict[str, Float[Tensor, " B"]]:
    """Values of the registered metrics by name, ``own/<name>``.

    A metric is a function of a forecast and its scene that returns a value for every scene, NaN for scenes without one::

        @register("metric", "jerk")
        def jerk(forecast: JointForecast, scene: Scene) -> Float[Tensor, " B"]: ...

    Raises:
        ConfigError: a metric that fails, or returns something else.
    """
    values = {}
    for name, metric in parts("metric").items():
        try:
            value = metric(forecast, scene)
        except Exception as error:
            where = failing_place(error, metric)
            raise ConfigError(f"the metric {name!r} fails at {where}, {type(error).__name__}: {error}") from error
        shape = list(value.shape) if isinstance(value, Tensor) else type(value).__name__
        if shape != [len(scene.history)] or value.is_complex():
            raise ConfigError(
                f"{place(metric)}: the metric {name!r} returned {shape}; a tensor [{len(scene.history)}] was expected, a "
                "real number for every scene"
            )
        values[OWN + name] = value.detach().to(scene.history.device)
    return values


def calibration_values(probabilities: Float[Tensor, "B M"], average: Errors) -> Float[Tensor, "B bins 3"]:
    """Sums of the bins of the calibration error of every scene, in float64.

    All sums are zero for forecasts with a single mode, for scenes without observations, and for broken forecasts, of which
    no mode is the closest or whose probabilities are not numbers.
    """
    known = average.joint().isfinite() & probabilities.isfinite().all(1)
    if probabilities.shape[1] == 1:
        known = torch.zeros_like(known)
    return torch.where(known[:, None, None], reliability(probabilities.nan_to_num(0.0), average.closest()), 0.0)


def pair_effect(forecast: JointForecast, agent_mask: Bool[Tensor, "B N"]) -> Float[Tensor, " B"]:
    """Mean displacement [m] over agents and steps between the most likely mode and its game's solution without pair terms.

    NaN for forecasts whose games were not solved without pair terms, for scenes without agents, and for broken forecasts.
    """
    rows = torch.arange(len(forecast.states), device=forecast.states.device)
    if forecast.states_without_pairs is None:
        return forecast.states.new_full((len(rows),), torch.nan)
    likely = forecast.probabilities.argmax(1)
    change = forecast.states[rows, likely, ..., :2] - forecast.states_without_pairs[rows, likely, ..., :2]
    moved = torch.linalg.vector_norm(change, dim=-1).mean(-1).where(agent_mask, 0.0).sum(-1) / agent_mask.sum(-1)
    return moved.where(moved.isfinite(), torch.nan)


def stopped(forecast: JointForecast) -> Bool[Tensor, "B M"] | None:
    """Mask of the joint modes whose hard constraints were not met; None for forecasts without hard constraints."""
    solution = forecast.solution
    return None if solution is None or solution.constraints is None else solution.status == Status.STOPPED


def equilibrium_values(forecast: JointForecast) -> dict[str, Float[Tensor, " B"]]:
    """``EQUILIBRIUM_METRICS`` of every scene, NaN where a value is not finite; none without a measured equilibrium.

    Agents whose objective is not positive have no relative gap.
    """
    found = forecast.equilibrium
    if found is None:
        return {}
    values = {
        "energy_initial": found.initial_energy,
        "energy_solved": found.energy,
        "energy_optimum": found.optimum,
        "gradient_norm": found.gradient_norm,
        "nash_gap": torch.full_like(found.energy, torch.nan),
        "nash_gap_relative": torch.full_like(found.energy, torch.nan),
    }
    if found.nash_gap.shape[1]:
        positive = found.objective > 0
        relative = torch.where(positive, found.nash_gap / torch.where(positive, found.objective, 1.0), -torch.inf)
        values |= {"nash_gap": found.nash_gap.amax(1), "nash_gap_relative": relative.amax(1)}
    return {name: torch.where(value.isfinite(), value, torch.nan) for name, value in values.items()}
