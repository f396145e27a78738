"""Resampling of recordings to a common clock: uninterrupted stretches of states at multiples of dt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.tracks import TrackTable, unwrapped
from epo_lightning.registry import ConfigError

TOO_SHORT = "in a track shorter than a window"
"""Name of a count: windows whose agent is observed in a stretch that is shorter than a window."""


MOST_BETWEEN = 20
"""Largest number of steps of a clock from one frame of a recording to the next."""


@dataclass(frozen=True)
class Stretches:
    """States of agents at steps of a common clock. Row ``start + s - first`` of a stretch is its state at step s.

    Attributes:
        dt: time step of the clock [s]; step s is at time s dt after the recording's frame 0.
        agent: index of the agent of each stretch.
        first: first step of each stretch.
        count: number of steps of each stretch.
        start: first row of each stretch.
        state: x, y [m], heading [rad], speed [m/s] of every row; headings are unwrapped.
        ending: every row's state and the J - 1 states before it, estimated without later frames, for tracks that are
            smoothed and for clocks whose steps lie between frames; None if ``state`` needs no later frame. ``state`` is
            smoothed and interpolated with later frames too, which is more accurate, but the inputs of a forecaster must not
            contain the future.
    """

    dt: float
    agent: Int[np.ndarray, " C"]
    first: Int[np.ndarray, " C"]
    count: Int[np.ndarray, " C"]
    start: Int[np.ndarray, " C"]
    state: Float[np.ndarray, "Z 4"]
    ending: Float[np.ndarray, "Z J 4"] | None = None

    @property
    def now(self) -> Float[np.ndarray, "Z 4"]:
        """Every row's state, estimated without later frames."""
        return self.state if self.ending is None else self.ending[:, 0]

    @property
    def owner(self) -> Int[np.ndarray, " Z"]:
        """Index of the stretch of each row."""
        return np.repeat(np.arange(len(self.count)), self.count)


def stretches(
    tracks: TrackTable,
    dt: float,
    smoothing: float | None,
    shortest: int,
    every: int = 1,
    interpolate: bool = False,
) -> tuple[Stretches, dict[str, int]]:
    """Stretches of a recording, resampled to the clock.

    Args:
        tracks: the recording.
        dt: time step of the clock [s].
        smoothing: length [s] of the window in which a parabola is fitted to positions and headings; None for data that
            are smooth already.
        shortest: smallest number of steps of a stretch; shorter ones are left out.
        every: steps between two windows.
        interpolate: whether the clock may be faster than the recording.

    Returns:
        the stretches, the numbers of stretches that were interrupted or left out, by reason, and under ``TOO_SHORT`` the
        number of windows in those that were left out.

    Raises:
        ConfigError: the clock is faster than the recording, without ``interpolate``, or more than ``MOST_BETWEEN`` times as
            fast.
    """
    if dt * tracks.rate < 1 - 1e-6 and not interpolate:
        raise ConfigError(
            f"data.windows.dt={dt} asks for more than the recording's {tracks.rate:g} frames per second: "
            f"use {1 / tracks.rate:g} or more, or data.windows.interpolate=true"
        )
    if dt * tracks.rate * MOST_BETWEEN < 1 - 1e-6:
        least = np.ceil(1e4 / (MOST_BETWEEN * tracks.rate)) / 1e4
        raise ConfigError(
            f"data.windows.dt={dt} asks for more than {MOST_BETWEEN} steps between two of the recording's {tracks.rate:g} "
            f"frames per second: use {least:g} or more"
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
    dropped[TOO_SHORT] = int(np.maximum(last // every - (first - 1) // every, 0)[~long].sum())
    begin, length, first, count = begin[long], length[long], first[long], count[long]

    kept = np.repeat(begin - np.append(0, length.cumsum()[:-1]), length) + np.arange(length.sum())
    within = length.cumsum() - length
    heading = unwrapped(tracks.heading[kept], within)
    values = np.column_stack([tracks.position[kept], heading, tracks.velocity[kept]])
    raw = values
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
    ending = None
    if window:
        ending = _ending(raw, row, lower, at - lower, window, tracks.rate, dt)
    elif ((share > 1e-6) & (share < 1 - 1e-6)).any():
        ending = _continued(raw, values, row, share[:, 0], np.repeat(start, count), tracks.rate, dt)
    return Stretches(dt, tracks.agent[begin], first, count, start, _states(values), ending), dropped


def _states(values: Float[np.ndarray, "*n 5"]) -> Float[np.ndarray, "*n 4"]:
    """States [.., 4] from positions, headings and velocities [.., 5]; the speed is the component along the heading."""
    x, y, heading, right, up = np.moveaxis(values, -1, 0)
    return np.stack([x, y, heading, right * np.cos(heading) + up * np.sin(heading)], -1)


def _smooth(
    values: Float[np.ndarray, "n 5"],
    begin: Int[np.ndarray, " C"],
    length: Int[np.ndarray, " C"],
    window: int,
    rate: float,
) -> Float[np.ndarray, "n 5"]:
    """Positions, headings and velocities of a centred Savitzky-Golay filter: a parabola is fitted to every window.

    Velocities are the derivatives of the parabolas. Near the ends of a stretch, the parabola of its first or last complete
    window is evaluated.
    """
    half = window // 2
    time, fit = _parabolas(window, rate)
    smooth = np.empty_like(values)
    if len(values) >= window:
        middle = np.lib.stride_tricks.sliding_window_view(values[:, :3], window, axis=0)  # [n - window + 1, 3, window]
        coefficients = np.einsum("cw,nvw->cnv", fit[:2], middle)
        smooth[half : len(values) - half, :3] = coefficients[0]
        smooth[half : len(values) - half, 3:] = coefficients[1][:, :2]
    for offset, edge in ((begin, np.arange(half)), (begin + length - window, np.arange(half + 1, window))):
        around = values[offset[:, None] + np.arange(window), :3]  # [C, window, 3]
        smooth[offset[:, None] + edge] = _evaluate(fit, around[:, None], time[edge])
    return smooth


def _ending(
    raw: Float[np.ndarray, "n 5"],
    row: Int[np.ndarray, " Z"],
    before: Int[np.ndarray, " Z"],
    beyond: Float[np.ndarray, " Z"],
    window: int,
    rate: float,
    dt: float,
) -> Float[np.ndarray, "Z J 4"]:
    """States of every step, and of the J - 1 steps before it, estimated from frames up to the step only.

    A parabola is fitted to the window that ends at the step and evaluated at the J steps. J - 1 is the number of earlier
    steps that the centred filter would smooth with frames after the step. At the beginning of a stretch, before there is a
    complete window, the recorded states are used.

    Args:
        raw: recorded positions, headings and velocities.
        row: index into ``raw`` of the last row at or before each step.
        before: number of rows of the stretch before that row.
        beyond: time from that row to the step [rows].
    """
    time, fit = _parabolas(window, rate)
    steps = int(window // 2 / (dt * rate)) + 1
    whole = before >= window - 1
    around = raw[np.maximum(row[:, None] - window + 1 + np.arange(window), 0), :3]
    at = time[-1] + np.minimum(beyond, 1.0)[:, None] / rate - dt * np.arange(steps)  # [Z, J]
    fitted = _states(_evaluate(fit, around[:, None], at))
    earlier = np.maximum(row[:, None] - np.round(np.arange(steps) * dt * rate).astype(int), (row - before)[:, None])
    return np.where(whole[:, None, None], fitted, _states(raw[earlier]))


def _continued(
    raw: Float[np.ndarray, "n 5"],
    values: Float[np.ndarray, "Z 5"],
    row: Int[np.ndarray, " Z"],
    share: Float[np.ndarray, " Z"],
    start: Int[np.ndarray, " Z"],
    rate: float,
    dt: float,
) -> Float[np.ndarray, "Z J 4"]:
    """States of every step, and of the J - 1 steps before it, that need no frame after the step, without smoothing.

    A step between two frames continues the motion of the earlier one at constant velocity. J - 1 earlier steps can lie
    between the same two frames: there are none unless the clock is faster than the recording.

    Args:
        raw: recorded positions, headings and velocities.
        values: the same, interpolated at every step.
        row: index into ``raw`` of the last frame up to each step.
        share: time from that frame to the step [frames], 0 to 1.
        start: first row of each row's stretch.
    """
    index, frames = np.arange(len(row)), dt * rate
    found = []
    for earlier in range(max(1, int(np.ceil(1 / frames - 1e-6)))):
        since = share - earlier * frames
        ahead = raw[row].copy()
        ahead[:, :2] += ahead[:, 3:] * (since / rate)[:, None]
        between = (since > 1e-6) & (share < 1 - 1e-6)
        found.append(np.where(between[:, None], ahead, values[np.maximum(index - earlier, start)]))
    return _states(np.stack(found, 1))


def _parabolas(window: int, rate: float) -> tuple[Float[np.ndarray, " window"], Float[np.ndarray, "3 window"]]:
    """Times of a window's frames relative to its middle [s], and the matrix from samples to a parabola's coefficients."""
    time = (np.arange(window) - window // 2) / rate
    return time, np.linalg.pinv(np.vander(time, 3, increasing=True))


def _evaluate(
    fit: Float[np.ndarray, "3 window"], around: Float[np.ndarray, "*n window 3"], at: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 5"]:
    """Values of windows' parabolas (x, y, heading) and first derivatives (velocities along x and y)."""
    constant, linear, quadratic = np.moveaxis(np.einsum("cw,...wv->...cv", fit, around), -2, 0)
    t = at[..., None]
    return np.concatenate([constant + linear * t + quadratic * t**2, (linear + 2 * quadratic * t)[..., :2]], -1)
