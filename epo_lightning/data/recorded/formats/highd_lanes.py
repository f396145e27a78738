"""Lanes of highD: straight lines between the lane markings of a recording's metadata."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.lanes import LANE, LaneGraph, Polyline

NARROWEST, WIDEST = 2.0, 8.0
"""Smallest and largest width of a lane [m]."""
ROUNDED = 10.0
"""Lanes begin and end at multiples of this length [m]."""


def highd_lanes(
    upper: Sequence[float], lower: Sequence[float], reach: tuple[float, float], speed_limit: float, path: Path | str
) -> LaneGraph:
    """The lanes of both carriageways of a recording, in axes with y up.

    Vehicles on the upper carriageway of the image drive towards smaller x, those on the lower one towards larger x. Lane ids
    are highD's: lanes and the gaps between them are counted from the upper edge of the image, and the first lane is 2.

    Args:
        upper, lower: positions of the markings of both carriageways along y, which points down [m].
        reach: smallest and largest x of the recorded vehicles [m]; the files do not say where lanes begin and end.
        speed_limit: [m/s]; NaN if there is none.
        path: path of the file, for error messages.

    Raises:
        RecordingError: fewer than two markings on a side, or markings that are not in increasing order or leave lanes of an
            implausible width.
    """
    for name, markings in (("upperLaneMarkings", upper), ("lowerLaneMarkings", lower)):
        widths = np.diff(np.array(markings, dtype=float))
        if len(markings) < 2 or not ((widths >= NARROWEST) & (widths <= WIDEST)).all():
            raise RecordingError(
                path,
                f"{name} is {list(markings)}; two or more positions of markings in metres were expected, in increasing "
                f"order and {NARROWEST:g} to {WIDEST:g} m apart",
                row=2,
            )
    if not upper[-1] < lower[0]:
        raise RecordingError(
            path, f"upperLaneMarkings end at {upper[-1]}, beyond the first of lowerLaneMarkings, {lower[0]}", row=2
        )
    begin, end = ROUNDED * np.floor(reach[0] / ROUNDED), ROUNDED * np.ceil(reach[1] / ROUNDED)

    def line(y: float, ahead: bool) -> Polyline:
        points = np.array([[begin, -y], [end, -y]])
        return points if ahead else points[::-1]

    lanes = [(number + 2, upper[number], upper[number + 1], False) for number in range(len(upper) - 1)]
    lanes += [(number + 2 + len(upper), lower[number], lower[number + 1], True) for number in range(len(lower) - 1)]
    index = {id: lane for lane, (id, *_) in enumerate(lanes)}
    # On the upper carriageway, the left lane is the next one towards the lower edge of the image.
    left_of = np.array([index.get(id + (-1 if ahead else 1), -1) for id, _, _, ahead in lanes])
    right_of = np.array([index.get(id + (1 if ahead else -1), -1) for id, _, _, ahead in lanes])
    return LaneGraph(
        ids=np.array([id for id, *_ in lanes]),
        left=[line(near if ahead else far, ahead) for _, near, far, ahead in lanes],
        right=[line(far if ahead else near, ahead) for _, near, far, ahead in lanes],
        centre=[line((near + far) / 2, ahead) for _, near, far, ahead in lanes],
        successors=[()] * len(lanes),
        left_of=left_of,
        right_of=right_of,
        adjacent_left=left_of,
        adjacent_right=right_of,
        speed_limit=np.full(len(lanes), speed_limit),
        kind=np.full(len(lanes), LANE),
    ).check(path)
