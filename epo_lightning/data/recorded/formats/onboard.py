"""Tracks and maps of cars that drive in traffic and record what their sensors see: Argoverse 2, Waymo Open Motion.

Such tracks have gaps and lengths of a few seconds, and agents of all kinds, also pedestrians beside the road. Units are
metres, radians and m/s; headings are counter-clockwise from x.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.motion import check_motion
from epo_lightning.data.recorded.lanes import FARTHEST, Polyline
from epo_lightning.data.recorded.tracks import FASTEST, Recording, TrackTable

RATE = 10.0
"""Frames per second of both data sets [Hz]."""
APART = 2.0
"""Largest factor between displacements and velocities, in the median: single tracks of parked or distant cars are noisy."""
NO_TRAFFIC = "recordings without traffic"


def refuse(error: RecordingError) -> Recording:
    """The ``read`` of a recording that cannot be read: a broken one among very many must not stop their listing.

    Raises:
        RecordingError: always.
    """
    raise error


def tracks_of(
    path: Path,
    frame: Int[np.ndarray, " T"],
    agent: Int[np.ndarray, " T"],
    states: Float[np.ndarray, "T 5"],
    ids: Int[np.ndarray, " A"],
    size: Float[np.ndarray, "A 2"],
    kind: Int[np.ndarray, " A"],
    dropped: Counter[str],
) -> TrackTable:
    """The tracks of a recording, sorted and checked. Tracks that jump are left out and counted.

    Args:
        path: path of the file, for error messages.
        frame, agent: frame and index of the agent of each row.
        states: x, y [m], heading [rad], velocities along x and y [m/s] of each row.
        ids, size, kind: identifier, length and width [m], and index of the kind of each agent.
        dropped: counts of items that are left out.

    Raises:
        RecordingError: implausible numbers, or positions, headings and velocities that contradict each other.
    """
    order = np.lexsort((frame, agent))
    frame, agent, states = frame[order], agent[order], states[order]
    bad = ~(np.isfinite(states).all(1) & (np.abs(states[:, :2]) <= FARTHEST).all(1))
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise RecordingError(
            path,
            f"track {ids[agent[row]]} has the numbers {states[row].tolist()} in frame {frame[row]}: position, heading and "
            f"velocity were expected to be finite, and positions at most {FARTHEST:g} m: is the file damaged?",
        )
    kept = ~_jumping(frame, agent, states[:, :2], len(ids))
    if not kept.all():
        dropped[f"tracks that jump, faster than {FASTEST:g} m/s"] += int((~kept).sum())
    rows, number = kept[agent], kept.cumsum() - 1
    table = TrackTable(
        rate=RATE,
        agent=number[agent[rows]],
        frame=frame[rows],
        position=states[rows, :2],
        heading=states[rows, 2],
        velocity=states[rows, 3:],
        ids=ids[kept],
        size=size[kept],
        kind=kind[kept],
    )
    if not len(table):
        dropped[NO_TRAFFIC] += 1
        return table
    table.check(path)
    check_motion(table, path, "the velocities", f"{RATE:g} Hz", unit="radians", most=APART)
    return table


def _jumping(
    frame: Int[np.ndarray, " T"], agent: Int[np.ndarray, " T"], position: Float[np.ndarray, "T 2"], count: int
) -> Bool[np.ndarray, " A"]:
    """Mask of the agents that move faster than ``FASTEST`` from one of their rows to the next."""
    within = np.flatnonzero((np.diff(agent) == 0) & (np.diff(frame) > 0))
    way = np.linalg.norm(position[within + 1] - position[within], axis=1)
    jumps = way * RATE > FASTEST * (frame[within + 1] - frame[within])
    found = np.zeros(count, dtype=bool)
    found[agent[within[jumps]]] = True
    return found


def without_tiny(line: Polyline) -> Polyline:
    """A line whose coordinates below a nanometre are zero, because squares of such numbers underflow."""
    return np.where(np.abs(line) < 1e-9, 0.0, line)


class References:
    """References between the lanes of a map by identifier. Those to lanes that are not in the map are left out and counted.

    The maps are cut out around a recording, so that lanes at the edge refer to lanes beyond it.

    Args:
        ids: identifiers of the lanes in the map.
        dropped: counts of items that are left out.
    """

    def __init__(self, ids: Iterable[int], dropped: Counter[str]) -> None:
        self.index = {identity: lane for lane, identity in enumerate(ids)}
        self.dropped = dropped

    def lane(self, identity: int | None) -> int:
        """Index of a lane; -1 for None and for a lane that is not in the map."""
        if identity is None:
            return -1
        if (lane := self.index.get(identity, -1)) < 0:
            self.dropped["lane references to lanes that do not exist"] += 1
        return lane

    def successors(self, exits: Sequence[Sequence[int]], entries: Sequence[Sequence[int]]) -> list[tuple[int, ...]]:
        """Successors of each lane: the lanes that it names, and the lanes that name it as their predecessor."""
        found: list[dict[int, None]] = [{} for _ in self.index]
        for lane, (after, before) in enumerate(zip(exits, entries, strict=True)):
            for other in map(self.lane, after):
                if other >= 0:
                    found[lane][other] = None
            for other in map(self.lane, before):
                if other >= 0:
                    found[other][lane] = None
        return [tuple(following) for following in found]
