"""Maps of all layouts, read by our reader and by the lanelet2 library; and the small set that other tests use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data.recorded.formats.exid_files import read_tracks
from pyproj import Transformer

from epo_lightning.data.recorded.formats.lanelet2 import read_map
from epo_lightning.data.recorded.lanes import SHOULDER, LaneGraph, Polylines, lane_changes
from epo_lightning.data.simulate.lanelets import lanelets, write_map
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.registry import lookup

FIXTURE = Path(__file__).parents[2] / "fixtures" / "exid_sim"


@pytest.fixture(scope="module", params=LAYOUTS, ids=lambda layout: layout.name)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Layout, Path, LaneGraph]:
    layout = request.param
    path = tmp_path_factory.mktemp(layout.name) / f"location{layout.id}.osm"
    write_map(layout, path)
    dropped: dict[str, int] = {}
    lanes = read_map(path, layout.origin, zone=32, dropped=dropped)
    assert dropped == {}
    return layout, path, lanes


@pytest.fixture(scope="module")
def library(case: tuple[Layout, Path, LaneGraph]) -> tuple[Any, Any]:
    """The map and its routing graph for vehicles, by the lanelet2 library."""
    lanelet2 = pytest.importorskip("lanelet2", reason="the lanelet2 library is not installed")
    layout, path, _ = case
    east, north = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(*layout.origin)
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(north, east))
    loaded, errors = lanelet2.io.loadRobust(str(path), projector)
    assert list(errors) == []
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    return loaded, lanelet2.routing.RoutingGraph(loaded, rules)


def test_the_reader_finds_the_strips_where_they_were_drawn(case: tuple[Layout, Path, LaneGraph]):
    layout, _, lanes = case
    pieces = {piece.id: piece for piece in lanelets(layout)}
    assert set(lanes.ids.tolist()) == set(pieces)
    read = Polylines(lanes.left), Polylines(lanes.right), lanes.centrelines
    for index, number in enumerate(lanes.ids.tolist()):
        piece = pieces[number]
        strip = layout.strips[piece.strip]
        s = np.arange(piece.begin, piece.end, 0.1)
        assert (lanes.kind[index] == SHOULDER) == strip.shoulder
        for offset, lines in zip((*layout.edges(strip, s), layout.offset(strip, s)), read, strict=True):
            _, aside = lines.project(np.full(len(s), index), layout.locate(s, offset))
            assert np.abs(aside).max() < 0.01


def test_lanes_that_follow_or_lie_beside_are_those_of_the_layout(case: tuple[Layout, Path, LaneGraph]):
    layout, _, lanes = case
    place = {number: index for index, number in enumerate(lanes.ids.tolist())}
    pieces = lanelets(layout)
    for one in pieces:
        follow = {place[other.id] for other in pieces if other.strip == one.strip and other.begin == one.end}
        assert set(lanes.successors[place[one.id]]) == follow
        middle = (one.begin + one.end) / 2
        strip = layout.strips[one.strip]
        left = [
            place[other.id]
            for other in pieces
            if other.begin == one.begin
            and layout.strips[other.strip].place == strip.place + 1
            and layout.strips[other.strip].road(middle) == strip.road(middle)
        ]
        assert lanes.adjacent_left[place[one.id]] == (left[0] if left else -1)
        assert lanes.left_of[place[one.id]] == (left[0] if left and not strip.shoulder else -1)


def test_lines_are_those_of_the_lanelet2_library(case: tuple[Layout, Path, LaneGraph], library: tuple[Any, Any]):
    _, _, lanes = case
    loaded, _ = library
    for index, number in enumerate(lanes.ids.tolist()):
        lane = loaded.laneletLayer[number]
        for ours, theirs in (
            (lanes.left[index], lane.leftBound),
            (lanes.right[index], lane.rightBound),
        ):
            np.testing.assert_allclose(ours, [(point.x, point.y) for point in theirs], atol=1e-3)
        centre = np.array([(point.x, point.y) for point in lane.centerline])
        _, aside = lanes.centrelines.project(np.full(len(centre), index), centre)
        assert np.abs(aside).max() < 0.01


def test_neighbours_and_successors_are_those_of_the_lanelet2_library(
    case: tuple[Layout, Path, LaneGraph], library: tuple[Any, Any]
):
    _, _, lanes = case
    loaded, graph = library

    def number(lane: Any) -> int:
        return -1 if lane is None else lane.id

    def ours(index: int) -> int:
        return -1 if index < 0 else int(lanes.ids[index])

    for index, ident in enumerate(lanes.ids.tolist()):
        if lanes.kind[index] == SHOULDER:
            continue  # its routing graph is for vehicles, which do not drive there
        lane = loaded.laneletLayer[ident]
        assert ours(lanes.left_of[index]) == number(graph.left(lane))
        assert ours(lanes.right_of[index]) == number(graph.right(lane))
        assert {ours(follow) for follow in lanes.successors[index]} == {follow.id for follow in graph.following(lane)}


def test_the_small_set_is_small_and_has_lane_changes():
    files = [path for path in FIXTURE.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 300_000
    sources = lookup("format", "exid")(FIXTURE)
    assert [source.group for source in sources] == ["0", "1", "2"]
    for source in sources:
        recording = source.read()
        tracks = recording.tracks
        assert tracks.rate == 10
        assert len(tracks.ids) == 5
        assert (np.bincount(tracks.agent) == 75).all()
        told = np.flatnonzero(read_tracks(FIXTURE / "data" / f"{source.name}_tracks.csv")["laneChange"].to_numpy())
        located = recording.lanes.locate(tracks.position, tracks.heading)
        seen = np.flatnonzero(lane_changes(tracks.agent, located, recording.lanes))
        assert len(told) >= 1
        assert len(seen) == len(told)
        assert np.abs(seen - told).max() <= 1
