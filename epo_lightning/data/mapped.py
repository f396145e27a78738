"""Tensors of files that may be larger than the memory."""

from __future__ import annotations

import ctypes
import json
import mmap
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

PIECE = 1 << 28
"""Size [bytes] of the pieces in which numbers are checked."""
DTYPES = {
    "BOOL": torch.bool,
    "U8": torch.uint8,
    "I32": torch.int32,
    "I64": torch.int64,
    "F32": torch.float32,
    "F64": torch.float64,
}
"""Types of tensors by their names in safetensors files."""


def mapped(path: Path, names: Sequence[str]) -> dict[str, Tensor]:
    """Memory-mapped tensors of a safetensors file.

    The package safetensors maps a file privately and writable, which the system refuses for more bytes than it has memory.
    """
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
    content = np.memmap(path, np.uint8, "r")[8 + length :]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        whole = torch.from_numpy(content)
    found = {}
    for name in names:
        first, last = header[name]["data_offsets"]
        found[name] = whole[first:last].view(DTYPES[header[name]["dtype"]]).view(header[name]["shape"])
    return found


def read_ahead(tensor: Tensor) -> None:
    """Ask the system to read a contiguous piece of a memory-mapped tensor from the disk, without waiting for it."""
    advise = getattr(ctypes.CDLL(None), "madvise", None)
    if advise is None or not tensor.numel():
        return
    begin = tensor.data_ptr() // mmap.PAGESIZE * mmap.PAGESIZE
    size = tensor.data_ptr() + tensor.nbytes - begin
    advise(ctypes.c_void_p(begin), ctypes.c_size_t(size), mmap.MADV_WILLNEED)


def not_finite(tensor: Tensor) -> tuple[int, int]:
    """Number of rows that are not finite, and the first of them."""
    count, found = 0, -1
    rows = max(1, PIECE // max(1, tensor[:1].nbytes))
    for begin in range(0, len(tensor), rows):
        piece = tensor[begin : begin + rows]
        bad = ~piece.isfinite().flatten(1).all(1) if piece.dim() > 1 else ~piece.isfinite()
        if bad.any():
            found = found if count else begin + int(torch.nonzero(bad)[0])
            count += int(bad.sum())
    return count, found
