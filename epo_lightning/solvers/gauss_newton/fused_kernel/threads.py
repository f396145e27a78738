"""What the threads of one game share: their number, a barrier, and fast memory."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

THREADS = 32
"""Threads of a game on a GPU: one warp, so that its barrier is cheap. On a CPU a game has one thread."""

_SYNC = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
"""
_LANE = """
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
"""
_FAST = """
#if defined(__CUDA_ARCH__)
    __shared__ {number} values[{count}];
    return (wp::uint64)values;
#else
    return otherwise;
#endif
"""


@no_type_check
def make(T: Any, most: int) -> SimpleNamespace:
    """The functions for numbers of type ``T`` and games of up to ``most`` agents.

    With ``most`` = 0, for any number of agents, fast memory is global memory, which the processor caches.
    """
    number = "float" if T is wp.float32 else "double"
    fast_code = _FAST.format(number=number, count=fast_numbers(most)) if most else "    return otherwise;"

    @wp.func_native(_SYNC)
    def sync(): ...

    @wp.func_native(_LANE)
    def lane() -> int: ...

    @wp.func_native(fast_code)
    def fast_memory(otherwise: wp.uint64) -> wp.uint64: ...

    return SimpleNamespace(sync=sync, lane=lane, fast_memory=fast_memory)


def fast_numbers(agents: int) -> int:
    """Numbers in the fast memory of a game; the end of ``Layout`` in `kernels.py`."""
    pairs = agents * (agents - 1) // 2
    return 52 * agents**2 + 33 * agents + 11 * pairs


def work_numbers(agents: int, steps: int) -> int:
    """Numbers in the slow memory of a game: trajectory, two tangents, and two arrays of controls."""
    return 14 * agents * (steps + 1) + 4 * agents * steps
