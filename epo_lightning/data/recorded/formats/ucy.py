"""Reader of UCY and ETH pedestrians: one ``obsmat.txt`` per place, without a map.

Lerner, Chrysanthou and Lischinski, "Crowds by Example", Eurographics 2007; Pellegrini, Ess, Schindler and van Gool, "You'll
Never Walk Alone", ICCV 2009. The columns are frame, pedestrian, x, z, y, vx, vz and vy, in metres and m/s; z is up. Frames
are those of a video, of which every tenth or sixth is annotated: UCY and ETH's ``seq_hotel`` have 25 Hz, ``seq_eth`` 15 Hz.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.formats.motion import direction_of_motion
from epo_lightning.data.recorded.tracks import Recording, RecordingError, RecordingSource, TrackTable
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import KINDS

NAME = "obsmat.txt"
"""Name of the file of every recording."""
VIDEO_RATE = 25.0
"""Frames per second of most videos [Hz]."""
COLUMNS = ("frame", "pedestrian", "x", "z", "y", "vx", "vz", "vy")
USUAL_RATES = (5.0, 10.0, 12.0, 15.0, 20.0, 24.0, 25.0, 30.0, 50.0, 60.0)
"""Frames per second of videos [Hz]."""
TOLERANCE = 0.12
"""Largest relative difference between the rate that displacements and velocities say and a usual one, because velocities are
estimates."""
WALKING = 0.3
"""Speed [m/s] above which displacements are compared with velocities."""
ENOUGH = 10
"""Smallest number of displacements that say a frame rate."""
SERIES = 3
"""Smallest number of annotated frames with the same phase."""
LARGEST = 1e9
"""Largest frame number or id."""
DIAMETER = 0.5
"""Length and width of a pedestrian [m]; the format has none."""


@register("format", "ucy")
def ucy(folder: Path, video_rate: float | None = None) -> list[RecordingSource]:
    """All ``obsmat.txt`` below a folder, each named after its own folder.

    Args:
        video_rate: frames per second of the videos [Hz]; None for 25 or, in a file whose displacements and velocities say
            something else, the nearest usual rate.

    Raises:
        RecordingError: there is no such file, or two have the same name.
        ConfigError: the frame rate is no positive number.
    """
    if video_rate is not None and (
        isinstance(video_rate, bool) or not isinstance(video_rate, int | float) or not 1.0 <= video_rate <= 1000.0
    ):
        raise ConfigError(
            f"data.options.video_rate must be frames per second, between 1 and 1000, or null, not {video_rate!r}"
        )
    # Links to nowhere are kept, which a pattern without a star skips: no recording must be left out in silence.
    paths = sorted(path for path in Path(folder).rglob("obsmat*") if path.name == NAME and not path.is_dir())
    if not paths:
        raise RecordingError(folder, "there is no obsmat.txt in this folder or below it")
    first: dict[str, Path] = {}
    for path in paths:
        name = path.parent.resolve().name
        if name in first:
            raise RecordingError(path, f"{first[name]} is in a folder of the same name: rename one of the two")
        first[name] = path
    return [
        RecordingSource(name, name, (path,), partial(_read_recording, path, name, video_rate))
        for name, path in first.items()
    ]


def _read_recording(path: Path, name: str, video_rate: float | None = None) -> Recording:
    dropped: Counter[str] = Counter()
    table = _table(path)
    _check_axes(table, path)
    table = table[np.lexsort((table[:, 0], table[:, 1]))]
    step = _step(table, path)
    table, index = _annotated(table, step, dropped)
    ids, agent = np.unique(table[:, 1].astype(int), return_inverse=True)
    position, velocity = table[:, [2, 4]], table[:, [5, 7]]
    rate = _video_rate(agent, index, position, velocity, step, path) if video_rate is None else float(video_rate)
    tracks = TrackTable(
        rate=rate / step,
        agent=agent,
        frame=index,
        position=position,
        heading=direction_of_motion(agent, velocity),
        velocity=velocity,
        ids=ids,
        size=np.full((len(ids), 2), DIAMETER),
        kind=np.full(len(ids), KINDS.index("pedestrian")),
    )
    return Recording(name, name, tracks.check(path), lanes=None, dropped=dict(dropped))


def _check_axes(table: Float[np.ndarray, "T 8"], path: Path) -> None:
    """Check that pedestrians move along y rather than upwards, as they seem to do where y and z are exchanged."""
    for across, up in (("y", "z"), ("vy", "vz")):
        same, differ = (table[:, COLUMNS.index(name)] for name in (across, up))
        if not np.ptp(same) and np.ptp(differ):
            raise RecordingError(
                path,
                f"{across} is {same[0]:g} in all rows, and {up} is not the same: z is up, and columns were expected in the "
                f"order {', '.join(COLUMNS)}; are {across} and {up} exchanged?",
            )


def _step(table: Float[np.ndarray, "T 8"], path: Path) -> int:
    """Video frames between two annotated frames: the usual distance of two rows of a pedestrian."""
    frame, agent = table[:, 0].astype(int), table[:, 1]
    every = int(np.gcd.reduce(frame - frame.min()))
    if every == 0:
        raise RecordingError(path, "all rows are of one frame; pedestrians were expected to be seen at several times")
    within = np.sort(np.diff(frame)[np.diff(agent) == 0])
    usual = int(within[len(within) // 2]) if len(within) else every
    return max(usual, every)


def _annotated(
    table: Float[np.ndarray, "T 8"], step: int, dropped: Counter[str]
) -> tuple[Float[np.ndarray, "T 8"], Int[np.ndarray, " T"]]:
    """The rows of annotated frames, and the index of each row's frame among the annotated ones.

    ETH's annotation is shifted by some frames here and there. A shift begins a new series of annotated frames; the indices
    leave a gap there, so that tracks are cut and no time step has another length. Frames in a series of fewer than SERIES
    are mistakes, and are left out.
    """
    frame = table[:, 0].astype(int)
    kept = np.ones(len(frame), dtype=bool)
    while True:
        seen = np.unique(frame[kept])
        series = np.append(0, (np.diff(seen) % step != 0).cumsum())
        short = np.bincount(series) < min(SERIES, len(seen))
        if not short.any() or len(short) == 1:
            break
        # The shortest series goes first: without it, the series around it may be one.
        worst = int(np.argmin(np.bincount(series)))
        kept &= ~np.isin(frame, seen[series == worst])
    if (left_out := int((~kept).sum())) > 0:
        dropped["rows between the annotated frames"] = left_out
    if shifts := int(series[-1]):
        dropped["shifts of the annotated frames, where tracks are cut"] = shifts
    gap = np.diff(seen)
    ahead = np.where(gap % step == 0, gap // step, np.maximum(-(-gap // step), 2))
    index = np.append(0, ahead.cumsum())
    return table[kept], index[np.searchsorted(seen, frame[kept])]


def _video_rate(
    agent: Int[np.ndarray, " T"],
    index: Int[np.ndarray, " T"],
    position: Float[np.ndarray, "T 2"],
    velocity: Float[np.ndarray, "T 2"],
    step: int,
    path: Path,
) -> float:
    """Frames per second of a video: 25, or the usual rate with which displacements agree with velocities."""
    row = np.flatnonzero((np.diff(agent) == 0) & (np.diff(index) == 1))
    with np.errstate(all="ignore"):  # numbers that are too large are reported by the table's own check
        travelled = np.hypot(*(position[row + 1] - position[row]).T) / step
        stated = 0.5 * np.hypot(*(velocity[row] + velocity[row + 1]).T)
        moving = (travelled * VIDEO_RATE > WALKING) & (stated > WALKING)
        found = float(np.median(stated[moving] / travelled[moving])) if moving.sum() >= ENOUGH else VIDEO_RATE
    if not 0 < found < np.inf:
        return VIDEO_RATE
    if abs(np.log(found / VIDEO_RATE)) < np.log(1 + TOLERANCE):
        return VIDEO_RATE
    usual = min(USUAL_RATES, key=lambda rate: abs(np.log(found / rate)))
    if abs(np.log(found / usual)) < np.log(1 + TOLERANCE):
        return usual
    raise RecordingError(
        path,
        f"positions and velocities agree at {found:.3g} video frames per second, which is no usual rate: set it with "
        "data.options.video_rate",
    )


def _table(path: Path) -> Float[np.ndarray, "T 8"]:
    """The numbers of a file, checked."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(path, f"the file is no text ({error.reason}): fetch it again") from error
    if not text.strip():
        raise RecordingError(path, f"the file is empty; rows of {', '.join(COLUMNS)} were expected")
    rows = [(row, line.split()) for row, line in enumerate(text.split("\n"), 1) if line.strip()]
    for row, cells in rows:
        if len(cells) != len(COLUMNS):
            raise RecordingError(
                path, f"there are {len(cells)} columns; {', '.join(COLUMNS)} were expected, separated by spaces", row
            )
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
