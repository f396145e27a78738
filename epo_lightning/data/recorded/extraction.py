"""Extraction of recordings into a file, the task of a worker process, which starts faster without importing Lightning.

The file of one or more recordings is a part of a data set (:mod:`~epo_lightning.data.recorded.parts`). It is complete or
absent, and its bytes do not depend on the process that writes it, except for the seconds that the work took.
"""

from __future__ import annotations

import dataclasses
import json
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from epo_lightning.data import cache
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.plausibility import doubts, doubts_of_lanes
from epo_lightning.data.recorded.surroundings import far_from_lanes
from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import ConfigError, failing_place, kind_and_message

OUTCOMES = "recordings"
"""Key of the outcomes in the metadata of a file."""
RAW = "raw"
"""First word of the names of columns of the recorded tracks."""


@dataclass(frozen=True)
class Extracted:
    """Outcome of the extraction of one recording, without its scenes.

    Attributes:
        counts: windows, windows that were left out by reason, scenes, and items that were left out before.
        about: number of agents, seconds of recording and of work, warnings, and agents that end far from all given lanes.
        problem: why the recording could not be read; None if it was read.
    """

    counts: Mapping[str, int]
    about: Mapping[str, Any]
    problem: str | None = None


def extract_to_file(
    sources: Sequence[RecordingSource],
    windows: WindowConfig,
    has_map: bool,
    file: Path,
    strict: bool = True,
    keep: bool = False,
) -> None:
    """Extract the scenes of some recordings into a file.

    Args:
        sources: the recordings.
        windows: selection of the windows that become scenes.
        has_map: whether to use the recordings' lanes.
        file: file to write.
        strict: whether a recording that cannot be read is an error; otherwise the file says why it cannot be read.
        keep: whether to keep the recorded tracks as well, to find the same vehicles in other recordings.

    Raises:
        RecordingError: a recording that cannot be read, if ``strict``.
        ConfigError: settings that do not fit a recording.
    """
    columns: dict[str, np.ndarray] = {}
    outcomes = []
    for number, source in enumerate(sources):
        of_one, outcome = _extract(source, windows, has_map, strict, keep)
        columns |= {f"{number} {name}": values for name, values in of_one.items()}
        outcomes.append(dataclasses.asdict(outcome))
    cache.write_file(file, save(columns, {OUTCOMES: json.dumps(outcomes)}))


def _extract(
    source: RecordingSource, windows: WindowConfig, has_map: bool, strict: bool, keep: bool
) -> tuple[dict[str, np.ndarray], Extracted]:
    """Columns of the scenes of one recording and, if they are kept, of its tracks; and the outcome."""
    begin = time.perf_counter()
    columns: dict[str, np.ndarray] = {}
    counts: dict[str, int] = {}
    about: dict[str, Any] = {}
    problem = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            recording = _read(source)
            for doubt in doubts(recording.tracks):
                warnings.warn(doubt, stacklevel=1)
            if has_map and recording.lanes is None:
                raise RecordingError(source.name, "the recording has no map: set data.map=false, or give it one")
            if not has_map:
                recording = dataclasses.replace(recording, lanes=None)
            for doubt in doubts_of_lanes(recording.lanes) if recording.lanes is not None else ():
                warnings.warn(doubt, stacklevel=1)
            found, counts = extract(recording, windows)
        except RecordingError as error:
            if strict or _may_be_readable(source, error):
                raise
            problem = str(error)
        else:
            if found is not None:
                # safetensors writes the memory as it is, whatever the strides.
                columns = {name: np.ascontiguousarray(values) for name, values in found.columns().items()}
                about["ends far from lanes"], about["moving agents"] = far_from_lanes(found)
            if keep:
                columns |= {f"{RAW} {name}": values for name, values in _raw(recording).items()}
            about["agents"] = len(recording.tracks.ids)
            about["recorded"] = _duration(recording)
    about["warnings"] = sorted({str(warning.message) for warning in caught})
    about["seconds"] = time.perf_counter() - begin
    return columns, Extracted(counts, about, problem)


def _read(source: RecordingSource) -> Recording:
    """The recording.

    Raises:
        RecordingError: as its reader raises it, or in the place of an exception in which the reader fails; or implausible
            tracks or lanes of a reader that did not check them.
    """
    place = source.files[0] if source.files else source.name
    try:
        found = source.read()
        if len(found.tracks):
            found.tracks.check(place)
        if found.lanes is not None:
            found.lanes.check(place)
        return found
    except (ConfigError, OSError, MemoryError):
        raise
    except Exception as error:
        what = kind_and_message(error, 400)
        raise RecordingError(place, f"its reader fails at {failing_place(error, source.read)}, {what}") from error


def _may_be_readable(source: RecordingSource, error: RecordingError) -> bool:
    """Whether the operating system could not read a file of a recording, for instance over a network, that lay there before.

    Such a file is not known to be broken, so a data set without its recording would be wrong.
    """
    cause = error.__cause__ or error.__context__
    return isinstance(cause, OSError) and any(str(cause.filename) == str(file) for file in source.files)


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
    }


def outcomes(file: Path) -> list[Extracted] | None:
    """Outcomes of the recordings in a file of :func:`extract_to_file`; None if the file is absent or is not readable.

    Only the header is read, because a file is renamed into place when it is complete.
    """
    try:
        with safe_open(file, framework="np") as content:
            return [Extracted(**outcome) for outcome in json.loads(content.metadata()[OUTCOMES])]
    except (SafetensorError, OSError, ValueError, KeyError, TypeError):
        return None
