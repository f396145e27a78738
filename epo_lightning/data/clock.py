"""One clock for all agents of a recording: uninterrupted stretches of states at multiples of dt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.tracks import TrackTable
from epo_lightning.registry import ConfigError


@dataclass(frozen=True)
class Stretches:
    """States of agents at steps of a common clock. Row ``start + s - first`` of a stretch is its state at step s.

    Attributes:
        dt: of the clock [s]; step s is at s dt, counted from the recording's frame 0.
        agent: whose stretch it is.
        first: its first step.
        count: how many steps it lasts.
        start: its first row.
        state: x, y [m], heading [rad], speed [m/s] of every row; headings go on beyond half a turn.
    """

    dt: float
    agent: Int[np.ndarray, " C"]
    first: Int[np.ndarray, " C"]
    count: Int[np.ndarray, " C"]
    start: Int[np.ndarray, " C"]
    state: Float[np.ndarray, "Z 4"]

    @property
    def owner(self) -> Int[np.ndarray, " Z"]:
        """The stretch that each row belongs to."""
        return np.repeat(np.arange(len(self.count)), self.count)


def stretches(
    tracks: TrackTable, dt: float, smoothing: float | None, shortest: int
) -> tuple[Stretches, dict[str, int]]:
    """Put a recording on a clock.

    Args:
        tracks: the recording.
        dt: of the clock [s].
        smoothing: length [s] of the window in which a parabola is fitted to positions and headings; None for data that
            are smooth already.
        shortest: steps that a stretch must last to be of use.

    Returns:
        the stretches, and how many stretches were interrupted or left out, by reason.

    Raises:
        ConfigError: a clock that is faster than the recording.
    """
    if dt * tracks.rate < 1 - 1e-6:
        raise ConfigError(
            f"data.dt={dt} asks for more than the recording's {tracks.rate:g} frames per second: "
            f"use {1 / tracks.rate:g} or more"
        )
    rows = len(tracks)
    new = np.append(True, (np.diff(tracks.agent) != 0) | (np.diff(tracks.frame) != 1))[:rows]
    begin = np.flatnonzero(new)
    length = np.diff(np.append(begin, rows))
    agents = len(np.unique(tracks.agent))
    dropped = {"gaps in tracks": len(begin) - agents}

    window = 0 if smoothing is None else max(3, 2 * round(smoothing * tracks.rate / 2) + 1)
    first = np.ceil(tracks.frame[begin] / (tracks.rate * dt) - 1e-6).astype(int)
    last = np.floor(tracks.frame[begin + length - 1] / (tracks.rate * dt) + 1e-6).astype(int)
    count = last - first + 1
    long = (count >= shortest) & (length >= window)
    dropped["tracks shorter than a window"] = int((~long).sum())
    begin, length, first, count = begin[long], length[long], first[long], count[long]

    kept = np.repeat(begin - np.append(0, length.cumsum()[:-1]), length) + np.arange(length.sum())
    within = length.cumsum() - length
    heading = _unwrap(tracks.heading[kept], within)
    values = np.column_stack([tracks.position[kept], heading, tracks.velocity[kept]])
    if window:
        values = _smooth(values, within, length, window, tracks.rate)

    start = count.cumsum() - count
    step = np.arange(count.sum()) - np.repeat(start - first, count)
    at = step * (dt * tracks.rate) - np.repeat(tracks.frame[begin], count)
    lower = np.clip(np.floor(at + 1e-6).astype(int), 0, np.repeat(np.maximum(length - 2, 0), count))
    share = np.clip(at - lower, 0.0, 1.0)[:, None]
    row = np.repeat(within, count) + lower
    after = np.minimum(row + 1, len(values) - 1)
    values = np.where(share < 1e-6, values[row], (1 - share) * values[row] + share * values[after])
    along = values[:, 3] * np.cos(values[:, 2]) + values[:, 4] * np.sin(values[:, 2])
    state = np.column_stack([values[:, :3], along])
    return Stretches(dt, tracks.agent[begin], first, count, start, state), dropped


def _unwrap(heading: Float[np.ndarray, " n"], begin: Int[np.ndarray, " C"]) -> Float[np.ndarray, " n"]:
    """Headings that go on beyond half a turn within a stretch."""
    turn = np.diff(heading, prepend=heading[:1])
    turns = np.round(turn / (2 * np.pi))
    turns[begin] = 0.0
    total = turns.cumsum()
    offset = np.repeat(total[begin], np.diff(np.append(begin, len(heading))))
    return heading - 2 * np.pi * (total - offset)


def _smooth(
    values: Float[np.ndarray, "n 5"],
    begin: Int[np.ndarray, " C"],
    length: Int[np.ndarray, " C"],
    window: int,
    rate: float,
) -> Float[np.ndarray, "n 5"]:
    """Fit a parabola to every window of positions and headings (Savitzky-Golay); velocities are the parabolas' slopes.

    Near the ends of a stretch, the first or last whole window's parabola goes on.
    """
    half = window // 2
    time = (np.arange(window) - half) / rate
    fit = np.linalg.pinv(np.vander(time, 3, increasing=True))  # samples -> coefficients

    def evaluate(around: Float[np.ndarray, "*n window 3"], at: Float[np.ndarray, " m"]) -> np.ndarray:
        """Values and slopes of the windows' parabolas: x, y, heading, and the speeds in x and y."""
        constant, slope, bend = np.moveaxis(np.einsum("cw,...wv->...cv", fit, around), -2, 0)
        t = at[:, None]
        value = constant + slope * t + bend * t**2
        return np.concatenate([value, (slope + 2 * bend * t)[..., :2]], -1)

    smooth = np.empty_like(values)
    if len(values) >= window:
        middle = np.lib.stride_tricks.sliding_window_view(values[:, :3], window, axis=0)  # [n - window + 1, 3, window]
        coefficients = np.einsum("cw,nvw->cnv", fit[:2], middle)
        smooth[half : len(values) - half, :3] = coefficients[0]
        smooth[half : len(values) - half, 3:] = coefficients[1][:, :2]
    for offset, edge in ((begin, np.arange(half)), (begin + length - window, np.arange(half + 1, window))):
        around = values[offset[:, None] + np.arange(window), :3]  # [C, window, 3]
        smooth[offset[:, None] + edge] = evaluate(around[:, None], time[edge])
    return smooth
