"""Tables of the scenes of a recording: the states of their agents, and what a map adds around them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from epo_lightning.data.recorded.clock import Stretches
from epo_lightning.data.recorded.junctions import Junctions
from epo_lightning.data.recorded.lanes import LaneGraph, Located
from epo_lightning.data.recorded.routes import BEYOND, VECTORS, Routes, pieces, reach
from epo_lightning.data.recorded.surroundings import nearest_pieces, reachable_pieces
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.tracks import Recording
from epo_lightning.frames import AGREE

if TYPE_CHECKING:
    from epo_lightning.data.recorded.windows import WindowConfig


def assemble(
    recording: Recording,
    config: WindowConfig,
    clock: Stretches,
    located: Located,
    moments: Int[np.ndarray, " scenes"],
    members: Int[np.ndarray, "scenes N"],
) -> SceneTables:
    """The tables of the selected windows.

    Args:
        recording: the recording.
        config: settings of the windows.
        clock: the states of the recording.
        located: lanes of these states.
        moments: step of the clock of each window.
        members: rows of the states of its agents at this step, -1 for none.
    """
    used, place = np.unique(members, return_inverse=True)
    place = place.reshape(members.shape)
    if used[0] < 0:
        used, place = used[1:], place - 1
    origin = np.floor(clock.state[:, :2].mean(0))
    history, history_mask = _states(clock, used, np.arange(1 - config.history, 1), origin)
    future, future_mask = _states(clock, used, np.arange(1, config.horizon + 1), origin)
    agent = clock.agent[clock.owner[used]]
    now = clock.now[used]
    centre, direction = common_axes(now[place, :2], now[place, 2], place >= 0)
    if recording.lanes is None:
        columns = _without_map(config, len(used), centre)
    else:
        here = Located(located.lane[used], located.along[used], located.offset[used])
        columns = _on_map(recording.lanes, config, now, here, place, centre, origin)
    return SceneTables(
        history=history,
        history_mask=history_mask,
        future=future,
        future_mask=future_mask,
        size=recording.tracks.size[agent].astype(np.float32),
        kind=recording.tracks.kind[agent],
        track=recording.tracks.ids[agent],
        agents=place.astype(np.int32),
        centre=centre - origin,
        direction=direction,
        recording=np.zeros(len(moments), dtype=np.int32),
        frame=np.round(moments * config.dt * recording.tracks.rate).astype(np.int64),
        origin=origin[None],
        **columns,
    )


def _states(
    clock: Stretches, used: Int[np.ndarray, " A"], steps: Int[np.ndarray, " H"], origin: Float[np.ndarray, " 2"]
) -> tuple[Float[np.ndarray, "A H 4"], Bool[np.ndarray, "A H"]]:
    """States of agents at steps before or after the rows ``used``, relative to an origin, and where they are observed."""
    owner = clock.owner[used]
    begin, end = clock.start[owner], clock.start[owner] + clock.count[owner] - 1
    turns = 2 * np.pi * np.round(clock.now[used, 2] / (2 * np.pi))
    at = used[:, None] + steps
    real = (at >= begin[:, None]) & (at <= end[:, None])
    found = clock.state[np.clip(at, begin[:, None], end[:, None])]
    if clock.ending is not None and steps[-1] == 0:
        recent = min(clock.ending.shape[1], len(steps))
        found[:, len(steps) - recent :] = clock.ending[used, recent - 1 :: -1]
    found[..., :2] -= origin
    found[..., 2] -= turns[:, None]
    return np.where(real[..., None], found, 0.0).astype(np.float32), real


def common_axes(
    position: Float[np.ndarray, "scenes N 2"],
    heading: Float[np.ndarray, "scenes N"],
    counted: Bool[np.ndarray, "scenes N"],
) -> tuple[Float[np.ndarray, "scenes 2"], Float[np.ndarray, " scenes"]]:
    """Mean position [m] of the counted agents of each scene, and direction [rad] of their mean heading.

    All values must be finite, also those of agents that are not counted. The first agent must be counted.
    """
    there = counted[..., None]
    centre = (position * there).sum(1) / there.sum(1)
    ahead = np.stack([(f(heading) * counted).sum(1) for f in (np.cos, np.sin)], 1)
    # If headings oppose each other, their mean has no meaning, and the heading of the first agent is used.
    scattered = np.linalg.norm(ahead, axis=1) < AGREE * counted.sum(1)
    return centre, np.where(scattered, heading[:, 0], np.arctan2(ahead[:, 1], ahead[:, 0]))


def _without_map(config: WindowConfig, agents: int, centre: Float[np.ndarray, "scenes 2"]) -> dict[str, np.ndarray]:
    """Empty columns of what a map adds."""
    polylines = np.empty((0, VECTORS + 1, 2))
    return {
        "candidates": np.empty((agents, 0, 2), dtype=np.float32),
        "references": np.empty((agents, 0, 0, 2), dtype=np.float32),
        "reference_speed": np.empty((agents, 0), dtype=np.float32),
        "polylines": polylines,
        "lanes": nearest_pieces(polylines, centre, config.lanes or 0),
    }


def _on_map(
    lanes: LaneGraph,
    config: WindowConfig,
    now: Float[np.ndarray, "A 4"],
    here: Located,
    place: Int[np.ndarray, "scenes N"],
    centre: Float[np.ndarray, "scenes 2"],
    origin: Float[np.ndarray, " 2"],
) -> dict[str, np.ndarray]:
    """Columns of what a map adds: goal candidates, reference lines and speeds of the agents, and lane polylines.

    Args:
        lanes: the map.
        config: settings of the windows.
        now, here: present states of the agents, and their lanes.
        place: rows of the agents of each scene, -1 for none.
        centre: mean position of the agents of each scene.
        origin: offset that is subtracted from all coordinates.
    """
    time = config.horizon * config.dt
    if config.lines is None:
        route = Routes(lanes).of(now[:, :2], now[:, 3], here, time)
    else:
        route = Junctions(lanes, config.lines).of(now[:, :2], now[:, 2], now[:, 3], here, time)
    limit = lanes.speed_limit[here.lane]
    polylines = pieces(lanes)
    if config.lanes is None:
        _, far = reach(now[:, 3], time)
        near = reachable_pieces(polylines, now[:, :2], far + BEYOND, place, centre)
    else:
        near = nearest_pieces(polylines, centre, config.lanes)
    columns = {
        "candidates": (route.candidates - origin).astype(np.float32),
        "references": (route.references - origin).astype(np.float32),
        "reference_speed": np.where(np.isnan(limit), config.speed_limit, limit).astype(np.float32),
        "polylines": polylines - origin,
        "lanes": near,
    }
    return columns if route.count is None else {**columns, "lines": route.count.astype(np.int32)}
