"""Argoverse 2: types that are agents, markings that may be crossed, and lines that are lanes."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from data.recorded.formats.argoverse2_files import city, drive, lane, points, write
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.argoverse2 import SPACING, argoverse2, midways
from epo_lightning.scene import KINDS


def read(home):
    (source,) = argoverse2(home)
    return source.read()


def typed(kind: str) -> pl.DataFrame:
    """The usual tracks, one of which is of another type."""
    return drive().with_columns(
        object_type=pl.when(pl.col("track_id") == "9").then(pl.lit(kind)).otherwise("object_type")
    )


@pytest.mark.parametrize("kind", ["static", "background", "construction", "riderless_bicycle"])
def test_things_that_are_no_agents_are_left_out_and_counted_by_track(tmp_path, kind):
    write(tmp_path, tracks=typed(kind))
    recording = read(tmp_path)
    assert 9 not in recording.tracks.ids
    assert recording.dropped["tracks of things that are no agents (static, construction, ...)"] == 2


def test_an_unknown_object_is_an_agent_of_a_known_class(tmp_path):
    write(tmp_path, tracks=typed("unknown"))
    recording = read(tmp_path)
    assert KINDS[recording.tracks.kind[recording.tracks.ids == 9][0]] == "other"
    assert not any("class that is unknown" in reason for reason in recording.dropped)


@pytest.mark.parametrize(
    ("marking", "crossable"),
    [
        *((f"{kind}_{colour}", False) for kind in ("SOLID", "DOUBLE_SOLID") for colour in ("WHITE", "YELLOW")),
        ("SOLID_BLUE", False),
        *((f"{kind}_WHITE", True) for kind in ("DASHED", "DOUBLE_DASH", "DASH_SOLID", "SOLID_DASH")),
        ("NONE", True),
        ("UNKNOWN", True),
    ],
)
def test_markings_decide_on_lane_changes(tmp_path, marking, crossable):
    roads = city()
    roads["lane_segments"]["10"]["left_lane_mark_type"] = marking
    roads["lane_segments"]["11"]["right_lane_mark_type"] = marking
    write(tmp_path, roads=roads)
    lanes = read(tmp_path).lanes
    at = {id: number for number, id in enumerate(lanes.ids.tolist())}
    assert (lanes.adjacent_left[at[10]], lanes.adjacent_right[at[11]]) == (at[11], at[10])
    expected = (at[11], at[10]) if crossable else (-1, -1)
    assert (lanes.left_of[at[10]], lanes.right_of[at[11]]) == expected


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_lane_one_of_whose_boundaries_is_a_point_has_no_length(tmp_path, side):
    roads = city()
    roads["lane_segments"]["99"] = lane(99, [(0.0, 3.0), (9.0, 3.0)], [(0.0, 0.0), (9.0, 0.0)])
    roads["lane_segments"]["99"][f"{side}_lane_boundary"] = points((1.0, 1.0), (1.0, 1.0))
    write(tmp_path, roads=roads)
    recording = read(tmp_path)
    assert 99 not in recording.lanes.ids
    assert recording.dropped["lanes without length"] == 1


def test_the_longer_boundary_decides_on_the_points_of_a_centreline_up_to_500_pieces():
    outer, inner = (np.array([[0.0, y], [length, y]]) for y, length in ((4.0, 40.0), (0.0, 10.0)))
    for left, right in ((outer, inner), (inner, outer)):
        (middle,) = midways([left], [right])
        assert len(middle) == 1 + 40 / SPACING
    (middle,) = midways([outer * (50, 1)], [inner * (200, 1)])
    assert len(middle) == 501


def test_an_identifier_of_more_than_eighteen_digits_is_refused(tmp_path):
    tracks = drive().with_columns(pl.col("track_id").replace("7", "1234567890123456789"))
    write(tmp_path, tracks=tracks)
    with pytest.raises(RecordingError, match=r"row 1: track_id is '1234567890123456789'; a number or AV was expected"):
        read(tmp_path)


def test_the_publishers_test_split_alone_is_read(tmp_path):
    write(tmp_path / "test", "e", drive(50))
    assert [(source.name, source.group) for source in argoverse2(tmp_path)] == [("e", "e")]
