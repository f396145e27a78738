"""Statistics that compare simulated traffic with real recordings.

All are computed from positions alone, after the same smoothing, so that recordings of different formats are comparable.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.clock import Stretches, stretches
from epo_lightning.data.recorded.lanes import lane_changes
from epo_lightning.data.recorded.tracks import Recording, TrackTable
from epo_lightning.data.simulate.leaders import leaders
from epo_lightning.scene import KINDS

DT, SMOOTHING = 0.2, 1.0
"""Time step and smoothing window [s] of all statistics."""
SIDEWAYS = 0.2
"""Smallest lateral speed [m/s] during a lane change; it defines begin and end."""
FURTHEST_ASIDE = 1.0
"""Largest change of the offset from the lane's middle in one step [m]; more is a change of the reference lane."""
ACROSS = 2.0
"""Smallest lateral displacement of a lane change [m]; less is driving on the marking."""
FOLLOWING = 100.0
"""Largest gap [m] at which a vehicle counts as following its leader."""
QUANTILES = (1, 5, 50, 95, 99)
UNITS = {
    "speed": "m/s",
    "longitudinal acceleration": "m/s^2",
    "lateral acceleration": "m/s^2",
    "longitudinal jerk": "m/s^3",
    "lateral jerk": "m/s^3",
    "gap": "m",
    "time headway": "s",
    "lane-change duration": "s",
    "lane-change lateral speed": "m/s",
}
"""Quantities and their units."""


def describe(recordings: Iterable[Recording]) -> dict[str, dict[str, float]]:
    """Percentiles and counts of every quantity in :data:`UNITS`, over all vehicles and times of all recordings.

    Gaps are free distances to leaders nearer than FOLLOWING, and time headways are the times to cover them. Lane changes,
    vehicles and trucks are counted too. Recordings without lanes contribute only to quantities that need no lanes.
    """
    found: dict[str, list[Float[np.ndarray, " n"]]] = {name: [] for name in UNITS}
    changes, hours, vehicles, trucks = 0, 0.0, 0, 0
    for recording in recordings:
        clock, _ = stretches(recording.tracks, DT, SMOOTHING, shortest=round(2.0 / DT))
        for name, values in _motion(clock).items():
            found[name].append(values)
        vehicles += len(recording.tracks.ids)
        trucks += int((recording.tracks.kind == KINDS.index("truck")).sum())
        if recording.lanes is None:
            continue
        hours += len(clock.state) * DT / 3600
        traffic = _table(clock, recording.tracks)
        located = recording.lanes.locate(traffic.position, traffic.heading)
        leader, distance = leaders(traffic, located, recording.lanes)
        gap = distance - (traffic.size[traffic.agent, 0] + traffic.size[traffic.agent[leader], 0]) / 2
        follows = (leader >= 0) & (gap < FOLLOWING) & (gap > 0)
        found["gap"].append(gap[follows])
        moving = follows & (traffic.speed > 1.0)
        found["time headway"].append(gap[moving] / traffic.speed[moving])
        rows = np.flatnonzero(lane_changes(traffic.agent, located, recording.lanes))
        changes += len(rows)
        for duration, speed in _manoeuvres(clock, located.offset, rows):
            found["lane-change duration"].append(np.array([duration]))
            found["lane-change lateral speed"].append(np.array([speed]))
    report: dict[str, dict[str, float]] = {}
    for name, parts in found.items():
        values = np.concatenate([np.empty(0), *parts])
        report[name] = {"count": float(len(values))}
        if len(values):
            levels = np.percentile(values, QUANTILES)
            report[name] |= {f"p{q}": float(level) for q, level in zip(QUANTILES, levels, strict=True)}
    report["lane changes"] = {"count": float(changes), "per vehicle and hour": changes / hours if hours else np.nan}
    report["vehicles"] = {"count": float(vehicles), "share of trucks": trucks / max(vehicles, 1)}
    return report


def markdown(reports: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Table of several descriptions side by side, with the percentiles 1, 5, 50, 95, 99, in Markdown."""
    lines = ["| | " + " | ".join(reports) + " |", "|---" * (len(reports) + 1) + "|"]
    for name, unit in UNITS.items():
        cells = [
            " / ".join(f"{report[name][f'p{q}']:.2f}" for q in QUANTILES) if "p1" in report[name] else "-"
            for report in reports.values()
        ]
        lines.append(f"| {name} [{unit}] | " + " | ".join(cells) + " |")
    for name, entry, form in (
        ("vehicles", "count", "{:,.0f}"),
        ("vehicles", "share of trucks", "{:.1%}"),
        ("lane changes", "count", "{:,.0f}"),
        ("lane changes", "per vehicle and hour", "{:.1f}"),
    ):
        label = name if entry == "count" else f"{name}: {entry}"
        lines.append(
            f"| {label} | " + " | ".join(form.format(report[name][entry]) for report in reports.values()) + " |"
        )
    return "\n".join(lines)


def _table(clock: Stretches, tracks: TrackTable) -> TrackTable:
    """The tracks resampled to the clock."""
    x, y, heading, speed = clock.state.T
    owner = clock.owner
    return TrackTable(
        rate=1 / DT,
        agent=clock.agent[owner],
        frame=clock.first[owner] + np.arange(len(owner)) - clock.start[owner],
        position=np.stack([x, y], -1),
        heading=heading,
        velocity=np.stack([speed * np.cos(heading), speed * np.sin(heading)], -1),
        ids=tracks.ids,
        size=tracks.size,
        kind=tracks.kind,
    )


def _motion(clock: Stretches) -> dict[str, Float[np.ndarray, " n"]]:
    """Speeds, accelerations and jerks from differences of positions."""
    owner, position, heading = clock.owner, clock.state[:, :2], clock.state[:, 2]

    def in_vehicle_frame(order: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        rate = np.diff(position, n=order, axis=0) / DT**order
        whole = owner[order:] == owner[:-order]
        angle = heading[order // 2 : len(heading) - (order - order // 2)]
        ahead = rate[:, 0] * np.cos(angle) + rate[:, 1] * np.sin(angle)
        aside = rate[:, 1] * np.cos(angle) - rate[:, 0] * np.sin(angle)
        return ahead[whole], aside[whole]

    acceleration, jerk = in_vehicle_frame(2), in_vehicle_frame(3)
    return {
        "speed": in_vehicle_frame(1)[0],
        "longitudinal acceleration": acceleration[0],
        "lateral acceleration": acceleration[1],
        "longitudinal jerk": jerk[0],
        "lateral jerk": jerk[1],
    }


def _manoeuvres(
    clock: Stretches, offset: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"]
) -> list[tuple[float, float]]:
    """Duration [s] and largest lateral speed [m/s] of the lane changes that are recorded from begin to end."""
    owner = clock.owner
    step = np.diff(offset)
    usable = (owner[1:] == owner[:-1]) & (np.abs(step) < FURTHEST_ASIDE)
    # At a change of lane the offset refers to another lane, so its rate is interpolated there.
    index = np.arange(len(step))
    rate = np.interp(index, index[usable], step[usable]) / DT if usable.any() else np.zeros(len(step))
    found = []
    for row in rows - 1:
        sign = np.sign(rate[row])
        fast = sign * rate > SIDEWAYS
        begin, end = row, row
        low = clock.start[owner[row]]
        high = low + clock.count[owner[row]] - 2
        while begin > low and fast[begin - 1]:
            begin -= 1
        while end < high and fast[end + 1]:
            end += 1
        sideways = sign * rate[begin : end + 1]
        if begin > low and end < high and sideways.sum() * DT > ACROSS:
            found.append(((end + 1 - begin) * DT, float(sideways.max())))
    return found
