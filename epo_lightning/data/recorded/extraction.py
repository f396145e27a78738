"""Extraction of one recording into a file, the task of a worker process, which starts faster without importing Lightning."""

from __future__ import annotations

import dataclasses
import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from epo_lightning.data import cache
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.surroundings import far_from_lanes
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import ConfigError


@dataclass(frozen=True)
class Extracted:
    """The file of one recording, as :func:`extract_to_file` wrote it.

    Attributes:
        tables: the scenes; None if there are none.
        counts: windows, windows that were left out by reason, scenes, and items that were left out before.
        about: number of agents, seconds of recording and of work, warnings, and agents that end far from all given lanes.
        problem: why the recording could not be read; None if it was read.
        raw: rows of the recording's tracks by name, if they were kept.
    """

    tables: SceneTables | None
    counts: Mapping[str, int]
    about: Mapping[str, Any]
    problem: str | None = None
    raw: Mapping[str, np.ndarray] = field(default_factory=dict)


def extract_to_file(
    source: RecordingSource, windows: WindowConfig, has_map: bool, file: Path, strict: bool = True, keep: bool = False
) -> None:
    """Extract the scenes of one recording into a file.

    Args:
        source: the recording.
        windows: selection of the windows that become scenes.
        has_map: whether to use the recording's lanes.
        file: file to write.
        strict: whether a recording that cannot be read is an error; otherwise the file says why it cannot be read.
        keep: whether to keep the recorded tracks as well, to find the same vehicles in other recordings.

    Raises:
        RecordingError: a recording that cannot be read, if ``strict``.
        ConfigError: settings that do not fit the recording.
    """
    begin = time.perf_counter()
    columns: dict[str, np.ndarray] = {}
    counts: dict[str, int] = {}
    about: dict[str, Any] = {}
    problem = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            recording = source.read()
            if has_map and recording.lanes is None:
                raise ConfigError(f"the recording {source.name} has no map: set data.map=false, or give it one")
            if not has_map:
                recording = dataclasses.replace(recording, lanes=None)
            found, counts = extract(recording, windows)
        except RecordingError as error:
            if strict:
                raise
            problem = str(error)
        else:
            if found is not None:
                # safetensors writes the memory as it is, whatever the strides.
                columns = {name: np.ascontiguousarray(values) for name, values in found.columns().items()}
                about["ends far from lanes"], about["moving agents"] = far_from_lanes(found)
            if keep:
                columns |= {f"raw {name}": values for name, values in _raw(recording).items()}
            about["agents"] = len(recording.tracks.ids)
            about["recorded"] = _duration(recording)
    about["warnings"] = sorted({str(warning.message) for warning in caught})
    about["seconds"] = time.perf_counter() - begin
    content = {"counts": counts, "about": about, "problem": problem}
    cache.write_file(file, save(columns, {name: json.dumps(value) for name, value in content.items()}))


def _duration(recording: Recording) -> float:
    """Seconds from the first frame of a recording to its last one."""
    frame = recording.tracks.frame
    return float(np.ptp(frame) / recording.tracks.rate) if len(frame) else 0.0


def _raw(recording: Recording) -> dict[str, np.ndarray]:
    """Rows of a recording's tracks, see :class:`~epo_lightning.data.recorded.duplicates.Drives`."""
    tracks = recording.tracks
    return {
        "rate": np.array([tracks.rate]),
        "agent": tracks.agent.astype(np.int64),
        "frame": tracks.frame.astype(np.int64),
        "position": np.ascontiguousarray(tracks.position, dtype=float),
        "speed": np.ascontiguousarray(tracks.speed, dtype=float),
        "ids": tracks.ids.astype(np.int64),
        "size": np.ascontiguousarray(tracks.size, dtype=float),
    }


def read_extracted(file: Path) -> Extracted:
    """The content of a recording's file, as :func:`extract_to_file` wrote it."""
    with safe_open(file, framework="np") as content:
        texts = content.metadata()
        columns = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 - not a mapping
    raw = {name.removeprefix("raw "): columns.pop(name) for name in list(columns) if name.startswith("raw ")}
    counts, about, problem = (json.loads(texts[name]) for name in ("counts", "about", "problem"))
    return Extracted(SceneTables(**columns) if columns else None, counts, about, problem, raw)


def is_complete(file: Path) -> bool:
    """Whether the file of a recording exists, can be read and holds a recording that could be read.

    It is renamed into place when it is complete.
    """
    try:
        return file.is_file() and read_extracted(file).problem is None
    except (SafetensorError, OSError, ValueError, KeyError, TypeError):
        return False
