"""Doubts about the tracks of a recording: values that are allowed, and nearly always a mistake of units, axes or frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from epo_lightning.data.recorded.tracks import TrackTable

MOVING, CLEAR = 1.0, 0.5
"""Stated speed [m/s] above which a step counts, and speed of a displacement above which it has a clear direction."""
FEWEST = 20
"""Number of such steps from which on a recording is judged."""
RATIO, ANGLE = 1.25, 30.0
"""Largest ratio of speeds in positions and velocities, in either direction, and largest angle [degrees]; medians."""


def doubts(tracks: TrackTable) -> list[str]:
    """Sentences on frames that are apart, and on positions, velocities and headings that contradict each other."""
    same = np.diff(tracks.agent) == 0
    apart = np.diff(tracks.frame)[same]
    found = []
    if len(apart) and np.median(apart) > 1:
        frames = np.median(apart)
        found.append(
            f"the frames of a track are {frames:g} apart in the median, so that it has gaps nearly everywhere: is the frame "
            f"rate {tracks.rate / frames:g} Hz instead of {tracks.rate:g} Hz, with frames 0, 1, 2, ...?"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.diff(tracks.position, axis=0)[same] * (tracks.rate / apart)[:, None]
    stated = 0.5 * (tracks.velocity[1:] + tracks.velocity[:-1])[same]
    ahead = np.stack((np.cos(tracks.heading), np.sin(tracks.heading)), -1)[1:][same]
    fast = _length(stated) > MOVING
    if fast.sum() < FEWEST:
        return found
    moved, stated, ahead = moved[fast], stated[fast], ahead[fast]
    clear = _length(moved) > CLEAR
    enough = clear.sum() >= FEWEST
    if enough and (angle := _angle(moved[clear], stated[clear])) > ANGLE:
        found.append(
            f"agents move in another direction than that of their velocities, by {angle:.0f} degrees in the median: have "
            "positions and velocities the same axes, x and y?"
        )
        return found
    # Along the velocity: noise of positions makes displacements longer, but not in this direction.
    ratio = float(np.median((moved * stated).sum(-1) / (stated**2).sum(-1)))
    if not 1 / RATIO <= ratio <= RATIO:
        found.append(
            f"agents move {ratio:.2g} times as fast in their positions as their velocities say, in the median: are both in "
            "m and m/s, and is the frame rate right?"
        )
    if enough and (angle := _angle(moved[clear], ahead[clear])) > ANGLE:
        found.append(
            f"agents move in another direction than that of their headings, by {angle:.0f} degrees in the median: headings "
            "are in rad, counter-clockwise from x"
        )
    return found


def _length(vectors: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, " S"]:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _angle(one: Float[np.ndarray, "S 2"], other: Float[np.ndarray, "S 2"]) -> float:
    """The median angle between vectors [degrees]."""
    cosine = (one * other).sum(-1) / (_length(one) * _length(other))
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))
