"""A short simulation: plausible physics, derived columns that agree with the tracks, the same bytes for the same seed."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest
import shapely
from data.recorded.formats.exid_files import read_tracks, read_tracks_meta

from epo_lightning.data.recorded.formats.exid_tables import TRACKS
from epo_lightning.data.recorded.lanes import lane_changes
from epo_lightning.data.recorded.tracks import Recording
from epo_lightning.data.simulate import realism, recording
from epo_lightning.data.simulate.generate import map_path
from epo_lightning.data.simulate.lanelets import write_map
from epo_lightning.data.simulate.layout import LAYOUTS
from epo_lightning.data.simulate.leaders import FURTHEST_LEADER, leaders
from epo_lightning.data.simulate.motion import Motion, move, savitzky_golay
from epo_lightning.data.simulate.network import edges_of, write_network
from epo_lightning.data.simulate.traffic import RATE, Traffic, simulate, simulator
from epo_lightning.registry import ConfigError, lookup

LAYOUT, SEED, SECONDS = LAYOUTS[4], [5, 4], 40.0


def run(folder: Path) -> Motion:
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
    return move(simulate(LAYOUT, SEED, SECONDS, folder), LAYOUT, SECONDS)


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> Motion:
    return run(tmp_path_factory.mktemp("sumo"))


@pytest.fixture(scope="module")
def folder(motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    recording.write(motion, LAYOUT, 4, folder / "data")
    write_map(LAYOUT, folder / map_path(LAYOUT))
    return folder


@pytest.fixture(scope="module")
def table(folder: Path) -> pl.DataFrame:
    return read_tracks(folder / "data" / "04_tracks.csv")


@pytest.fixture(scope="module")
def read(folder: Path) -> Recording:
    (source,) = lookup("format", "exid")(folder)
    return source.read()


def following(motion: Motion) -> np.ndarray:
    """Rows whose next row is the same vehicle's next frame."""
    return np.flatnonzero(np.diff(motion.vehicle) == 0)


def test_the_road_is_busy_from_the_first_frame(motion: Motion):
    assert set(np.unique(motion.frame)) == set(range(round(SECONDS * RATE)))
    assert np.bincount(motion.frame).min() >= 5
    assert recording.lane_changes(motion).sum() >= 5
    assert motion.dropped == {"collision": 0, "jump": 0, "acceleration": 0}


def test_speeds_and_accelerations_are_those_of_vehicles(motion: Motion):
    speed = np.linalg.norm(motion.velocity, axis=1)
    assert 15 < np.median(speed) < 40
    assert speed.max() < 60
    assert np.linalg.norm(motion.acceleration, axis=1).max() < 9.0
    sideways = np.abs(np.diff(motion.d) * motion.rate)[following(motion)]
    on_the_road = (motion.s > LAYOUT.lanes[2].join) & (motion.s < LAYOUT.lanes[2].leave)
    assert sideways[on_the_road[following(motion)]].max() < 1.5


def test_positions_velocities_and_accelerations_belong_together(motion: Motion):
    rows = following(motion)
    mean = (motion.velocity[rows] + motion.velocity[rows + 1]) / 2
    np.testing.assert_allclose(motion.position[rows + 1], motion.position[rows] + mean / RATE, atol=0.01)
    mean = (motion.acceleration[rows] + motion.acceleration[rows + 1]) / 2
    gained = (motion.velocity[rows + 1] - motion.velocity[rows]) * RATE
    assert np.percentile(np.linalg.norm(gained - mean, axis=1), 99) < 0.5


def test_vehicles_point_where_they_drive(motion: Motion):
    course = np.arctan2(motion.velocity[:, 1], motion.velocity[:, 0])
    fast = np.linalg.norm(motion.velocity, axis=1) > 3.0
    aside = (motion.heading - course + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(np.abs(aside[fast])).max() < 2.0


def test_vehicles_do_not_overlap(motion: Motion):
    length, width = (motion.size[motion.vehicle] / 2).T
    corners = np.stack([np.stack([a * length, b * width], -1) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))], 1)
    cosine, sine = np.cos(motion.heading)[:, None], np.sin(motion.heading)[:, None]
    x, y = corners[..., 0], corners[..., 1]
    bodies = shapely.polygons(np.stack([cosine * x - sine * y, sine * x + cosine * y], -1) + motion.position[:, None])
    for frame in range(0, round(SECONDS * RATE), RATE // 5):
        rows = np.flatnonzero(motion.frame == frame)
        tree = shapely.STRtree(bodies[rows])
        one, other = tree.query(bodies[rows], predicate="intersects")
        different = one < other
        shared = shapely.area(shapely.intersection(bodies[rows][one[different]], bodies[rows][other[different]]))
        assert (shared < 0.1).all()


def test_lane_changes_take_seconds(read: Recording):
    report = realism.describe([read])
    assert report["lane-change duration"]["count"] >= 3
    assert 3.0 <= report["lane-change duration"]["p50"] <= 5.0
    assert report["lane-change lateral speed"]["p99"] < 1.5
    assert 0.5 < report["time headway"]["p50"] < 3.0


def test_the_tracks_have_all_columns_in_order(folder: Path, motion: Motion):
    header = (folder / "data" / "04_tracks.csv").read_text().partition("\n")[0].split(",")
    assert header == [name for name in TRACKS if not name.startswith("odr")]
    meta = read_tracks_meta(folder / "data" / "04_tracksMeta.csv")
    assert len(meta) == len(motion.size)
    assert set(meta["class"]) <= {"car", "van", "truck", "motorcycle"}


def test_velocities_and_accelerations_are_also_given_along_and_to_the_left_of_the_heading(table: pl.DataFrame):
    turned = np.exp(-1j * np.radians(table["heading"].to_numpy()))
    for name in ("Velocity", "Acceleration"):
        x, y, ahead, aside = (table[f"{way}{name}"].to_numpy() for way in ("x", "y", "lon", "lat"))
        np.testing.assert_allclose((x + 1j * y) * turned, ahead + 1j * aside, atol=1e-3)
    assert np.abs(table["latAcceleration"].to_numpy()).max() > 0.1


def test_lanes_and_offsets_are_those_of_the_map(table: pl.DataFrame, read: Recording):
    tracks, lanes = read.tracks, read.lanes
    located = lanes.locate(tracks.position, tracks.heading)
    same = table["laneletId"].list.first().to_numpy() == lanes.ids[located.lane]
    assert same.mean() > 0.999  # but where a vehicle is within a millimetre of the line
    offset, along = (table[name].list.first().to_numpy() for name in ("latLaneCenterOffset", "lonLaneletPos"))
    assert np.abs(offset - located.offset)[same].max() < 0.01
    assert np.abs(along - located.along)[same].max() < 0.05
    length = table["laneletLength"].list.first().to_numpy()
    np.testing.assert_allclose(length[same], lanes.centrelines.length[located.lane[same]], rtol=1e-3)


def test_lane_changes_are_seen_in_the_tracks(table: pl.DataFrame, read: Recording):
    located = read.lanes.locate(read.tracks.position, read.tracks.heading)
    seen = np.flatnonzero(lane_changes(read.tracks.agent, located, read.lanes))
    told = np.flatnonzero(table["laneChange"].to_numpy())
    assert len(seen) == len(told)
    assert np.abs(seen - told).max() <= 1


def test_leaders_and_gaps_are_seen_in_the_tracks(table: pl.DataFrame, read: Recording):
    tracks = read.tracks
    located = read.lanes.locate(tracks.position, tracks.heading)
    leader, distance = leaders(tracks, located, read.lanes)
    told = table["leadId"].fill_null(-1).to_numpy()
    seen = np.where(leader >= 0, tracks.ids[tracks.agent[leader]], -1)
    gap = table["leadDHW"].fill_null(np.inf).to_numpy()
    # The tracks know no leader further ahead than that, centre to centre.
    length = tracks.size[tracks.agent, 0]
    near = gap + (length + np.where(leader >= 0, length[leader], 0)) / 2 < FURTHEST_LEADER - 20
    assert (seen == told)[near | (told < 0)].mean() > 0.999
    both = (seen == told) & (told >= 0)
    expected = distance[both] - (length[both] + length[leader[both]]) / 2
    np.testing.assert_allclose(gap[both], expected, atol=0.1)
    speed = table["lonVelocity"].to_numpy()
    np.testing.assert_allclose(
        table["leadDV"].fill_null(np.nan).to_numpy()[both], (speed - speed[leader])[both], atol=1e-3
    )
    np.testing.assert_allclose(table["leadTHW"].fill_null(np.nan).to_numpy()[both], (gap / speed)[both], atol=1e-3)


def test_vehicles_beside_are_those_beside(motion: Motion, table: pl.DataFrame):
    """Every neighbour column against a plain search among all vehicles of a frame."""
    frames = np.random.default_rng(0).choice(np.unique(motion.frame), 25, replace=False)
    for frame in frames:
        rows = np.flatnonzero(motion.frame == frame)
        half = motion.size[motion.vehicle[rows], 0] / 2
        for row in range(len(rows)):
            lane = LAYOUT.lanes[motion.strip[rows[row]]]
            s = motion.s[rows[row]]
            for side, step in (("left", 1), ("right", -1)):
                beside = [
                    index
                    for index, other in enumerate(LAYOUT.lanes)
                    if other.place == lane.place + step
                    and other.begin < s < other.end
                    and other.road(s) == lane.road(s)
                ]
                others = [k for k in range(len(rows)) if motion.strip[rows[k]] in beside]
                gap = {k: motion.s[rows[k]] - s for k in others}
                ahead = [k for k in others if gap[k] >= half[k] + half[row]]
                behind = [k for k in others if gap[k] <= -half[k] - half[row]]
                along = {motion.vehicle[rows[k]] for k in others} - {motion.vehicle[rows[k]] for k in ahead + behind}
                told = table.row(int(rows[row]), named=True)
                lead = motion.vehicle[rows[min(ahead, key=gap.__getitem__)]] if ahead else None
                rear = motion.vehicle[rows[max(behind, key=gap.__getitem__)]] if behind else None
                assert told[f"{side}LeadId"] == lead
                assert told[f"{side}RearId"] == rear
                assert set(told[f"{side}AlongsideId"] or ()) == along


def test_the_same_seed_gives_the_same_bytes(folder: Path, tmp_path: Path):
    recording.write(run(tmp_path), LAYOUT, 4, tmp_path / "again")
    for path in sorted((folder / "data").iterdir()):
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()


def test_vehicles_with_impossible_lateral_motion_are_left_out():
    """A vehicle that is moved 1.5 m sideways from one step to the next, in otherwise steady traffic."""
    step = np.tile(np.arange(-25, 250), 2)
    aside = np.where((step > 100) & (np.arange(550) >= 275), 1.5, 0.0)
    size, kind = np.array([[4.0, 1.8], [4.0, 1.8]]), np.zeros(2, dtype=int)
    front = np.concatenate([600 + np.arange(275.0), 500 + np.arange(275.0)])
    traffic = Traffic(
        RATE, np.repeat([0, 1], 275), step, np.zeros(550, dtype=int), front, aside, size, kind, {"jump": 1}
    )
    left = move(traffic, LAYOUT, 8.0)
    assert left.dropped == {"jump": 1, "acceleration": 1}
    assert len(left.size) == 1
    assert left.s[0] == pytest.approx(600 + 25 - 2)
    assert np.linalg.norm(left.velocity, axis=1) == pytest.approx(25.0, rel=0.01)


def test_the_filter_keeps_cubics_and_their_derivatives():
    time = np.arange(60) * 0.04
    values = np.stack([1e5 + 3 * time - 2 * time**2 + 0.5 * time**3, np.ones_like(time)], -1)
    value, rate, second = savitzky_golay(values, 0.04, 12)
    inside = time[12:-12]
    np.testing.assert_allclose(value, values[12:-12], atol=1e-6)
    np.testing.assert_allclose(rate[:, 0], 3 - 4 * inside + 1.5 * inside**2, atol=1e-6)
    np.testing.assert_allclose(second[:, 0], -4 + 3 * inside, atol=1e-5)


def test_ramps_have_a_speed_limit_of_their_own(tmp_path: Path):
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
    edges = edges_of(LAYOUT)
    net = ElementTree.parse(write_network(LAYOUT, edges, simulator()[1], tmp_path))
    limits = {edge.get("id"): [float(lane.get("speed")) for lane in edge.findall("lane")] for edge in net.iter("edge")}
    for edge in edges:
        expected = LAYOUT.limit if edge.road == "main" else 90 / 3.6
        assert limits[edge.name] == pytest.approx([expected] * len(edge.strips), abs=0.01)
    assert {edge.road == "main" for edge in edges} == {True, False}


def test_a_missing_simulator_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "libsumo", None)
    with pytest.raises(ConfigError, match=r"pip install 'epo_lightning\[sim\]'"):
        simulator()


def test_a_missing_library_of_the_system_is_named_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "libsumo.py").write_text('raise ImportError("libX11.so.6: cannot open shared object file")')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "libsumo", raising=False)
    with pytest.raises(ConfigError, match=r"a library of the system is missing \(libX11.*`apt-get install libgl1 "):
        simulator()
