"""Scenes per second read from a split that may be larger than the memory.

    python -m benchmarks.reading cache/us101-fb7914247bae --gigabytes 6

The training split of a data set is repeated until its file has the given size. Then batches are read from it as in training,
and at random from the whole split. Limit the memory from outside, for example by
`systemd-run --scope -p MemoryMax=1G`, and compare: major faults are pages that had to be read from the disk.
"""

from __future__ import annotations

import resource
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.command_line import parser_of
from benchmarks.measure import positive
from epo_lightning.data import cache
from epo_lightning.data.datamodule import BatchSampler
from epo_lightning.data.recorded.extraction import Extracted
from epo_lightning.data.recorded.gathering import gather
from epo_lightning.data.recorded.parts import Lazy
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.tables import SceneTables


def repeated(source: Path, folder: Path, size: float) -> None:
    """Write a data set whose training split is that of ``source``, repeated until it has ``size`` bytes or more."""
    tables = {name: tensor.numpy() for name, tensor in cache.load(source, "train").items()}
    tables["recording"] = tables["recording"] * 0
    tables["origin"] = tables["origin"][:1]
    piece = SceneTables(**tables)
    times = -(-int(size) // sum(values.nbytes for values in tables.values()))
    names = [f"copy {number}" for number in range(times)]
    columns = folder.with_name(f"{folder.name}-columns")
    tensors, _ = gather(
        names,
        Lazy(names, lambda _: piece),
        Lazy(names, lambda _: Counter()),
        Lazy(names, lambda _: Extracted({}, {})),
        piece.lanes.shape[1],
        columns,
    )
    cache.write(folder, {"train": tensors}, {"copies of": source.name, "times": times}, {})
    shutil.rmtree(columns)


def measure(title: str, data: RecordedScenes, batches: Iterator[Tensor], seconds: float) -> None:
    """Read batches for some seconds, and print the scenes per second, and per second of processor time, and the faults."""
    data[next(batches)]  # draws the order, and asks for the first blocks
    before, begin, scenes = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter(), 0
    for indices in batches:
        data[indices]
        scenes += len(indices)
        if time.perf_counter() - begin > seconds:
            break
    lasted, used = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF)
    faults = (used.ru_majflt - before.ru_majflt) / scenes
    busy = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    print(
        f"{title:<50}{scenes / lasted:>9,.0f} scenes/s{scenes / busy:>9,.0f} per CPU second{faults:>8.3f} faults/scene",
        flush=True,
    )


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("reading", __doc__)
    parser.add_argument("source", type=Path, help="a recorded data set")
    parser.add_argument("--gigabytes", type=float, default=6.0, help="the least size of the split")
    parser.add_argument("--folder", type=Path, help="where the repeated data set is kept; default: beside the source")
    parser.add_argument("--batch", type=positive, nargs="+", default=[32, 256], help="sizes of batches")
    parser.add_argument("--seconds", type=float, default=20.0, help="the duration of each measurement")
    arguments = parser.parse_args(given)
    torch.set_num_threads(1)
    folder = arguments.folder or arguments.source.with_name(f"{arguments.source.name}-repeated")
    if not folder.exists():
        repeated(arguments.source, folder, 1e9 * arguments.gigabytes)
    tables = cache.load(folder, "train")
    size = sum(tensor.nbytes for tensor in tables.values())
    data = RecordedScenes(tables, 0.2, "aligned", ["copy"] * len(tables["origin"]))
    print(f"{len(data):,} scenes, {size / 1e9:.1f} GB, {size / len(data):,.0f} bytes per scene")
    known = cache.load(arguments.source, "train")
    known["recording"], known["origin"] = known["recording"] * 0, known["origin"][:1]
    small = RecordedScenes(known, 0.2, "aligned", ["source"])
    for count in arguments.batch:
        draws = (torch.randint(0, len(small), (count,)) for _ in iter(int, 1))
        measure(f"the source, in memory, batches of {count}", small, draws, arguments.seconds)
        sampler = BatchSampler(data, count, shuffle=True, seed=0)
        measure(f"order of a training, batches of {count}", data, iter(sampler), arguments.seconds)
        in_order = iter(BatchSampler(data, count, shuffle=False, seed=0))
        measure(f"one after the other, batches of {count}", data, islice(in_order, 10**9), arguments.seconds)
        draw = (torch.randint(0, len(data), (count,)) for _ in iter(int, 1))
        measure(f"at random from the whole split, batches of {count}", data, draw, arguments.seconds)


if __name__ == "__main__":
    main()
