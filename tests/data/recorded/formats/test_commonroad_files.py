"""CommonRoad: scenarios that overlap, bad folders and files, and real files."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

from data.recorded.formats.commonroad_files import (
    CAR,
    ROAD,
    beside,
    drive,
    lanelet,
    obstacle,
    point,
    read,
    scenario,
    speeds,
    state,
)
from epo_lightning.data.recorded.formats.commonroad import commonroad
from epo_lightning.data.recorded.tracks import RecordingError

SHARED = Path(os.environ.get("EPO_SHARED", "../shared")) / "data/us101"


shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no scenarios of US-101 in {SHARED}")


SCENARIO = scenario(ROAD, CAR)


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


@pytest.mark.parametrize("version", ["2018b", "2020a"])
@pytest.mark.parametrize(("identity", "same"), [(1, 12), (2, 40)])
def test_the_fewest_speeds_that_show_the_same_vehicle(tmp_path, identity, same, version):
    """Twelve under the same id, and forty under another one."""
    long = speeds(0, 60)
    for count in (same - 1, same):
        (tmp_path / f"{count}").mkdir()
        cuts = {"a": drive(1, long[:50], version=version), "b": drive(identity, long[50 - count :], version=version)}
        for name, content in cuts.items():
            (tmp_path / f"{count}" / f"{name}.xml").write_text(scenario(content, version=version))
        groups = [source.group for source in commonroad(tmp_path / f"{count}")]
        assert groups == (["a", "a"] if count == same else ["a", "b"])


def test_scenes_that_overlap_are_grouped_also_with_ids_in_single_quotes(tmp_path):
    long = speeds(0, 60)
    for name, content in {"a": drive(1, long[:50]), "b": drive(2, long[5:])}.items():
        (tmp_path / f"{name}.xml").write_text(scenario(content).replace('id="', "id = '").replace('">', "'>"))
    assert [source.group for source in commonroad(tmp_path)] == ["a", "a"]


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
