"""Fuzzing of Argoverse 2 scenarios: each damaged file gives one sentence or a valid recording."""

from __future__ import annotations

import copy
import io
import json
from collections import Counter

import numpy as np
import polars as pl
import pytest

from data.recorded.formats.argoverse2_files import city, drive, write
from data.recorded.formats.fuzz import attempt, flip, splice, truncate
from data.recorded.formats.test_argoverse2 import found_states, plain
from epo_lightning.data.recorded.formats.argoverse2 import NUMBERS, argoverse2

pytestmark = pytest.mark.filterwarnings("error")

NUMBER = [0.0, -1.0, 1e300, -1e300, 1e20, 1e7, float("nan"), float("inf"), None, 1e-320]
TEXT = ["", "AV", "-1", "7", "1e5", "9" * 30, "seven", "static", "bus", "\x00", None]
WHOLE = [-1, 0, 1, 109, 110, 10**6, 2**62, None]
JSON = [None, True, -1, 0, 10, 11, 2**70, 1e308, float("nan"), float("inf"), "x", "BIKE", [], {}, [1], {"x": 1.0}]


def set_cells(rows, random):
    name = str(random.choice(["track_id", "object_type", "timestep", *NUMBERS]))
    values = TEXT if rows.schema[name] == pl.String else WHOLE if name == "timestep" else NUMBER
    cells = rows[name].to_list()
    value = values[random.integers(len(values))]
    for _ in range(random.integers(1, 4)):
        cells[random.integers(len(cells))] = value
    if random.random() < 0.1:
        cells = [value] * len(cells)
    return rows.with_columns(pl.Series(name, cells, rows.schema[name]))


def change_columns(rows, random):
    name = str(random.choice(rows.columns))
    other = str(random.choice(rows.columns))
    match random.integers(4):
        case 0:
            return rows.drop(name)
        case 1:
            return rows.with_columns(pl.col(other).alias(name))
        case 2:
            return rows.select(random.permutation(rows.columns).tolist())
        case _:
            return rows.with_columns(pl.col(name).cast(pl.String))


def change_rows(rows, random):
    match random.integers(4):
        case 0:
            return rows.head(random.integers(len(rows)))
        case 1:
            return pl.concat([rows, rows.slice(random.integers(len(rows)), 3)])
        case 2:
            return rows.sample(len(rows) // 2, seed=int(random.integers(1000)))
        case _:
            return rows.with_columns(
                pl.col(str(random.choice(NUMBERS))) * random.choice([0.001, 0.3048, 3.6, -1, 57.3])
            )


def set_values(roads, random):
    """Values at random places of a map, of any type."""
    for _ in range(random.integers(1, 4)):
        place = roads
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = keys[random.integers(len(keys))]
            deeper = isinstance(place[key], dict | list) and len(place[key])
            if deeper and random.random() < 0.9:
                place = place[key]
                continue
            if isinstance(place, dict) and random.random() < 0.2:
                del place[key]
            else:
                place[key] = copy.deepcopy(JSON[random.integers(len(JSON))])
            break
    return roads


def of_rows(change):
    def changed(content, random):
        rows = change(pl.read_parquet(io.BytesIO(content)), random)
        buffer = io.BytesIO()
        rows.write_parquet(buffer)
        return buffer.getvalue()

    changed.__name__ = change.__name__
    return changed


def of_map(content, random):
    return json.dumps(set_values(json.loads(content), random)).encode()


TRACKS = [
    flip,
    flip,
    truncate,
    splice,
    *(of_rows(change) for change in (set_cells, set_cells, change_columns, change_rows)),
]
MAPS = [flip, truncate, splice, of_map, of_map, of_map]


@pytest.mark.parametrize("trials", [60, pytest.param(2500, marks=pytest.mark.slow)])
def test_damaged_scenarios_give_only_recording_errors(tmp_path, trials):
    random = np.random.default_rng(trials)
    folder = write(tmp_path, tracks=drive(frames=12), roads=city())
    (source,) = argoverse2(tmp_path)
    whole = source.read()
    contents = {file: file.read_bytes() for file in source.files}
    outcomes: Counter[str] = Counter()
    for trial in range(trials):
        tracks = bool(random.random() < 0.6)
        file, changes = (source.files[0], TRACKS) if tracks else (source.files[1], MAPS)
        change = changes[random.integers(len(changes))]
        content = change(contents[file], random)
        file.write_bytes(content)
        label = f"trial {trial}: {change.__name__} of {file.name}"
        found, _ = attempt(source.read, tmp_path, label)
        if found is not None:
            check_recording(found, whole, folder, label)
        outcomes[f"{change.__name__}: {'refused' if found is None else 'read'}"] += 1
        file.write_bytes(contents[file])
    print(*sorted(outcomes.items()), sep="\n")
    refused = sum(count for name, count in outcomes.items() if name.endswith("refused"))
    assert 0.3 < refused / trials < 0.95, "both outcomes are well represented"


def check_recording(found, whole, folder, label):
    """A recording from damaged files holds what these files say, and what is missing is counted."""
    if len(found.tracks):
        found.tracks.check("fuzz")
    if found.lanes is not None:
        found.lanes.check("fuzz")
    states, _, segments = plain(folder)
    lost = sum(map(len, states.values())) - len(found.tracks)
    assert lost >= 0, label
    assert not lost or found.dropped, f"{label}: rows were lost"
    for id, track in found_states(found.tracks).items():
        assert track == states[id], label
    lanes = 0 if found.lanes is None else len(found.lanes)
    assert len(segments) - lanes == found.dropped.get("lanes without length", 0), f"{label}: lanes were lost"
