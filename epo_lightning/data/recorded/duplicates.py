"""Recordings that share traffic: the same vehicles at the same moments, under other times, ids and coordinates.

Recordings are cut out of longer ones, and some cuts overlap (CommonRoad). A cut may begin at another time, number its
vehicles anew and have an origin and axes of its own. Two recordings overlap if, at a fixed difference of their frames, many
consecutive speeds agree, and if one rigid motion maps the positions of these rows onto each other. Then two tracks are the
same vehicle if that motion maps one onto the other wherever both are recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.windows import WindowConfig

AGAIN, ELSEWHERE = "the same vehicles in another recording", "the same vehicles in another split"
"""Reasons for which windows are left out."""
RUN = 20
"""Number of consecutive speeds that are compared."""
CHANGES = RUN // 2
"""Smallest number of changes within such a run: nearly constant speeds do not identify a vehicle."""
DIGIT = 1e-4
"""Speeds [m/s] that agree within this are equal."""
ENOUGH = 20
"""Smallest number of equal runs at one difference of frames that shows an overlap."""
NEAR = 0.1
"""Largest mean distance [m] between two tracks of the same vehicle."""
SLOTS = np.uint64(1 << 26)
"""Number of remainders of hashes, by which runs of one recording alone are left out before hashes are compared."""
ORDER = ("test", "val", "train")
"""Splits that keep their scenes first."""


@dataclass(frozen=True)
class Drives:
    """Recorded rows of one recording, sorted by agent and frame.

    Attributes:
        rate: frames per second [Hz].
        agent: index of each row's agent.
        frame: number of each row's frame.
        position: [m].
        speed: along the heading [m/s].
        ids: identifier of each agent.
    """

    rate: float
    agent: Int[np.ndarray, " T"]
    frame: Int[np.ndarray, " T"]
    position: Float[np.ndarray, "T 2"]
    speed: Float[np.ndarray, " T"]
    ids: Int[np.ndarray, " A"]

    @classmethod
    def of(cls, raw: Mapping[str, np.ndarray]) -> Drives:
        """The rows that an extraction kept."""
        return cls(float(raw["rate"][0]), *(raw[name] for name in ("agent", "frame", "position", "speed", "ids")))


@dataclass(frozen=True)
class Shared:
    """Times and vehicles that are common to several recordings.

    Attributes:
        shift: for each recording, what is added to its frames to get those of the common clock.
        vehicle: for each recording, the number of the vehicle of each of its agents; recordings that do not overlap have
            different vehicles.
    """

    shift: Int[np.ndarray, " P"]
    vehicle: Sequence[Int[np.ndarray, " A"]]


def runs(drives: Drives) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """First rows and hashes of all runs of ``RUN`` consecutive frames of an agent whose speeds identify it."""
    count = len(drives.agent) - RUN + 1
    if count < 1:
        return np.empty(0, dtype=int), np.empty(0, dtype=np.uint64)
    last = RUN - 1
    whole = (drives.agent[last:] == drives.agent[:count]) & (drives.frame[last:] - drives.frame[:count] == last)
    digits = np.round(drives.speed / DIGIT).astype(np.int64)
    changed = np.append(0, (np.diff(digits) != 0).cumsum())
    (first,) = np.nonzero(whole & (changed[last:] - changed[:count] >= CHANGES))
    key = np.zeros(len(first), dtype=np.uint64)
    for step in range(RUN):
        key = key * np.uint64(0x9E3779B97F4A7C15) + digits[first + step].astype(np.uint64)
        key ^= key >> np.uint64(29)
    return first, key


def align(recordings: Sequence[Drives]) -> Shared:
    """The common times and vehicles of recordings; at most two of these are in memory at a time."""
    shift = np.zeros(len(recordings), dtype=np.int64)
    links: dict[int, list[tuple[int, int]]] = {number: [] for number in range(len(recordings))}
    offsets = np.cumsum([0, *(len(drives.ids) for drives in recordings)])
    same = np.arange(offsets[-1])

    def root(agent: int) -> int:
        while same[agent] != agent:
            same[agent] = same[same[agent]]
            agent = int(same[agent])
        return agent

    for one, other, difference in _overlaps(recordings):
        pairs = _same_vehicles(recordings[one], recordings[other], difference)
        if not len(pairs):
            continue
        links[one].append((other, difference))
        links[other].append((one, -difference))
        for mine, its in pairs.tolist():
            first, second = sorted((root(offsets[one] + mine), root(offsets[other] + its)))
            same[second] = first
    seen: set[int] = set()
    for start in range(len(recordings)):
        waiting = [start]
        while waiting:
            number = waiting.pop()
            if number in seen:
                continue
            seen.add(number)
            for neighbour, difference in links[number]:
                if neighbour not in seen:
                    # A moment is frame f here and frame f + difference there.
                    shift[neighbour] = shift[number] - difference
                    waiting.append(neighbour)
    vehicle = np.array([root(agent) for agent in range(len(same))], dtype=np.int64)
    return Shared(shift, [vehicle[begin:end] for begin, end in pairwise(offsets)])


def used_once(
    splits: Mapping[str, Sequence[str]],
    tables: Mapping[str, SceneTables | None],
    drives: Mapping[str, Drives],
    windows: WindowConfig,
) -> tuple[dict[str, Bool[np.ndarray, " scenes"]], dict[str, Counter[str]]]:
    """The scenes of each recording that are kept, so that the same vehicles at the same moment are in one scene only.

    - Of scenes with the same vehicles at the same moment, in two recordings of one split, the first is kept. Moments that
      differ by less than the time between two windows are the same.
    - A scene is left out if the window of one of its vehicles overlaps with a window of the same vehicle in another split.
      Test scenes are kept first, then those of validation, then those of training.

    Args:
        splits: names of the recordings of each split.
        tables: scenes of each recording, by name.
        drives: recorded rows of each recording, by name.
        windows: selection of the windows.

    Returns:
        masks of the scenes that are kept, for recordings that have scenes, and numbers of those that are left out, by name.
    """
    names = sorted(drives)
    place = {name: number for number, name in enumerate(names)}
    shared = align(_InOrder(names, drives))
    kept: dict[str, np.ndarray] = {}
    counts: dict[str, Counter[str]] = {name: Counter() for name in names}
    taken = np.empty((0, 2))
    for split in sorted(splits, key=lambda split: ORDER.index(split) if split in ORDER else len(ORDER)):
        seen: dict[tuple[int, ...], str] = {}
        used = [taken]
        for name in splits[split]:
            scenes = tables[name]
            if scenes is None:
                continue
            number, drive = place[name], drives[name]
            step = windows.dt * drive.rate
            ids = np.argsort(drive.ids)
            row = ids[np.searchsorted(drive.ids, scenes.track, sorter=ids)]
            members = np.where(scenes.agents >= 0, shared.vehicle[number][row][scenes.agents], -1)
            time = (scenes.frame + shared.shift[number]) / step
            moment = np.floor(time / windows.every + 0.5).astype(int)
            there = _windows_overlap(members, time, taken, windows.history - 1 + windows.horizon)
            keep = ~there
            for scene in np.flatnonzero(keep).tolist():
                key = (int(moment[scene]), *sorted(members[scene].tolist()))
                keep[scene] = seen.setdefault(key, name) == name
            counts[name][ELSEWHERE] = int(there.sum())
            counts[name][AGAIN] = int((~keep & ~there).sum())
            kept[name] = keep
            present = (members >= 0) & keep[:, None]
            used.append(np.stack([members[present], np.broadcast_to(time[:, None], members.shape)[present]], 1))
        taken = np.concatenate(used)
    return kept, counts


@dataclass(frozen=True)
class _InOrder(Sequence[Drives]):
    """Recordings in the order of their names, each of them read when it is asked for."""

    names: Sequence[str]
    drives: Mapping[str, Drives]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, number: Any) -> Any:
        return self.drives[self.names[number]]


def _windows_overlap(
    members: Int[np.ndarray, "scenes N"],
    time: Float[np.ndarray, " scenes"],
    taken: Float[np.ndarray, "n 2"],
    steps: int,
) -> Bool[np.ndarray, " scenes"]:
    """Mask of the scenes with a vehicle in ``taken`` (vehicle, t0 in steps) at most ``steps`` before or after their t0."""
    if not len(taken):
        return np.zeros(len(members), dtype=bool)
    apart = 4.0 * (np.abs(taken[:, 1]).max() + np.abs(time).max(initial=0.0) + steps + 1)
    key = np.sort(taken[:, 0] * apart + taken[:, 1])
    asked = members * apart + time[:, None]
    first = np.searchsorted(key, asked - steps - 1e-6, side="left")
    last = np.searchsorted(key, asked + steps + 1e-6, side="right")
    return ((last > first) & (members >= 0)).any(1)


def _overlaps(recordings: Sequence[Drives]) -> list[tuple[int, int, int]]:
    """Pairs of recordings with equal runs of speeds, and the difference of their frames at which most runs are equal."""
    repeated = _in_several(recordings)
    rates, owners, frames, keys = [], [], [], []
    for number, drives in enumerate(recordings):
        first, of_runs = runs(drives)
        kept = repeated[of_runs % SLOTS]
        rates.append(drives.rate)
        owners.append(np.full(kept.sum(), number))
        frames.append(drives.frame[first[kept]])
        keys.append(of_runs[kept])
    owner, frame, key = np.concatenate(owners), np.concatenate(frames), np.concatenate(keys)
    order = np.lexsort((owner, key))
    owner, frame, key = owner[order], frame[order], key[order]
    votes: Counter[tuple[int, int, int]] = Counter()
    apart = 1
    while True:
        # Rows with equal keys follow each other; compare each with the one that is `apart` rows later.
        (at,) = np.nonzero(key[apart:] == key[:-apart]) if apart < len(key) else (np.empty(0, dtype=int),)
        if not len(at):
            break
        pairs = np.stack([owner[at], owner[at + apart], frame[at + apart] - frame[at]], 1)
        pairs, count = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0, return_counts=True)
        for (one, other, difference), number in zip(pairs.tolist(), count.tolist(), strict=True):
            votes[one, other, difference] += number
        apart += 1
    best: dict[tuple[int, int], tuple[int, int]] = {}
    for (one, other, difference), number in sorted(votes.items()):
        if number >= ENOUGH and number > best.get((one, other), (0, 0))[0]:
            best[one, other] = number, difference
    return [
        (one, other, difference)
        for (one, other), (_, difference) in sorted(best.items())
        if abs(rates[one] - rates[other]) < 1e-6
    ]


def _in_several(recordings: Sequence[Drives]) -> Bool[np.ndarray, " n"]:
    """Mask [SLOTS] of the remainders of hashes that occur in two or more recordings: others cannot show an overlap."""
    seen, again = np.zeros(SLOTS, dtype=bool), np.zeros(SLOTS, dtype=bool)
    for drives in recordings:
        slot = np.unique(runs(drives)[1] % SLOTS)
        again[slot] |= seen[slot]
        seen[slot] = True
    return again


def _same_vehicles(one: Drives, other: Drives, difference: int) -> Int[np.ndarray, "n 2"]:
    """Agents of two recordings that are the same vehicles, if frame f of one is frame f + ``difference`` of the other."""
    rows, its_rows = _equal_runs(one, other, difference)
    motion = _rigid(one.position[rows], other.position[its_rows])
    moved = motion(one.position)
    if len(rows) < ENOUGH or np.linalg.norm(moved[rows] - other.position[its_rows], axis=1).mean() > NEAR:
        return np.empty((0, 2), dtype=int)
    sums: dict[tuple[int, int], list[float]] = {}
    begin = {frame: np.flatnonzero(other.frame == frame) for frame in np.unique(other.frame)}
    for frame in np.unique(one.frame):
        there = begin.get(frame + difference)
        if there is None:
            continue
        here = np.flatnonzero(one.frame == frame)
        distance = np.linalg.norm(moved[here, None] - other.position[there], axis=-1)
        for row, column in np.argwhere(distance <= 10 * NEAR).tolist():
            pair = int(one.agent[here[row]]), int(other.agent[there[column]])
            total = sums.setdefault(pair, [0.0, 0.0])
            total[0] += distance[row, column]
            total[1] += 1
    return np.array([pair for pair, (total, count) in sums.items() if total <= NEAR * count], dtype=int).reshape(-1, 2)


def _equal_runs(one: Drives, other: Drives, difference: int) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Rows of both recordings at which equal runs of speeds begin, at the given difference of frames."""
    (first, key), (its_first, its_key) = runs(one), runs(other)
    mine = np.stack([key, (one.frame[first] + difference).astype(np.uint64)], 1)
    its = np.stack([its_key, other.frame[its_first].astype(np.uint64)], 1)
    mine, here = np.unique(mine, axis=0, return_index=True)
    its, there = np.unique(its, axis=0, return_index=True)
    both = {tuple(row): index for row, index in zip(its.tolist(), there.tolist(), strict=True)}
    known = zip(mine.tolist(), here.tolist(), strict=True)
    pairs = [(index, both[tuple(row)]) for row, index in known if tuple(row) in both]
    rows = np.array(pairs, dtype=int).reshape(-1, 2)
    return first[rows[:, 0]], its_first[rows[:, 1]]


def _rigid(
    points: Float[np.ndarray, "n 2"], images: Float[np.ndarray, "n 2"]
) -> Callable[[Float[np.ndarray, "m 2"]], Float[np.ndarray, "m 2"]]:
    """The rotation and translation that maps points best onto their images, as a function."""
    if not len(points):
        return lambda values: values
    centre, target = points.mean(0), images.mean(0)
    way, image = points - centre, images - target
    angle = np.arctan2((way[:, 0] * image[:, 1] - way[:, 1] * image[:, 0]).sum(), (way * image).sum())
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    return lambda values: (values - centre) @ rotation.T + target
