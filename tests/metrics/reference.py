"""Reference implementation of the metrics, as slow loops over scenes, modes, agents and steps, with shapely polygons."""

from __future__ import annotations

import math

import torch
from shapely.affinity import rotate, translate
from shapely.geometry import Point, Polygon, box
from torch import Tensor

from .cases import Case


def displacements(states: Tensor, future: Tensor, mask: Tensor) -> dict[str, list[float]]:
    """The four displacement metrics of every scene."""
    result: dict[str, list[float]] = {"minADE": [], "minFDE": [], "minSADE": [], "minSFDE": []}
    scenes, modes, agents, steps = states.shape[:4]
    for b in range(scenes):
        average, final = {}, {}
        for i in range(agents):
            for m in range(modes):
                errors = [
                    math.dist(states[b, m, i, k, :2].tolist(), future[b, i, k, :2].tolist())
                    for k in range(steps)
                    if mask[b, i, k]
                ]
                if errors:
                    average[m, i] = sum(errors) / len(errors)
                if mask[b, i, -1]:
                    final[m, i] = errors[-1]
        for name, error in (("ADE", average), ("FDE", final)):
            counted = sorted({i for _, i in error})
            if not counted:
                result[f"min{name}"].append(math.nan)
                result[f"minS{name}"].append(math.nan)
                continue
            marginal = [min(error[m, i] for m in range(modes)) for i in counted]
            joint = [sum(error[m, i] for i in counted) / len(counted) for m in range(modes)]
            result[f"min{name}"].append(sum(marginal) / len(marginal))
            result[f"minS{name}"].append(min(joint))
    return result


def outline(state: list[float], size: list[float], shape: str) -> Polygon:
    """The ground that an agent covers; discs as polygons of 4096 corners."""
    x, y, heading, _ = state
    if shape == "disc":
        return Point(x, y).buffer(size[0] / 2, quad_segs=1024)
    return translate(rotate(box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2), heading, (0, 0), True), x, y)


def overlaps(
    states: Tensor, probabilities: Tensor, size: Tensor, agent_mask: Tensor, shape: str
) -> dict[str, list[float]]:
    """Both overlap rates of every scene."""
    result: dict[str, list[float]] = {"jfp": [], "authors": []}
    for b in range(len(states)):
        mode = max(range(states.shape[1]), key=lambda m: float(probabilities[b, m]))
        present = [i for i in range(states.shape[2]) if agent_mask[b, i]]
        pairs = 0
        for a, i in enumerate(present):
            for j in present[a + 1 :]:
                pairs += any(
                    outline(states[b, mode, i, k].tolist(), size[b, i].tolist(), shape)
                    .intersection(outline(states[b, mode, j, k].tolist(), size[b, j].tolist(), shape))
                    .area
                    > 1e-11
                    for k in range(states.shape[3])
                )
        result["jfp"].append(float(pairs > 0) if present else math.nan)
        result["authors"].append(pairs / len(present) if present else math.nan)
    return result


def ordered(states: Tensor, agent_probabilities: Tensor) -> tuple[Tensor, Tensor]:
    """Marginal modes ordered agent by agent."""
    new_states, new_probabilities = torch.empty_like(states), torch.empty_like(agent_probabilities)
    for b in range(len(states)):
        for i in range(states.shape[2]):
            ranking = sorted(range(states.shape[1]), key=lambda m: -float(agent_probabilities[b, m, i]))
            for rank, m in enumerate(ranking):
                new_states[b, rank, i] = states[b, m, i]
                new_probabilities[b, rank, i] = agent_probabilities[b, m, i]
    return new_states, new_probabilities


def brier(case: Case) -> list[float]:
    """The brier-minSADE of every scene."""
    values = []
    for b in range(len(case.states)):
        joint = [
            displacements(case.states[b : b + 1, [m]], case.future[b : b + 1], case.mask[b : b + 1])["minSADE"][0]
            for m in range(case.states.shape[1])
        ]
        best = min(range(len(joint)), key=lambda m: joint[m])
        values.append(joint[best] + (1 - case.probabilities[b, best].item()) ** 2)
    return values


def calibration_error(case: Case, chosen: list[int], bins: int = 10) -> float:
    """The expected calibration error of the chosen scenes; NaN without any statement."""
    statements = []
    for b in chosen:
        joint = [
            displacements(case.states[b : b + 1, [m]], case.future[b : b + 1], case.mask[b : b + 1])["minSADE"][0]
            for m in range(case.states.shape[1])
        ]
        if not math.isnan(joint[0]):
            best = min(range(len(joint)), key=lambda m: joint[m])
            statements += [(case.probabilities[b, m].item(), m == best) for m in range(len(joint))]
    error = 0.0
    for low in range(bins):
        inside = [(p, true) for p, true in statements if low <= p * bins < low + 1 or (low == bins - 1 and p == 1)]
        error += abs(sum(p - true for p, true in inside))
    return error / len(statements) if statements else math.nan
