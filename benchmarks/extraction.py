"""Speed of the road from recordings to batches: windows extracted and scenes loaded per second.

    python -m benchmarks.extraction cache/highway_sim-recordings-... --format exid --recordings 3

Times are CPU seconds of one core. Reading, extraction and loading are measured separately.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from benchmarks.command_line import parser_of
from benchmarks.measure import positive
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.tables import joined
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import ConfigError, lookup

Result = TypeVar("Result")


def timed(function: Callable[[], Result]) -> tuple[Result, float]:
    """Result of a function, and the CPU seconds that it took."""
    start = time.process_time()
    return function(), max(time.process_time() - start, 1e-9)


def measure(folder: Path, format_: str, recordings: int, batches: int) -> None:
    """Read, extract and load, and print the rates.

    Raises:
        ConfigError: an unknown format, or a folder without recordings of this format.
    """
    sources = lookup("format", format_)(folder)[:recordings]
    read, reading = timed(lambda: [source.read() for source in sources])
    rows = sum(len(recording.tracks) for recording in read)
    print(f"reading     {rows / reading:>12,.0f} rows/s      ({rows:,} rows)")
    # Without lanes there are no lane changes, so all windows count.
    config = WindowConfig(
        lane_change=WindowConfig.lane_change and all(recording.lanes is not None for recording in read)
    )
    found, extraction = timed(lambda: [extract(recording, config) for recording in read])
    windows = sum(counts["windows"] for _, counts in found)
    print(f"extraction  {windows / extraction:>12,.0f} windows/s   ({windows:,} windows)")
    extracted = [scenes for scenes, _ in found if scenes is not None]
    if not extracted:
        raise ConfigError(f"the first {len(read)} recordings in {folder} hold no scene: measure more with --recordings")
    scenes = joined(extracted)
    tables = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in scenes.columns().items()}
    for frame in ("fixed", "aligned"):
        data = RecordedScenes(tables, config.dt, frame, [recording.name for recording in read])
        order = torch.randint(0, len(data), (batches, 32))
        _, loading = timed(lambda data=data, order=order: [data[indices] for indices in order])  # type: ignore[misc]
        print(f"loading     {order.numel() / loading:>12,.0f} scenes/s    (batches of 32, {frame})")


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("extraction", __doc__)
    parser.add_argument("folder", type=Path, help="recordings, see docs/highway.md")
    parser.add_argument("--format", default="exid", help="a registered format, such as exid, commonroad or ucy")
    parser.add_argument("--recordings", type=positive, default=3, help="the number of recordings to read")
    parser.add_argument("--batches", type=positive, default=500, help="the number of batches to load")
    arguments = parser.parse_args(given)
    torch.set_num_threads(1)
    try:
        measure(arguments.folder, arguments.format, arguments.recordings, arguments.batches)
    except ConfigError as error:
        raise SystemExit(f"{error} (--format is {arguments.format})") from error


if __name__ == "__main__":
    main()
