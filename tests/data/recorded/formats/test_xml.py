"""Broken or hostile XML gives one error sentence in a short time."""

from __future__ import annotations

import time

import pytest

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats import xml

BOMB = (
    '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY e0 "ha">'
    + "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 12))
    + "]><a>&e11;</a>"
)


def test_valid_files_are_parsed(tmp_path):
    (tmp_path / "a.xml").write_text('<a><b k="1.5"> 2 </b></a>')
    root = xml.parse(tmp_path / "a.xml")
    (element,) = root
    assert (root.tag, element.tag) == ("a", "b")
    assert xml.number(element.get("k"), "k of b", "a.xml") == 1.5
    assert xml.whole(element.text, "b", "a.xml") == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"a.xml: the file is not well-formed XML \(no element found"),
        (b"<a><b></a>", r"not well-formed XML \(mismatched tag: line 1"),
        (b"<a><b/>", "not well-formed XML .*: is it complete"),
        (bytes(range(256)), "not well-formed XML"),
        (BOMB.encode(), "declares a document type or entities.*: remove the declaration"),
        (b'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "declares a document type"),
        (b'<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>', "declares a document type"),
        (b"<a>&undeclared;</a>", "undefined entity"),
        (b'<?xml version="1.0" encoding="klingon"?><a/>', "encoding"),
        (b'<?xml version="1.0" encoding="utf-32"?><a/>', "encoding"),
        (b'<?xml version="1.0" encoding="big5"?><a/>', "encoding of the file is unknown .*save it as UTF-8"),
        ('<?xml version="1.0" encoding="utf-8"?><a>\xe4</a>'.encode("latin-1"), "not well-formed"),
    ],
)
def test_invalid_and_dangerous_files_are_refused(tmp_path, content, message):
    (tmp_path / "a.xml").write_bytes(content)
    started = time.perf_counter()
    with pytest.raises(RecordingError, match=message):
        xml.parse(tmp_path / "a.xml")
    assert time.perf_counter() - started < 1.0


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"b.xml: there is no such file$"):
        xml.parse(tmp_path / "b.xml")
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        xml.parse(tmp_path)


def test_deep_nesting_is_parsed(tmp_path):
    depth = 100_000
    (tmp_path / "a.xml").write_text("<a>" * depth + "</a>" * depth)
    assert sum(1 for _ in xml.parse(tmp_path / "a.xml").iter("a")) == depth


@pytest.mark.parametrize("text", [None, "", "x", "nan", "inf", "1e999", "1_0", "9" * 5000])
def test_text_that_is_no_number_is_refused(text):
    with pytest.raises(RecordingError, match=r"^a.xml: lat of node 3 is .*; a finite number was expected there$"):
        xml.number(text, "lat of node 3", "a.xml")
    with pytest.raises(RecordingError, match=r"^a.xml: lat of node 3 is .*; a whole number was expected there$"):
        xml.whole(text, "lat of node 3", "a.xml")


def test_whole_numbers_fit_into_eight_bytes():
    assert xml.whole(str(-(2**63)), "id", "a.xml") == -(2**63)
    for value in (2**63, -(2**63) - 1):
        with pytest.raises(RecordingError, match=rf"id is '{value}'; a whole number was expected"):
            xml.whole(str(value), "id", "a.xml")
