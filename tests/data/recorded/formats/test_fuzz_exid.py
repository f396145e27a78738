"""Fuzzing of exiD files and Lanelet2 maps: each damaged file gives one sentence or a valid recording."""

from __future__ import annotations

import re
import time
from collections import Counter

import numpy as np
import polars as pl
import pytest

from data.recorded.formats.exid_files import ORIGIN, SETTING, drive, road, write
from data.recorded.formats.fuzz import CSV, HARMLESS, VALUES, flip, splice, truncate
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.exid_tables import USED
from epo_lightning.data.recorded.formats.lanelet2 import read_map
from epo_lightning.data.recorded.formats.levelx import exid

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error")]

TRIALS = 2500
PATIENCE = 5.0
"""Longest allowed time for a file [s]."""


@pytest.fixture(scope="module", autouse=True)
def warmed(tmp_path_factory):
    """Centrelines are compiled before anything is timed."""
    path = tmp_path_factory.mktemp("map") / "map.osm"
    path.write_text(str(road()))
    read_map(path, ORIGIN)


def attempt(read, folder, label):
    """The recording, or None with the message of the error."""
    started = time.perf_counter()
    try:
        found, problem = read(), ""
    except RecordingError as error:
        found, problem = None, str(error)
    except BaseException as error:
        raise AssertionError(label) from error
    assert time.perf_counter() - started < PATIENCE, label
    if found is None:
        assert re.fullmatch(rf"{re.escape(str(folder))}\S*(, row \d+)?: .{{10,}}", problem), f"{label}: {problem!r}"
    return found, problem


def test_damaged_tracks_and_metadata_give_only_recording_errors(tmp_path):
    random = np.random.default_rng(0)
    folder = write(tmp_path / "exid", drive(frames=8), setting=SETTING | {"duration": 1.0})
    (source,) = exid(folder)
    whole = source.read()
    files = [file for file in source.files if file.suffix == ".csv"]
    contents = {file: file.read_bytes() for file in files}
    outcomes: Counter[str] = Counter()
    for trial in range(TRIALS):
        file = files[random.choice(3, p=(0.6, 0.25, 0.15))]
        change = CSV[random.integers(len(CSV))]
        content = change(contents[file], random)
        file.write_bytes(content)
        label = f"trial {trial}: {change.__name__} of {file.name}"
        found, problem = attempt(lambda: exid(folder)[0].read(), folder, f"{label}: {content!r}")
        assert not (problem and change in HARMLESS), f"{label}: {problem}"
        outcome = "error" if found is None else check_recording(found, whole, folder, label)
        outcomes[f"{change.__name__}: {outcome}"] += 1
        file.write_bytes(contents[file])
    print(*sorted(outcomes.items()), sep="\n")
    errors = sum(count for name, count in outcomes.items() if name.endswith("error"))
    assert 0.3 < errors / TRIALS < 0.95, "both outcomes are well represented"


def check_recording(found, whole, folder, label):
    """A recording from broken files holds what these files say, row by row, and agrees with itself."""
    tracks = found.tracks.check("fuzz")
    assert found.lanes is not None
    assert len(found.lanes) == len(whole.lanes), label
    rows = pl.read_csv(folder / "data" / "07_tracks.csv", columns=list(USED), infer_schema=False, quote_char=None)
    assert len(rows) == len(tracks), f"{label}: rows were lost"
    rows = rows.select(pl.col("*").str.strip_chars(' "').cast(pl.Float64)).sort("trackId", maintain_order=True)
    np.testing.assert_array_equal(tracks.ids[tracks.agent], rows["trackId"], label)
    np.testing.assert_array_equal(tracks.frame, rows["frame"], label)
    np.testing.assert_array_equal(tracks.position, rows.select("xCenter", "yCenter"), label)
    np.testing.assert_array_equal(tracks.velocity, rows.select("xVelocity", "yVelocity"), label)
    turns = (tracks.heading - np.deg2rad(rows["heading"].to_numpy())) / (2 * np.pi)
    np.testing.assert_allclose(turns, turns.round(), atol=1e-9, err_msg=label)
    if len(tracks) != len(whole.tracks):
        assert found.dropped, f"{label}: there are {len(tracks)} rows instead of {len(whole.tracks)}, unsaid"
    names = ("rate", "agent", "frame", "position", "heading", "velocity", "ids", "size", "kind")
    same = all(np.array_equal(getattr(tracks, name), getattr(whole.tracks, name)) for name in names)
    return "the same" if same else "as the file says"


def attributes(text, random):
    """One value of one attribute."""
    places = list(re.finditer(r"='([^']*)'", text))
    place = places[random.integers(len(places))]
    value = random.choice([*VALUES, "2", "999", "way", "left", "walkway", "lanelet", "delete"])
    value = str(value).replace("\x00", "").replace("'", "")
    return text[: place.start(1)] + value + text[place.end(1) :]


def element(kind):
    """Elements of a kind removed, doubled, or exchanged."""

    def change(text, random):
        places = list(re.finditer(rf"<{kind} [^>]*/>|<{kind} .*?</{kind}>", text))
        a, b = (places[random.integers(len(places))] for _ in range(2))
        match random.integers(3):
            case 0:
                return text[: a.start()] + text[a.end() :]
            case 1:
                return text[: a.start()] + a[0] + text[a.start() :]
            case _:
                return text[: a.start()] + b[0] + text[a.end() :]

    change.__name__ = f"element_{kind}"
    return change


def one_node(text, random):
    """Ways of one node, which may be anyone's."""
    places = list(re.finditer(r"(<way [^>]*>)(?:<nd [^>]*/>)+", text))
    place = places[random.integers(len(places))]
    return (
        text[: place.start()]
        + place[1]
        + f"<nd ref='{random.integers(1, 40)}'/>" * random.integers(1, 3)
        + text[place.end() :]
    )


def tangle(text, random):
    """Nodes under other numbers: ways that cross, rings, lanes that lead into themselves and into one another."""
    for _ in range(random.integers(1, 12)):
        places = list(re.finditer(r"<nd ref='(\d+)'", text))
        place = places[random.integers(len(places))]
        text = text[: place.start(1)] + str(random.integers(1, 37)) + text[place.end(1) :]
    return text


def other_ways(text, random):
    """Lanelets between other ways."""
    return re.sub(r"(<member type='way' ref=)'\d+'", lambda m: f"{m[1]}'{random.integers(1, 10)}'", text)


def bomb(text, random):
    entities = '<!ENTITY e0 "lol">' + "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 10))
    doctype = random.choice(
        [f"<!DOCTYPE osm [{entities}]>", "<!DOCTYPE osm SYSTEM 'file:///etc/passwd'>", "<!DOCTYPE osm>"]
    )
    return text.replace("<osm", f"{doctype}<osm", 1).replace("highway", "&e9;", 1)


def encoding(text, random):
    return text.replace(
        "UTF-8", str(random.choice(["UTF-16", "klingon", "big5", "utf-7", "idna", "ascii", "hex", ""])), 1
    )


def nest(text, random):
    depth = 20_000
    return text.replace("<node", "<a>" * depth + "</a>" * depth + "<node", 1) if random.random() < 0.1 else text


def as_bytes(change):
    def changed(text, random):
        return change(text.encode(), random)

    changed.__name__ = change.__name__
    return changed


XML = [
    *(as_bytes(change) for change in (flip, truncate, splice)),
    *(element(kind) for kind in ("node", "way", "relation", "member", "nd", "tag")),
    *(attributes, attributes, one_node, tangle, tangle, other_ways, bomb, encoding, nest),
]


def test_damaged_maps_give_only_recording_errors(tmp_path):
    random = np.random.default_rng(1)
    text = str(road())
    path = tmp_path / "map.osm"
    path.write_text(text)
    whole = read_map(path, ORIGIN)
    outcomes: Counter[str] = Counter()
    for trial in range(TRIALS):
        change = XML[random.integers(len(XML))]
        changed = change(text, random)
        path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
        label = f"trial {trial}: {change.__name__}"
        dropped: Counter[str] = Counter()
        lanes, _ = attempt(lambda counts=dropped: read_map(path, ORIGIN, dropped=counts), path, f"{label}: {changed!r}")
        outcome = "error" if lanes is None else check_lanes(lanes, whole, dropped, path, label)
        assert change.__name__ != "bomb" or outcome == "error", label
        outcomes[f"{change.__name__}: {outcome}"] += 1
    print(*sorted(outcomes.items()), sep="\n")
    errors = sum(count for name, count in outcomes.items() if name.endswith("error"))
    assert 0.2 < errors / TRIALS < 0.9, "both outcomes are well represented"


def check_lanes(lanes, whole, dropped, path, label):
    """Lanes of a broken map agree with one another, and none went missing unsaid."""
    lanes.check("fuzz")
    declared = len(re.findall(rb"<tag k='type' v='lanelet'", path.read_bytes()))
    hidden = len(re.findall(rb"action='delete'", path.read_bytes()))
    assert len(lanes) + sum(dropped.values()) >= declared - hidden, f"{label}: lanes were lost"
    for lane, following in enumerate(lanes.successors):
        for successor in following:
            np.testing.assert_array_equal(lanes.left[lane][-1], lanes.left[successor][0], label)
            np.testing.assert_array_equal(lanes.right[lane][-1], lanes.right[successor][0], label)
    for lane, beside in enumerate(lanes.adjacent_left):
        if beside >= 0:
            np.testing.assert_array_equal(lanes.left[lane], lanes.right[beside], label)
    for changes, beside in ((lanes.left_of, lanes.adjacent_left), (lanes.right_of, lanes.adjacent_right)):
        assert ((changes == -1) | (changes == beside)).all(), label
    same = len(lanes) == len(whole) and np.array_equal(np.concatenate(lanes.centre), np.concatenate(whole.centre))
    return "dropped" if dropped else "the same" if same else "as the file says"
