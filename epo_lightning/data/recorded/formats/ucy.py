"""Reader of UCY pedestrians: one ``obsmat.txt`` per place, without a map.

Lerner, Chrysanthou and Lischinski, "Crowds by Example", Eurographics 2007. The columns are frame, pedestrian, x, z, y, vx,
vz and vy, in metres and m/s; z is up. Frames are those of a video of 25 Hz, of which about every tenth is annotated.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from epo_lightning.data.recorded.formats.motion import direction_of_motion
from epo_lightning.data.recorded.tracks import Recording, RecordingError, RecordingSource, TrackTable
from epo_lightning.registry import register
from epo_lightning.scene import KINDS

VIDEO_RATE = 25.0
"""Frames per second of the videos [Hz]."""
COLUMNS = ("frame", "pedestrian", "x", "z", "y", "vx", "vz", "vy")
LARGEST = 1e9
"""Largest frame number or id."""
DIAMETER = 0.5
"""Length and width of a pedestrian [m]; the format has none."""


@register("format", "ucy")
def ucy(folder: Path) -> list[RecordingSource]:
    """All ``obsmat.txt`` below a folder, each named after its own folder.

    Raises:
        RecordingError: there is no such file, or two have the same name.
    """
    paths = sorted(path for path in Path(folder).rglob("obsmat.txt") if path.is_file())
    if not paths:
        raise RecordingError(folder, "there is no obsmat.txt in this folder or below it")
    first: dict[str, Path] = {}
    for path in paths:
        name = path.resolve().parent.name
        if name in first:
            raise RecordingError(path, f"{first[name]} is in a folder of the same name: rename one of the two")
        first[name] = path
    return [RecordingSource(name, name, (path,), partial(_read_recording, path, name)) for name, path in first.items()]


def _read_recording(path: Path, name: str) -> Recording:
    table = _table(path)
    table = table[np.lexsort((table[:, 0], table[:, 1]))]
    ids, agent = np.unique(table[:, 1].astype(int), return_inverse=True)
    video_frame = table[:, 0].astype(int)
    frame = video_frame - video_frame.min()
    step = int(np.gcd.reduce(frame))
    if step == 0:
        raise RecordingError(path, "all rows are of one frame; pedestrians were expected to be seen at several times")
    within = np.sort(np.diff(frame)[np.diff(agent) == 0])
    usual = int(within[len(within) // 2]) if len(within) else step
    if usual > step:
        row = int(np.flatnonzero(frame % usual)[0])
        raise RecordingError(
            path,
            f"frame {video_frame[row]} of pedestrian {ids[agent[row]]} is not annotated: annotated frames are "
            f"{usual} apart; correct or remove it",
        )
    velocity = table[:, [5, 7]]
    tracks = TrackTable(
        rate=VIDEO_RATE / step,
        agent=agent,
        frame=frame // step,
        position=table[:, [2, 4]],
        heading=direction_of_motion(agent, velocity),
        velocity=velocity,
        ids=ids,
        size=np.full((len(ids), 2), DIAMETER),
        kind=np.full(len(ids), KINDS.index("pedestrian")),
    )
    return Recording(name, name, tracks.check(path), lanes=None)


def _table(path: Path) -> Float[np.ndarray, "T 8"]:
    """The numbers of a file, checked."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(path, f"the file is no text ({error.reason}): fetch it again") from error
    if not text.strip():
        raise RecordingError(path, f"the file is empty; rows of {', '.join(COLUMNS)} were expected")
    rows = [(row, line.split()) for row, line in enumerate(text.split("\n"), 1) if line.strip()]
    for row, cells in rows:
        if len(cells) != len(COLUMNS):
            raise RecordingError(path, f"there are {len(cells)} columns; {', '.join(COLUMNS)} were expected", row)
    table = np.array([[_number(cell) for cell in cells] for _, cells in rows])
    bad = ~np.isfinite(table)
    bad[:, :2] |= (np.abs(table[:, :2]) > LARGEST) | (table[:, :2] != np.rint(table[:, :2]))
    if bad.any():
        at, column = np.argwhere(bad)[0]
        row, cells = rows[at]
        expected = f"whole number up to {LARGEST:g}" if column < 2 else "finite number"
        raise RecordingError(path, f"{COLUMNS[column]} is {cells[column][:40]!r}; a {expected} was expected", row)
    return table


def _number(cell: str) -> float:
    """The number in a cell; NaN for other text and for 1_000, which Python would read as a number."""
    try:
        return np.nan if "_" in cell else float(cell)
    except ValueError:
        return np.nan
