"""Extraction of scenes from recordings: the choice of agents and moments (Appendix D.2, "exiD").

A window is a moment of a recording (t0) with a focal agent and its neighbours. Windows that pass all filters become scenes.
Scenes share agents: a vehicle at one moment may be the centre of one scene and a neighbour in others. Its data are stored
once, in a table of agents; a scene is a row of indices into that table.
:class:`~epo_lightning.data.recorded.tables.SceneTables` holds both, in coordinates relative to an origin of the recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int

from epo_lightning.checks import check_number, check_whole
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.assembling import assemble
from epo_lightning.data.recorded.clock import TOO_SHORT, Stretches, stretches
from epo_lightning.data.recorded.lanes import Located, lane_changes
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.tracks import Recording
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS

BESIDE_LANES = [KINDS.index(kind) for kind in ("pedestrian", "bicycle")]
"""Kinds of agents that often move beside the lanes of vehicles."""
STANDING = 2.0
"""Speed [m/s] up to which a vehicle may be parked."""
MOST_BESIDE = 0.5
"""Largest share of positions of moving vehicles on no lane; above it, the map does not belong to the tracks."""
MOST_AGENTS, MOST_LINES, MOST_LANES, LONGEST_SMOOTHING = 64, 64, 4096, 10.0
"""Largest numbers of agents of a scene, lines of an agent and lane polylines, and largest length [s] of smoothing."""
MOMENTS, AT_ENDS = "agents at steps of the clock", "near the beginning or end of a track"
"""Names of counts: possible windows, one per agent and step, and those whose agent is not observed in the whole window."""
TOO_FEW, TWICE = "too few agents around", "the same agents twice"
NO_CHANGE, NO_LANE = "no lane change", "an agent on no lane"
REASONS = (TOO_FEW, TWICE, NO_CHANGE, NO_LANE)
"""Reasons for which windows are left out, in the order of the filters."""
CHUNK = 4_000_000
"""Largest number of distances between agents that are computed at once, to bound the memory."""


@dataclass(frozen=True)
class WindowConfig:
    """Selection of the windows of a recording that become scenes.

    Times and the number of agents are by default those of the paper for exiD.

    Attributes:
        dt: time step [s].
        history: observed steps H, including the current one (1.8 s).
        horizon: future steps K (4 s).
        agents: largest number of agents N: a focal one and its nearest neighbours.
        least_agents: windows with fewer agents are left out.
        radius: largest distance from the focal agent to its neighbours [m]; null for no limit.
        lane_change: whether at least one agent must change lane within the window.
        every: steps between two windows.
        complete: whether neighbours must be observed in the whole window, like the focal agent, or only at the current
            step and at the one before.
        smoothing: length [s] of the smoothing filter; null for tracks that are smooth already.
        lanes: largest number of lane polylines L of a scene, the nearest ones; null for all that an agent may reach.
        speed_limit: reference speed [m/s] on lanes without a speed limit.
        off_lane: what is left out if an agent is on no lane of the map: the ``window``, or the ``agent``, as if it were not
            there, such as parked cars. With ``agent``, pedestrians always count as on no lane.
        interpolate: whether ``dt`` may be less than the time between two frames of a recording. Steps between frames are
            then interpolated, and the last steps of a history are computed without the frames after them.
        lines: largest number of reference lines R of an agent, along all successors of its lane and after one lane change
            (:mod:`~epo_lightning.data.recorded.junctions`); null for three lines, on its lane and on those beside it, which
            follow the straightest successors (:mod:`~epo_lightning.data.recorded.routes`).
    """

    dt: float = 0.2
    history: int = 10
    horizon: int = 20
    agents: int = 4
    least_agents: int = 4
    radius: float | None = 60.0
    lane_change: bool = True
    every: int = 1
    complete: bool = True
    smoothing: float | None = None
    lanes: int | None = 32
    speed_limit: float = 36.1
    off_lane: Literal["window", "agent"] = "window"
    interpolate: bool = False
    lines: int | None = None

    def __post_init__(self) -> None:
        for name, least in (
            ("history", 2),
            ("horizon", 2),
            ("agents", 1),
            ("least_agents", 1),
            ("every", 1),
            ("lanes", 1),
            ("lines", 1),
        ):
            value = getattr(self, name)
            if value is not None or name not in ("lanes", "lines"):
                check_whole(f"data.windows.{name}", value, least)
        for name in ("dt", "speed_limit", "radius", "smoothing"):
            check_number(f"data.windows.{name}", getattr(self, name), null=name in ("radius", "smoothing"))
        if self.lanes is not None and self.lanes > MOST_LANES:
            raise ConfigError(
                f"data.windows.lanes must be {MOST_LANES} or less, or null for all that an agent may reach, not {self.lanes}"
            )
        if self.lines is not None and self.lines > MOST_LINES:
            raise ConfigError(f"data.windows.lines must be {MOST_LINES} or less, not {self.lines}")
        if self.agents > MOST_AGENTS:
            raise ConfigError(f"data.windows.agents must be {MOST_AGENTS} or less, not {self.agents}")
        if self.smoothing is not None and self.smoothing > LONGEST_SMOOTHING:
            raise ConfigError(
                f"data.windows.smoothing must be {LONGEST_SMOOTHING:g} s or less, or null for none, not {self.smoothing}"
            )
        if self.least_agents > self.agents:
            raise ConfigError(
                f"data.windows.least_agents={self.least_agents} must not be more than data.windows.agents={self.agents}"
            )


LATER = ("off_lane", "interpolate", "lines")
"""Settings of windows that older versions did not have."""


def identifying(windows: WindowConfig) -> dict[str, Any]:
    """The settings of windows that identify a data set; later settings enter only if they differ from their default.

    Data sets that were extracted before these settings existed keep their digest.
    """
    defaults = {field.name: field.default for field in fields(WindowConfig)}
    values = asdict(windows)
    return {name: value for name, value in values.items() if name not in LATER or value != defaults[name]}


def extract(recording: Recording, config: WindowConfig) -> tuple[SceneTables | None, dict[str, int]]:
    """The scenes of a recording.

    Returns:
        the scenes, None if there are none; and the number of windows, with the numbers that were left out by reason. A
        window is an agent at a step of the clock: ``MOMENTS`` of them are possible, ``windows`` are observed completely, and
        ``scenes`` are left after the ``REASONS``. Other entries count items that a reader left out, and gaps in tracks.

    Raises:
        ConfigError: the settings need lanes, which the recording lacks, or the clock is faster than the recording.
    """
    if config.lane_change and recording.lanes is None:
        raise ConfigError(
            f"{recording.name} has no lanes, so there are no lane changes: use data.windows.lane_change=false"
        )
    counts: Counter[str] = Counter(recording.dropped)
    shortest = config.history + config.horizon if config.complete else 2
    clock, left_out = stretches(
        recording.tracks, config.dt, config.smoothing, shortest, config.every, config.interpolate
    )
    counts.update(left_out)
    last = clock.first + clock.count - 1
    observed = int((last // config.every - (clock.first - 1) // config.every).sum())
    counts[MOMENTS] = observed + counts[TOO_SHORT]
    located, changes = _on_lanes(clock, recording)
    usable = np.ones(len(clock.state), dtype=bool)
    if recording.lanes is not None and config.off_lane == "agent":
        usable = (located.lane >= 0) & ~_walking(clock, recording)
    moments, members = _choose(clock, changes, usable, config, counts)
    counts[AT_ENDS] = observed - counts["windows"]
    if recording.lanes is not None:
        off = ((located.lane[_rows(clock, moments, members)] < 0) & (members >= 0)).any(1)
        counts[NO_LANE] += int(off.sum())
        moments, members = moments[~off], members[~off]
    counts["scenes"] = len(moments)
    if not len(moments):
        return None, dict(counts)
    return assemble(recording, config, clock, located, moments, _rows(clock, moments, members)), dict(counts)


def _on_lanes(clock: Stretches, recording: Recording) -> tuple[Located, Int[np.ndarray, " Z"]]:
    """The lane of every state, and the cumulative number of lane changes over the rows.

    Raises:
        RecordingError: the map does not fit the tracks.
    """
    rows = len(clock.state)
    if recording.lanes is None:
        return Located(np.full(rows, -1), np.zeros(rows), np.zeros(rows)), np.zeros(rows, dtype=int)
    located = recording.lanes.locate(clock.now[:, :2], clock.now[:, 2])
    # Parked cars and agents beside the lanes say nothing about the map.
    driving = ~np.isin(recording.tracks.kind[clock.agent], BESIDE_LANES)[clock.owner]
    driving &= np.abs(clock.now[:, 3]) > STANDING
    beside = float((located.lane[driving] < 0).mean()) if driving.any() else 0.0
    if beside > MOST_BESIDE:
        raise RecordingError(
            recording.name,
            f"{beside:.0%} of the positions of moving vehicles lie on no lane of its map: is it the map of another place, "
            "or in other coordinates? Give it the right one, or set data.map=false",
        )
    smooth = located if clock.ending is None else recording.lanes.locate(clock.state[:, :2], clock.state[:, 2])
    return located, lane_changes(clock.owner, smooth, recording.lanes).cumsum()


def _walking(clock: Stretches, recording: Recording) -> Bool[np.ndarray, " Z"]:
    """Mask of the states of pedestrians."""
    return (recording.tracks.kind == KINDS.index("pedestrian"))[clock.agent][clock.owner]


def _rows(
    clock: Stretches, moments: Int[np.ndarray, " scenes"], members: Int[np.ndarray, "scenes N"]
) -> Int[np.ndarray, "scenes N"]:
    """Rows of the members of windows at their moments; -1 for none."""
    return np.where(members >= 0, clock.start[members] + moments[:, None] - clock.first[members], -1)


def _choose(
    clock: Stretches,
    changes: Int[np.ndarray, " Z"],
    usable: Bool[np.ndarray, " Z"],
    config: WindowConfig,
    counts: Counter[str],
) -> tuple[Int[np.ndarray, " scenes"], Int[np.ndarray, "scenes N"]]:
    """Moments and members (stretches) of the selected windows; the focal agent is first, the others follow by distance."""
    found_moments, found_members = [np.empty(0, dtype=int)], [np.empty((0, config.agents), dtype=int)]
    for moment, stretch, focal in _crowds(clock, usable, config, counts):
        position = clock.now[_rows(clock, moment, stretch), :2]
        distance = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
        distance[np.broadcast_to((stretch < 0)[:, None], distance.shape)] = np.inf
        diagonal = np.arange(stretch.shape[1])
        distance[:, diagonal, diagonal] = -1.0
        nearest = np.argsort(distance, axis=-1, kind="stable")[..., : config.agents]
        reach = np.take_along_axis(distance, nearest, -1)
        members = np.take_along_axis(np.broadcast_to(stretch[:, None], distance.shape), nearest, -1)
        members = np.where(reach <= (np.inf if config.radius is None else config.radius), members, -1)
        members = np.pad(members, ((0, 0), (0, 0), (0, config.agents - members.shape[2])), constant_values=-1)
        members, moments = members[focal], np.broadcast_to(moment[:, None], focal.shape)[focal]
        counts["windows"] += len(moments)
        enough = (members >= 0).sum(1) >= config.least_agents
        counts[TOO_FEW] += int((~enough).sum())
        members, moments = members[enough], moments[enough]
        _, once = np.unique(np.column_stack([moments, np.sort(members, 1)]), axis=0, return_index=True)
        once.sort()
        counts[TWICE] += len(moments) - len(once)
        found_moments.append(moments[once])
        found_members.append(members[once])
    moments, members = np.concatenate(found_moments), np.concatenate(found_members)
    if config.lane_change:
        first, last = clock.first[members], (clock.first + clock.count - 1)[members]
        before = np.clip((moments - config.history + 1)[:, None], first, last)
        after = np.clip((moments + config.horizon)[:, None], first, last)
        offset = clock.start[members] - first
        changed = ((changes[offset + after] > changes[offset + before]) & (members >= 0)).any(1)
        counts[NO_CHANGE] += int((~changed).sum())
        moments, members = moments[changed], members[changed]
    return moments, members


def _crowds(
    clock: Stretches, usable: Bool[np.ndarray, " Z"], config: WindowConfig, counts: Counter[str]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Moments, the stretches present at each (padded with -1), and the mask of those that may be focal, in chunks."""
    before, after = (config.history - 1, config.horizon) if config.complete else (1, 0)
    count = np.maximum(clock.count - before - after, 0)
    stretch = np.repeat(np.arange(len(count)), count)
    within = np.arange(count.sum()) - np.repeat(count.cumsum() - count, count) + before
    moment = clock.first[stretch] + within
    focal = (within >= config.history - 1) & (within + config.horizon < clock.count[stretch])
    kept = moment % config.every == 0
    on = usable[clock.start[stretch] + moment - clock.first[stretch]]
    if left_out := int((kept & focal & ~on).sum()):
        counts["windows"] += left_out
        counts[NO_LANE] += left_out
    kept &= on
    stretch, moment, focal = stretch[kept], moment[kept], focal[kept]
    order = np.argsort(moment, kind="stable")
    stretch, moment, focal = stretch[order], moment[order], focal[order]
    moments, begin, present = np.unique(moment, return_index=True, return_counts=True)
    most = int(present.max(initial=1))
    size = max(1, CHUNK // most**2)
    for chunk in range(0, len(moments), size):
        rows = slice(chunk, chunk + size)
        place = np.arange(int(present[rows].max()))
        there = place < present[rows, None]
        at = np.where(there, begin[rows, None] + place, 0)
        yield moments[rows], np.where(there, stretch[at], -1), there & focal[at]
