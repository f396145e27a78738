"""Threads of one game: their number, a barrier, and the fast memory that they share."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

THREADS = 32
"""Threads of a game on a GPU: one warp, so that its barrier is cheap. On a CPU a game has one thread, unless Warp is set to
run blocks of threads there (``warp.config.enable_cpu_blocks``), as tests of the barriers do."""

_SYNC = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
"""
_LANE = """
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return {cpu};
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
def make(T: Any, most: int, backwards: bool) -> SimpleNamespace:
    """The functions for numbers of type ``T`` and games of up to ``most`` agents.

    With ``most`` = 0, for any number of agents, fast memory is global memory, which the processor caches. Threads of a CPU
    run one after the other from barrier to barrier, in the order of their numbers, or if ``backwards`` in the opposite one.
    """
    lane_code = _LANE.replace(
        "{cpu}", "WP_TILE_BLOCK_DIM - 1 - WP_TILE_THREAD_IDX" if backwards else "WP_TILE_THREAD_IDX"
    )
    number = "float" if T is wp.float32 else "double"
    fast_code = _FAST.format(number=number, count=fast_numbers(most)) if most else "    return otherwise;"

    @wp.func_native(_SYNC)
    def sync(): ...

    @wp.func_native(lane_code)
    def lane() -> int: ...

    @wp.func_native(fast_code)
    def fast_memory(otherwise: wp.uint64) -> wp.uint64: ...

    return SimpleNamespace(sync=sync, lane=lane, fast_memory=fast_memory)


def fast_numbers(agents: int) -> int:
    """Numbers in the fast memory of a game; the end of ``Layout`` in `games.py`."""
    pairs = agents * (agents - 1) // 2
    return 52 * agents**2 + 33 * agents + 11 * pairs


def work_numbers(agents: int, steps: int) -> int:
    """Numbers in the slow memory of a game: trajectory, two tangents, and two arrays of controls."""
    return 14 * agents * (steps + 1) + 4 * agents * steps
