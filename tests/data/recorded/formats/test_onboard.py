"""Tracks of cars' sensors: gaps are no jumps."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.onboard import RATE, tracks_of
from epo_lightning.data.recorded.tracks import FASTEST


@pytest.mark.parametrize(("speed", "kept"), [(0.9 * FASTEST, [7, 8]), (1.1 * FASTEST, [8])])
def test_a_track_with_a_gap_jumps_only_if_it_moves_too_fast_in_the_time_of_the_gap(
    speed: float, kept: list[int]
) -> None:
    """Two agents; the first one was not seen for two seconds, in which it moved on at the given speed."""
    frame = np.array([0, 1, 21, 22])
    x = np.array([0.0, 1.0, 1.0 + speed * 20 / RATE, 2.0 + speed * 20 / RATE])  # 10 m/s else
    moving = np.stack([x, 0 * x, 0 * x, 10.0 + 0 * x, 0 * x], 1)
    dropped: Counter[str] = Counter()
    tracks = tracks_of(
        Path("given"),
        np.tile(frame, 2),
        np.repeat([0, 1], 4),
        np.concatenate([moving, [[float(at), 5.0, 0.0, 10.0, 0.0] for at in frame]]),
        np.array([7, 8]),
        np.tile([4.0, 2.0], (2, 1)),
        np.zeros(2, dtype=int),
        dropped,
    )
    assert tracks.ids.tolist() == kept
    assert sum(dropped.values()) == 2 - len(kept)


@pytest.mark.parametrize(("factor", "said"), [(0.55, None), (1.9, None), (0.45, "0.45 times"), (2.2, "2.2 times")])
def test_velocities_of_sensors_may_be_wrong_by_a_factor_of_two_in_the_median(factor: float, said: str | None) -> None:
    x = 1.0 * factor * np.arange(20)
    states = np.stack([x, 0 * x, 0 * x, 10.0 + 0 * x, 0 * x], 1)
    given = (np.arange(20), np.zeros(20, dtype=int), states, np.array([7]), np.array([[4.0, 2.0]]))
    if said is None:
        assert len(tracks_of(Path("given"), *given, np.zeros(1, dtype=int), Counter())) == 20
        return
    with pytest.raises(RecordingError, match=f"positions move {said} as fast as the velocities say"):
        tracks_of(Path("given"), *given, np.zeros(1, dtype=int), Counter())
