"""Cost of extracting many recordings: time, memory and files, and what a million recordings would take.

    python -m benchmarks.generation --recordings 5000 --workers 2

Scenarios in the format of Argoverse 2 are made first: 11 s of traffic at 10 Hz on a road of 16 lane segments. A fifth of
them, and then all of them, are extracted as `epo generate data=argoverse2` does, each time in a new process. The memory is
that of the process that gathers the scenes, without pages of mapped files, which the system can drop at any time.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.command_line import parser_of
from benchmarks.measure import positive

FRAMES, AGENTS, MAPS = 110, 12, 20
"""Frames of a scenario, largest number of its agents, and number of different maps."""
PIECES, LENGTH, WIDTH, LANES = 4, 150.0, 3.5, 2
"""Pieces of a road, length of a piece [m], width of a lane [m], and lanes per direction."""
MILLION = 1_000_000


def road(turn: float) -> str:
    """A straight road in the direction ``turn`` [rad] as the JSON of a map."""
    direction, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    segments: dict[str, Any] = {}

    def line(along: np.ndarray, offset: float) -> list[dict[str, float]]:
        points = along[:, None] * direction + offset * left
        return [{"x": round(float(x), 2), "y": round(float(y), 2), "z": 0.0} for x, y in points]

    for way in (1, -1):
        for piece in range(PIECES):
            along = way * (np.linspace(0.0, LENGTH, 16) + piece * LENGTH - PIECES * LENGTH / 2)
            for lane in range(LANES):
                number = 1000 * (way < 0) + 10 * piece + lane
                segments[str(number)] = {
                    "id": number,
                    "is_intersection": False,
                    "lane_type": "VEHICLE",
                    "left_lane_boundary": line(along, -way * WIDTH * lane),
                    "right_lane_boundary": line(along, -way * WIDTH * (lane + 1)),
                    "left_lane_mark_type": "DASHED_WHITE",
                    "right_lane_mark_type": "DASHED_WHITE",
                    "left_neighbor_id": number - 1 if lane > 0 else None,
                    "right_neighbor_id": number + 1 if lane < LANES - 1 else None,
                    "successors": [number + 10] if piece < PIECES - 1 else [],
                    "predecessors": [number - 10] if piece > 0 else [],
                }
    return json.dumps({"drivable_areas": {}, "pedestrian_crossings": {}, "lane_segments": segments})


def traffic(draw: np.random.Generator, turn: float) -> pl.DataFrame:
    """Tracks of vehicles that keep their lanes on the road with that direction, some for a part of the scenario only."""
    count = int(draw.integers(AGENTS // 2, AGENTS + 1))
    way = draw.choice([1.0, -1.0], count)
    offset = -way * WIDTH * (draw.integers(0, LANES, count) + 0.5)
    begin, last = np.zeros(count, int), np.full(count, FRAMES)
    brief = draw.random(count) < 0.5
    begin[brief], last[brief] = draw.integers(0, 50, brief.sum()), draw.integers(60, FRAMES, brief.sum())
    speed = draw.uniform(3.0, 14.0, count)
    agent = np.repeat(np.arange(count), last - begin)
    frame = np.concatenate([np.arange(*span) for span in zip(begin, last, strict=True)])
    now = speed[agent] + np.sin(0.05 * frame + agent)
    along = way[agent] * (draw.uniform(-150.0, 50.0, count)[agent] + 0.1 * frame * speed[agent])
    across = offset[agent] + draw.normal(0.0, 0.02, len(agent))
    cosine, sine = np.cos(turn), np.sin(turn)
    columns = {
        "observed": frame < 50,
        "track_id": np.where(agent == 0, "AV", (1000 + agent).astype(str)),
        "object_type": np.full(len(agent), "vehicle"),
        "object_category": np.ones(len(agent), int),
        "timestep": frame,
        "position_x": cosine * along - sine * across,
        "position_y": sine * along + cosine * across,
        "heading": turn + np.where(way[agent] > 0, 0.0, np.pi),
        "velocity_x": cosine * way[agent] * now,
        "velocity_y": sine * way[agent] * now,
    }
    return pl.DataFrame(columns)


def make(folder: Path, first: int, last: int) -> int:
    """Write the scenarios with the numbers from ``first`` to before ``last``; returns their size [bytes]."""
    turns = np.linspace(0.0, np.pi, MAPS)
    maps = [road(float(turn)) for turn in turns]
    size = 0
    for number in range(first, last):
        name = f"{number:07d}"
        home = folder / ("val" if number % 10 == 0 else "train") / name
        home.mkdir(parents=True, exist_ok=True)
        tracks, lanes = home / f"scenario_{name}.parquet", home / f"log_map_archive_{name}.json"
        traffic(np.random.default_rng(number), float(turns[number % MAPS])).write_parquet(tracks)
        lanes.write_text(maps[number % MAPS])
        size += tracks.stat().st_size + lanes.stat().st_size
    return size


@contextmanager
def peak() -> Iterator[list[float]]:
    """Context whose value is a list with the largest memory of this process [MB], without pages of files."""
    found, ended = [0.0], threading.Event()

    def look() -> None:
        lines = Path("/proc/self/status").read_text().splitlines()
        found[0] = max(found[0], next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024)

    def watch() -> None:
        while not ended.wait(0.02):
            look()

    thread = threading.Thread(target=watch, daemon=True)
    look()
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join()


def extract(folder: Path, root: Path, workers: int) -> dict[str, float]:
    """Extract the scenarios of a folder; seconds of each stage, memory, numbers and sizes."""
    from epo_lightning.data.recorded.extraction import extract_to_file
    from epo_lightning.data.workers import finished
    from epo_lightning.experiment import assembly
    from epo_lightning.experiment.config.compose import compose

    words = ["data=argoverse2", f"data.folder={folder}", f"data.root={root}"]
    section = compose("generate", words)["data"]
    cost: dict[str, float] = {}

    def launch(tasks: Any, report: Any) -> None:
        begin = time.perf_counter()
        for _ in finished(extract_to_file, tasks, workers, report, ""):
            pass
        cost["extract"] = time.perf_counter() - begin
        files = [task.file for task in tasks]
        cost["parts"], cost["bytes of parts"] = len(files), sum(file.stat().st_size for file in files)

    with peak() as memory:
        cost["memory at the start"] = memory[0]
        data = assembly.build_data(section)
        begin = time.perf_counter()
        sources = data.sources()
        cost["list"], begin = time.perf_counter() - begin, time.perf_counter()
        data.identity(sources)
        cost["fingerprints"], begin = time.perf_counter() - begin, time.perf_counter()
        made = data.generate(progress=True, launch=launch)
        whole = time.perf_counter() - begin
        cost["gather"] = whole - cost["extract"]
        files = list(made.iterdir())
        cost["files"], cost["bytes"] = len(files), sum(file.stat().st_size for file in files)
        cost["manifest"] = (made / "manifest.json").stat().st_size
        begin = time.perf_counter()
        again = assembly.build_data(section)
        train = again.open("train")
        cost["open"] = time.perf_counter() - begin
    report = data.report()
    cost |= {"memory": memory[0], "recordings": len(sources), "train": len(train)}
    cost["scenes"] = sum(report[split]["scenes"] for split in report["recordings"])
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cost["worker seconds"] = used.ru_utime + used.ru_stime
    cost["memory of a worker"] = used.ru_maxrss / 1024
    return cost


def print_cost(small: dict[str, float], large: dict[str, float], size: int) -> None:
    """Print both measurements, and the extrapolation of what grows with the recordings."""
    lines = {
        "recordings": ("recordings", ",.0f"),
        "scenes": ("scenes", ",.0f"),
        "list": ("listing [s]", ".2f"),
        "fingerprints": ("fingerprints of all files [s]", ".2f"),
        "extract": ("extraction [s]", ".1f"),
        "worker seconds": ("  processor time of the workers [s]", ".1f"),
        "gather": ("gathering and writing [s]", ".1f"),
        "open": ("opening the training split [s]", ".2f"),
        "memory at the start": ("memory at the start [MB]", ",.0f"),
        "memory": ("largest memory of the process that gathers [MB]", ",.0f"),
        "memory of a worker": ("largest memory of a worker [MB]", ",.0f"),
        "parts": ("temporary files", ",.0f"),
        "files": ("files of the data set", ",.0f"),
        "bytes of parts": ("bytes of temporary files", ",.0f"),
        "bytes": ("bytes of the data set", ",.0f"),
        "manifest": ("  of which the manifest", ",.0f"),
    }
    for key, (title, form) in lines.items():
        print(f"{title:<52}{small[key]:>16{form}}{large[key]:>16{form}}")
    grown = large["recordings"] - small["recordings"]
    slope = {key: (large[key] - small[key]) / grown for key in large}
    per_core = grown / (large["worker seconds"] - small["worker seconds"])
    print(f"{'recordings per second and core':<52}{per_core:>32.1f}")
    print(f"{'scenes per second and core':<52}{per_core * large['scenes'] / large['recordings']:>32.1f}")
    scale = MILLION / large["recordings"]
    print(f"\na million of these recordings ({size * scale / 1e9:,.0f} GB):")
    hours = MILLION / per_core / 3600
    print(f"  extraction         {hours:,.1f} core hours: {60 * hours / 64:,.0f} minutes on 64 cores")
    alone = slope["list"] + slope["fingerprints"] + slope["gather"]
    print(f"  one process alone  {alone * MILLION / 3600:,.1f} h (listing, fingerprints, gathering and writing)")
    memory = large["memory"] + slope["memory"] * (MILLION - large["recordings"])
    worker = large["memory of a worker"]
    print(f"  memory             {memory / 1000:,.1f} GB of that process, {worker / 1000:.1f} GB of a worker")
    print(f"  data set           {slope['bytes'] * MILLION / 1e9:,.0f} GB in {large['files']:.0f} files")
    # At most as many parts as parts.MOST; the columns of a split lie in files of their own until it is written.
    print(f"  besides, for a while {2 * slope['bytes of parts'] * MILLION / 1e9:,.0f} GB in 10,000 files")


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("generation", __doc__)
    parser.add_argument("--recordings", type=positive, default=5000, help="the number of scenarios, 20 or more")
    parser.add_argument("--workers", type=positive, default=2, help="the number of worker processes, 2 or more")
    parser.add_argument("--folder", type=Path, help="folder to make and keep, with the scenarios and the data sets")
    arguments = parser.parse_args(given)
    if arguments.recordings < 20:
        parser.error("--recordings takes 20 or more: each of the two data sets needs three splits")
    if arguments.workers < 2:
        parser.error("--workers takes 2 or more, because workers are measured apart from the process that gathers")
    home = arguments.folder or Path(tempfile.mkdtemp(prefix="generation-"))
    spawn = multiprocessing.get_context("spawn")
    try:
        sizes = (arguments.recordings // 5, arguments.recordings)
        made = []
        total = 0
        for name, count in zip(("fifth", "all"), sizes, strict=True):
            total = make(home / name, 0, count)
            with ProcessPoolExecutor(1, mp_context=spawn) as pool:
                job = pool.submit(extract, home / name, home / f"cache-{name}", arguments.workers)
                made.append(job.result())
        print_cost(made[0], made[1], total)
    finally:
        if not arguments.folder:
            shutil.rmtree(home, ignore_errors=True)


if __name__ == "__main__":
    main()
