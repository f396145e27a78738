"""Simple roads and traffic: parallel lanes, straight or on an arc; vehicles that keep or change lane."""

from __future__ import annotations

import numpy as np

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.tracks import Recording, TrackTable

WIDTH = 3.6


def curve(radius: float | None, turn: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)):
    """From (along, left) on a road to world positions and the road's heading, rotated and moved afterwards."""

    def place(along, left):
        along, left = np.broadcast_arrays(np.asarray(along, dtype=float), np.asarray(left, dtype=float))
        if radius is None:
            x, y, heading = along, left, np.zeros_like(along)
        else:
            heading = along / radius
            x, y = (radius - left) * np.sin(heading), radius - (radius - left) * np.cos(heading)
        cosine, sine = np.cos(turn), np.sin(turn)
        position = np.stack([cosine * x - sine * y + shift[0], sine * x + cosine * y + shift[1]], -1)
        return position, heading + turn

    return place


def road(place, lanes: int = 3, sections: int = 3, length: float = 200.0) -> LaneGraph:
    """Sections of parallel lanes; lane ``section * lanes + k`` is the k-th from the right."""
    along = np.linspace(0.0, length, 41)

    def lines(offset: float):
        return [
            place(section * length + along, (k + offset) * WIDTH)[0]
            for section in range(sections)
            for k in range(lanes)
        ]

    count = sections * lanes
    index = np.arange(count)
    left = np.where(index % lanes < lanes - 1, index + 1, -1)
    right = np.where(index % lanes > 0, index - 1, -1)
    successors = [(i + lanes,) if i + lanes < count else () for i in range(count)]
    nothing = np.full(count, np.nan)
    graph = LaneGraph(
        index + 100,
        lines(0.5),
        lines(-0.5),
        lines(0.0),
        successors,
        left,
        right,
        left,
        right,
        nothing,
        np.zeros(count, int),
    )
    return graph.check("road")


def traffic(place, vehicles, seconds: float = 10.0, rate: float = 25.0) -> TrackTable:
    """Vehicles ``(id, along, lane, speed, change)``: ``change`` is None, or the time at which a change to the left begins,
    which takes four seconds."""
    time = np.arange(round(seconds * rate) + 1) / rate
    rows = []
    for number, (_, along, lane, speed, change) in enumerate(vehicles):
        share = np.zeros_like(time) if change is None else np.clip((time - change) / 4.0, 0, 1)
        left = WIDTH * (lane + 3 * share**2 - 2 * share**3)
        position, _ = place(along + speed * time, left)
        velocity = np.gradient(position, 1 / rate, axis=0)
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        rows.append((np.full(len(time), number), np.arange(len(time)), position, heading, velocity))
    agent, frame, position, heading, velocity = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    count = len(vehicles)
    return TrackTable(
        rate=rate,
        agent=agent,
        frame=frame,
        position=position,
        heading=heading,
        velocity=velocity,
        ids=np.array([vehicle[0] for vehicle in vehicles]),
        size=np.tile([4.5, 1.8], (count, 1)),
        kind=np.zeros(count, int),
    ).check("traffic")


FOUR = ((7, 60.0, 0, 24.0, 2.0), (3, 80.0, 1, 25.0, None), (9, 40.0, 2, 26.0, None), (4, 100.0, 0, 24.0, None))
"""Four neighbours, the first of which changes lane."""


def recording(place=None, vehicles=FOUR, lanes: int = 3, name: str = "road", **about) -> Recording:
    """A recording of ``vehicles`` on a road."""
    place = place or curve(None)
    return Recording(name, "road", traffic(place, vehicles, **about), road(place, lanes))
