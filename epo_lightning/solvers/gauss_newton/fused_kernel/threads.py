"""Threads of one game: their number, a barrier, and sums along time, which one thread computes."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

import os
THREADS = int(os.environ.get("EPO_BLOCK", "32"))
"""Threads of a game on a GPU: one warp, so that its barrier is cheap. On a CPU a game has one thread, unless Warp is set to
run blocks of threads there (``warp.config.enable_cpu_blocks``), as tests of the barriers do."""

SYNC = """
#if defined(__CUDA_ARCH__)
    if (WP_TILE_BLOCK_DIM > 32) {
        __syncthreads();
    } else {
        __syncwarp();
    }
#else
    WP_TILE_SYNC();
#endif
"""
LANE = """
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return {cpu};
#endif
"""
# Numbers are read in batches, so that their ways from memory overlap; sources and results may be the same array.
_SUMS = """
    typedef {number} T;
    T sum = 0;
    const T* from = source.data + first;
    T* to = target.data + place;
    for (int begin = 0; begin <= count; begin += 8) {
        T batch[8];
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            batch[j] = begin + j < count ? from[(begin + j) * stride] : T(0);
        }
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            if (begin + j <= count) {
                to[begin + j] = start + sum;
                sum += scale * batch[j];
            }
        }
    }
"""
_SUMS_BACK = """
    typedef {number} T;
    T sum = 0;
    const T* from = source.data + first;
    T* to = target.data + place;
    for (int end = count; end > 0; end -= 8) {
        T batch[8];
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            batch[j] = end - 1 - j >= 0 ? from[(end - 1 - j) * stride] : T(0);
        }
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            if (end - 1 - j >= 0) {
                sum += batch[j];
                to[end - 1 - j] = sum;
            }
        }
    }
"""


@no_type_check
def make(T: Any, backwards: bool) -> SimpleNamespace:
    """The functions for numbers of type ``T``.

    Threads of a CPU run one after the other from barrier to barrier, in the order of their numbers, or if ``backwards`` in
    the opposite one.
    """
    number = number_type(T)
    Array = wp.array(dtype=T)

    @wp.func_native(SYNC)
    def sync(): ...

    @wp.func_native(LANE.replace("{cpu}", cpu_lane(backwards)))
    def lane() -> int: ...

    @wp.func_native(_SUMS.replace("{number}", number))
    def sums(source: Array, first: int, stride: int, count: int, start: T, scale: T, target: Array, place: int): ...

    @wp.func_native(_SUMS_BACK.replace("{number}", number))
    def sums_back(source: Array, first: int, stride: int, count: int, target: Array, place: int): ...

    return SimpleNamespace(sync=sync, lane=lane, sums=sums, sums_back=sums_back)


def number_type(T: Any) -> str:
    """The name of Warp's type ``T`` in C++."""
    return "double" if T is wp.float64 else "float"


def cpu_lane(backwards: bool) -> str:
    """The number of a thread on a CPU, as an expression in C++."""
    return "(WP_TILE_BLOCK_DIM - 1 - WP_TILE_THREAD_IDX)" if backwards else "WP_TILE_THREAD_IDX"
