"""Versions of the extraction, and the settings that identify a data set together with its version and its recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from epo_lightning.data.recorded.windows import WindowConfig, identifying

VERSION = 2
"""Version of the extraction: raised whenever the same recordings would give other scenes.

Version 2 has one exception: its reference lines were mended where an agent is beside the end of a lane. On simulated
highways nine of 554,676 agents have lines that are moved, by at most 7 mm, on US-101 none; on Lankershim Boulevard, with
three lines per agent, six of 8,407, by up to 27 cm.
"""
VERSION_OF_JUNCTIONS = 4
"""The same for scenes with reference lines through junctions (``windows.lines``).

The lines of version 2 were wrong beside the end of a lane; those of version 3 might begin far from the agent.
"""
DUPLICATES = ("keep", "once")
"""Settings of vehicles that several recordings show at the same moments; the first one is the default."""


def identifying_settings(
    dataset: str,
    format: str,
    windows: WindowConfig,
    has_map: bool,
    options: Mapping[str, Any],
    reader: str,
    duplicates: str,
) -> dict[str, Any]:
    """The part of a data set's configuration that does not depend on the recordings.

    Args:
        dataset, format, windows, options, duplicates: settings of
            :class:`~epo_lightning.data.recorded.recordings.RecordedData`.
        has_map: whether lanes are used.
        reader: hash of the file that defines the format, see :func:`~epo_lightning.data.recorded.sources.code_of`.
    """
    return {
        "version": VERSION_OF_JUNCTIONS if has_map and windows.lines is not None else VERSION,
        "dataset": dataset,
        "format": format,
        "windows": identifying(windows),
        "map": has_map,
        # Data sets without options keep the names that they had before formats had any.
        **({"options": dict(options)} if options else {}),
        **({"reader": reader} if reader else {}),
        # A default is no part of the configuration, so that data sets of older versions keep theirs.
        **({} if duplicates == "keep" else {"duplicates": duplicates}),
    }


def of_older_versions(config: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The configurations that older versions gave to a data set of the same recordings, splits and settings."""
    now = config["version"]
    older = [{**config, "version": version} for version in range(1, now)]
    if "reader" in config:  # older versions did not know the readers of own formats
        without = {key: value for key, value in config.items() if key != "reader"}
        older += [{**without, "version": version} for version in range(1, now + 1)]
    return older
