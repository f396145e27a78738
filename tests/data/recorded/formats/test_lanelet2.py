"""Lanes equal those of the Lanelet2 library: boundaries, centrelines, successors and neighbours."""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
import shapely

from data.recorded.formats.exid_files import BORDER, DASHED, ORIGIN, SOLID, Osm, globe, road, shared
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.centreline import centreline
from epo_lightning.data.recorded.formats.lanelet2 import _signed_distance, read_map
from epo_lightning.data.recorded.lanes import LANE, SHOULDER

FZI = "data/maps/fzi_mapping_example.osm"
FZI_ORIGIN = (457_500.0, 5_428_000.0)


class Library:
    """The Lanelet2 library's view of a map, for emergency vehicles, which may use the shoulder."""

    def __init__(self, path, origin):
        library = pytest.importorskip("lanelet2", reason="there is no lanelet2 wheel for this Python")
        from lanelet2.projection import UtmProjector

        projector = UtmProjector(library.io.Origin(*globe(0.0, 0.0, origin)))
        self.map, errors = library.io.loadRobust(str(path), projector)
        assert not errors
        self.rules = library.traffic_rules.create("de", "vehicle:emergency")
        self.graph = library.routing.RoutingGraph(self.map, self.rules)
        self.lanelets = {lanelet.id: lanelet for lanelet in self.map.laneletLayer}

    def lanes(self):
        return {id for id, lanelet in self.lanelets.items() if self.rules.canPass(lanelet)}

    def neighbour(self, id, name):
        found = getattr(self.graph, name)(self.lanelets[id])
        return None if found is None or found.inverted() else found.id

    def successors(self, id):
        return {lanelet.id for lanelet in self.graph.following(self.lanelets[id]) if not lanelet.inverted()}


def points(line):
    return np.array([[point.x, point.y] for point in line])


def apart(a, b):
    """The distance of two curves [m]: of all their points, and of their ends."""
    farthest = shapely.LineString(a).hausdorff_distance(shapely.LineString(b))
    return max(farthest, np.abs(a[[0, -1]] - b[[0, -1]]).max())


def compare(path, origin):
    """Asserts that our lanes are the library's."""
    ours, library = read_map(path, origin), Library(path, origin)
    ids = [int(id) for id in ours.ids]
    assert set(ids) == library.lanes()
    for lane, id in enumerate(ids):
        lanelet = library.lanelets[id]
        assert apart(ours.left[lane], points(lanelet.leftBound)) < 1e-3, id
        assert apart(ours.right[lane], points(lanelet.rightBound)) < 1e-3, id
        assert apart(ours.centre[lane], points(lanelet.centerline)) < 0.01, id
        assert {ids[successor] for successor in ours.successors[lane]} == library.successors(id), id
        for side, adjacent in (("left", "adjacentLeft"), ("right", "adjacentRight")):
            change = getattr(ours, f"{side}_of")[lane]
            beside = getattr(ours, f"adjacent_{side}")[lane]
            assert library.neighbour(id, side) == (ids[change] if change >= 0 else None), (id, side)
            # The library calls only those adjacent that one may not change to.
            expected = ids[beside] if change < 0 <= beside else None
            assert library.neighbour(id, adjacent) == expected, (id, adjacent)
            assert change in (-1, beside)
    return ours


def test_the_fzi_map_is_read():
    path = shared(FZI)
    lanes = compare(path, FZI_ORIGIN)
    assert len(lanes) == 328
    assert sum(map(len, lanes.successors)) > 300
    assert (lanes.left_of >= 0).sum() > 50
    assert (lanes.adjacent_left >= 0).sum() > 100


def test_centrelines_of_the_fzi_map_equal_those_of_lanelet2():
    """Footways are included, whose boundaries are less regular."""
    library = Library(shared(FZI), FZI_ORIGIN)
    assert len(library.lanelets) == 371
    for lanelet in library.lanelets.values():
        left, right = lanelet.leftBound, lanelet.rightBound
        ours = centreline(points(left), points(right), left[0].id == right[0].id)
        assert apart(ours, points(lanelet.centerline)) < 1e-6, lanelet.id


def unique(osm):
    """Map without duplicate ids, as the library requires."""
    shift = {"way": 1000, "lanelet": 2000}
    ways = [(id + shift["way"], nodes, tags) for id, nodes, tags in osm.ways]
    lanelets = [
        (id + shift["lanelet"], left + shift["way"], right + shift["way"], tags)
        for id, left, right, tags in osm.lanelets
    ]
    return Osm(osm.nodes, ways, lanelets)


MARKINGS = [
    *({"type": kind, "subtype": line} for kind in ("line_thin", "line_thick") for line in ("dashed", "solid")),
    *({"type": "line_thin", "subtype": line} for line in ("dashed_solid", "solid_dashed", "solid_solid")),
    *({"type": kind} for kind in ("road_border", "guard_rail", "curbstone", "virtual", "line_thin")),
    *(DASHED | {"lane_change": value} for value in ("yes", "no", "maybe")),
    *(
        SOLID | {"lane_change:left": left, "lane_change:right": right}
        for left in ("yes", "no")
        for right in ("yes", "no")
    ),
    *(DASHED | {f"lane_change:{side}": value} for side in ("left", "right") for value in ("yes", "no")),
    BORDER | {"lane_change": "yes"},
]


@pytest.mark.parametrize("seed", range(6))
def test_centrelines_of_random_roads_equal_those_of_lanelet2(tmp_path, seed):
    """Four lanes side by side and four in a row, of points strewn about, ways stored either way round and all markings."""
    random = np.random.default_rng(seed)
    osm = Osm()
    bend = random.uniform(-3e-3, 3e-3)
    rows = []
    for y in 3.5 * np.arange(5, 0, -1):
        joints, inner = np.arange(0.0, 401.0, 100.0), np.sort(random.uniform(0, 400, 30))
        x = np.sort(np.concatenate((joints, inner[np.abs((inner + 50) % 100 - 50) > 3])))
        along = x + random.uniform(-1, 1, len(x))
        across = y + bend * x**2 + random.uniform(-0.6, 0.6, len(x))
        nodes = [osm.node(*point) for point in zip(along, across, strict=True)]
        cuts = np.searchsorted(x, joints)
        rows.append([nodes[a : b + 1] for a, b in pairwise(cuts)])
    ways = [
        [osm.way(nodes[:: random.choice((1, -1))], **MARKINGS[random.integers(len(MARKINGS))]) for nodes in row]
        for row in rows
    ]
    subtypes = [
        "highway",
        "highway",
        "road",
        "emergency_lane",
        "bus_lane",
        "walkway",
        "play_street",
        "exit",
        "unheard-of",
    ]
    for left, right in pairwise(ways):
        for pair in zip(left, right, strict=True):
            osm.lanelet(*pair, subtype=str(random.choice(subtypes)))
    (tmp_path / "map.osm").write_text(str(unique(osm)))
    lanes = compare(tmp_path / "map.osm", ORIGIN)
    assert len(lanes) > 8
    assert (lanes.adjacent_left >= 0).sum() > (lanes.left_of >= 0).sum() > 0


TRUE = [SOLID | {"lane_change": value} for value in ("true", "1")]


@pytest.mark.parametrize("marking", [*MARKINGS, *TRUE], ids=lambda marking: "-".join(marking.values()))
def test_markings_decide_on_lane_changes(tmp_path, marking):
    """Whether one may change across each marking, to either side, however its way is stored."""
    for number, backwards in enumerate((False, True)):
        osm = road()
        osm.ways = [
            (id, nodes[::-1] if backwards else nodes, marking if id == 2 else tags) for id, nodes, tags in osm.ways
        ]
        (tmp_path / f"{number}.osm").write_text(str(unique(osm)))
        lanes = compare(tmp_path / f"{number}.osm", ORIGIN)
        assert (lanes.adjacent_right[0], lanes.adjacent_left[1]) == (1, 0)


def test_closed_starts_and_repeated_nodes_are_read(tmp_path):
    """A lane that opens from a point, as beside an on-ramp; and nodes that a way names twice in a row."""
    osm = Osm()
    tip, *lower = (osm.node(x, 0.0) for x in (0.0, 20.0, 40.0, 60.0))
    upper = [osm.node(x, y) for x, y in ((15.0, 1.5), (30.0, 3.0), (60.0, 3.5))]
    osm.lanelet(osm.way([tip, *upper], **DASHED), osm.way([tip, *lower], **BORDER))
    (tmp_path / "map.osm").write_text(str(unique(osm)))
    compare(tmp_path / "map.osm", ORIGIN)
    before = read_map(tmp_path / "map.osm", ORIGIN)
    osm.ways[0][1].insert(2, upper[0])
    (tmp_path / "map.osm").write_text(str(unique(osm)))
    after = read_map(tmp_path / "map.osm", ORIGIN)
    assert apart(before.centre[0], after.centre[0]) < 1e-9
    assert all((np.diff(line, axis=0) != 0).any(1).all() for line in (*after.left, *after.centre))


@pytest.mark.parametrize(("noise", "share"), [(0.0, 1.0), (0.5, 1.0), (3.0, 0.95), (10.0, 0.95)])
def test_centrelines_of_irregular_boundaries_equal_those_of_lanelet2(noise, share):
    """Straight ones along both axes, and those that cross, turn back or fold over. A few of the worst depend on how the
    library rounds: whether the first point of the centreline lies on the line between the first points of the bounds."""
    library = pytest.importorskip("lanelet2", reason="there is no lanelet2 wheel for this Python").core
    random = np.random.default_rng(0)

    def drawn(line, id):
        return library.LineString3d(id, [library.Point3d(10 * id + k, *point, 0.0) for k, point in enumerate(line)])

    same = []
    for number in range(400):
        lines = []
        for n, y in zip(random.integers(2, 9, 2), (4.0, 0.0), strict=True):
            x = np.linspace(0, 40, n) if noise else np.sort(random.uniform(0, 40, n))
            line = np.stack((x, np.full(n, y)), 1) + random.normal(0, noise, (n, 2))
            lines.append(line @ np.linalg.matrix_power([[0, 1], [-1, 0]], number % 4))
        left, right = lines
        ours, theirs = centreline(left, right), points(library.Lanelet(1, drawn(left, 10), drawn(right, 20)).centerline)
        same.append(ours.shape == theirs.shape and np.abs(ours - theirs).max() < 1e-9)
    assert np.mean(same) >= share


def test_colliding_and_negative_ids_are_read(tmp_path):
    """Nodes, ways and relations count from one each; JOSM gives new elements negative ids."""
    (tmp_path / "a.osm").write_text(str(road()))
    (tmp_path / "b.osm").write_text(str(unique(road())))
    osm = road()
    negative = Osm(
        [(-id, x, y) for id, x, y in osm.nodes],
        [(-id, [-node for node in nodes], tags) for id, nodes, tags in osm.ways],
        [(-id, -left, -right, tags) for id, left, right, tags in osm.lanelets],
    )
    (tmp_path / "c.osm").write_text(str(negative))
    a, b, c = (read_map(tmp_path / f"{name}.osm", ORIGIN) for name in "abc")
    assert (a.ids.tolist(), b.ids.tolist()) == ([1, 2, 3, 4, 5, 6], [2001, 2002, 2003, 2004, 2005, 2006])
    for other in (b, c):
        assert a.successors == other.successors == [(3,), (4,), (5,), (), (), ()]
        np.testing.assert_array_equal(np.concatenate(a.centre), np.concatenate(other.centre))
    assert a.kind.tolist() == [LANE, LANE, SHOULDER] * 2
    assert a.left_of.tolist() == [-1, 0, -1, -1, 3, -1]
    assert a.right_of.tolist() == [1, -1, -1, 4, -1, -1]
    assert a.adjacent_left.tolist() == [-1, 0, 1, -1, 3, 4]
    assert a.adjacent_right.tolist() == [1, 2, -1, 4, 5, -1]
    assert np.isnan(a.speed_limit).all()


def test_lanes_of_a_ring_succeed_each_other(tmp_path):
    osm = Osm()
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ways = []
    for radius in (40.0, 44.0):
        nodes = [osm.node(radius * np.cos(angle), radius * np.sin(angle)) for angle in angles]
        ways.append((osm.way(nodes[:9]), osm.way([*nodes[8:], nodes[0]])))
    for inner, outer in zip(*ways, strict=True):
        osm.lanelet(inner, outer)
    (tmp_path / "map.osm").write_text(str(unique(osm)))
    assert compare(tmp_path / "map.osm", ORIGIN).successors == [(1,), (0,)]


def test_lanelets_for_some_vehicles_are_lanes_and_those_for_none_are_not(tmp_path):
    osm = road()
    osm.lanelets[0][3]["participant:vehicle:bus"] = "yes"
    osm.lanelets[1][3]["participant:vehicle"] = "no"
    for lanelet in osm.lanelets[2:]:
        del lanelet[3]["subtype"]
    (tmp_path / "map.osm").write_text(str(osm))
    assert read_map(tmp_path / "map.osm", ORIGIN).ids.tolist() == [1, 3, 4, 5, 6]


def test_of_lanelets_that_overlap_the_first_one_is_the_neighbour(tmp_path):
    osm = road()
    assert osm.lanelets[1][1:3] == (2, 3)
    osm.lanelet(2, 3)
    (tmp_path / "map.osm").write_text(str(osm))
    lanes = read_map(tmp_path / "map.osm", ORIGIN)
    assert (lanes.adjacent_right[0], lanes.adjacent_left[2]) == (1, 1)
    assert (lanes.adjacent_left[6], lanes.adjacent_right[6]) == (0, 2)


def test_lanes_of_two_points_that_close_at_their_end_are_read(tmp_path):
    osm = Osm()
    tip, *begins = (osm.node(x, y) for x, y in ((60.0, 0.0), (0.0, 3.5), (0.0, 0.0)))
    osm.lanelet(*(osm.way([begin, tip], **DASHED) for begin in begins))
    (tmp_path / "map.osm").write_text(str(unique(osm)))
    compare(tmp_path / "map.osm", ORIGIN)


@pytest.mark.parametrize(("x", "y", "left"), [(12.0, -0.3, True), (12.0, 0.3, True), (8.0, -0.3, False)])
def test_a_point_before_a_sharp_right_turn_is_on_the_left(x, y, left):
    line = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, -5.0]])
    for sign in (1, -1):  # and mirrored, before a turn to the left
        distance = _signed_distance(line * (1, sign), np.array([x, sign * y]))
        assert (sign * distance > 0) == left


def test_participants_and_drawn_centrelines_are_respected(tmp_path):
    osm = road()
    osm.lanelets[0][3]["participant:bicycle"] = "yes"
    osm.lanelets[1][3]["participant:vehicle"] = "yes"
    text = str(unique(osm))
    drawn = "<member type='way' ref='1002' role='centerline'/>"
    text = re.sub(r"(<relation id='2005'[^>]*>)", rf"\1{drawn}", text)
    (tmp_path / "map.osm").write_text(text)
    lanes = compare(tmp_path / "map.osm", ORIGIN)
    assert lanes.ids.tolist() == [2002, 2003, 2004, 2005, 2006]


def test_other_zones_and_hemispheres_are_projected(tmp_path):
    """The zone is that of the map, unless it is given."""
    from pyproj import Transformer

    for code, zone in ((32755, 55), (32633, 33)):
        to_globe = Transformer.from_crs(f"EPSG:{code}", "EPSG:4326")
        text = str(road())
        for id, x, y in road().nodes:
            lat, lon = to_globe.transform(400_000.0 + x, 5_800_000.0 + y)
            text = re.sub(rf"(<node id='{id}' .*) lat=.*/>", rf"\1 lat='{lat:.12f}' lon='{lon:.12f}'/>", text)
        (tmp_path / "map.osm").write_text(text)
        expected = read_map(tmp_path / "map.osm", (400_000.0, 5_800_000.0), zone=zone)
        found = read_map(tmp_path / "map.osm", (400_000.0, 5_800_000.0))
        np.testing.assert_array_equal(np.concatenate(found.left), np.concatenate(expected.left))
        np.testing.assert_allclose(found.left[0][0], (0.0, 7.5), atol=1e-5)
        beside = read_map(tmp_path / "map.osm", (0.0, 0.0), zone=zone - 1, north=code == 32633)
        assert len(beside) == 6, "a map may lie some degrees outside of its zone"


def test_a_map_may_lie_on_both_sides_of_the_date_line(tmp_path):
    from pyproj import Transformer

    east, north = Transformer.from_crs("EPSG:4326", "EPSG:32660").transform(52.0, 180.0)
    to_globe, text = Transformer.from_crs("EPSG:32660", "EPSG:4326"), str(road())
    for id, x, y in road().nodes:
        lat, lon = to_globe.transform(east + x - 100.0, north + y)
        text = re.sub(rf"(<node id='{id}' .*) lat=.*/>", rf"\1 lat='{lat:.12f}' lon='{lon:.12f}'/>", text)
    assert "lon='-179" in text
    assert "lon='179" in text
    (tmp_path / "map.osm").write_text(text)
    lanes = read_map(tmp_path / "map.osm", (east - 100.0, north), zone=60)
    np.testing.assert_allclose(lanes.left[0][0], (0.0, 7.5), atol=1e-5)


def changed(pattern, replacement, count=0):
    return lambda text: re.sub(pattern, replacement, text, count=count, flags=re.DOTALL)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (changed("</?osm", lambda m: m[0].replace("osm", "commonRoad")), "root element is <commonRoad>"),
        (changed("<node[^>]*>", ""), "there is no node in it"),
        (changed("<relation.*</relation>", ""), r"the map has no lanes \(no relation of type lanelet\)"),
        (
            changed("highway|emergency_lane", "walkway"),
            r"the map has no lanes \(6 lanelets that are not for vehicles\)",
        ),
        (changed("role='left'", "role='right'"), r"6 lanelets without exactly one left and one right way"),
        (changed(r"<nd ref='\d+'/>", "<nd ref='999'/>"), "6 lanelets whose ways or nodes are missing"),
        (changed("<nd ref='2'/>", "<nd/>", 1), "a node of way 1 is missing; a whole number"),
        (changed(" lat='[0-9.]*'", "", 1), "lat of node 1 is missing; a finite number was expected there"),
        (changed(" lon='[0-9.]*'", " lon='NaN'", 1), "lon of node 1 is 'NaN'; a finite number"),
        (changed(" lat='[0-9.]*'", " lat='1e300'", 1), r"node 1 at latitude .* was expected in degrees"),
        (changed(" lon='[0-9.]*'", " lon='19'", 1), r"node 1 at .* near UTM zone 32: is it a stray node"),
        (changed(" lon='[0-9.]*'", " lon='-173'", 1), r"node 1 at .* near UTM zone 32: is it a stray node"),
        (changed("<node id='2'", "<node id='1'"), "the id 1 belongs to two nodes: give one of them another id"),
        (changed("<way id='2'", "<way id='1'"), "the id 1 belongs to two ways"),
        (changed("<relation id='2'", "<relation id='1'"), "the id 1 belongs to two relations"),
        (changed("<relation id='2'", "<relation id='x'"), "the id of a relation is 'x'; a whole number"),
        (lambda text: text[: len(text) // 2], "not well-formed XML"),
    ],
)
def test_invalid_maps_are_refused(tmp_path, change, message):
    text = str(road())
    assert change(text) != text
    (tmp_path / "map.osm").write_text(change(text))
    with pytest.raises(RecordingError, match=message):
        read_map(tmp_path / "map.osm", ORIGIN)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            changed("(<relation id='1' .*?)role='left'", r"\1role='side'", 1),
            "without exactly one left and one right way",
        ),
        (changed("(<relation id='1' .*?)ref='1'", r"\1ref='999'", 1), "whose ways or nodes are missing"),
        (changed("<node id='2'", "<node id='2' action='delete'"), "whose ways or nodes are missing"),
        (changed("(<way id='1' [^>]*>).*?<tag", r"\1<nd ref='1'/><tag", 1), "without length or width"),
        (changed("(<relation id='1' .*?ref='1'.*?)ref='2'", r"\1ref='1'", 1), "without length or width"),
        (changed("(<relation id='1' .*?)highway", r"\1crosswalk", 1), "that are not for vehicles"),
        (
            changed("(<relation id='1'[^>]*>)", r"\1<member type='way' ref='999' role='centerline'/>", 1),
            "whose ways or nodes are missing",
        ),
    ],
)
def test_left_out_content_is_counted(tmp_path, change, reason):
    (tmp_path / "map.osm").write_text(change(str(road())))
    dropped = Counter()
    lanes = read_map(tmp_path / "map.osm", ORIGIN, dropped=dropped)
    assert dropped == {f"lanelets {reason}": 1}
    assert lanes.ids.tolist() == [2, 3, 4, 5, 6]
    assert lanes.adjacent_left.tolist() == [-1, 0, -1, 2, 3]
