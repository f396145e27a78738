"""Recordings: the tracks of agents and the lanes they move on, in one record type for every format.

A format is one file in ``formats/``: a registered function that lists the recordings of a folder::

    @register("format", "exid")
    def exid(folder: Path) -> list[RecordingSource]: ...

Listing must be cheap; a :class:`RecordingSource` reads its files when its ``read`` is called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.lanes import FARTHEST, LaneGraph
from epo_lightning.scene import KINDS

__all__ = ["Recording", "RecordingError", "RecordingSource", "TrackTable"]

FASTEST = 120.0
"""Largest speed [m/s]; more indicates a wrong unit."""
LONGEST = 40.0
"""Largest length of a vehicle [m]; more indicates a wrong unit."""
NUMBERING = {
    "ids": "number texts by np.unique(ids, return_inverse=True)[1]",
    "kind": f"a kind is an index into KINDS of epo_lightning/scene.py, 0 to {len(KINDS) - 1} for {', '.join(KINDS)}",
}
"""How columns of whole numbers are made from texts."""


def _first_text(values: np.ndarray) -> str | None:
    """The first entry that is text and no number; None if there is none."""
    for value in values.ravel() if values.dtype.kind in "OUS" else ():
        try:
            float(value)
        except (TypeError, ValueError):
            return str(value)
    return None


def _first(bad: Bool[np.ndarray, " n"]) -> int:
    """Index of the first entry that is True."""
    return int(np.flatnonzero(bad)[0])


@dataclass(frozen=True)
class TrackTable:
    """Tracks of all agents of a recording. Rows are sorted by agent, and by frame within an agent; frames may be missing.

    Attributes:
        rate: frames per second [Hz].
        agent: index of each row's agent, 0 .. A-1.
        frame: number of each row's frame.
        position: position of the centre [m].
        heading: direction of the front, counter-clockwise from x [rad]; any number of turns.
        velocity: components along x and y [m/s].
        ids: identifier of each agent in the recording.
        size: length and width of each agent [m].
        kind: kind of each agent, an index into :data:`~epo_lightning.scene.KINDS`.
    """

    rate: float
    agent: Int[np.ndarray, " T"]
    frame: Int[np.ndarray, " T"]
    position: Float[np.ndarray, "T 2"]
    heading: Float[np.ndarray, " T"]
    velocity: Float[np.ndarray, "T 2"]
    ids: Int[np.ndarray, " A"]
    size: Float[np.ndarray, "A 2"]
    kind: Int[np.ndarray, " A"]

    def __len__(self) -> int:
        return len(self.agent)

    @property
    def speed(self) -> Float[np.ndarray, " T"]:
        """Speed along the heading [m/s], negative when reversing."""
        return self.velocity[:, 0] * np.cos(self.heading) + self.velocity[:, 1] * np.sin(self.heading)

    def check(self, path: Path | str, fastest: float = FASTEST, sizes: Path | str | None = None) -> TrackTable:
        """This table, after a check that its numbers are plausible.

        Args:
            path: path of the file, for error messages.
            fastest: speed [m/s] that no agent exceeds from one of its rows to the next.
            sizes: path of the file with the sizes; None if it is the same.

        Raises:
            RecordingError: no rows, columns of different length, numbers of another type or that are not finite, implausible
                units, or an agent whose frames do not increase or that jumps.
        """

        if not len(self.agent):
            raise RecordingError(path, "the recording has no tracks; at least one was expected")
        self._check_types(path)
        self._check_shapes(path)
        if not (np.isfinite(self.rate) and 1.0 <= self.rate <= 1000.0):
            raise RecordingError(path, f"a frame rate of {self.rate} Hz was expected to lie between 1 and 1000 Hz")
        self._check_order(path)
        self._check_units(path)
        self._check_jumps(path, fastest)
        self._check_sizes(path if sizes is None else sizes)
        return self

    def _check_types(self, path: Path | str) -> None:
        """Refuse columns of another type than expected.

        Raises:
            RecordingError: the column and its type.
        """
        for name in ("agent", "frame", "ids", "kind"):
            if not np.issubdtype((given := getattr(self, name)).dtype, np.integer):
                how = NUMBERING.get(name, "number them")
                raise RecordingError(path, f"{name} is of type {given.dtype}; whole numbers were expected: {how}")
        for name in ("position", "heading", "velocity", "size"):
            if not np.issubdtype((given := getattr(self, name)).dtype, np.floating):
                text = _first_text(given)
                what = f"of type {given.dtype}" if text is None else f"text, such as {text!r}"
                raise RecordingError(path, f"{name} is {what}; floating-point numbers were expected")

    def _check_shapes(self, path: Path | str) -> None:
        """Refuse columns of another shape than the others have.

        Raises:
            RecordingError: the column, its shape and the expected one.
        """
        rows, agents = len(self.agent), len(self.ids)
        shapes = {"frame": (rows,), "position": (rows, 2), "heading": (rows,), "velocity": (rows, 2)}
        for name, shape in {**shapes, "size": (agents, 2), "kind": (agents,)}.items():
            if (given := np.shape(getattr(self, name))) != shape:
                column = "agent" if name in shapes else "ids"
                raise RecordingError(
                    path, f"{name} has the shape {given}; {shape} was expected, because {column} has {shape[0]} entries"
                )

    def _check_order(self, path: Path | str) -> None:
        """Refuse rows that are not sorted by agent, and then by frame.

        Raises:
            RecordingError: the first row that is out of order.
        """
        by_agent = np.diff(self.agent)
        backwards = (by_agent < 0) | ((by_agent == 0) & (np.diff(self.frame) <= 0))
        if backwards.any():
            row = _first(backwards) + 1
            track, frame, before = self.ids[self.agent[row]], self.frame[row], self.frame[row - 1]
            if self.agent[row] == self.agent[row - 1] and frame == before:
                raise RecordingError(
                    path, f"track {track} has frame {frame} twice: is its id that of two agents, or a row repeated?"
                )
            if by_agent[row - 1] < 0:
                raise RecordingError(
                    path,
                    f"frame {frame} of track {track} comes after frames of track {self.ids[self.agent[row - 1]]}: tracks "
                    "are sorted by agent, and then by frame",
                )
            raise RecordingError(
                path,
                f"frame {frame} of track {track} comes after its frame {before}: frames of a track must increase, and an id "
                "must belong to one agent",
            )

    def _check_units(self, path: Path | str) -> None:
        """Refuse numbers that are not finite or so large that their unit must be another one.

        Raises:
            RecordingError: the first such number.
        """
        for name, values, limit, unit in (
            ("position", self.position, FARTHEST, "m"),
            ("heading", self.heading[:, None], 1e4, "rad"),
            ("velocity", self.velocity, FASTEST, "m/s"),
        ):
            bad = ~np.all(np.abs(values) <= limit, axis=1)
            if bad.any():
                row = _first(bad)
                raise RecordingError(
                    path,
                    f"{name} {values[row].tolist()} of track {self.ids[self.agent[row]]} in frame {self.frame[row]} was "
                    f"expected to be finite and at most {limit:g} {unit}: is it in another unit?",
                )

    def _check_jumps(self, path: Path | str, fastest: float) -> None:
        """Refuse an agent that is faster than ``fastest`` [m/s] from one of its rows to the next.

        Raises:
            RecordingError: the first jump.
        """
        way = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        jumps = (np.diff(self.agent) == 0) & (way * self.rate > fastest * np.diff(self.frame))
        if jumps.any():
            row = _first(jumps)
            raise RecordingError(
                path,
                f"track {self.ids[self.agent[row]]} jumps from {self.position[row].tolist()} to "
                f"{self.position[row + 1].tolist()} m after its frame {self.frame[row]}: agents stay below {fastest:g} m/s; "
                "is its id that of two agents, or a position wrong?",
            )

    def _check_sizes(self, path: Path | str) -> None:
        """Refuse sizes of agents that are not positive, or too large.

        Raises:
            RecordingError: the first such size.
        """
        bad = ~np.all((self.size > 0) & (self.size <= LONGEST), axis=1)
        if bad.any():
            agent = _first(bad)
            raise RecordingError(
                path,
                f"length and width {self.size[agent].tolist()} of track {self.ids[agent]} were expected to be positive "
                f"and at most {LONGEST:g} m: are they in another unit?",
            )


def together(parts: Sequence[TrackTable]) -> TrackTable:
    """The agents of several tables of one recording in one table, one table after the other; all have the same rate."""
    agents = np.cumsum([0, *(len(part.ids) for part in parts[:-1])])
    columns = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(TrackTable)
        if field.name not in ("rate", "agent")
    }
    agent = np.concatenate([part.agent + before for part, before in zip(parts, agents, strict=True)])
    return TrackTable(rate=parts[0].rate, agent=agent, **columns)


@dataclass(frozen=True)
class Recording:
    """The contents of one recording.

    Attributes:
        name: name of the recording, unique within its data set.
        group: name of a group of recordings, such as a map, a scene or a layout. Splits can keep a group together.
        tracks: tracks of all agents.
        lanes: lane graph of the map; None without a map.
        dropped: numbers of items that the reader left out, by reason.
    """

    name: str
    group: str
    tracks: TrackTable
    lanes: LaneGraph | None
    dropped: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordingSource:
    """A recording that can be read: its name, its files and the function that reads them.

    Attributes:
        name, group: name and group of the :class:`Recording`.
        files: files of the recording; their contents identify a data set.
        read: function that reads the recording, possibly in another process; it must therefore be a function at module level
            or a partial of one. Raises :class:`RecordingError`.

    Raises:
        RecordingError: ``read`` is no function.
    """

    name: str
    group: str
    files: tuple[Path, ...]
    read: Callable[[], Recording]

    def __post_init__(self) -> None:
        if not callable(self.read):
            raise RecordingError(
                self.files[0] if self.files else self.name,
                f"the last argument of RecordingSource is a {type(self.read).__name__}; a function was expected, which is "
                "called when the recording is needed: partial(read, file) instead of read(file)",
            )


def unwrapped(heading: Float[np.ndarray, " n"], begin: Int[np.ndarray, " C"]) -> Float[np.ndarray, " n"]:
    """Headings [rad] without jumps of a turn within the stretches that begin at the rows ``begin``.

    The first heading of each stretch is kept.
    """
    turns = -np.round(np.diff(heading, prepend=heading[:1]) / (2 * np.pi))
    turns[begin] = 0.0
    turns = turns.cumsum()
    return heading + 2 * np.pi * (turns - np.repeat(turns[begin], np.diff(np.append(begin, len(heading)))))
