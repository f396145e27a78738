"""Fuzzing of scenarios and tables: each damaged file is refused in one sentence, or read with its losses counted."""

from __future__ import annotations

import copy
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest

from data.recorded.formats.commonroad_files import ROAD, beside, drive, lanelet, scenario, speeds
from epo_lightning.data.recorded.formats.commonroad import commonroad
from epo_lightning.data.recorded.formats.ucy import ucy
from epo_lightning.data.recorded.tracks import Recording, RecordingError

pytestmark = pytest.mark.slow

COUNT = 4000
SECONDS = 5.0
VALUES = (
    "",
    " ",
    "nan",
    "-inf",
    "1e308",
    "-1e308",
    "1e-320",
    "0",
    "-1",
    "1_0",
    "0x10",
    "1,5",
    "vier",
    "9" * 400,
    "٣",
    "\u2028",
    "0.5",
)
BOMB = '<!DOCTYPE a [<!ENTITY e0 "ha">' + "".join(f'<!ENTITY e{i} "&e{i - 1};&e{i - 1};">' for i in range(1, 40)) + "]>"

ELEMENTS = (
    ROAD,
    lanelet(30, 8.0, rest='<successor ref="31"/><trafficSignRef ref="40"/><laneletType>shoulder</laneletType>'),
    lanelet(31, 8.0, start=100.0, rest='<predecessor ref="30"/><successor ref="30"/>' + beside("Left", 20, "opposite")),
    '<trafficSign id="40"><trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>30</additionalValue>'
    "</trafficSignElement></trafficSign>",
    '<staticObstacle id="50"/>',
    *(drive(60 + k, speeds(k, 6), 4.0 * k, version=version) for k, version in enumerate(("2020a", "2018b", "2020a"))),
)
SCENARIO = scenario(*ELEMENTS)


def outcome(read: Callable[[], Recording]) -> Recording | RecordingError:
    """Recording or refusal that a reader gives for a file; other results, errors and warnings fail the test."""
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            result: Recording | RecordingError = read()
    except RecordingError as error:
        result = error
    if isinstance(result, RecordingError):
        assert len(str(result)) < 1000
        assert "\n" not in str(result)
    else:
        if len(result.tracks):
            result.tracks.check("fuzz")
        else:
            assert result.dropped["recordings without traffic"] == 1
        if result.lanes is not None:
            result.lanes.check("fuzz")
    assert time.perf_counter() - begin < SECONDS
    return result


def break_text(draw: np.random.Generator, text: str) -> bytes:
    """Random damage to a file of any format: cut, flip, repeat, swap, insert or change a digit."""
    content = bytearray(text.encode())
    start, end = sorted(draw.integers(0, len(content), 2).tolist())
    digits = [at for at, byte in enumerate(content) if chr(byte).isdigit()]
    match draw.integers(7):
        case 0:
            del content[start:]
        case 1:
            del content[start : min(end, start + 50)]
        case 2:
            for at in draw.integers(0, len(content), draw.integers(1, 6)):
                content[at] ^= 1 << int(draw.integers(8))
        case 3:
            content[end:end] = content[start : start + 200]
        case 4:
            content[start : start + 1] = draw.bytes(int(draw.integers(1, 20)))
        case 5:
            content = content[end:] + content[:end]
        case 6:
            content[draw.choice(digits)] = ord(draw.choice(list("0123456789-.e")))
    return bytes(content)


def break_elements(draw: np.random.Generator, root: Element) -> None:
    """Delete, repeat, move, rename or rewrite one element anywhere below."""
    parents = [element for element in root.iter() if len(element)]
    parent = parents[draw.integers(len(parents))]
    at = int(draw.integers(len(parent)))
    child = parent[at]
    match draw.integers(7):
        case 0:
            parent.remove(child)
        case 1:
            parent.insert(int(draw.integers(len(parent))), copy.deepcopy(child))
        case 2:
            parent[:] = [parent[k] for k in draw.permutation(len(parent))]
        case 3:
            child.tag = str(draw.choice([element.tag for element in root.iter()]))
        case 4:
            others = [other for other in parents if other not in child.iter() and other is not parent]
            if others:
                parent.remove(child)
                others[draw.integers(len(others))].append(child)
        case _:
            leaves = [element for element in child.iter() if not len(element)]
            leaf = leaves[draw.integers(len(leaves))]
            if leaf.attrib:
                leaf.set(str(draw.choice(list(leaf.attrib))), str(draw.choice(VALUES)))
            else:
                leaf.text = str(draw.choice(VALUES))


def break_references(draw: np.random.Generator, root: Element) -> None:
    """Make lanes lead to or lie beside any lane, themselves or none."""
    ids = [element.get("id") for element in root.iter("lanelet")] + ["999", "-1"]
    for lane in root.findall("lanelet"):
        for tag in ("successor", "predecessor", "adjacentLeft", "adjacentRight", "trafficSignRef"):
            if draw.random() < 0.5:
                ElementTree.SubElement(lane, tag, ref=str(draw.choice(ids)), drivingDir="same")


def accounted(recording: Recording, root: Element) -> None:
    """Every agent of the file is in the recording or counted as left out."""
    dropped = Counter(recording.dropped)
    moving = len(root.findall("dynamicObstacle")) + sum(
        (each.findtext("role") or "").strip() == "dynamic" for each in root.findall("obstacle")
    )
    left_out = sum(number for reason, number in dropped.items() if reason.startswith("obstacles "))
    assert len(recording.tracks.ids) + left_out == moving
    lanes = 0 if recording.lanes is None else len(recording.lanes)
    assert lanes + dropped["lanes without length"] == len(root.findall("lanelet"))


def test_damaged_scenarios_give_only_recording_errors(tmp_path: Path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENARIO)
    original = commonroad(tmp_path)[0].read()
    assert original.tracks.ids.tolist() == [60, 61, 62]
    assert len(original.lanes) == 4
    rows = {each: original.tracks.agent == agent for agent, each in enumerate(original.tracks.ids.tolist())}
    draw = np.random.default_rng(0)
    results: Counter[str] = Counter()
    for trial in range(COUNT):
        root = ElementTree.fromstring(SCENARIO)
        touched: set[int] = set(rows)
        kind = ("text", "elements", "one obstacle", "references", "bomb")[trial % 20 % 4 if trial % 20 else 4]
        if kind == "text":
            content = break_text(draw, SCENARIO)
        elif kind == "bomb":
            content = SCENARIO.replace("?>", "?>" + BOMB).replace("5", "&e39;", 3).encode()
        else:
            if kind == "elements":
                for _ in range(draw.integers(1, 4)):
                    break_elements(draw, root)
            elif kind == "one obstacle":
                obstacles = [each for each in root if each.tag in ("obstacle", "dynamicObstacle")]
                chosen = obstacles[draw.integers(len(obstacles))]
                touched = {int(chosen.get("id", ""))}
                break_elements(draw, chosen)
            else:
                break_references(draw, root)
                touched = set()
            content = ElementTree.tostring(root)
        path.write_bytes(content)
        result = outcome(lambda: commonroad(tmp_path)[0].read())
        results[f"{kind}: {'refused' if isinstance(result, RecordingError) else 'read'}"] += 1
        if kind == "bomb":
            assert isinstance(result, RecordingError)
        if isinstance(result, RecordingError):
            continue
        if kind != "text":
            accounted(result, ElementTree.fromstring(content))
        # What is broken in one obstacle changes nothing about another.
        for identity in set(rows) - touched:
            (agent,) = np.flatnonzero(result.tracks.ids == identity)
            mine = result.tracks.agent == agent
            for name in ("frame", "position", "heading", "velocity"):
                ours, theirs = getattr(original.tracks, name), getattr(result.tracks, name)
                np.testing.assert_array_equal(theirs[mine], ours[rows[identity]])
    assert min(results[f"{kind}: refused"] for kind in ("text", "elements", "one obstacle", "references", "bomb")) > 50
    assert min(results[f"{kind}: read"] for kind in ("text", "elements", "one obstacle", "references")) > 50


def pedestrians() -> str:
    rows = [
        (10.0 * frame + 1, agent, frame * 0.5 - agent, 0.0, agent, 1.25, 0.0, 0.1 * agent)
        for agent in range(1, 6)
        for frame in range(agent, agent + 8)
    ]
    return "\n".join("   ".join(f"{value:e}" for value in row) for row in rows) + "\n"


def break_cells(draw: np.random.Generator, text: str) -> str:
    """Delete, repeat, move or rewrite rows, columns and cells."""
    rows = [line.split() for line in text.splitlines()]
    at, column = int(draw.integers(len(rows))), int(draw.integers(8))
    match draw.integers(7):
        case 0:
            del rows[at]
        case 1:
            rows.insert(int(draw.integers(len(rows))), rows[at])
        case 2:
            rows = [rows[k] for k in draw.permutation(len(rows))]
        case 3:
            order = draw.permutation(8)
            rows = [[row[k] for k in order] for row in rows]
        case 4:
            for row in rows:
                del row[column]
        case 5:
            rows[at] = rows[at][: int(draw.integers(8))] * int(draw.integers(1, 4))
        case _:
            rows[at][column] = str(draw.choice(VALUES))
    return "\n".join(" ".join(row) for row in rows)


def test_damaged_pedestrian_files_give_only_recording_errors(tmp_path: Path):
    (tmp_path / "square").mkdir()
    path = tmp_path / "square/obsmat.txt"
    text = pedestrians()
    draw = np.random.default_rng(1)
    results: Counter[str] = Counter()
    for trial in range(COUNT):
        content = break_text(draw, text) if trial % 2 else break_cells(draw, text).encode()
        path.write_bytes(content)
        result = outcome(lambda: ucy(tmp_path)[0].read())
        if isinstance(result, RecordingError):
            results["refused"] += 1
        else:
            results["read"] += 1
            # No row vanishes uncounted.
            rows = sum(bool(line.strip()) for line in content.decode().split("\n"))
            assert len(result.tracks) + result.dropped.get("rows between the annotated frames", 0) == rows
    assert min(results.values()) > COUNT // 20
