"""Doubts about lines of lanes: points in another order are named, and roads as they are built are not doubted."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from data.recorded.roads import curve, recording, road
from epo_lightning.data.recorded.extraction import extract_to_file, outcomes
from epo_lightning.data.recorded.formats import argoverse2, lanelet2
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.plausibility import doubts_of_lanes
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.registry import lookup

SHARED = Path(os.environ.get("EPO_SHARED", "../shared")) / "data"


def shuffled(lanes: LaneGraph, lane: int, name: str = "left") -> LaneGraph:
    """The lanes with the points of one line in another order."""
    lines = list(getattr(lanes, name))
    lines[lane] = np.random.default_rng(0).permutation(lines[lane])
    return dataclasses.replace(lanes, **{name: lines})


@pytest.mark.parametrize("name", ["left", "right", "centre"])
def test_points_in_another_order_are_named(name: str) -> None:
    lanes = road(curve(300.0))
    assert not doubts_of_lanes(lanes)
    (doubt,) = doubts_of_lanes(shuffled(lanes, 4, name))
    assert doubt.startswith(
        "lines of lanes that turn back by more than 90 degrees 2 times or more: 1, the first one is "
    )
    assert f"the {name} line of lane {lanes.ids[4]}: are their points in the order of driving?" in doubt


def test_two_exchanged_points_are_seen_and_hairpins_right_angles_and_tiny_hooks_are_not() -> None:
    lanes = road(curve(None))
    straight = np.stack([np.arange(9.0), np.zeros(9)], 1)
    exchanged = straight[[0, 1, 2, 4, 3, 5, 6, 7, 8]]
    hairpin = np.concatenate([straight, straight[::-1] + np.array([0.0, 0.3])])[[*range(9), *range(10, 18)]]
    hooks = np.concatenate(
        [straight[:3], straight[2:3] - [0.01, 0.0], straight[3:5], straight[4:5] - [0.01, 0.0], straight[5:]]
    )
    stairs = np.repeat(np.arange(9.0), 2)[np.arange(8)[:, None] + [1, 0]]  # right angles to the left and to the right
    for line, found in ((straight, 0), (exchanged, 1), (hairpin, 0), (hooks, 0), (stairs, 0)):
        assert len(doubts_of_lanes(dataclasses.replace(lanes, centre=[line, *lanes.centre[1:]]))) == found


def test_they_are_among_the_warnings_of_an_extraction_that_uses_the_map(tmp_path: Path) -> None:
    whole = recording(curve(None))
    broken = dataclasses.replace(whole, lanes=shuffled(whole.lanes, 0))
    windows = WindowConfig(dt=0.2, history=3, horizon=10, lane_change=False)
    for used in (True, False):
        file = tmp_path / f"{used}.safetensors"
        source = RecordingSource("road", "road", (), partial(dataclasses.replace, broken))
        extract_to_file([source], windows, used, file)
        (outcome,) = outcomes(file)
        assert any("turn back by more than 90 degrees" in warning for warning in outcome.about["warnings"]) == used


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"no recordings in {SHARED}")
def test_real_maps_are_not_doubted() -> None:
    maps = [lanelet2.read_map(SHARED / "maps/fzi_mapping_example.osm", (0.0, 0.0))]
    maps += [argoverse2.read_map(path, Counter()) for path in sorted((SHARED / "argoverse2").rglob("log_map*.json"))]
    for name in ("us101", "lankershim"):
        maps += [source.read().lanes for source in lookup("format", "commonroad")(SHARED / name)[:4]]
    assert len(maps) > 8
    for lanes in maps:
        assert not doubts_of_lanes(lanes)
