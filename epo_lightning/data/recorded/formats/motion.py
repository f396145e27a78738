"""Headings from velocities, and checks that positions, velocities and headings agree in rate, unit and sign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.tracks import TrackTable


def direction_of_motion(
    agent: Int[np.ndarray, " T"], velocity: Float[np.ndarray, "T 2"], slowest: float = 0.0
) -> Float[np.ndarray, " T"]:
    """Headings [rad] of agents whose heading is not recorded: the direction of motion.

    An agent that is not faster than ``slowest`` keeps its last direction, because the direction of a small velocity is
    noise. Before it first exceeds ``slowest``, its direction is that of its first velocity: later ones would be the future.

    Args:
        agent: index of each row's agent; rows are sorted by agent and time.
        velocity: components along x and y [m/s].
        slowest: speed [m/s] above which an agent moves.
    """
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > slowest
    rows = np.arange(len(agent))
    first = np.maximum.accumulate(np.where(np.diff(agent, prepend=-1) != 0, rows, 0))
    before = np.maximum.accumulate(np.where(moving, rows, 0))
    known = moving[before] & (before >= first)
    row = np.where(known, before, first)
    heading: Float[np.ndarray, " T"] = np.arctan2(velocity[row, 1], velocity[row, 0])
    return np.where(velocity[row].any(axis=1), heading, 0.0)


def check_motion(
    table: TrackTable,
    path: Path | str,
    velocity: str,
    rate: str,
    moving: float = 2.0,
    fast: float = 5.0,
    unit: str = "degrees",
    most: float = 1.25,
) -> None:
    """Check that positions, velocities and headings of a recording agree.

    Args:
        table: tracks of all agents.
        path: path of the file, for error messages.
        velocity: names of the columns of velocities, for error messages.
        rate: name of the frame rate and its file, for error messages.
        moving: speed [m/s] above which displacements are compared with velocities.
        fast: speed [m/s] above which headings are compared with directions of motion.
        unit: unit of headings in the file, for error messages.
        most: largest factor between displacements and velocities, in the median.

    Raises:
        RecordingError: displacements and velocities differ by a factor or in direction, or headings do not point along the
            directions of motion.
    """
    within = np.flatnonzero(np.diff(table.agent) == 0)
    elapsed = np.diff(table.frame)[within] / table.rate
    way = (table.position[within + 1] - table.position[within]) / elapsed[:, None]
    travelled = np.linalg.norm(way, axis=1)
    speed = np.linalg.norm(table.velocity, axis=1)
    stated = 0.5 * (speed[within] + speed[within + 1])
    faster = np.maximum(travelled, stated) > moving
    ratio = float(np.median(travelled[faster] / np.maximum(stated[faster], 1e-3))) if faster.any() else 1.0
    if not 1 / most < ratio < most:
        raise RecordingError(
            path,
            f"positions move {ratio:.3g} times as fast as {velocity} say: they were expected in m and m/s, at {rate}",
        )
    mean = 0.5 * (table.velocity[within] + table.velocity[within + 1])
    clear = (travelled > moving) & (np.linalg.norm(mean, axis=1) > moving)
    if clear.any():
        aside = _median_angle(np.arctan2(*way[clear].T[::-1]), np.arctan2(*mean[clear].T[::-1]))
        if aside > np.pi / 4:
            raise RecordingError(
                path,
                f"positions move in another direction than {velocity} say, by {np.rad2deg(aside):.0f} degrees in the "
                "median: have both the same axes, and are angles in the right unit?",
            )
    rows = speed > fast
    if rows.any():
        course = np.arctan2(table.velocity[rows, 1], table.velocity[rows, 0])
        aside = _median_angle(table.heading[rows], course)
        if aside > np.pi / 4:
            raise RecordingError(
                path,
                f"headings differ by {np.rad2deg(aside):.0f} degrees from the directions of motion: "
                f"{unit} counter-clockwise from x were expected",
            )


def _median_angle(one: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"]) -> float:
    """The median of the angles between directions [rad]."""
    return float(np.median(np.abs((one - other + np.pi) % (2 * np.pi) - np.pi)))
