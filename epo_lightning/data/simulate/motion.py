"""Smooth trajectories of vehicles' centres in the plane, from SUMO's positions of front bumpers in lanes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from epo_lightning.data.simulate.demand import CLASSES
from epo_lightning.data.simulate.layout import Layout
from epo_lightning.data.simulate.traffic import Traffic

WINDOW = 1.0
"""Length [s] of the Savitzky-Golay filter."""
DEGREE = 3
"""Degree of its polynomials."""
HARDEST = 9.0
"""Largest acceleration of a vehicle in any direction [m/s^2]; vehicles with more are left out."""
SLOWEST = 2.0
"""Smallest speed [m/s] used for the slip angle, which is ill-defined at low speed."""


@dataclass(frozen=True)
class Motion:
    """Smooth tracks in the recorded area. Rows are sorted by vehicle, and by frame within a vehicle, without gaps.

    Attributes:
        rate: frames per second [Hz].
        vehicle: index of each row's vehicle.
        frame: number of each row's frame, from 0.
        s, d: along the reference curve and to its left [m].
        position, velocity, acceleration: motion of the centre [m, m/s, m/s^2].
        heading: heading of the vehicle's axis [rad].
        strip: index into ``layout.lanes`` of the lane that holds the centre.
        size: length and width of each vehicle [m].
        kind: class of each vehicle in exiD's terms.
        dropped: vehicles that were left out, by reason.
    """

    rate: int
    vehicle: Int[np.ndarray, " T"]
    frame: Int[np.ndarray, " T"]
    s: Float[np.ndarray, " T"]
    d: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T 2"]
    velocity: Float[np.ndarray, "T 2"]
    acceleration: Float[np.ndarray, "T 2"]
    heading: Float[np.ndarray, " T"]
    strip: Int[np.ndarray, " T"]
    size: Float[np.ndarray, "A 2"]
    kind: tuple[str, ...]
    dropped: dict[str, int]

    def select(self, rows: Bool[np.ndarray, " T"]) -> Motion:
        """Some rows, with vehicles and frames renumbered; a vehicle must not lose rows in the middle of its track."""
        # Vehicles are numbered by their first appearance.
        present, begins = np.unique(self.vehicle[rows], return_index=True)
        present = present[np.argsort(self.frame[rows][begins], kind="stable")]
        number = np.empty(len(self.size), dtype=np.int64)
        number[present] = np.arange(len(present))
        chosen = np.flatnonzero(rows)
        chosen = chosen[np.argsort(number[self.vehicle[chosen]], kind="stable")]
        return Motion(
            rate=self.rate,
            vehicle=number[self.vehicle[chosen]],
            frame=self.frame[chosen] - self.frame[chosen].min(),
            s=self.s[chosen],
            d=self.d[chosen],
            position=self.position[chosen],
            velocity=self.velocity[chosen],
            acceleration=self.acceleration[chosen],
            heading=self.heading[chosen],
            strip=self.strip[chosen],
            size=self.size[present],
            kind=tuple(self.kind[vehicle] for vehicle in present),
            dropped=self.dropped,
        )


def savitzky_golay(
    values: Float[np.ndarray, "T c"], dt: float, half: int
) -> tuple[Float[np.ndarray, "t c"], Float[np.ndarray, "t c"], Float[np.ndarray, "t c"]]:
    """Value, first and second derivative of the polynomials fitted to ``half`` rows before and behind each row."""
    powers = (np.arange(-half, half + 1) * dt)[:, None] ** np.arange(DEGREE + 1)
    fit = np.linalg.pinv(powers)
    middle = values.mean(0)  # avoids cancellation with large coordinates

    def filtered(row: int, factor: float) -> Float[np.ndarray, "t c"]:
        kernel = factor * fit[row, ::-1]
        return np.stack([np.convolve(column, kernel, "valid") for column in (values - middle).T], -1)

    return filtered(0, 1.0) + middle, filtered(1, 1.0), filtered(2, 2.0)


def strip_at(layout: Layout, s: Float[np.ndarray, " T"], d: Float[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
    """The lane whose centreline is nearest, among those that exist at s: an index into ``layout.lanes``."""
    away = [
        np.where((s >= lane.begin) & (s <= lane.end), np.abs(d - layout.offset(lane, s)), np.inf)
        for lane in layout.lanes
    ]
    return np.argmin(away, 0)


def move(traffic: Traffic, layout: Layout, seconds: float) -> Motion:
    """Smooth trajectories of all vehicles' centres, inside the recorded area and after the warm-up."""
    lanes = layout.lanes
    s = traffic.front - traffic.size[traffic.vehicle, 0] / 2
    middle = np.select(
        [traffic.strip == index for index in range(len(lanes))], [layout.offset(lane, s) for lane in lanes]
    )
    d = middle + traffic.aside
    half = round(WINDOW * traffic.rate / 2 - 0.5)
    raw = np.column_stack([s, d, layout.locate(s, d)])
    value, rate, second = savitzky_golay(raw, 1 / traffic.rate, half)
    inside = slice(half, len(raw) - half)
    # Windows that contain rows of two vehicles are dropped.
    own = traffic.vehicle[: -2 * half] == traffic.vehicle[2 * half :]
    frame = traffic.step[inside]
    s, d = value[:, 0], value[:, 1]
    kept = own & (frame >= 0) & (frame < round(seconds * traffic.rate)) & (s >= layout.area[0]) & (s <= layout.area[1])
    s, d, velocity = s[kept], d[kept], rate[kept, 2:]
    strip = strip_at(layout, s, d)
    along = np.select([strip == index for index in range(len(lanes))], [layout.direction(lane, s) for lane in lanes])
    ahead = velocity[:, 0] * np.cos(along) + velocity[:, 1] * np.sin(along)
    sideways = velocity[:, 1] * np.cos(along) - velocity[:, 0] * np.sin(along)
    motion = Motion(
        rate=traffic.rate,
        vehicle=traffic.vehicle[inside][kept],
        frame=frame[kept],
        s=s,
        d=d,
        position=value[kept, 2:],
        velocity=velocity,
        acceleration=second[kept, 2:],
        heading=along + np.arctan2(sideways, np.maximum(ahead, SLOWEST)),
        strip=strip,
        size=traffic.size,
        kind=tuple(CLASSES[kind] for kind in traffic.kind),
        dropped=traffic.dropped,
    )
    hard = np.unique(motion.vehicle[np.linalg.norm(motion.acceleration, axis=1) > HARDEST])
    selected = motion.select(~np.isin(motion.vehicle, hard))
    return replace(selected, dropped={**traffic.dropped, "acceleration": len(hard)})
