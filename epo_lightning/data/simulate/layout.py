"""Layouts: motorway sections with ramps, as smooth curves.

A reference curve s -> (x, y, heading) has piecewise linear curvature (straights, clothoids, arcs). Strips are continuous
lanes at a lateral offset d(s) to its left. A main lane has a constant offset; an acceleration lane is continued backwards by
its on-ramp and a deceleration lane forwards by its off-ramp, and both ramps turn away to the right. The traffic simulator
only knows which strips are neighbours in every section of the road; all geometry comes from this module, so that vehicles
do not jump where sections meet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, " *n"]

GRID = 0.25
"""Spacing [m] at which the reference curve is integrated; linear interpolation in between is accurate to 0.01 mm."""
COARSE, STEPS = 10.0, 4
"""Spacing [m] of the points from which positions on the reference curve are searched, and number of Newton steps."""
CLEARANCE = 20.0
"""Length [m] at the beginning or end of a lane beside others that is not driven on, so that vehicles change inside it."""
SWING = 80.0
"""Length [m] over which a ramp turns away from the road."""
SHOULDER_WIDTH = 2.5
"""Width of a hard shoulder [m]."""


@dataclass(frozen=True)
class Strip:
    """A continuous lane.

    Attributes:
        place: number of lanes from the rightmost main lane, positive to the left.
        begin, end: range of s in which it exists [m].
        join: value of s before which it is an on-ramp [m].
        leave: value of s behind which it is an off-ramp [m].
        shoulder: whether it is a hard shoulder, which is not driven on.
    """

    place: float
    begin: float
    end: float
    join: float = -math.inf
    leave: float = math.inf
    shoulder: bool = False

    def road(self, s: float) -> str:
        """Name of its carriageway at s; vehicles change lanes within one carriageway only."""
        return f"on{self.join:.0f}" if s < self.join else f"off{self.leave:.0f}" if s > self.leave else "main"

    @property
    def driven(self) -> tuple[float, float]:
        """Range of s in which vehicles' front bumpers may be [m]."""
        begins_beside = self.begin > 0 and math.isinf(self.join)
        ends_beside = math.isinf(self.leave)
        return self.begin + CLEARANCE * begins_beside, self.end - CLEARANCE * ends_beside


@dataclass(frozen=True)
class Layout:
    """A motorway section.

    Attributes:
        id, name: id and name of the location; the id 0 is reserved for testing.
        curvature: (s, curvature) [m, 1/m] of the reference curve, linear in between; positive turns left.
        heading: heading of the reference curve at s = 0 [rad].
        origin: UTM zone 32N easting and northing [m] of s = 0, which is also the origin of the recordings.
        width: width of a lane [m].
        limit: speed limit [m/s]; None without one.
        slope: largest slope dd/ds of the ramps.
        strips: all lanes, and shoulders.
        area: range of s that is recorded [m].
        main, on, off: vehicles per hour that arrive on the road, arrive on the on-ramp and take the off-ramp.
    """

    id: int
    name: str
    curvature: tuple[tuple[float, float], ...]
    heading: float
    origin: tuple[float, float]
    width: float
    limit: float | None
    slope: float
    strips: tuple[Strip, ...]
    area: tuple[float, float]
    main: float
    on: float
    off: float

    @property
    def lanes(self) -> tuple[Strip, ...]:
        """The strips without the shoulders."""
        return tuple(strip for strip in self.strips if not strip.shoulder)

    @property
    def length(self) -> float:
        """Length of the simulated road [m]."""
        return max(strip.end for strip in self.strips)

    @cached_property
    def _curve(self) -> tuple[Values, Values, Values, Values, Values]:
        s = np.arange(-50.0, self.length + 50.0 + GRID, GRID)
        knots, values = np.array(self.curvature).T
        curvature = np.interp(s, knots, values)

        def integral(rate: Values) -> Values:
            total = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) * (GRID / 2))])
            return total - np.interp(0.0, s, total)

        heading = self.heading + integral(curvature)
        return s, curvature, heading, integral(np.cos(heading)), integral(np.sin(heading))

    def locate(self, s: Values, d: Values) -> Float[np.ndarray, "*n 2"]:
        """Points at s along the reference curve and d to its left [m]."""
        grid, _, heading, x, y = self._curve
        angle = np.interp(s, grid, heading)
        return np.stack([np.interp(s, grid, x) - d * np.sin(angle), np.interp(s, grid, y) + d * np.cos(angle)], -1)

    def project(self, points: Float[np.ndarray, "*n 2"]) -> tuple[Values, Values]:
        """Positions s along the reference curve and d to its left [m] of points near the road.

        This is the inverse of :meth:`locate`: Newton steps from the nearest point of the curve on a coarse
        grid.
        """
        grid, _, heading, x, y = self._curve
        coarse = slice(None, None, round(COARSE / GRID))
        away = (points[..., :1] - x[coarse]) ** 2 + (points[..., 1:] - y[coarse]) ** 2
        s = grid[coarse][away.argmin(-1)]
        d = np.zeros_like(s)
        for _ in range(STEPS):
            angle = np.interp(s, grid, heading)
            way = points - self.locate(s, np.zeros_like(s))
            d = way[..., 1] * np.cos(angle) - way[..., 0] * np.sin(angle)
            ahead = way[..., 0] * np.cos(angle) + way[..., 1] * np.sin(angle)
            s = s + ahead / self.stretch(s, d)
        return s, d

    @property
    def course(self) -> tuple[Values, Values]:
        """Values of s and the heading of the reference curve at them, for interpolation."""
        return self._curve[0], self._curve[2]

    def edges(self, strip: Strip, s: Values) -> tuple[Values, Values]:
        """Offsets of a strip's left and right boundary [m]."""
        left = (strip.place + 0.5) * self.width - self._swing(strip.join - s) - self._swing(s - strip.leave)
        return left, left - (SHOULDER_WIDTH if strip.shoulder else self.width)

    def offset(self, strip: Strip, s: Values) -> Values:
        """Offset of a strip's centreline [m]."""
        return np.mean(self.edges(strip, s), 0)

    def direction(self, strip: Strip, s: Values) -> Values:
        """Heading of a strip's centreline [rad]."""
        grid, _, heading, _, _ = self._curve
        slope = self._swing_slope(strip.join - s) - self._swing_slope(s - strip.leave)
        return np.interp(s, grid, heading) + np.arctan2(slope, self.stretch(s, self.offset(strip, s)))

    def stretch(self, s: Values, d: Values) -> Values:
        """Metres that a point at d moves along the road while s increases by a metre."""
        return 1.0 - np.interp(s, self._curve[0], self._curve[1]) * d

    def along(self, strip: Strip, s: Values) -> Values:
        """Distance along a strip's centreline from its beginning [m]."""
        grid = self._curve[0]
        points = self.locate(grid, self.offset(strip, grid))
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        return np.interp(s, grid, arc) - np.interp(strip.begin, grid, arc)

    def _swing(self, beyond: Values) -> Values:
        """Lateral offset [m] of a ramp, at a distance ``beyond`` the point where it touches the road."""
        x = np.clip(beyond / SWING, 0.0, 1.0)
        return self.slope * (SWING * (x**3 - x**4 / 2) + np.clip(beyond - SWING, 0.0, None))

    def _swing_slope(self, beyond: Values) -> Values:
        """First derivative of :meth:`_swing`."""
        x = np.clip(beyond / SWING, 0.0, 1.0)
        return self.slope * (3 * x**2 - 2 * x**3)

    def sections(self, cuts: Iterable[float]) -> list[tuple[float, float]]:
        """Sections (begin, end) of the road, cut at some values of s [m]."""
        kept = sorted({min(max(cut, 0.0), self.length) for cut in cuts} | {0.0, self.length})
        return list(pairwise(kept))


def _main(lanes: int, end: float) -> tuple[Strip, ...]:
    return tuple(Strip(place, 0.0, end) for place in range(lanes))


def _shoulders(*ranges: tuple[float, float]) -> tuple[Strip, ...]:
    return tuple(Strip(-1, begin, end, shoulder=True) for begin, end in ranges)


LAYOUTS = (
    Layout(
        id=0,
        name="merge_diverge",
        curvature=((0, 0), (450, 0), (600, 1 / 1200), (900, 1 / 1200), (1050, 0)),
        heading=0.6,
        origin=(352_100.0, 5_651_300.0),
        width=3.75,
        limit=100 / 3.6,
        slope=0.07,
        strips=(
            *_main(2, 1600),
            Strip(-1, 380, 870, join=620),
            Strip(-1, 1040, 1560, leave=1290),
            *_shoulders((0, 460), (870, 1040), (1450, 1600)),
        ),
        area=(480, 1460),
        main=2350,
        on=650,
        off=600,
    ),
    Layout(
        id=1,
        name="merge",
        curvature=((0, -1 / 1500), (500, -1 / 1500), (650, -1 / 900), (1000, -1 / 900), (1150, 0)),
        heading=2.2,
        origin=(355_600.0, 5_655_400.0),
        width=3.75,
        limit=100 / 3.6,
        slope=0.08,
        strips=(*_main(3, 1450), Strip(-1, 400, 960, join=640), *_shoulders((0, 480), (960, 1450))),
        area=(500, 1300),
        main=3900,
        on=900,
        off=0,
    ),
    Layout(
        id=2,
        name="diverge",
        curvature=((0, 0), (600, 0), (800, 1 / 700), (1100, 1 / 700), (1250, 0)),
        heading=-1.1,
        origin=(301_800.0, 5_622_700.0),
        width=3.5,
        limit=None,
        slope=0.06,
        strips=(*_main(2, 1500), Strip(-1, 820, 1470, leave=1120), *_shoulders((0, 820), (1300, 1500))),
        area=(450, 1330),
        main=3400,
        on=0,
        off=1200,
    ),
    Layout(
        id=3,
        name="diverge_merge",
        curvature=((0, 1 / 2500), (700, 1 / 2500), (900, -1 / 2500), (1700, -1 / 2500)),
        heading=1.4,
        origin=(331_900.0, 5_644_200.0),
        width=3.75,
        limit=None,
        slope=0.07,
        strips=(
            *_main(3, 1700),
            Strip(-1, 530, 900, leave=780),
            Strip(-1, 980, 1400, join=1150),
            *_shoulders((0, 530), (1400, 1700)),
        ),
        area=(460, 1500),
        main=3900,
        on=800,
        off=700,
    ),
    Layout(
        id=4,
        name="weave",
        curvature=((0, 0), (500, 0), (650, 1 / 1000), (800, 1 / 1000), (1000, -1 / 1000), (1150, -1 / 1000), (1300, 0)),
        heading=-2.5,
        origin=(353_300.0, 5_638_800.0),
        width=3.5,
        limit=120 / 3.6,
        slope=0.07,
        strips=(*_main(2, 1550), Strip(-1, 400, 1350, join=640, leave=1080), *_shoulders((0, 460), (1270, 1550))),
        area=(460, 1380),
        main=2650,
        on=750,
        off=750,
    ),
    Layout(
        id=5,
        name="merge_lane_drop",
        curvature=((0, 1 / 1800), (400, 1 / 1800), (600, 0), (900, 0), (1050, -1 / 1300), (1500, -1 / 1300)),
        heading=0.1,
        origin=(294_400.0, 5_630_100.0),
        width=3.75,
        limit=120 / 3.6,
        slope=0.08,
        strips=(
            *_main(2, 1500),
            Strip(2, 0, 1130),
            Strip(-1, 380, 860, join=620),
            *_shoulders((0, 460), (860, 1500)),
        ),
        area=(480, 1380),
        main=2800,
        on=650,
        off=0,
    ),
    Layout(
        id=6,
        name="double_merge",
        curvature=((0, -1 / 2000), (600, -1 / 2000), (800, 1 / 1600), (1200, 1 / 1600), (1400, 0)),
        heading=-0.4,
        origin=(321_700.0, 5_640_600.0),
        width=3.5,
        limit=None,
        slope=0.06,
        strips=(
            *_main(2, 1500),
            Strip(-1, 380, 1500, join=640),
            Strip(-2, 380, 930, join=640),
            *_shoulders((0, 440)),
        ),
        area=(500, 1350),
        main=3200,
        on=1800,
        off=0,
    ),
)
"""Seven layouts, like the seven locations of exiD: single ramps, two ramps in either order, weaving, and lanes that end."""
