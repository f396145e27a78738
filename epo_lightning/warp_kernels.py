"""Kernels that are written in NVIDIA Warp, for PyTorch's tensors and on PyTorch's stream.

``pip install 'epo_lightning[gpu]'`` brings Warp; it is imported when a kernel is first used. A first launch compiles the
kernel; later ones can be captured in a CUDA graph.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


@functools.cache
def installed() -> bool:
    """Whether Warp is installed."""
    return importlib.util.find_spec("warp") is not None


@functools.cache
def warp() -> Any:
    """Warp, set up for kernels without derivatives of its own.

    Raises:
        ImportError: it is not installed.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    return wp


def described(tensor: Tensor) -> Any:
    """The description of a tensor's memory that a kernel takes; it costs a fraction of the time of one of Warp's arrays.

    The memory stays the tensor's, which has to live until the kernel is launched.
    """
    return warp().from_torch(tensor, requires_grad=False, return_ctype=True)


def launch(kernel: Any, blocks: int, threads: int, inputs: Sequence[Any], device: torch.device) -> None:
    """Launch a kernel on PyTorch's current stream.

    Memory that it uses may be released as soon as this returns: PyTorch hands it out again in the order of the stream.

    Args:
        kernel: the kernel, which takes the number of its block and of its thread by ``wp.tid()``.
        blocks, threads: number of blocks, and of threads in each of them; on a CPU a block has one.
        inputs: numbers, structures and described tensors.
        device: where the tensors are.
    """
    wp = warp()
    stream: Any = contextlib.nullcontext()
    if device.type == "cuda":
        stream = wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)
    with stream:
        wp.launch_tiled(
            kernel, dim=[blocks], inputs=list(inputs), block_dim=threads, device=wp.device_from_torch(device)
        )
