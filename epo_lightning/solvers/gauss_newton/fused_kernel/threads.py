"""Threads of one game: their number, a barrier and the memory that they share, and two loops of one thread: sums along time,
and along a line."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.layout import Fast

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
# Memory of a multiprocessor if it has room, and otherwise a part of the other memory.
_FAST = """
#if defined(__CUDA_ARCH__)
    if ({shared}) {
        __shared__ alignas(32) {number} memory[{shared} ? {numbers} : 1];
        return wp::array_t<{number}>(memory, {numbers});
    }
#endif
    return wp::array_t<{number}>(work.data + place, {numbers});
"""
_FAST_NUMBERS = """
#if defined(__CUDA_ARCH__)
    __shared__ int numbers[{count}];
    return wp::array_t<int>(numbers, {count});
#else
    return given;
#endif
"""
_PUT = """
    typedef {number} T;
    struct alignas(4 * sizeof(T)) Four { T x, y, z, w; };
    *(Four*)(to.data + place) = Four{x, y, z, w};
"""
# Numbers are read in batches, so that their ways from memory overlap; sources and results may be the same array. Loops are
# not unrolled further: with more code, threads wait for instructions more often.
_SUMS = """
    typedef {number} T;
    T sum = 0;
    const T* from = source.data + first;
    T* to = target.data + place;
    #pragma unroll 1
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
    #pragma unroll 1
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
# Sine and cosine at once. On a GPU they are those of a multiple of pi, whose error is about the rounding of the angle: the
# plain functions bring a lot of code for angles that are very large.
_DIRECTION = """
#if defined(__CUDA_ARCH__)
    typedef {number} T;
    T s, c;
    sincospi(angle * T(0.31830988618379067), &s, &c);
    to.data[sine] = s;
    to.data[cosine] = c;
#else
    to.data[sine] = sin(angle);
    to.data[cosine] = cos(angle);
#endif
"""
_ROW_SUM = """
    {number} sum = 0;
    #pragma unroll 1
    for (int k = 0; k < count; ++k) sum += source.data[first + k];
    return sum;
"""
# The line's segment that is nearest to a point; -1 if no comparison is true, because an input is NaN. What is left of the
# point's coordinates on the segment need not be exact, and is computed again: a GPU divides fast. Points are read
# in batches, as numbers of sums are.
_NEAREST_SEGMENT = """
    typedef {number} T;
    struct alignas(2 * sizeof(T)) Point { T x, y; };
    const Point* const line = (const Point*)(points.data + first);
    Point from = line[0];
    T least = INFINITY;
    int nearest = -1;
    #pragma unroll 1
    for (int begin = 0; begin + 1 < count; begin += 8) {
        Point batch[8];
        #pragma unroll
        for (int j = 0; j < 8; ++j) batch[j] = line[begin + j + 1 < count ? begin + j + 1 : count - 1];
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            const Point to = batch[j];
            const T dx = to.x - from.x, dy = to.y - from.y, off_x = x - from.x, off_y = y - from.y;
            const T length = dx * dx + dy * dy, ahead = off_x * dx + off_y * dy;
#if defined(__CUDA_ARCH__)
            T along;  // between 0 and 1, and 0 instead of NaN where the length is zero
            if (sizeof(T) == 4) {
                const float whole = length, part = ahead;
                float inverse;
                asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(whole));
                along = __saturatef(part * inverse);
            } else {
                along = fmin(fmax(ahead / length, T(0)), T(1));
            }
#else
            const T raw = length > T(0) ? ahead / length : T(0);
            const T along = raw < T(0) ? T(0) : raw > T(1) ? T(1) : raw;
#endif
            const T gap_x = off_x - along * dx, gap_y = off_y - along * dy;
            const T square = gap_x * gap_x + gap_y * gap_y;
            if (square < least && begin + j + 1 < count) {
                least = square;
                nearest = begin + j;
            }
            from = to;
        }
    }
    return nearest;
"""


@no_type_check
def make(T: Any, agents: int, fast: Fast, backwards: bool) -> SimpleNamespace:
    """The functions for numbers of type ``T`` and games of up to ``agents`` agents, with fast memory for ``fast``.

    Threads of a CPU run one after the other from barrier to barrier, in the order of their numbers, or if ``backwards`` in
    the opposite one.
    """
    number = number_type(T)
    Array = wp.array(dtype=T)

    @wp.func_native(SYNC)
    def sync(): ...

    @wp.func_native(LANE.replace("{cpu}", cpu_lane(backwards)))
    def lane() -> int: ...

    memory = _FAST.replace("{number}", number).replace("{numbers}", str(fast.numbers))

    @wp.func_native(memory.replace("{shared}", str(int(fast.shared))))
    def fast_memory(work: Array, place: int) -> Array: ...

    @wp.func_native(_FAST_NUMBERS.replace("{count}", str(4 * agents + 2)))
    def fast_numbers(given: wp.array(dtype=wp.int32)) -> wp.array(dtype=wp.int32): ...

    @wp.func_native(_PUT.replace("{number}", number))
    def put(to: Array, place: int, x: T, y: T, z: T, w: T): ...

    @wp.func_native(_SUMS.replace("{number}", number))
    def sums(source: Array, first: int, stride: int, count: int, start: T, scale: T, target: Array, place: int): ...

    @wp.func_native(_SUMS_BACK.replace("{number}", number))
    def sums_back(source: Array, first: int, stride: int, count: int, target: Array, place: int): ...

    @wp.func_native(_DIRECTION.replace("{number}", number))
    def direction(angle: T, to: Array, sine: int, cosine: int): ...

    @wp.func_native(_ROW_SUM.replace("{number}", number))
    def row_sum(source: Array, first: int, count: int) -> T: ...

    @wp.func_native(_NEAREST_SEGMENT.replace("{number}", number))
    def nearest_segment(points: Array, first: int, count: int, x: T, y: T) -> int: ...

    return SimpleNamespace(
        sync=sync,
        lane=lane,
        fast_memory=fast_memory,
        fast_numbers=fast_numbers,
        put=put,
        sums=sums,
        sums_back=sums_back,
        direction=direction,
        row_sum=row_sum,
        nearest_segment=nearest_segment,
    )


def number_type(T: Any) -> str:
    """The name of Warp's type ``T`` in C++."""
    return "double" if T is wp.float64 else "float"


def cpu_lane(backwards: bool) -> str:
    """The number of a thread on a CPU, as an expression in C++."""
    return "(WP_TILE_BLOCK_DIM - 1 - WP_TILE_THREAD_IDX)" if backwards else "WP_TILE_THREAD_IDX"
