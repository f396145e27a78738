"""Leaders: the vehicle ahead of each vehicle, from tracks and lanes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.lanes import LaneGraph, Located
from epo_lightning.data.recorded.tracks import TrackTable

FURTHEST_LEADER = 250.0
"""Largest distance to a leader [m]."""
HOPS = 6
"""Number of consecutive lanes on which leaders are searched."""


def leaders(
    tracks: TrackTable, located: Located, lanes: LaneGraph
) -> tuple[Int[np.ndarray, " T"], Float[np.ndarray, " T"]]:
    """The agent ahead of each row's agent, on its lane or its successors, and the distance to it.

    Returns:
        row of the leader in the same frame, -1 for none; distance between the centres along the lanes [m], inf for none.
    """
    rows = np.flatnonzero(located.lane >= 0)
    order = rows[np.lexsort((located.along[rows], located.lane[rows], tracks.frame[rows]))]
    place = tracks.frame[order].astype(np.int64) * len(lanes) + located.lane[order]
    leader, distance = np.full(len(tracks), -1), np.full(len(tracks), np.inf)
    same = place[1:] == place[:-1]
    leader[order[:-1][same]] = order[1:][same]
    distance[order[:-1][same]] = (located.along[order[1:]] - located.along[order[:-1]])[same]

    # The first agent on a lane is the leader of the last agent on a preceding lane without agents in between.
    first, start = np.unique(place, return_index=True)
    last = order[np.append(~same, True)] if len(order) else order
    frontier, lane = last, located.lane[last]
    gone = lanes.centrelines.length[lane] - located.along[last]
    following = [np.array(successors, dtype=int) for successors in lanes.successors]
    count = np.array([len(successors) for successors in following], dtype=int)
    flat = np.concatenate([np.empty(0, dtype=int), *following])
    begin = np.concatenate([[0], count.cumsum()])
    for _ in range(HOPS):
        copies = count[lane]
        frontier, gone = np.repeat(frontier, copies), np.repeat(gone, copies)
        within = np.arange(copies.sum()) - np.repeat(copies.cumsum() - copies, copies)
        lane = flat[np.repeat(begin[lane], copies) + within]
        key = tracks.frame[frontier].astype(np.int64) * len(lanes) + lane
        at = np.searchsorted(first, key)
        hit = at < len(first)
        hit[hit] = first[at[hit]] == key[hit]
        candidate = order[start[at[hit]]]
        ahead = gone[hit] + located.along[candidate]
        near = (ahead < FURTHEST_LEADER) & (ahead < distance[frontier[hit]]) & (candidate != frontier[hit])
        nearest = np.flatnonzero(near)[np.argsort(-ahead[near], kind="stable")]  # the nearest is written last
        leader[frontier[hit][nearest]], distance[frontier[hit][nearest]] = candidate[nearest], ahead[nearest]
        on = ~hit & (gone < FURTHEST_LEADER)
        frontier, lane, gone = frontier[on], lane[on], gone[on] + lanes.centrelines.length[lane[on]]
        if not len(frontier):
            break
    return leader, distance
