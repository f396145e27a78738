"""Report about a generated data set: sizes, modes over time, convergence of the solver, and simple baselines.

All numbers are stored in the manifest of the data set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from epo_lightning.data.cache import SPLITS
from epo_lightning.data.rpi.game import DISC_DIAMETER, FUTURE, HISTORY, Array, GameConstants, generator
from epo_lightning.data.rpi.subgames import Records

BINS = ((18, 28), (28, 38), (38, 48), (48, 61))
"""Ranges [first, end) of the step k of the current state; steps 18 .. 27 are 1.8 .. 2.7 s after the start."""
GAIN = 1e-6
"""Relative gain of a best response above which a strategy does not count as an equilibrium."""


def describe(
    splits: Mapping[str, Records], counts: Mapping[str, int], weights: Array, pool: Mapping[str, Any]
) -> dict[str, Any]:
    """The report about a data set, as plain values.

    Args:
        splits: records of training, validation and test.
        counts: numbers of solved and dropped games in the whole pool.
        weights: w of every main game.
        pool: configuration of the pool.
    """
    rows = {name: np.concatenate([split[name] for split in splits.values()]) for name in splits["train"]}
    return {
        "sizes": {split: _sizes(records) for split, records in splits.items()},
        "weights": {split: sorted({float(w) for w in records["weight"]}) for split, records in splits.items()},
        "two_modes": {"all": float((rows["modes"] == 2).mean()), **_over_time(rows)},
        "solver": _solver(counts, pool["solver"]),
        "nash": _nash(rows),
        "motion": _motion(rows, weights),
        "baselines": {"constant_velocity": _constant_velocity(splits["test"]), "nearest_neighbour": _nearest(splits)},
    }


def _sizes(records: Records) -> dict[str, int]:
    return {
        "records": len(records["step"]),
        "samples": int(records["modes"].sum()),
        "games": len(np.unique(records["game"])),
    }


def _over_time(rows: Records) -> dict[str, float]:
    """Share of records with two modes, by time since the main game's start."""
    shares = {}
    for first, end in BINS:
        chosen = (rows["step"] >= first) & (rows["step"] < end)
        if chosen.any():
            shares[f"{first / 10:.1f}-{(end - 1) / 10:.1f} s"] = float((rows["modes"][chosen] == 2).mean())
    return shares


def _solver(counts: Mapping[str, int], solver: str) -> dict[str, Any]:
    return {
        "solver": solver,
        "main_converged": counts["main_converged"] / counts["main_starts"],
        "main_kept": counts["main_kept"] / counts["main_starts"],
        "main_two_modes": counts["main_both"] / counts["main_games"],
        "sub_games": counts["sub_games"],
        "sub_converged": counts["sub_converged"] / max(1, counts["sub_starts"]),
        "sub_kept": counts["sub_kept"] / max(1, counts["sub_starts"]),
        "sub_games_dropped": counts["sub_dropped"],
    }


def _quantiles(values: NDArray, levels: tuple[float, ...] = (0.0, 0.5, 0.9, 0.99, 1.0)) -> dict[str, float]:
    if not len(values):
        return {}
    return {f"{q:g}": float(v) for q, v in zip(levels, np.quantile(values, levels), strict=True)}


def _nash(rows: Records) -> dict[str, Any]:
    """Distance from an equilibrium: unilateral gradients, and gains of best responses from perturbed strategies."""
    two = rows["modes"] == 2
    found = {}
    for name, gradient, gain in (
        ("executed", rows["gradient"][:, 0], rows["gain"][:, 0]),
        ("alternative", rows["gradient"][two, 1], rows["gain"][two, 1]),
    ):
        found[name] = {
            "gradient_max": _quantiles(gradient),
            "gain": _quantiles(gain),
            "gain_share": float((gain > GAIN).mean()) if len(gain) else 0.0,
        }
    ratio = rows["cost"][two, 1] / rows["cost"][two, 0]
    return {**found, "cost_ratio": _quantiles(ratio, (0.0, 0.05, 0.5, 0.95, 1.0)), "bellman": _bellman(rows)}


def _bellman(rows: Records) -> dict[str, float]:
    """Largest difference [m, rad, m/s] between an executed mode and the rest of the mode of the step before.

    By Bellman's principle of optimality it is zero.
    """
    order = np.lexsort((rows["step"], rows["executed"], rows["placement"], rows["game"]))
    follows = np.diff(rows["step"][order]) == 1
    for name in ("game", "placement", "executed"):
        follows &= np.diff(rows[name][order]) == 0
    executed = rows["states"][order, 0]
    rest = np.abs(executed[1:, :, :-1] - executed[:-1, :, 1:])[follows]
    return {"pairs": int(follows.sum()), "max": float(rest.max()) if len(rest) else 0.0}


def _motion(rows: Records, weights: Array) -> dict[str, Any]:
    """Distances between agents and between modes, sizes of controls, and the residual of the dynamics."""
    two = rows["modes"] == 2
    states = rows["states"].astype(np.float64)
    controls = rows["controls"].astype(np.float64)
    between = np.linalg.norm(states[:, :, 0, :, :2] - states[:, :, 1, :, :2], axis=-1)
    executed, alternative = between[:, 0].min(1), between[two, 1].min(1)
    apart = np.linalg.norm(states[two, 0, ..., :2] - states[two, 1, ..., :2], axis=-1).mean((1, 2))
    acceleration = np.concatenate([controls[:, 0], controls[two, 1]])[..., 0]
    by_weight = [
        [float(w), float(np.median(rows["distance"][np.isclose(rows["weight"], w), 0]))]
        for w in np.sort(weights)
        if np.isclose(rows["weight"], w).any()
    ]
    return {
        "distance_executed": _quantiles(executed),
        "distance_alternative": _quantiles(alternative),
        "disc_overlaps": int((executed < DISC_DIAMETER).sum() + (alternative < DISC_DIAMETER).sum()),
        "median_distance_by_weight": by_weight,
        "sade_between_modes": _quantiles(apart),
        "acceleration_99": float(np.quantile(np.abs(acceleration), 0.99)),
        "jerk_99": float(np.quantile(np.abs(np.diff(acceleration, axis=-1)) / GameConstants().dt, 0.99)),
        "euler_residual": _euler(states[:, 0], controls[:, 0], rows["history"].astype(np.float64)),
    }


def _euler(states: Array, controls: Array, history: Array) -> float:
    """Largest difference between a stored state and an Euler step from the state before, over the executed futures."""
    dt = GameConstants().dt
    before = np.concatenate([history[:, :, -1:], states[:, :, :-1]], axis=2)
    heading, speed = before[..., 2], before[..., 3]
    rate = np.stack([speed * np.cos(heading), speed * np.sin(heading), controls[..., 1], controls[..., 0]], axis=-1)
    return float(np.abs(before + dt * rate - states).max())


def constant_velocity(history: Array) -> Array:
    """Forecast of constant velocity, positions [B, 2, 40, 2]."""
    now = history[:, :, -1]
    velocity = now[..., 3:4] * np.stack([np.cos(now[..., 2]), np.sin(now[..., 2])], axis=-1)
    time = GameConstants().dt * np.arange(1, FUTURE + 1)
    return now[:, :, None, :2] + velocity[:, :, None] * time[:, None]


def _errors(forecast: Array, records: Records) -> dict[str, dict[str, float]]:
    """ADE and FDE [m] of a forecast with one mode, for which ADE equals SADE."""
    two = records["modes"] == 2
    found = {}
    for name, mode, chosen in (("executed", 0, slice(None)), ("alternative", 1, two)):
        error = np.linalg.norm(forecast[chosen] - records["states"][chosen, mode, :, :, :2], axis=-1)
        found[name] = {"ade": float(error.mean()), "fde": float(error[..., -1].mean())} if len(error) else {}
    return found


def _constant_velocity(test: Records) -> dict[str, Any]:
    return _errors(constant_velocity(test["history"].astype(np.float64)), test)


def _key(records: Records) -> Tensor:
    """Keys of the nearest-neighbour search, positions of history and goals, shape [B, 2 * 19 * 2 + 4]."""
    history = torch.from_numpy(records["history"][..., :2].reshape(len(records["step"]), -1))
    return torch.cat([history, torch.from_numpy(records["goals"]).flatten(1)], dim=1)


def _nearest(splits: Mapping[str, Records]) -> dict[str, Any]:
    """Errors of a forecast that copies the training record with the nearest history and goals (at most 6000 test records).

    An alternative mode is compared with the neighbour's alternative mode if it has one, otherwise with its executed mode.
    """
    train, test = splits["train"], splits["test"]
    count = len(test["step"])
    chosen = np.sort(generator(0, 3).permutation(count)[:6000])
    test = {name: values[chosen] for name, values in test.items()}
    keys, queries = _key(train), _key(test)
    found = torch.cat([torch.cdist(block, keys).argmin(1) for block in queries.split(500)])
    # cdist is fast but accurate to three digits only: enough to find neighbours, but not for the report.
    step = (queries - keys[found]).double().norm(dim=1).numpy() / np.sqrt(2 * (HISTORY + 1))
    nearest = found.numpy()
    same = train["states"][nearest, 0, :, :, :2].astype(np.float64)
    both = (train["modes"][nearest] == 2)[:, None, None, None]
    other = np.where(both, train["states"][nearest, 1, :, :, :2], same)
    return {
        "rms_distance_per_step": _quantiles(step),
        "executed": _errors(same, test)["executed"],
        "alternative": _errors(other, test)["alternative"],
    }


def summary(report: Mapping[str, Any]) -> list[str]:
    """Lines of the most important numbers of a report: sizes of the splits, dropped games, and records with two modes."""
    lines = [f"  {'':<8}{'records':>10}{'scenes':>10}{'games':>8}   w"]
    for split in SPLITS:
        size, weights = report["sizes"][split], report["weights"][split]
        counts = f"{size['records']:>10}{size['samples']:>10}{size['games']:>8}"
        lines.append(f"  {split:<8}{counts}   {weights[0]:.0f} to {weights[-1]:.0f}")
    solver = report["solver"]
    return [
        *lines,
        f"  {report['two_modes']['all']:.0%} of the records have an equilibrium on both sides, and are two scenes each",
        f"  {solver['sub_games_dropped']} of {solver['sub_games']} sub-games were left out: no equilibrium was found",
    ]
