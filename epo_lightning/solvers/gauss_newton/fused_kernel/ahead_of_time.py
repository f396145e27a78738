"""The fused kernels compiled for GPUs that need not exist here, and what they take of one.

``python -m epo_lightning.solvers.gauss_newton.fused_kernel.ahead_of_time`` prints registers per thread, stack per thread and
shared memory per game of all kernels. Warp brings NVIDIA's compiler; neither a driver nor a GPU is needed.
"""

from __future__ import annotations

import argparse
import itertools
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from epo_lightning.solvers.gauss_newton.backends import warp as backend
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import TEAM, WARP
from epo_lightning.solvers.gauss_newton.fused_kernel.features import Features
from epo_lightning.warp_kernels import warp

ARCHITECTURES = (80, 90)
"""Compute capabilities times ten: A100; H100 and H200."""
HIGHWAY = Features(("goal", "lane", "velref", "vel", "acc", "jerk", "steer", "turnr", "turnacc"), ("proximity",))
STEPS = 20
"""The energy of the highway setting of `benchmarks/games.py`, and its number of time steps."""
_VALUE, _REGISTERS, _STACK = 0x04, 0x2F, 0x12  # a record with a payload, and the attributes of two of them


@dataclass(frozen=True)
class Resources:
    """Resources of a GPU that a kernel takes.

    Attributes:
        registers: 32-bit registers per thread.
        stack: bytes of local memory per thread, for values that do not fit into registers and for calls.
        shared: bytes of shared memory per block, that is, per game.
        code: bytes of the instructions.
    """

    registers: int
    stack: int
    shared: int
    code: int


def compile_for(architecture: int, double: bool, agents: int, games: int, folder: Path) -> dict[str, Resources]:
    """The resources of both kernels for games of :data:`HIGHWAY`.

    Args:
        architecture: one of :data:`ARCHITECTURES`.
        double: whether numbers have double precision.
        agents: number of agents of a game.
        games: number of games of a launch.
        folder: where Warp writes source and machine code.
    """
    wp = warp()
    dtype, device = torch.float64 if double else torch.float32, torch.device("cuda")
    kernels = backend.kernels(dtype, agents, STEPS, games, device, HIGHWAY)
    found = {}
    for name in ("solve", "differentiate"):
        module = getattr(kernels, name).module
        module.options["block_dim"] = kernels.threads
        (path,) = wp.compile_aot_module(module, arch=architecture, use_ptx=False, module_dir=folder)
        found[name] = resources(path.read_bytes())
    return found


def resources(cubin: bytes) -> Resources:
    """Resources that the only kernel of a module takes, from the attributes in its machine code (ELF).

    Raises:
        ValueError: no machine code of one kernel.
    """
    sections = dict(_sections(cubin))
    codes = [name for name in sections if name.startswith(".text.") and name.endswith("_kernel_forward")]
    if len(codes) != 1:
        raise ValueError(
            f"the machine code of one kernel has one section .text.*_kernel_forward, and this has {len(codes)}"
        )
    kernel = codes[0].removeprefix(".text.")
    attributes: dict[int, int] = {}
    info = sections[".nv.info"]
    at = 0
    while at + 4 <= len(info):
        form, attribute, size = struct.unpack_from("<BBH", info, at)
        at += 4
        if form == _VALUE:
            if size >= 8:
                _, value = struct.unpack_from("<II", info, at)
                attributes[attribute] = max(value, attributes.get(attribute, 0))
            at += size
    shared = len(sections.get(f".nv.shared.{kernel}", b""))
    return Resources(attributes[_REGISTERS], attributes[_STACK], shared, len(sections[codes[0]]))


def _sections(elf: bytes) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the sections of an ELF file of 64 bits; memory that is only reserved is zeros."""
    if elf[:5] != b"\x7fELF\x02":
        raise ValueError("this is no machine code for a GPU: it does not begin as an ELF file of 64 bits")
    (start,) = struct.unpack_from("<Q", elf, 40)
    each, count, names = struct.unpack_from("<HHH", elf, 58)
    headers = [struct.unpack_from("<IIQQQQ", elf, start + each * index) for index in range(count)]
    reserved = 8  # SHT_NOBITS
    _, _, _, _, table, _ = headers[names]
    for name, kind, _, _, offset, size in headers:
        end = elf.index(b"\0", table + name)
        yield elf[table + name : end].decode(), bytes(size) if kind == reserved else elf[offset : offset + size]


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--arch", type=int, nargs="+", default=list(ARCHITECTURES), help="compute capabilities times ten"
    )
    arguments = parser.parse_args(given)
    print("| arch | numbers | agents | threads | kernel | registers | stack [B] | shared [B] | code [kB] |")
    print("|---|---|---|---|---|---|---|---|---|")
    for architecture, double, agents, games in itertools.product(
        arguments.arch, (False, True), backend.SIZES, (backend.FEW, backend.FEW + 1)
    ):
        with tempfile.TemporaryDirectory() as folder:
            found = compile_for(architecture, double, agents, games, Path(folder))
        threads = TEAM if games <= backend.FEW else WARP
        for name, r in found.items():
            numbers = "float64" if double else "float32"
            what = f"sm_{architecture} | {numbers} | up to {agents} | {threads} | {name}"
            print(f"| {what} | {r.registers} | {r.stack} | {r.shared} | {r.code / 1000:.0f} |", flush=True)


if __name__ == "__main__":
    main()
