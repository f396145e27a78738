"""Framing of tfrecord files: checksums against a slow version and published values, and damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data.recorded.formats import waymo_files
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.tfrecord import Place, content_of, crc32c, masked, places


def test_checksums_are_those_of_the_standard():
    # RFC 3720, appendix B.4, and the check value of the Castagnoli polynomial.
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(b"\xff" * 32) == 0x62A8AB43
    assert crc32c(bytes(range(32))) == 0x46DD794E
    assert crc32c(bytes(range(31, -1, -1))) == 0x113FDB5C
    assert crc32c(b"") == 0
    # The header of every record of 24 bytes that TensorFlow writes.
    assert masked((24).to_bytes(8, "little")).to_bytes(4, "little") == bytes([0xA3, 0x7F, 0x4B, 0x22])


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=100))
def test_checksums_equal_the_bitwise_version(content):
    assert crc32c(content) == waymo_files.crc32c(content)
    assert masked(content).to_bytes(4, "little") == waymo_files.masked(content)


def test_records_are_found_without_reading_them(tmp_path):
    contents = [b"", b"a", bytes(1000), b"last"]
    path = waymo_files.write(tmp_path, contents)
    found, error = places(path)
    assert error is None
    assert [place.length for place in found] == [0, 1, 1000, 4]
    assert [content_of(path, place) for place in found] == contents
    # Contents have no part in the list.
    whole = bytearray(path.read_bytes())
    whole[found[2].offset + 500] ^= 1
    path.write_bytes(whole)
    assert places(path) == (found, None)
    with pytest.raises(RecordingError, match=r"the record at byte \d+ has a wrong checksum: it is damaged"):
        content_of(path, found[2])
    assert content_of(path, found[3]) == b"last"


def test_a_cut_file_is_listed_up_to_the_cut(tmp_path):
    contents = [bytes([k]) * 50 for k in range(4)]
    whole = waymo_files.write(tmp_path, contents).read_bytes()
    size = len(whole) // 4
    path = tmp_path / "cut"
    path.write_bytes(b"")
    found, error = places(path)
    assert (found, str(error)) == ([], f"{path}: it is empty: fetch the file again")
    for length in range(1, len(whole)):
        path.write_bytes(whole[:length])
        found, error = places(path)
        assert len(found) == length // size
        assert (error is None) == (length % size == 0)
        if error is not None:
            assert f"it ends within record {length // size} at byte {length // size * size}" in str(error)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "file"
    for content, message in (
        (b"\x1f\x8b" + bytes(30), "it is compressed; unpack it with gunzip"),
        (
            b"some,csv\n1,2\n3,4\n5,6\n",
            "the header of record 0 at byte 0 has a wrong checksum: it is damaged, or no tfrecord",
        ),
        (np.random.default_rng(0).bytes(1000), "wrong checksum"),
    ):
        path.write_bytes(content)
        found, error = places(path)
        assert not found
        assert message in str(error)
    with pytest.raises(RecordingError, match="the file cannot be read: No such file"):
        places(tmp_path / "none")
    with pytest.raises(RecordingError, match="the file cannot be read"):
        content_of(tmp_path / "none", Place(0, 1))
    path.write_bytes(b"1234")
    with pytest.raises(RecordingError, match="it ends within the record at byte 2"):
        content_of(path, Place(2, 10))
