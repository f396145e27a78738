"""Records of a tfrecord file: an index of their places, and their contents after a check of their checksums.

A record is its length (8 bytes, little-endian), the masked CRC-32C of these bytes (4 bytes), the content, and the masked
CRC-32C of the content (4 bytes). TensorFlow documents the framing; it is not needed here.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, UInt8
from numba import njit

from epo_lightning.data.errors import RecordingError

HEADER, FOOTER = struct.Struct("<QI"), struct.Struct("<I")
POLYNOMIAL = 0x82F63B78
"""Polynomial of CRC-32C (Castagnoli), bits reversed."""
MASK = 0xA282EAD8
"""Number that is added to the rotated checksum."""


class Place(NamedTuple):
    """The place of a record's content in its file [bytes]."""

    offset: int
    length: int


def _tables() -> Int[np.ndarray, "8 256"]:
    """Entry [k, b] is the checksum state after the byte b and k zero bytes."""
    table = np.arange(256)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ POLYNOMIAL, table >> 1)
    tables = [table]
    for _ in range(7):
        tables.append(tables[-1] >> 8 ^ table[tables[-1] & 255])
    return np.stack(tables)


TABLES = _tables()


@njit(cache=True)
def _crc32c(content: np.ndarray, tables: np.ndarray) -> int:
    """CRC-32C of bytes, eight at a time."""
    crc = 0xFFFFFFFF
    whole = len(content) // 8 * 8
    for k in range(0, whole, 8):
        crc ^= content[k] | content[k + 1] << 8 | content[k + 2] << 16 | content[k + 3] << 24
        crc = (
            tables[7, crc & 255]
            ^ tables[6, crc >> 8 & 255]
            ^ tables[5, crc >> 16 & 255]
            ^ tables[4, crc >> 24]
            ^ tables[3, content[k + 4]]
            ^ tables[2, content[k + 5]]
            ^ tables[1, content[k + 6]]
            ^ tables[0, content[k + 7]]
        )
    for k in range(whole, len(content)):
        crc = crc >> 8 ^ tables[0, (crc ^ content[k]) & 255]
    return crc ^ 0xFFFFFFFF


def crc32c(content: bytes) -> int:
    """CRC-32C of bytes (RFC 3720, appendix B.4)."""
    values: UInt8[np.ndarray, " n"] = np.frombuffer(content, dtype=np.uint8)
    return int(_crc32c(values, TABLES))


def masked(content: bytes) -> int:
    """The checksum that tfrecord files store: CRC-32C, rotated right by 15 bits, plus ``MASK``."""
    crc = crc32c(content)
    return ((crc >> 15 | crc << 17) + MASK) & 0xFFFFFFFF


def places(path: Path) -> tuple[list[Place], RecordingError | None]:
    """The places of all records, from their headers alone, and the error at which the list ends; None for a whole file.

    Raises:
        RecordingError: the file cannot be opened.
    """
    found: list[Place] = []
    try:
        with path.open("rb", buffering=0) as file:
            size, at = path.stat().st_size, 0
            if not size:
                return found, RecordingError(path, "it is empty: fetch the file again")
            while at < size:
                file.seek(at)
                header = file.read(HEADER.size)
                where = f"record {len(found)} at byte {at}"
                if not at and header[:2] == b"\x1f\x8b":
                    return found, RecordingError(path, "it is compressed; unpack it with gunzip")
                if len(header) < HEADER.size:
                    return found, RecordingError(path, f"it ends within {where}: fetch the file again")
                length, checksum = HEADER.unpack(header)
                if masked(header[:8]) != checksum:
                    return found, RecordingError(
                        path,
                        f"the header of {where} has a wrong checksum: it is damaged, or no tfrecord; fetch it again",
                    )
                place = Place(at + HEADER.size, length)
                at = place.offset + length + FOOTER.size
                if at > size:
                    return found, RecordingError(
                        path, f"it ends within {where}, which has {length} bytes: fetch the file again"
                    )
                found.append(place)
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    return found, None


def content_of(path: Path, place: Place) -> bytes:
    """The content of a record. Nothing else is read of the file.

    Raises:
        RecordingError: the file cannot be read, or the checksum is wrong.
    """
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(place.offset)
            content = file.read(place.length + FOOTER.size)
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    if len(content) < place.length + FOOTER.size:
        raise RecordingError(path, f"it ends within the record at byte {place.offset}: fetch the file again")
    content, (checksum,) = content[: place.length], FOOTER.unpack(content[place.length :])
    if masked(content) != checksum:
        raise RecordingError(
            path, f"the record at byte {place.offset} has a wrong checksum: it is damaged; fetch the file again"
        )
    return content
