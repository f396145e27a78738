"""Small shards of Waymo Open Motion, written byte by byte: an encoder of the wire format and of the tfrecord framing that
shares nothing with the reader. Field numbers are those of the publisher's scenario.proto and map.proto."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np


def crc32c(content: bytes) -> int:
    """CRC-32C, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in content:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


_OF_BYTE = [crc32c(bytes([byte])) ^ crc32c(b"\0") for byte in range(256)]
"""Contribution of a byte to the checksum, from the definition."""
_BEGIN = crc32c(b"") ^ 0xFFFFFFFF


def masked(content: bytes) -> bytes:
    """The checksum of tfrecord files, as four bytes."""
    crc = _BEGIN
    for byte in content:
        crc = crc >> 8 ^ _OF_BYTE[crc & 255 ^ byte]
    crc ^= 0xFFFFFFFF
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) % 2**32)


def framed(content: bytes) -> bytes:
    """One record of a tfrecord file."""
    length = struct.pack("<Q", len(content))
    return length + masked(length) + content + masked(content)


def varint(value: int) -> bytes:
    value %= 2**64
    found = bytearray()
    while value >= 128:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def whole(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)


def double(number: int, value: float) -> bytes:
    return varint(number << 3 | 1) + struct.pack("<d", value)


def single(number: int, value: float) -> bytes:
    return varint(number << 3 | 5) + struct.pack("<f", value)


def inside(number: int, content: bytes) -> bytes:
    """A message, a text or packed numbers within a message."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def packed(number: int, values: Iterable[int]) -> bytes:
    return inside(number, b"".join(varint(value) for value in values))


def state(x: float, y: float, heading: float, speed: float, size=(4.5, 1.9), valid: bool = True) -> bytes:
    """ObjectState."""
    return (
        double(2, x)
        + double(3, y)
        + double(4, 1.0)
        + single(5, size[0])
        + single(6, size[1])
        + single(7, 1.6)
        + single(8, heading)
        + single(9, speed * np.cos(heading))
        + single(10, speed * np.sin(heading))
        + whole(11, valid)
    )


def track(id: int, kind: int, states: Iterable[bytes]) -> bytes:
    """Track."""
    return whole(1, id) + whole(2, kind) + b"".join(inside(3, each) for each in states)


def polyline(number: int, points: Iterable[tuple[float, float]]) -> bytes:
    return b"".join(inside(number, double(1, x) + double(2, y) + double(3, 0.0)) for x, y in points)


def boundary(first: int, last: int, feature: int, kind: int) -> bytes:
    """BoundarySegment."""
    return whole(1, first) + whole(2, last) + whole(3, feature) + whole(4, kind)


def neighbour(feature: int, first: int, last: int, kinds: Iterable[int] = ()) -> bytes:
    """LaneNeighbor."""
    return (
        whole(1, feature)
        + whole(2, first)
        + whole(3, last)
        + whole(4, first)
        + whole(5, last)
        + b"".join(inside(6, boundary(first, last, 0, kind)) for kind in kinds)
    )


def lane(
    points: Iterable[tuple[float, float]],
    kind: int = 2,
    mph: float = 25.0,
    entries=(),
    exits=(),
    left=(),
    right=(),
    left_lines=(),
    right_lines=(),
    pack: bool = True,
) -> bytes:
    """LaneCenter."""
    lists = (
        [packed(9, entries), packed(10, exits)]
        if pack
        else [whole(9, each) for each in entries] + [whole(10, each) for each in exits]
    )
    return (
        double(1, mph)
        + whole(2, kind)
        + whole(3, 0)
        + polyline(8, points)
        + b"".join(lists)
        + b"".join(inside(11, each) for each in left)
        + b"".join(inside(12, each) for each in right)
        + b"".join(inside(13, each) for each in left_lines)
        + b"".join(inside(14, each) for each in right_lines)
    )


def feature(id: int, number: int, content: bytes) -> bytes:
    """MapFeature: number 3 is a lane, 4 a road line, 5 a road edge, 7 a stop sign, 8 a crosswalk."""
    return whole(1, id) + inside(number, content)


def line(y: float, begin: float, end: float, step: float = 5.0) -> list[tuple[float, float]]:
    return [(float(x), y) for x in np.arange(begin, end + step / 2, step)]


def roads() -> list[bytes]:
    """Two pieces of a road along x with a right lane (10, 12) and a left lane (11, 13), 3.5 m wide, a broken line (50)
    between them, an edge (51) on the right and a yellow double line (52) on the left; a bicycle lane (30) on the right;
    and a turn to the left (14) out of lane 11."""
    after = [12], [13, 14]
    lanes = [
        feature(
            10,
            3,
            lane(
                line(1.75, 0, 100),
                exits=after[0],
                entries=[999],
                left=[neighbour(11, 0, 20, [1])],
                right=[neighbour(30, 0, 20, [2])],
                left_lines=[boundary(0, 20, 50, 1)],
                right_lines=[boundary(0, 20, 51, 0)],
            ),
        ),
        feature(
            11,
            3,
            lane(
                line(5.25, 0, 100),
                exits=after[1],
                right=[neighbour(10, 0, 4, [2]), neighbour(10, 5, 20, [1, 2])],
                left_lines=[boundary(0, 20, 52, 7)],
                right_lines=[boundary(0, 9, 50, 1)],
                pack=False,
            ),
        ),
        feature(12, 3, lane(line(1.75, 100, 250), entries=[10], left=[neighbour(13, 0, 30)], mph=0.0)),
        feature(13, 3, lane(line(5.25, 100, 250), entries=[11], right=[neighbour(12, 0, 30, [2])])),
        feature(14, 3, lane([(100.0, 5.25), (110.0, 7.0), (115.0, 12.0), (117.0, 30.0)], entries=[11])),
        feature(30, 3, lane(line(-0.8, 0, 100), kind=3, left=[neighbour(10, 0, 20, [2])])),
        feature(31, 3, lane([(1.0, 1.0)])),
    ]
    marks = [
        feature(50, 4, whole(1, 1) + polyline(2, [(0.0, 3.5), (250.0, 3.5)])),
        feature(51, 5, whole(1, 1) + polyline(2, [(0.0, 0.0), (250.0, 0.0)])),
        feature(52, 4, whole(1, 7) + polyline(2, [(0.0, 7.2), (250.0, 7.2)])),
        feature(60, 7, whole(1, 10) + inside(2, double(1, 99.0) + double(2, 1.0))),
        feature(61, 8, polyline(1, [(99.0, 0.0), (102.0, 0.0), (102.0, 7.0)])),
    ]
    return lanes + marks


AGENTS = (
    (7, 1, 5.0, 1.9, 0.0, 12.0, (4.5, 1.9)),
    (8, 1, 20.0, 5.2, 0.0, 10.0, (12.0, 2.6)),
    (9, 2, 30.0, -4.0, 0.0, 1.2, (0.6, 0.7)),
    (12, 3, 35.0, -0.7, 0.0, 5.0, (1.8, 0.8)),
    (13, 1, 40.0, 1.6, 0.0, 9.0, (4.8, 2.0)),
)
"""Identifier, type, x, y, heading, speed and size of each agent at the beginning."""


def moving(x, y, heading, speed, size, frames: int = 91, unseen: Iterable[int] = ()) -> list[bytes]:
    """States at constant velocity; invalid ones are at -1, -1."""
    unseen = set(unseen)
    return [
        state(-1.0, -1.0, 0.0, 0.0, (-1.0, -1.0), valid=False)
        if k in unseen
        else state(x + 0.1 * k * speed * np.cos(heading), y + 0.1 * k * speed * np.sin(heading), heading, speed, size)
        for k in range(frames)
    ]


def scenario(
    frames: int = 91,
    tracks: Iterable[bytes] | None = None,
    features: Iterable[bytes] | None = None,
    name: str = "abc",
    times: Iterable[float] | None = None,
) -> bytes:
    """Scenario."""
    if tracks is None:
        tracks = [track(id, kind, moving(*about, frames=frames)) for id, kind, *about in AGENTS]
    times = [0.1 * k for k in range(frames)] if times is None else times
    return (
        b"".join(double(1, time) for time in times)
        + b"".join(inside(2, each) for each in tracks)
        + whole(4, 7)
        + inside(5, name.encode())
        + whole(6, 1)
        + b"".join(inside(7, inside(1, whole(1, 10) + whole(2, 6))) for _ in times)
        + b"".join(inside(8, each) for each in (roads() if features is None else features))
        + whole(10, 10)
        + inside(11, whole(1, 0) + whole(2, 1))
    )


def write(home: Path, scenarios: Iterable[bytes], name: str = "training.tfrecord-00000-of-00001") -> Path:
    """A shard."""
    home.mkdir(parents=True, exist_ok=True)
    (home / name).write_bytes(b"".join(framed(each) for each in scenarios))
    return home / name
