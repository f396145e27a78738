"""CommonRoad scenarios: both versions of the format, what is left out and counted, overlapping scenes, and bad files."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

from epo_lightning.data.recorded.formats.commonroad import commonroad
from epo_lightning.data.recorded.lanes import LANE, SHOULDER
from epo_lightning.data.recorded.tracks import RecordingError
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS

SHARED = Path(os.environ.get("EPO_SHARED", "../shared")) / "data/us101"
shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no scenarios of US-101 in {SHARED}")

RECTANGLE = "<rectangle><length>5</length><width>2</width></rectangle>"


def exact(value) -> str:
    return f"<exact>{value}</exact>"


def interval(start, end) -> str:
    return f"<intervalStart>{start}</intervalStart><intervalEnd>{end}</intervalEnd>"


def point(x, y) -> str:
    return f"<point><x>{x}</x><y>{y}</y></point>"


def state(time, position, orientation=0.0, velocity=10.0, tag="state") -> str:
    values = {"position": position, "orientation": orientation, "time": time, "velocity": velocity}
    values = {name: value if isinstance(value, str) else exact(value) for name, value in values.items()}
    return f"<{tag}>" + "".join(f"<{name}>{value}</{name}>" for name, value in values.items()) + f"</{tag}>"


def obstacle(identity, states, shape=RECTANGLE, kind="car", version="2020a") -> str:
    initial = states[0].replace("<state>", "<initialState>").replace("</state>", "</initialState>")
    trajectory = f"<trajectory>{''.join(states[1:])}</trajectory>" if len(states) > 1 else ""
    role, tag = ("", "dynamicObstacle") if version == "2020a" else ("<role>dynamic</role>", "obstacle")
    return f'<{tag} id="{identity}">{role}<type>{kind}</type><shape>{shape}</shape>{initial}{trajectory}</{tag}>'


def drive(identity, speeds, y=0.0, **options) -> str:
    """A vehicle along x, one step per speed."""
    x = np.cumsum(speeds) * 0.1
    return obstacle(identity, [state(k, point(x[k], y), velocity=v) for k, v in enumerate(speeds)], **options)


def bound(side: str, y: float, marking: str = "", start: float = 0.0) -> str:
    points = "".join(point(start + x, y) for x in (0.0, 50.0, 100.0))
    return f"<{side}Bound>{points}{marking and f'<lineMarking>{marking}</lineMarking>'}</{side}Bound>"


def lanelet(identity, y=0.0, start=0.0, left="", right="", rest="") -> str:
    bounds = bound("left", y + 2, left, start) + bound("right", y - 2, right, start)
    return f'<lanelet id="{identity}">{bounds}{rest}</lanelet>'


def beside(side, identity, direction="same") -> str:
    return f'<adjacent{side} ref="{identity}" drivingDir="{direction}"/>'


def scenario(*elements: str, version="2020a", step="0.1") -> str:
    head = f'<commonRoad commonRoadVersion="{version}" benchmarkID="USA_A-1_1_T-1" timeStepSize="{step}">'
    problem = '<planningProblem id="1"><initialState/></planningProblem>'
    return f'<?xml version="1.0"?>{head}{"".join(elements)}{problem}</commonRoad>'


ROAD = lanelet(10, 4.0, rest=beside("Right", 20)) + lanelet(20, rest=beside("Left", 10))
CAR = drive(7, [10.0, 11.0, 12.0])
SCENARIO = scenario(ROAD, CAR)


def read(folder: Path, content: str | bytes):
    path = folder / "USA_A-1_1_T-1.xml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    (source,) = commonroad(folder)
    assert (source.name, source.group, source.files) == (path.stem, path.stem, (path,))
    recording = source.read()
    assert (recording.name, recording.group) == (path.stem, path.stem)
    return recording


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
    content = scenario(
        lanelet(1),
        lanelet(2).replace("<x>50.0</x>", "<x>0.0</x>").replace("<x>100.0</x>", "<x>0.0</x>"),
        static,
        static.replace("30", "31"),
        obstacle(32, [standing]),
        drive(33, [10.0, 11.0], shape=RECTANGLE * 2),
        silent,
        CAR,
    )
    recording = read(tmp_path, content)
    assert recording.tracks.ids.tolist() == [7]
    assert recording.lanes.ids.tolist() == [1]
    assert recording.dropped == {
        "static obstacles": 2,
        "obstacles without a trajectory": 1,
        "obstacles whose shape is not one rectangle, circle or polygon": 1,
        "obstacles without velocities": 1,
        "lanes without length": 1,
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


def speeds(seed: int, steps: int) -> list[float]:
    return np.round(20 + np.random.default_rng(seed).normal(size=steps).cumsum(), 4).tolist()


def test_scenes_that_overlap_are_grouped(tmp_path):
    long, short = speeds(0, 60), speeds(1, 20)
    scenes = {
        "a": scenario(drive(1, long[:50])),
        "b": scenario(drive(2, long[5:])),  # 45 steps of a's vehicle under another id
        "c": scenario(drive(3, short)),
        "d": scenario(drive(3, short[5:])),  # 15 steps of c's vehicle
        "e": scenario(drive(4, short)),  # too short to be known without the id
        "f": scenario(drive(1, [20.0] * 60)),
        "g": scenario(drive(1, [20.0] * 60)),  # one speed is no sign of anything
        "h": scenario(drive(9, [*long[50:], 30.0]), drive(3, short[:14])),  # with c, and with d through c
    }
    for name, content in scenes.items():
        (tmp_path / f"{name}.xml").write_text(content)
    sources = commonroad(tmp_path)
    assert [source.name for source in sources] == list("abcdefgh")
    assert [source.group for source in sources] == list("aaccefgc")
    assert all(source.read().group == source.group for source in sources)


def test_a_link_to_nowhere_is_refused_and_a_folder_is_no_scenario(tmp_path):
    (tmp_path / "a.xml").write_text(SCENARIO)
    (tmp_path / "folder.xml").mkdir()
    assert [source.name for source in commonroad(tmp_path)] == ["a"]
    (tmp_path / "b.xml").symlink_to(tmp_path / "none")
    with pytest.raises(RecordingError, match=r"b.xml: the file cannot be read: No such file"):
        commonroad(tmp_path)


def test_invalid_folders_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="there is no CommonRoad scenario"):
        commonroad(tmp_path)
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same.xml").write_text(SCENARIO)
    with pytest.raises(RecordingError, match="has the same name: rename or remove one"):
        commonroad(tmp_path)


BOMB = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY e "ha"><!ENTITY f "&e;&e;">]><commonRoad>&f;</commonRoad>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not well-formed XML .*no element found"),
        (SCENARIO[: len(SCENARIO) // 2], "not well-formed XML .*is it complete"),
        (BOMB, "declares a document type or entities"),
        ("<osm/>", r"a commonRoad element of version 2018b or 2020a was expected.* 'osm' of version None"),
        (scenario(version="2024").replace("planningProblem", "problem"), "'commonRoad' of version '2024'"),
        (scenario(CAR, step="fast"), "timeStepSize of commonRoad is 'fast'"),
        (scenario(CAR, step="0"), "timeStepSize of commonRoad is 0.0; a positive"),
        (scenario(CAR, step="10"), "a frame rate of 0.1 Hz"),
        (SCENARIO.replace('id="7"', ""), "the id of a dynamicObstacle is missing"),
        (SCENARIO.replace('id="7"', 'id="seven"'), "the id of a dynamicObstacle is 'seven'; a whole number"),
        (scenario(CAR, CAR), "there are two obstacles with the id 7: give each its own"),
        (SCENARIO.replace("type>", "sort>"), "dynamicObstacle 7 has no type element"),
        (SCENARIO.replace("shape>", "form>"), "dynamicObstacle 7 has no shape element"),
        (SCENARIO.replace("dynamicObstacle", "obstacle"), "the role of obstacle 7 is '', not static or dynamic"),
        (SCENARIO.replace("<length>5</length>", ""), "length of the shape of dynamicObstacle 7 is missing"),
        (SCENARIO.replace("<length>5<", "<length>-5<"), r"length and width \[-5.0, 2.0\] of track 7"),
        (SCENARIO.replace("<length>5<", "<length>500<"), "are they in another unit"),
        (
            re.sub("<initialState>.*</initialState>(?=<traj)", "", SCENARIO),
            "dynamicObstacle 7 has no initialState element",
        ),
        (SCENARIO.replace("<time><exact>1</exact></time>", ""), "state 1 of dynamicObstacle 7 has no time element"),
        (SCENARIO.replace("<time><exact>1<", "<time><exact>-1<"), "time of state 1 of dynamicObstacle 7 is -1; a step"),
        (
            SCENARIO.replace("<time><exact>1<", "<time><exact>2<"),
            "track 7 has frame 2 twice: is its id",
        ),
        (
            SCENARIO.replace("<time><exact>0<", "<time><exact>5<"),
            "frame 1 of track 7 comes after its frame 5: frames of",
        ),
        (SCENARIO.replace("<x>2.1", "<x>2,1"), "x of position of state 1 of dynamicObstacle 7 is '2,1'"),
        (SCENARIO.replace("<x>2.1", "<x>nan"), "x of position of state 1 of dynamicObstacle 7 is 'nan.*'; a finite"),
        (SCENARIO.replace("<x>2.1", "<x>1e9"), "position .* of track 7 in frame 1 .* another unit"),
        (SCENARIO.replace("<exact>11.0</exact>", ""), "exact or intervalStart in velocity of state 1 .* is missing"),
        (SCENARIO.replace("<exact>11.0</exact>", "<exact/>"), "velocity of state 1 of dynamicObstacle 7 is"),
        (SCENARIO.replace("<exact>11.0<", "<exact>999<"), "velocity .* of track 7 in frame 1"),
        (
            scenario(obstacle(7, [state(k, '<lanelet ref="10"/>') for k in range(2)])),
            "position of the initial state of dynamicObstacle 7 must be one point, rectangle, circle or polygon",
        ),
        (
            scenario(obstacle(7, [state(k, "<circle><radius>1</radius></circle>") for k in range(2)])),
            "position of the initial state of dynamicObstacle 7 has no center element",
        ),
        (
            scenario(drive(7, [1.0, 2.0], shape=f"<polygon>{point(0, 0)}</polygon>")),
            "the shape of dynamicObstacle 7 is a polygon of 1 points",
        ),
        (scenario(lanelet(10), lanelet(10)), "there are two lanelets with the id 10"),
        (scenario(lanelet(10).replace("leftBound", "bound")), "lanelet 10 has no leftBound element"),
        (scenario(lanelet(10).replace(point(50.0, 2.0), "")), "the bounds of lanelet 10 have 2 and 3 points"),
        (scenario(lanelet(10).replace("<x>50.0", "<x>inf")), "x of leftBound of lanelet 10 is 'inf'; a finite number"),
        (scenario(lanelet(10, 1e9)), "the left line of lane 10 has coordinates that are not finite or beyond"),
        (scenario(re.sub("<point>.*?</point>", "", lanelet(10))), "the map has no lanes"),
        (scenario(lanelet(10, rest="<successor/>")), "ref of successor of lanelet 10 is missing"),
        (scenario(lanelet(10, rest=beside("Left", 10))), "lanelet 10 lies beside itself"),
        (
            scenario(lanelet(10, rest=beside("Left", 20, "up"))),
            "drivingDir of adjacentLeft of lanelet 10 is 'up', not same or opposite",
        ),
        (
            scenario(lanelet(10, rest="<speedLimit>130</speedLimit>")),
            "speedLimit of lanelet 10 is 130; a positive speed in",
        ),
    ],
)
def test_invalid_files_are_refused(tmp_path, content, message):
    with pytest.raises(RecordingError, match=f"USA_A-1_1_T-1.xml: .*{message}"):
        read(tmp_path, content)


@shared
def test_us101_scenarios_are_read():
    sources = commonroad(SHARED)
    recordings = [source.read() for source in sources]
    assert len(recordings) == 22
    assert sum(len(each.tracks) for each in recordings) == 49404
    assert sum(len(each.lanes) for each in recordings) == 233
    assert not any(each.dropped for each in recordings)
    groups: dict[str, set[str]] = {}
    for source in sources:
        groups.setdefault(source.group, set()).add(source.name.removeprefix("USA_US101-").removesuffix("_T-1"))
    assert sorted(sorted(group) for group in groups.values() if len(group) > 1) == [
        ["12_1", "17_1"],
        ["13_4", "1_1", "23_2", "24_2"],
        ["15_2", "20_1", "25_1", "28_1", "5_1"],
        ["18_2", "27_1"],
    ]
    for recording in recordings:
        tracks, lanes = recording.tracks, recording.lanes
        assert tracks.rate == 10.0
        same = np.diff(tracks.agent) == 0
        moved = np.diff(tracks.position, axis=0)[same] * 10
        assert np.median(np.linalg.norm(moved - tracks.velocity[:-1][same], axis=1)) < 1.0
        assert (lanes.locate(tracks.position, tracks.heading).lane >= 0).mean() > 0.9


@shared
def test_tracks_and_lanes_equal_those_of_the_commonroad_library():
    file_reader = pytest.importorskip("commonroad.common.file_reader", reason="commonroad-io is not installed")
    for source in commonroad(SHARED):
        (path,) = source.files
        scenario, _ = file_reader.CommonRoadFileReader(path).open()
        recording = source.read()
        tracks, lanes = recording.tracks, recording.lanes
        theirs = {each.lanelet_id: each for each in scenario.lanelet_network.lanelets}
        assert sorted(theirs) == sorted(lanes.ids.tolist())
        for at, identity in enumerate(lanes.ids.tolist()):
            each = theirs[identity]
            np.testing.assert_array_equal(lanes.centre[at], each.center_vertices)
            assert sorted(lanes.ids[list(lanes.successors[at])].tolist()) == sorted(each.successor)
            assert sorted(lanes.ids[list(lanes.predecessors[at])].tolist()) == sorted(each.predecessor)
            for ours, neighbour, same in (
                (lanes.adjacent_left, each.adj_left, each.adj_left_same_direction),
                (lanes.adjacent_right, each.adj_right, each.adj_right_same_direction),
            ):
                assert (int(lanes.ids[ours[at]]) if ours[at] >= 0 else None) == (neighbour if same else None)
        obstacles = {each.obstacle_id: each for each in scenario.dynamic_obstacles}
        assert sorted(obstacles) == sorted(tracks.ids.tolist())
        for agent, identity in enumerate(tracks.ids.tolist()):
            each, rows = obstacles[identity], tracks.agent == agent
            states = [each.initial_state, *each.prediction.trajectory.state_list]
            assert [state.time_step for state in states] == tracks.frame[rows].tolist()
            np.testing.assert_array_equal(tracks.position[rows], [state.position for state in states])
            np.testing.assert_array_equal(tracks.heading[rows], [state.orientation for state in states])
            np.testing.assert_allclose(tracks.speed[rows], [state.velocity for state in states])
            np.testing.assert_allclose(tracks.size[agent], [each.obstacle_shape.length, each.obstacle_shape.width])
