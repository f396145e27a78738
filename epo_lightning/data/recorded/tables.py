"""The scenes of recordings as tables: one row per agent, per lane polyline and per scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class SceneTables:
    """The scenes of one or more recordings, as columns.

    Attributes, by agent (A rows):
        history, history_mask, future, future_mask: states x, y [m], heading [rad], speed [m/s].
        size: length and width [m].
        kind: an index into :data:`~epo_lightning.scene.KINDS`.
        track: identifier of the agent in the recording.
        candidates, references, reference_speed: goal candidates and reference lines; empty without a map.
        lines: number of reference lines of each agent, the first ones of ``references``; None if every agent has all.
    Attributes, by lane polyline (T rows):
        polylines: points of the map's polylines.
    Attributes, by scene:
        agents: rows of the scene's agents, -1 for none.
        lanes: rows of its polylines, -1 for none.
        centre: mean position of its agents, the origin of its frame [m].
        direction: mean heading of its agents [rad].
        recording: index of its recording.
        frame: the recording's frame number at t0.
    Attributes, by recording:
        origin: offset that was subtracted from all coordinates of the recording [m].
    """

    history: Float[np.ndarray, "A H 4"]
    history_mask: Bool[np.ndarray, "A H"]
    future: Float[np.ndarray, "A K 4"]
    future_mask: Bool[np.ndarray, "A K"]
    size: Float[np.ndarray, "A 2"]
    kind: Int[np.ndarray, " A"]
    track: Int[np.ndarray, " A"]
    candidates: Float[np.ndarray, "A G 2"]
    references: Float[np.ndarray, "A R Q 2"]
    reference_speed: Float[np.ndarray, " A"]
    polylines: Float[np.ndarray, "T V+1 2"]
    agents: Int[np.ndarray, "scenes N"]
    lanes: Int[np.ndarray, "scenes L"]
    centre: Float[np.ndarray, "scenes 2"]
    direction: Float[np.ndarray, " scenes"]
    recording: Int[np.ndarray, " scenes"]
    frame: Int[np.ndarray, " scenes"]
    origin: Float[np.ndarray, "O 2"]
    lines: Int[np.ndarray, " A"] | None = None

    def __len__(self) -> int:
        return len(self.agents)

    def columns(self) -> dict[str, np.ndarray]:
        """The columns by name, without those that are None."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: values for name, values in found.items() if values is not None}


INDEX_OF = {"agents": "history", "lanes": "polylines", "recording": "origin"}
"""Fields that hold row indices, and the fields that these index."""
OF_AGENTS = (
    *("history", "history_mask", "future", "future_mask", "size", "kind", "track"),
    *("candidates", "references", "reference_speed", "lines"),
)
"""Fields with one row per agent."""
OF_SCENES = ("agents", "lanes", "centre", "direction", "recording", "frame")
"""Fields with one row per scene."""


def shifted(tables: SceneTables, before: Mapping[str, int], widest: int) -> dict[str, np.ndarray]:
    """The columns of a piece of longer tables, without those that are None.

    Args:
        tables: the piece.
        before: number of rows before the piece, for each of the fields that are values of ``INDEX_OF``.
        widest: number of lanes per scene of the longer tables; fewer lanes are padded.
    """
    columns = tables.columns()
    lanes = columns["lanes"]
    columns["lanes"] = np.pad(lanes, ((0, 0), (0, widest - lanes.shape[1])), constant_values=-1)
    for name, rows in INDEX_OF.items():
        columns[name] = np.where(columns[name] < 0, -1, columns[name] + np.int64(before[rows]))
    return columns


def joined(parts: Sequence[SceneTables]) -> SceneTables:
    """The concatenation of several tables, with all row indices adjusted.

    Tables may have different numbers of lanes per scene; the narrower ones are padded.
    """
    widest = max(part.lanes.shape[1] for part in parts)
    before = Counter(dict.fromkeys(INDEX_OF.values(), 0))
    pieces = []
    for part in parts:
        pieces.append(shifted(part, before, widest))
        before.update({name: len(getattr(part, name)) for name in before})
    return SceneTables(**{name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]})


def selected(tables: SceneTables | None, kept: Bool[np.ndarray, " scenes"] | None) -> SceneTables | None:
    """The tables of some of the scenes, without the agents of the others; None if no scene is kept."""
    if tables is None or kept is None or not kept.any():
        return None
    members = tables.agents[kept]
    used = np.unique(members[members >= 0])
    place = np.full(len(tables.history), -1, dtype=members.dtype)
    place[used] = np.arange(len(used))
    columns: dict[str, np.ndarray | None] = {}
    for field in fields(SceneTables):
        value = getattr(tables, field.name)
        if field.name in OF_AGENTS:
            value = None if value is None else value[used]
        elif field.name in OF_SCENES:
            value = value[kept]
        columns[field.name] = value
    columns["agents"] = np.where(members >= 0, place[members], -1).astype(members.dtype)
    return SceneTables(**columns)  # type: ignore[arg-type]
