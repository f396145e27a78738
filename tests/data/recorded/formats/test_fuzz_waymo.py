"""Fuzzing of Waymo shards: each damaged file gives one sentence or a valid recording."""

from __future__ import annotations

import struct
from collections import Counter

import numpy as np
import pytest

from data.recorded.formats.fuzz import attempt, flip, splice, truncate
from data.recorded.formats.waymo_files import framed, scenario, write
from epo_lightning.data.recorded.formats.waymo import waymo

pytestmark = pytest.mark.filterwarnings("error")

NESTED = {
    2: {3: {}},
    8: {3: {8: {}, 11: {6: {}}, 12: {6: {}}, 13: {}, 14: {}}, 4: {2: {}}, 5: {2: {}}},
}
"""Fields that hold messages, within a Scenario."""
NUMBERS = [0.0, -1.0, 1e300, -1e300, 1e20, 1e7, float("nan"), float("inf"), 1e-320, 3.0]


def varint(content, at):
    """Value and end of a variable-length number."""
    value = shift = 0
    while True:
        value |= (content[at] & 127) << shift
        shift, at = shift + 7, at + 1
        if content[at - 1] < 128:
            return value % 2**64, at
        if shift >= 70:
            raise ValueError("a number of more than ten bytes")


def fields(content, begin=0, end=None):
    """Number, wire type, and place of the value of every field of a message."""
    at, end = begin, len(content) if end is None else end
    while at < end:
        tag, at = varint(content, at)
        number, wire = tag >> 3, tag & 7
        if wire == 0:
            _, after = varint(content, at)
        elif wire in (1, 5):
            after = at + (8 if wire == 1 else 4)
        elif wire == 2:
            length, at = varint(content, at)
            after = at + length
        else:
            raise ValueError("a group")
        if after > end:
            raise ValueError("cut off")
        yield number, wire, at, after
        at = after


def leaves(content, begin=0, end=None, nested=NESTED):
    """Wire type and place of every number."""
    for number, wire, first, last in fields(content, begin, end):
        if number in nested and wire == 2:
            yield from leaves(content, first, last, nested[number])
        else:
            yield wire, first, last


def states(content):
    """Valid states by track and frame, decoded in the simplest way. For messages whose fields have their usual types."""
    found = {}
    for number, wire, first, last in fields(content):
        if number == 2 and wire == 2:
            id, track, frame = 0, {}, 0
            for inner, kind, begin, end in fields(content, first, last):
                if (inner, kind) == (1, 0):
                    id = int(np.int32(np.uint32(varint(content, begin)[0] % 2**32)))
                elif (inner, kind) == (3, 2):
                    values, valid = dict.fromkeys((2, 3, 8, 9, 10), 0.0), False
                    for which, form, a, b in fields(content, begin, end):
                        if which in (2, 3) and form == 1:
                            values[which] = struct.unpack("<d", content[a:b])[0]
                        elif which in (8, 9, 10) and form == 5:
                            values[which] = struct.unpack("<f", content[a:b])[0]
                        elif (which, form) == (11, 0):
                            valid = varint(content, a)[0] != 0
                    if valid:
                        track[frame] = list(values.values())
                    frame += 1
            if track:
                found[id] = track
    return found


def set_numbers(content, random):
    """Other values of some numbers, of the same lengths."""
    places = list(leaves(content))
    changed = bytearray(content)
    for _ in range(random.integers(1, 4)):
        wire, first, last = places[random.integers(len(places))]
        number = NUMBERS[random.integers(len(NUMBERS))]
        if wire == 1:
            changed[first:last] = struct.pack("<d", number)
        elif wire == 5:
            changed[first:last] = struct.pack("<f", np.clip(number, -3e38, 3e38) if number == number else number)
        elif wire == 0 and last == first + 1:
            changed[first] = random.integers(128)
    return bytes(changed)


def in_the_message(change):
    def changed(message, random):
        return framed(change(message, random))

    changed.__name__ = f"{change.__name__}_message"
    return changed


def in_the_file(change):
    def changed(message, random):
        return change(framed(message), random)

    changed.__name__ = f"{change.__name__}_file"
    return changed


CHANGES = [
    *(in_the_file(change) for change in (flip, truncate, splice)),
    *(in_the_message(change) for change in (flip, flip, truncate, splice, set_numbers, set_numbers, set_numbers)),
]


@pytest.mark.parametrize("trials", [80, pytest.param(2500, marks=pytest.mark.slow)])
def test_damaged_shards_give_only_recording_errors(tmp_path, trials):
    random = np.random.default_rng(trials)
    message = scenario(frames=12)
    path = write(tmp_path, [message])
    outcomes: Counter[str] = Counter()

    def read():
        first, *_ = waymo(tmp_path)
        return first.read()

    assert len(read().tracks) == sum(map(len, states(message).values()))
    for trial in range(trials):
        change = CHANGES[random.integers(len(CHANGES))]
        content = change(message, random)
        path.write_bytes(content)
        label = f"trial {trial}: {change.__name__}"
        found, _ = attempt(read, tmp_path, label) if content else (None, "")
        if found is not None:
            check_recording(found, content, label)
        outcomes[f"{change.__name__}: {'refused' if found is None else 'read'}"] += 1
    print(*sorted(outcomes.items()), sep="\n")
    refused = sum(count for name, count in outcomes.items() if name.endswith("refused"))
    assert 0.3 < refused / trials < 0.95, "both outcomes are well represented"


def check_recording(found, content, label):
    """A recording from a damaged shard holds what the shard says, and what is missing is counted."""
    if found.lanes is not None:
        found.lanes.check("fuzz")
    tracks = found.tracks
    if len(tracks):
        tracks.check("fuzz")
    length = struct.unpack("<Q", content[:8])[0]
    try:
        expected = states(content[12 : 12 + length])
    except (ValueError, IndexError):
        return  # a field of another type, which a plain decoder does not skip
    lost = sum(map(len, expected.values())) - len(tracks)
    assert lost == 0 or (lost > 0 and found.dropped), f"{label}: {lost} rows were lost"
    rows = np.column_stack([tracks.position, tracks.heading, tracks.velocity]).tolist()
    for id, frame, row in zip(tracks.ids[tracks.agent].tolist(), tracks.frame.tolist(), rows, strict=True):
        assert row == expected[id][frame], label
