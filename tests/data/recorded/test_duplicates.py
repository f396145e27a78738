"""The same vehicles at the same moments in several recordings, compared with a plain loop that knows which is which."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from epo_lightning.data.recorded.duplicates import (
    AGAIN,
    CHANGES,
    ELSEWHERE,
    ENOUGH,
    RUN,
    Drives,
    align,
    runs,
    used_once,
)
from epo_lightning.data.recorded.extraction import _raw
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.tracks import Recording, RecordingSource, TrackTable
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import ConfigError, register

RATE = 10.0
WINDOWS = WindowConfig(dt=0.2, history=5, horizon=5, agents=3, least_agents=1, radius=25.0, lane_change=False)
LANKERSHIM = Path(os.environ.get("EPO_SHARED", Path(__file__).parents[4] / "shared")) / "data" / "lankershim"


def drive(seed: int, vehicles: int = 6, frames: int = 160) -> TrackTable:
    """Vehicles whose speeds vary; the last one stands still."""
    random = np.random.default_rng(seed)
    rows = []
    for number in range(vehicles):
        begin = int(random.integers(0, 40))
        count = int(random.integers(70, frames - begin))
        time = np.arange(count) / RATE
        speed = np.round(8 + 3 * np.sin(time * random.uniform(0.5, 2.0) + random.uniform(0, 6)), 4)
        speed = speed if number < vehicles - 1 else np.zeros(count)
        heading = random.uniform(-3, 3) + 0.05 * time
        velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
        position = random.uniform(0, 60, 2) + velocity.cumsum(0) / RATE
        rows.append((np.full(count, number), begin + np.arange(count), position, heading, velocity))
    agent, frame, position, heading, velocity = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    nothing = np.zeros(vehicles, dtype=int)
    return TrackTable(
        RATE, agent, frame, position, heading, velocity, np.arange(vehicles), np.ones((vehicles, 2)), nothing
    )


@dataclass(frozen=True)
class Cut:
    """A part of a drive with frames, ids and axes of its own, and the frame and the vehicle that each stands for."""

    recording: Recording
    shift: int
    origin: dict[int, tuple[int, int]]


def cut(source: int, name: str, first: int, last: int, seed: int) -> Cut:
    of = drive(source)
    random = np.random.default_rng(seed)
    rows = (of.frame >= first) & (of.frame <= last) & (random.uniform(size=len(of.ids)) < 0.9)[of.agent]
    if not rows.any():
        rows = (of.frame >= first) & (of.frame <= last)
    kept = np.unique(of.agent[rows])
    order = random.permutation(len(kept))
    place = dict(zip(kept.tolist(), order.tolist(), strict=True))
    agent = np.array([place[old] for old in of.agent[rows].tolist()], dtype=int)
    sort = np.lexsort((of.frame[rows], agent))
    turn, move = random.uniform(-3, 3), random.uniform(-1e4, 1e4, 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    ids = 100 * seed + np.arange(len(kept))
    tracks = TrackTable(
        RATE,
        agent[sort],
        of.frame[rows][sort] - first,
        (of.position[rows] @ rotation.T + move)[sort],
        (of.heading[rows] + turn)[sort],
        (of.velocity[rows] @ rotation.T)[sort],
        ids,
        np.ones((len(kept), 2)),
        np.zeros(len(kept), dtype=int),
    )
    origin = {int(ids[new]): (source, old) for old, new in place.items()}
    return Cut(Recording(name, name, tracks, None), first, origin)


def plain(splits, cuts: dict[str, Cut], tables: dict[str, SceneTables | None]):
    """Kept scenes of each recording and the counts, from the true vehicles and frames, by loops over all pairs."""
    step = round(WINDOWS.dt * RATE)
    reach = (WINDOWS.history - 1 + WINDOWS.horizon) * step
    before: list[tuple[str, int, frozenset]] = []
    kept, counts = {}, {}
    for split in ("test", "val", "train"):
        for name in splits[split]:
            of, scenes = cuts[name], tables[name]
            counts[name] = {AGAIN: 0, ELSEWHERE: 0}
            if scenes is None:
                continue
            kept[name] = []
            mine = []
            for row in range(len(scenes)):
                members = scenes.agents[row]
                vehicles = frozenset(of.origin[int(scenes.track[a])] for a in members if a >= 0)
                frame = int(scenes.frame[row]) + of.shift
                leaks = any(
                    other != split and vehicles & its and abs(frame - when) <= reach for other, when, its in before
                )
                again = not leaks and any(
                    other == split and vehicles == its and frame == when for other, when, its in before
                )
                counts[name][ELSEWHERE] += leaks
                counts[name][AGAIN] += again
                kept[name].append(not leaks and not again)
                if kept[name][-1]:
                    mine.append((split, frame, vehicles))
            before += mine
    return kept, counts


def share_enough(one: Cut, other: Cut) -> bool:
    """Whether two cuts have no vehicle in common, or as many equal runs of speeds as show an overlap."""

    def frames(of: Cut) -> dict[tuple[int, int], set[int]]:
        tracks = of.recording.tracks
        return {
            of.origin[int(name)]: set((tracks.frame[tracks.agent == agent] + of.shift).tolist())
            for agent, name in enumerate(tracks.ids)
        }

    mine, its = frames(one), frames(other)
    both = mine.keys() & its.keys()
    # The last vehicle of a drive stands, so its speeds do not identify it.
    moving = [vehicle for vehicle in both if vehicle[1] < len(drive(vehicle[0]).ids) - 1]
    runs = sum(max(0, len(mine[vehicle] & its[vehicle]) - RUN + 1) for vehicle in moving)
    return not both or runs >= ENOUGH


@given(st.integers(0, 10_000), st.lists(st.tuples(st.integers(0, 20), st.integers(70, 159)), min_size=2, max_size=4))
@settings(max_examples=15)
def test_scenes_are_used_once_as_by_a_plain_loop(seed, spans):
    # Windows are at even frames; cuts at even frames have the same moments.
    cuts = {
        f"{number}": cut(seed, f"{number}", 2 * (first // 2), last, seed + number + 1)
        for number, (first, last) in enumerate(spans)
    }
    assume(all(share_enough(one, other) for one, other in combinations(cuts.values(), 2)))
    cuts["other"] = cut(seed + 1, "other", 0, 159, seed)
    random = np.random.default_rng(seed)
    splits = {split: [] for split in ("train", "val", "test")}
    for name in sorted(cuts):
        splits[("train", "val", "test")[random.integers(3)]].append(name)
    tables = {name: extract(of.recording, WINDOWS)[0] for name, of in cuts.items()}
    drives = {name: Drives.of(_raw(of.recording)) for name, of in cuts.items()}
    kept, counts = used_once(splits, tables, drives, WINDOWS)
    expected, numbers = plain(splits, cuts, tables)
    for name in cuts:
        if tables[name] is not None:
            assert kept[name].tolist() == expected[name]
        assert {reason: counts[name][reason] for reason in (AGAIN, ELSEWHERE)} == numbers[name]
    assert not sum(counts["other"].values()), "vehicles of another drive are not the same"


def test_vehicles_and_times_of_cuts_are_recognised():
    cuts = [cut(3, "a", 0, 100, 1), cut(3, "b", 33, 159, 2), cut(4, "c", 0, 159, 3)]
    shared = align([Drives.of(_raw(of.recording)) for of in cuts])
    assert shared.shift[1] - shared.shift[0] == 33
    named: dict[int, set[tuple[int, int]]] = {}
    for of, vehicles in zip(cuts, shared.vehicle, strict=True):
        for track, vehicle in zip(of.recording.tracks.ids.tolist(), vehicles.tolist(), strict=True):
            named.setdefault(vehicle, set()).add(of.origin[track])
    assert all(len(names) == 1 for names in named.values())
    both = set(cuts[0].origin.values()) & set(cuts[1].origin.values())
    assert len(named) == sum(len(of.recording.tracks.ids) for of in cuts) - len(both)
    assert (3, 5) in both, "a vehicle that stands still is recognised by its place"


def test_moments_between_the_steps_of_another_recording_are_used_once():
    cuts = {"a": cut(5, "a", 0, 159, 1), "b": cut(5, "b", 1, 159, 1)}
    tables = {name: extract(of.recording, WINDOWS)[0] for name, of in cuts.items()}
    drives = {name: Drives.of(_raw(of.recording)) for name, of in cuts.items()}
    kept, counts = used_once({"train": ["a", "b"], "val": [], "test": []}, tables, drives, WINDOWS)
    assert kept["a"].all()
    assert kept["b"].mean() < 0.2, "only where neighbours changed within 0.1 s"
    assert counts["b"][AGAIN] == (~kept["b"]).sum()


@register("format", "cuts")
def cuts_of_a_drive(folder: Path) -> list[RecordingSource]:
    """Files ``<name>.cut`` with seed, first and last frame."""

    def source(file: Path) -> RecordingSource:
        def read():
            seed, first, last = map(int, file.read_text().split())
            return cut(seed, file.stem, first, last, seed).recording

        return RecordingSource(file.stem, file.stem, (file,), read)

    return [source(file) for file in folder.glob("*.cut")]


def test_the_setting_changes_the_data_set_and_its_digest_and_the_default_does_neither(tmp_path):
    for name, text in {"a": "1 0 150", "b": "2 0 150", "c": "3 0 150", "d": "3 20 150", "e": "1 0 150"}.items():
        (tmp_path / f"{name}.cut").write_text(text)

    def data(**changes) -> RecordedData:
        windows = {"dt": 0.2, "history": 5, "horizon": 5, "agents": 3, "least_agents": 1, "lane_change": False}
        return RecordedData(
            *("cuts", "cuts", str(tmp_path), windows), map=False, test=["a"], root=str(tmp_path / "cache"), **changes
        )

    keep, once = data(), data(duplicates="once")
    assert "duplicates" not in keep.config
    assert keep.digest == data(duplicates="keep").digest != once.digest
    keep.generate(workers=1, progress=False)
    once.generate(workers=1, progress=False)
    before, after = keep.report(), once.report()
    same = "the same vehicles in another recording"
    assert all(before[split]["scenes"] >= after[split]["scenes"] for split in ("train", "val", "test"))
    assert before["test"]["scenes"] == after["test"]["scenes"]
    used = {split: after[split].get(ELSEWHERE, 0) + after[split].get(same, 0) for split in after["recordings"]}
    assert {split: before[split]["scenes"] - after[split]["scenes"] for split in used} == used
    assert sum(used.values()) > 0
    for split in used:
        assert len(once.open(split)) == after[split]["scenes"]
    with pytest.raises(ConfigError, match=r"unknown data\.duplicates 'twice'"):
        data(duplicates="twice")


@pytest.mark.slow
@pytest.mark.skipif(not LANKERSHIM.is_dir(), reason="no Lankershim recordings")
def test_lankershim_files_that_are_copies_of_others_give_no_second_scene(tmp_path):
    for name in ("2_12", "2_18", "2_4"):
        file = f"USA_Lanker-{name}_T-1.xml"
        (tmp_path / file).symlink_to(LANKERSHIM / file)
    windows = {"dt": 0.2, "lane_change": False, "smoothing": 1.0}
    module = RecordedData("lankershim", "commonroad", str(tmp_path), windows, duplicates="once")
    sources = module.sources()
    recordings = {source.name.split("-")[1].removesuffix("_T"): source.read() for source in sources}
    tables = {name: extract(of, module.windows)[0] for name, of in recordings.items()}
    drives = {name: Drives.of(_raw(of)) for name, of in recordings.items()}
    splits = {"train": ["2_12", "2_18"], "val": [], "test": ["2_4"]}
    kept, counts = used_once(splits, tables, drives, module.windows)
    assert kept["2_12"].all()
    assert not kept["2_18"].any(), "a copy under other coordinates"
    assert counts["2_18"][AGAIN] == len(tables["2_18"])
    assert kept["2_4"].all()


@pytest.mark.parametrize(("changes", "found"), [(CHANGES - 1, 0), (CHANGES, 1), (RUN - 1, 1)])
def test_a_run_identifies_a_vehicle_from_a_number_of_changes_on(changes: int, found: int) -> None:
    """One run of speeds that rise ``changes`` times and are constant afterwards, and its equal elsewhere and later."""
    speed = 5.0 + 0.1 * np.minimum(np.arange(RUN), changes)
    place = np.stack([speed.cumsum(), np.zeros(RUN)], 1)
    agent = np.zeros(RUN, dtype=int)
    first, key = runs(Drives(RATE, agent, np.arange(RUN), place, speed, np.array([7])))
    assert first.tolist() == [0] * found
    _, again = runs(Drives(RATE, agent, 50 + np.arange(RUN), place + 9.0, speed, np.array([3])))
    assert key.tolist() == again.tolist()


def same_vehicles(one: Drives, other: Drives) -> int:
    """Number of vehicles that two recordings have in common."""
    mine, its = align([one, other]).vehicle
    return len(np.intersect1d(mine, its))


def test_recordings_of_different_rates_have_no_vehicle_in_common():
    one = Drives.of(_raw(cut(3, "a", 0, 159, 1).recording))
    assert same_vehicles(one, one) == len(one.ids)
    assert same_vehicles(one, dataclasses.replace(one, rate=2 * RATE)) == 0


@pytest.mark.parametrize(("noise", "same"), [(0.03, True), (0.3, False)])
def test_the_same_vehicle_is_at_the_same_place_within_ten_centimetres_in_the_mean(noise, same):
    one = Drives.of(_raw(cut(3, "a", 0, 159, 1).recording))
    moved = one.position + np.random.default_rng(0).normal(0.0, noise, one.position.shape)
    assert same_vehicles(one, dataclasses.replace(one, position=moved)) == (len(one.ids) if same else 0)


def test_a_vehicle_that_stands_elsewhere_is_another_one():
    one = Drives.of(_raw(cut(3, "a", 0, 159, 1).recording))
    aside = np.where(one.speed == 0, 0.5, 0.0)[:, None] * (1.0, 0.0)
    assert len(np.unique(one.agent[one.speed == 0])) == 1
    assert same_vehicles(one, dataclasses.replace(one, position=one.position + aside)) == len(one.ids) - 1


@pytest.mark.parametrize("last", [90, 100])
def test_moments_between_two_windows_are_those_of_the_nearest_one(last):
    """Windows are eight frames apart; the second recording has them three frames later."""
    windows = dataclasses.replace(WINDOWS, every=4)
    cuts = {"a": cut(5, "a", 0, 159, 1), "b": cut(5, "b", 3, last, 1)}
    tables = {name: extract(of.recording, windows)[0] for name, of in cuts.items()}
    drives = {name: Drives.of(_raw(of.recording)) for name, of in cuts.items()}
    kept, _ = used_once({"train": ["a", "b"], "val": [], "test": []}, tables, drives, windows)
    assert kept["a"].all()
    assert len(kept["b"]) > 5
    assert kept["b"].mean() < 0.5


@pytest.mark.parametrize(("frames", "same"), [(39, 1), (38, 0)])
def test_twenty_runs_of_twenty_frames_show_an_overlap(frames, same):
    time = np.arange(120) / RATE
    speed = np.round(8 + 3 * np.sin(time), 4)
    place = np.stack([speed.cumsum() / RATE, np.zeros(120)], 1)
    rows = np.arange(60), np.arange(60 - frames, 120)
    parts = [Drives(RATE, np.zeros(len(at), int), at, place[at], speed[at], np.array([7])) for at in rows]
    assert same_vehicles(*parts) == same


def test_of_several_differences_of_frames_the_one_with_most_equal_runs_counts():
    """Speeds that repeat after 60 frames agree at three differences."""
    frame = np.arange(120)
    speed = np.round(8 + 3 * np.sin(frame * 2 * np.pi / 60), 4)
    place = np.stack([speed.cumsum() / RATE, np.zeros(120)], 1)
    one = Drives(RATE, np.zeros(120, int), frame, place, speed, np.array([7]))
    assert align([one, dataclasses.replace(one, frame=frame + 5)]).shift.tolist() == [0, -5]
