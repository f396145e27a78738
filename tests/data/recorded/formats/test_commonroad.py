"""CommonRoad scenarios: both versions of the format, their lanes, and what is left out and counted."""

from __future__ import annotations

import re

import numpy as np
import pytest

from data.recorded.formats.commonroad_files import (
    CAR,
    RECTANGLE,
    ROAD,
    beside,
    drive,
    lanelet,
    obstacle,
    point,
    read,
    scenario,
    state,
)
from epo_lightning.data.recorded.formats.commonroad import commonroad
from epo_lightning.data.recorded.lanes import LANE, SHOULDER
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS


def interval(start, end) -> str:
    return f"<intervalStart>{start}</intervalStart><intervalEnd>{end}</intervalEnd>"


def test_commonroad_is_a_registered_format():
    assert lookup("format", "commonroad") is commonroad


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_tracks_equal_the_states_of_the_scenario(tmp_path, version):
    other = obstacle(
        9, [state(3, point(0, 5), np.pi / 2, 2.0), state(5, point(0, 6), np.pi / 2, -2.0)], kind="bus", version=version
    )
    content = scenario(ROAD, drive(7, [10.0, 11.0, 12.0], version=version), other, version=version, step="0.04")
    recording = read(tmp_path, content)
    tracks = recording.tracks
    assert not recording.dropped
    assert tracks.rate == 25.0
    assert tracks.ids.tolist() == [7, 9]
    assert tracks.agent.tolist() == [0, 0, 0, 1, 1]
    assert tracks.frame.tolist() == [0, 1, 2, 3, 5]
    assert [KINDS[kind] for kind in tracks.kind] == ["car", "bus"]
    np.testing.assert_allclose(tracks.position, [[1.0, 0], [2.1, 0], [3.3, 0], [0, 5], [0, 6]])
    np.testing.assert_allclose(tracks.velocity, [[10, 0], [11, 0], [12, 0], [0, 2], [0, -2]], atol=1e-12)
    np.testing.assert_allclose(tracks.speed, [10, 11, 12, 2, -2])
    np.testing.assert_allclose(tracks.heading, [0, 0, 0, np.pi / 2, np.pi / 2])
    assert tracks.size.tolist() == [[5.0, 2.0]] * 2


@pytest.mark.parametrize(
    ("name", "kind"),
    [("taxi", "car"), ("truck", "truck"), ("bicycle", "bicycle"), ("train", "other"), ("unknown", "other")],
)
def test_kinds_of_agents_are_mapped(tmp_path, name, kind):
    assert KINDS[read(tmp_path, scenario(drive(7, [10.0, 11.0], kind=name))).tracks.kind[0]] == kind


def test_intervals_and_areas_are_read_as_their_centres(tmp_path):
    areas = [
        "<circle><radius>3</radius><center><x>1</x><y>2</y></center></circle>",
        "<rectangle><length>4</length><width>2</width><orientation>0.7</orientation>"
        "<center><x>3</x><y>4</y></center></rectangle>",
        f"<polygon>{point(4, 4)}{point(6, 4)}{point(6, 8)}{point(4, 8)}</polygon>",
    ]
    states = [
        state(interval(2 * k, 2 * k + 1), area, interval(-0.1, 0.3), interval(9, 12)) for k, area in enumerate(areas)
    ]
    tracks = read(tmp_path, scenario(obstacle(7, states))).tracks
    assert tracks.frame.tolist() == [0, 2, 4]
    np.testing.assert_allclose(tracks.position, [[1, 2], [3, 4], [5, 6]])
    np.testing.assert_allclose(tracks.heading, 0.1)
    np.testing.assert_allclose(tracks.speed, 10.5)


@pytest.mark.parametrize(
    ("shape", "size", "centre"),
    [
        ("<circle><radius>0.4</radius></circle>", [0.8, 0.8], [10, 20]),
        (f"<polygon>{point(-1, -1)}{point(5, -1)}{point(5, 1)}{point(-1, 1)}</polygon>", [6, 2], [10, 22]),
        (RECTANGLE.replace("</width>", "</width><originXShift>-1.5</originXShift>"), [5, 2], [10, 21.5]),
        (RECTANGLE.replace("</width>", "</width><center><x>1</x><y>-0.5</y></center>"), [5, 2], [10.5, 21]),
        (RECTANGLE.replace("</width>", f"</width><orientation>{np.pi / 2}</orientation>"), [2, 5], [10, 20]),
        (RECTANGLE.replace("</width>", f"</width><orientation>{np.pi}</orientation>"), [5, 2], [10, 20]),
        (
            RECTANGLE.replace(
                "</width>", f"</width><orientation>{np.pi / 2}</orientation><originXShift>-1.5</originXShift>"
            ),
            [2, 5],
            [8.5, 20],
        ),
    ],
)
def test_positions_are_those_of_the_centre(tmp_path, shape, size, centre):
    north = [state(k, point(10, 20), np.pi / 2) for k in range(2)]
    tracks = read(tmp_path, scenario(obstacle(7, north, shape))).tracks
    np.testing.assert_allclose(tracks.size, [size])
    np.testing.assert_allclose(tracks.position, [centre] * 2)


def test_lanes_equal_the_lanelets_of_the_scenario(tmp_path):
    signs = (
        '<trafficSign id="70"><trafficSignElement><trafficSignID>R2-1</trafficSignID><additionalValue>29.0</additionalValue>'
        "</trafficSignElement></trafficSign>"
        '<trafficSign id="71"><trafficSignElement><trafficSignID>R1-1</trafficSignID></trafficSignElement></trafficSign>'
    )
    content = scenario(
        lanelet(50, 8.0, rest=beside("Right", 10, "opposite")),
        lanelet(
            10,
            4.0,
            rest='<successor ref="11"/><successor ref="11"/>'
            + beside("Left", 50, "opposite")
            + beside("Right", 20)
            + '<trafficSignRef ref="70"/><trafficSignRef ref="71"/>',
        ),
        lanelet(11, 4.0, start=100.0, rest='<successor ref="10"/>'),
        lanelet(
            20,
            right="solid",
            rest=beside("Left", 10) + beside("Right", 30) + '<successor ref="99"/><speedLimit>20</speedLimit>',
        ),
        lanelet(21, start=100.0, rest='<predecessor ref="20"/>' + beside("Left", 98) + '<trafficSignRef ref="97"/>'),
        lanelet(
            30, -4.0, rest=beside("Left", 20) + "<laneletType>highway</laneletType><laneletType>shoulder</laneletType>"
        ),
        signs,
        CAR,
    )
    recording = read(tmp_path, content)
    lanes = recording.lanes
    assert lanes.ids.tolist() == [50, 10, 11, 20, 21, 30]
    assert lanes.centre[1].tolist() == [[0, 4], [50, 4], [100, 4]]
    assert (lanes.left[3][0].tolist(), lanes.right[3][0].tolist()) == ([0, 2], [0, -2])
    assert list(lanes.successors) == [(), (2,), (1,), (4,), (), ()]
    assert lanes.predecessors[4] == (3,)
    assert lanes.adjacent_left.tolist() == [-1, -1, -1, 1, -1, 3]
    assert lanes.adjacent_right.tolist() == [-1, 3, -1, 5, -1, -1]
    assert lanes.left_of.tolist() == [-1, -1, -1, 1, -1, 3]
    assert lanes.right_of.tolist() == [-1, 3, -1, -1, -1, -1]
    np.testing.assert_equal(lanes.speed_limit, [np.nan, 29.0, np.nan, 20.0, np.nan, np.nan])
    assert lanes.kind.tolist() == [LANE] * 5 + [SHOULDER]
    assert recording.dropped == {
        "lane references to lanes that do not exist": 2,
        "lane references to traffic signs that do not exist": 1,
    }


@pytest.mark.parametrize(
    ("marking", "from_right", "from_left"),
    [
        ("", True, True),
        ("dashed", True, True),
        ("no_marking", True, True),
        ("solid", False, False),
        ("broad_solid", False, False),
        ("solid_solid", False, False),
        ("curb", False, False),
        ("lowered_curb", False, False),
        ("solid_dashed", True, False),
        ("dashed_solid", False, True),
    ],
)
def test_markings_decide_on_lane_changes(tmp_path, marking, from_right, from_left):
    content = scenario(
        lanelet(1, 4.0, right=marking, rest=beside("Right", 2)), lanelet(2, left=marking, rest=beside("Left", 1))
    )
    lanes = read(tmp_path, content).lanes
    assert (lanes.adjacent_right[0], lanes.adjacent_left[1]) == (1, 0)
    assert lanes.left_of[1] == (0 if from_right else -1)
    assert lanes.right_of[0] == (1 if from_left else -1)


def test_left_out_content_is_counted(tmp_path):
    static = f'<staticObstacle id="30"><type>parkedVehicle</type><shape>{RECTANGLE}</shape></staticObstacle>'
    standing = state(0, point(0, 0))
    silent = re.sub("<velocity>.*?</velocity>", "", drive(34, [10.0, 11.0]))
    in_part = re.sub("<velocity>.*?</velocity>", "", drive(35, [10.0, 11.0, 12.0]), count=1)
    content = scenario(
        lanelet(1),
        lanelet(2).replace("<x>50.0</x>", "<x>0.0</x>").replace("<x>100.0</x>", "<x>0.0</x>"),
        re.sub("<leftBound>.*</leftBound>", f"<leftBound>{point(0, 2) * 3}</leftBound>", lanelet(3)),
        static,
        static.replace("30", "31"),
        obstacle(32, [standing]),
        drive(33, [10.0, 11.0], shape=RECTANGLE * 2),
        silent,
        in_part,
        '<environmentObstacle id="36"/><phantomObstacle id="37"/><phantomObstacle id="38"/>',
        CAR,
    )
    recording = read(tmp_path, content)
    assert recording.tracks.ids.tolist() == [7]
    assert recording.lanes.ids.tolist() == [1]
    assert recording.dropped == {
        "static obstacles": 2,
        "environment obstacles": 1,
        "phantom obstacles": 2,
        "obstacles without a trajectory": 1,
        "obstacles whose shape is not one rectangle, circle or polygon": 1,
        "obstacles without velocities": 2,
        "lanes without length": 2,
    }


def test_static_obstacles_of_2018b_are_counted_and_left_out(tmp_path):
    static = '<obstacle id="30"><role>static</role></obstacle>'
    recording = read(tmp_path, scenario(static, drive(7, [1.0, 2.0], version="2018b"), version="2018b"))
    assert recording.dropped == {"static obstacles": 1}
    assert recording.lanes is None


def test_a_planning_problem_without_traffic_has_no_tracks(tmp_path):
    recording = read(tmp_path, scenario(ROAD))
    assert recording.dropped == {"recordings without traffic": 1}
    assert len(recording.lanes) == 2
    tracks = recording.tracks
    assert (len(tracks), tracks.rate) == (0, 10.0)
    shapes = {name: value.shape for name, value in vars(tracks).items() if name != "rate"}
    assert shapes.pop("position") == shapes.pop("velocity") == shapes.pop("size") == (0, 2)
    assert set(shapes.values()) == {(0,)}


SPEED_SIGNS = ("274", "274.1", "R2-1", "r301", "3.24", "R15", "C43", "B14", "\u03a1-32", "B31")


def sign(identity: int, *limits: tuple[str, float]) -> str:
    elements = "".join(
        f"<trafficSignElement><trafficSignID>{name}</trafficSignID><additionalValue>{value}</additionalValue>"
        "</trafficSignElement>"
        for name, value in limits
    )
    return f'<trafficSign id="{identity}">{elements}</trafficSign>'


@pytest.mark.parametrize("name", SPEED_SIGNS)
def test_the_speed_limit_of_a_lane_is_the_lowest_that_its_signs_and_itself_state(tmp_path, name):
    refs = '<trafficSignRef ref="70"/><trafficSignRef ref="71"/>'
    content = scenario(
        lanelet(1, rest=refs),
        lanelet(2, 4.0, rest=f"<speedLimit>8</speedLimit>{refs}"),
        sign(70, ("310", 5.0), (name, 12.5)),
        sign(71, (name, 20.0)),
        CAR,
    )
    assert read(tmp_path, content).lanes.speed_limit.tolist() == [12.5, 8.0]


def test_borders_and_shoulders_are_not_driven_on_regularly(tmp_path):
    kinds = [f"<laneletType>{name}</laneletType>" for name in ("border", "shoulder", "exitRamp")]
    lanes = read(tmp_path, scenario(*(lanelet(k, 4.0 * k, rest=kind) for k, kind in enumerate(kinds)))).lanes
    assert lanes.kind.tolist() == [SHOULDER, SHOULDER, LANE]
