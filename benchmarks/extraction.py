"""How fast recordings become scenes, and scenes batches: windows per second of extraction, scenes per second of loading.

    python -m benchmarks.extraction cache/highway_sim-recordings-... --format exid --recordings 3

Times are processor seconds of one core. Reading, extraction and loading are measured apart.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.windows import SceneTables, WindowConfig, extract, joined
from epo_lightning.registry import lookup

Result = TypeVar("Result")


def timed(function: Callable[[], Result]) -> tuple[Result, float]:
    """A result, and the processor seconds that it took."""
    start = time.process_time()
    return function(), time.process_time() - start


def main() -> None:
    """Read, extract and load, and print the rates."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--format", default="exid")
    arguments.add_argument("--recordings", type=int, default=3)
    arguments.add_argument("--batches", type=int, default=500)
    chosen = arguments.parse_args()
    torch.set_num_threads(1)
    sources = lookup("format", chosen.format)(chosen.folder)[: chosen.recordings]
    recordings, reading = timed(lambda: [source.read() for source in sources])
    rows = sum(len(recording.tracks) for recording in recordings)
    print(f"reading     {rows / reading:>12,.0f} rows/s      ({rows:,} rows)")
    found, extraction = timed(lambda: [extract(recording, WindowConfig()) for recording in recordings])
    windows = sum(counts["windows"] for _, counts in found)
    print(f"extraction  {windows / extraction:>12,.0f} windows/s   ({windows:,} windows)")
    scenes = joined([scenes for scenes, _ in found if scenes is not None])
    tables = {
        field.name: torch.from_numpy(np.ascontiguousarray(getattr(scenes, field.name)))
        for field in dataclasses.fields(SceneTables)
    }
    for frame in ("fixed", "aligned"):
        data = RecordedScenes(tables, WindowConfig.dt, frame, [recording.name for recording in recordings])
        order = torch.randint(0, len(data), (chosen.batches, 32))
        _, loading = timed(lambda data=data, order=order: [data[indices] for indices in order])  # type: ignore[misc]
        print(f"loading     {order.numel() / loading:>12,.0f} scenes/s    (batches of 32, {frame})")


if __name__ == "__main__":
    main()
