"""Layouts: smooth lanes that do not cross, and maps with connected lanelets."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from epo_lightning.data.simulate.lanelets import Lanelet, lanelets, write_map
from epo_lightning.data.simulate.layout import CLEARANCE, LAYOUTS, Layout, Strip

everywhere = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)


def test_layouts_are_at_least_seven_and_addressed_by_their_place():
    assert len(LAYOUTS) >= 7
    assert [layout.id for layout in LAYOUTS] == list(range(len(LAYOUTS)))
    assert len({layout.name for layout in LAYOUTS}) == len(LAYOUTS)


def test_layouts_differ_in_geometry_and_purpose():
    ons = [sum(np.isfinite(strip.join) for strip in layout.lanes) for layout in LAYOUTS]
    offs = [sum(np.isfinite(strip.leave) for strip in layout.lanes) for layout in LAYOUTS]
    assert {(1, 0), (0, 1), (1, 1), (2, 0)} <= set(zip(ons, offs, strict=True))
    assert any(np.isfinite([strip.join, strip.leave]).all() for layout in LAYOUTS for strip in layout.lanes)
    assert {None} < {layout.limit for layout in LAYOUTS}
    assert all(3.5 <= layout.width <= 3.75 for layout in LAYOUTS)


@everywhere
def test_the_reference_curve_is_an_arc_where_its_curvature_is_constant(layout: Layout):
    """Heading and position follow the curvature: compared with a fine integration of the Fresnel kind."""
    s = np.linspace(0.0, layout.length, 200_001)
    curvature = np.interp(s, *np.array(layout.curvature).T)
    step = s[1] - s[0]
    middle = (curvature[1:] + curvature[:-1]) / 2
    heading = layout.heading + np.concatenate([[0.0], np.cumsum(middle * step)])
    halfway = (heading[1:] + heading[:-1]) / 2
    x, y = (np.concatenate([[0.0], np.cumsum(part * step)]) for part in (np.cos(halfway), np.sin(halfway)))
    np.testing.assert_allclose(layout.locate(s, np.zeros_like(s)), np.stack([x, y], -1), atol=1e-3)


@everywhere
def test_strips_are_smooth(layout: Layout):
    """A lane bends no more than a vehicle at speed can follow, and its direction is the one of its points."""
    for strip in layout.lanes:
        s = np.arange(strip.begin, strip.end, 0.5)
        points = layout.locate(s, layout.offset(strip, s))
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        assert lengths.min() > 0.4
        assert lengths.max() < 0.6
        direction = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        given = np.unwrap(layout.direction(strip, s[:-1] + 0.25))
        assert np.abs(direction - given).max() < 2e-4
        assert np.abs(np.diff(given) / 0.5).max() < 1 / 250
        assert np.diff(layout.along(strip, s)) == pytest.approx(lengths, abs=1e-5)


@everywhere
def test_strips_do_not_cross(layout: Layout):
    for index, one in enumerate(layout.strips):
        for other in layout.strips[index + 1 :]:
            s = np.arange(max(one.begin, other.begin), min(one.end, other.end), 1.0)
            if len(s):
                (left, right), (left_too, right_too) = layout.edges(one, s), layout.edges(other, s)
                assert (right > left_too - 1e-9).all() or (right_too > left - 1e-9).all(), (one, other)


@everywhere
def test_lanes_that_begin_or_end_beside_others_are_not_driven_to_their_last_metre(layout: Layout):
    for strip in layout.lanes:
        begin, end = strip.driven
        assert strip.begin <= begin < end <= strip.end
        if strip.begin > 0 and strip.road(strip.begin) == "main":
            assert begin == strip.begin + CLEARANCE
        if strip.end < layout.length and strip.road(strip.end) == "main":
            assert end == strip.end - CLEARANCE


def test_ramps_swing_away_to_the_right():
    layout = LAYOUTS[0]
    s = np.arange(0.0, layout.length, 1.0)
    ramp = Strip(-1, 0, layout.length, join=600, leave=900)
    offset = layout.offset(ramp, s)
    on_road = (s >= 600) & (s <= 900)
    assert (offset[on_road] == -layout.width).all()
    assert (np.diff(offset[s <= 600]) > 0).all()
    assert (np.diff(offset[s >= 900]) < 0).all()


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[ElementTree.Element, list[Lanelet]]]:
    folder = tmp_path_factory.mktemp("maps")
    found = {}
    for layout in LAYOUTS:
        write_map(layout, folder / f"{layout.name}.osm")
        found[layout.name] = ElementTree.parse(folder / f"{layout.name}.osm").getroot(), lanelets(layout)
    return found


@everywhere
def test_lanelets_share_points_with_successors_and_ways_with_neighbours(layout: Layout, maps):
    root, pieces = maps[layout.name]
    ways = {way.get("id"): [node.get("ref") for node in way.findall("nd")] for way in root.findall("way")}
    bounds = {
        int(relation.get("id")): {member.get("role"): member.get("ref") for member in relation.findall("member")}
        for relation in root.findall("relation")
    }
    assert set(bounds) == {piece.id for piece in pieces}
    by_strip: dict[int, list[Lanelet]] = {}
    for piece in pieces:
        by_strip.setdefault(piece.strip, []).append(piece)
    for row in by_strip.values():
        for before, after in pairwise(row):
            assert before.end == after.begin
            for side in ("left", "right"):
                assert ways[bounds[before.id][side]][-1] == ways[bounds[after.id][side]][0]
    shared = 0
    for one in pieces:
        for other in pieces:
            strips = layout.strips[one.strip], layout.strips[other.strip]
            middle = (one.begin + one.end) / 2
            if one.begin == other.begin and strips[1].place == strips[0].place + 1:
                beside = strips[0].road(middle) == strips[1].road(middle)
                assert (bounds[one.id]["left"] == bounds[other.id]["right"]) == beside
                shared += beside
    assert shared >= 3


@everywhere
def test_markings_say_what_may_be_crossed(layout: Layout, maps):
    root, pieces = maps[layout.name]
    tags = {
        element.get("id"): {tag.get("k"): tag.get("v") for tag in element.findall("tag")}
        for element in (*root.findall("way"), *root.findall("relation"))
    }
    users: dict[str, list[str]] = {}
    for relation in root.findall("relation"):
        for member in relation.findall("member"):
            users.setdefault(member.get("ref"), []).append(relation.get("id"))
    for way, lanes in users.items():
        kinds = {tags[lane]["subtype"] for lane in lanes}
        if len(lanes) == 1:
            assert tags[way] == {"type": "road_border"}
        else:
            marking = "dashed" if kinds == {"highway"} else "solid"
            assert tags[way] == {"type": "line_thin", "subtype": marking}
    for piece in pieces:
        strip, lane = layout.strips[piece.strip], tags[str(piece.id)]
        assert lane["subtype"] == ("emergency_lane" if strip.shoulder else "highway")
        assert ("onramp" in lane) == (piece.end <= strip.join)
        assert ("offramp" in lane) == (piece.begin >= strip.leave)


def test_a_map_has_each_place_once_and_to_a_tenth_of_a_millimetre(maps):
    for root, _ in maps.values():
        places = [(node.get("lat"), node.get("lon")) for node in root.findall("node")]
        assert len(set(places)) == len(places)
        assert all(len(value.partition(".")[2]) == 11 for place in places for value in place)
        ids = [element.get("id") for kind in ("node", "way", "relation") for element in root.findall(kind)]
        assert len(set(ids)) == len(ids)


def test_the_spacing_of_a_map_is_what_was_asked_for(tmp_path: Path):
    write_map(LAYOUTS[0], tmp_path / "fine.osm", 5.0)
    write_map(LAYOUTS[0], tmp_path / "coarse.osm", 20.0)
    fine, coarse = (len(ElementTree.parse(tmp_path / f"{name}.osm").findall("node")) for name in ("fine", "coarse"))
    assert 3 * coarse < fine < 5 * coarse
