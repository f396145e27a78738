"""Extraction of one recording into a file, the task of a worker process, which starts faster without importing Lightning."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from epo_lightning.data import cache
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.windows import SceneTables, WindowConfig, extract
from epo_lightning.registry import ConfigError


def extract_to_file(source: RecordingSource, windows: WindowConfig, has_map: bool, file: Path) -> None:
    """Extract the scenes of one recording into a file."""
    recording = source.read()
    if has_map and recording.lanes is None:
        raise ConfigError(f"the recording {source.name} has no map: set data.map=false, or give it one")
    if not has_map:
        recording = dataclasses.replace(recording, lanes=None)
    found, counts = extract(recording, windows)
    columns = {}
    if found is not None:
        # safetensors writes the memory as it is, whatever the strides.
        columns = {
            field.name: np.ascontiguousarray(getattr(found, field.name)) for field in dataclasses.fields(SceneTables)
        }
    cache.write_file(file, save(columns, {"counts": json.dumps(counts)}))


def read_tables(file: Path) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Columns and counts of one recording, as :func:`extract_to_file` wrote them."""
    with safe_open(file, framework="np") as content:
        counts = json.loads(content.metadata()["counts"])
        return {name: content.get_tensor(name) for name in content.keys()}, counts  # noqa: SIM118 - not a mapping


def is_complete(file: Path) -> bool:
    """Whether the file of a recording exists and can be read. It is renamed into place when it is complete."""
    try:
        return file.is_file() and bool(read_tables(file)[1])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError):
        return False
