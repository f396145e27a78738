"""Batch normalisation of the rows that are present as one kernel of a GPU, and its derivative as another one.

PyTorch takes 32 operations for both, and for the few rows of a batch a GPU's time is that of launches. The kernels are
written in NVIDIA Warp; the same source is compiled for CPUs, where it is meant for tests.
"""

# Warp reads annotations as values: this module does not postpone them.

import functools
from types import SimpleNamespace
from typing import Any, no_type_check

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.warp_kernels import described, launch, warp

THREADS = 128
"""Threads of a block, which normalises one feature."""


class FusedNormalise(torch.autograd.Function):
    """Batch normalisation with the statistics of the rows that are present; the result of absent rows is the bias.

    The running statistics are updated as by ``nn.BatchNorm1d``; without any present row they stay.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rows: Float[Tensor, "rows F"],
        present: Bool[Tensor, " rows"],
        weight: Float[Tensor, " F"],
        bias: Float[Tensor, " F"],
        running_mean: Float[Tensor, " F"],
        running_var: Float[Tensor, " F"],
        batches: Int[Tensor, ""],
        eps: float,
        momentum: float,
    ) -> Float[Tensor, "rows F"]:
        rows, present = rows.contiguous(), present.contiguous().view(torch.uint8)
        result, statistics = torch.empty_like(rows), rows.new_empty(3, rows.shape[1])
        mean, scale, count = statistics
        tensors = rows, present, weight, bias, running_mean, running_var, batches.view(1), result, mean, scale, count
        arguments = [*map(described, tensors), eps, momentum]
        launch(kernels(rows.dtype).normalise, rows.shape[1], THREADS, arguments, rows.device)
        ctx.save_for_backward(rows, present, weight, statistics)
        ctx.set_materialize_grads(False)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "rows F"] | None) -> tuple[Tensor | None, ...]:
        if gradient is None:  # the result has no effect on the loss
            return (None,) * 9
        rows, present, weight, statistics = ctx.saved_tensors
        by_rows, (by_weight, by_bias) = torch.empty_like(rows), statistics.new_empty(2, rows.shape[1])
        tensors = gradient.contiguous(), rows, present, weight, *statistics, by_rows, by_weight, by_bias
        launch(kernels(rows.dtype).differentiate, rows.shape[1], THREADS, list(map(described, tensors)), rows.device)
        return by_rows, None, by_weight, by_bias, None, None, None, None, None


@functools.cache
@no_type_check
def kernels(dtype: torch.dtype) -> SimpleNamespace:
    """The two kernels for numbers of a type."""
    wp = warp()
    T = wp.float64 if dtype == torch.float64 else wp.float32
    Rows, Row, Mask = wp.array2d(dtype=T), wp.array(dtype=T), wp.array(dtype=wp.uint8)

    @wp.func
    def in_block(part: T) -> T:
        """Sum over the threads of a block."""
        return wp.tile_extract(wp.tile_sum(wp.tile(part)), 0)

    @wp.kernel(enable_backward=False, module="unique")
    def normalise(
        rows: Rows,
        present: Mask,
        weight: Row,
        bias: Row,
        running_mean: Row,
        running_var: Row,
        batches: wp.array(dtype=wp.int64),
        result: Rows,
        mean: Row,
        scale: Row,
        count: Row,
        eps: T,
        momentum: T,
    ):
        f, lane = wp.tid()
        counted = T(0.0)
        total = T(0.0)
        for r in range(lane, rows.shape[0], wp.block_dim()):
            if present[r] != wp.uint8(0):
                counted += T(1.0)
                total += rows[r, f]
        found = in_block(counted)
        number = wp.max(found, T(1.0))
        middle = in_block(total) / number
        squares = T(0.0)
        for r in range(lane, rows.shape[0], wp.block_dim()):
            if present[r] != wp.uint8(0):
                squares += (rows[r, f] - middle) * (rows[r, f] - middle)
        square = in_block(squares)
        factor = T(1.0) / wp.sqrt(square / number + eps)
        for r in range(lane, rows.shape[0], wp.block_dim()):
            normalised = T(0.0)
            if present[r] != wp.uint8(0):
                normalised = (rows[r, f] - middle) * factor
            result[r, f] = bias[f] + normalised * weight[f]
        if lane == 0:
            mean[f] = middle
            scale[f] = factor
            count[f] = number
            if found > T(0.0):
                variance = square / wp.max(number - T(1.0), T(1.0))
                running_mean[f] = running_mean[f] + momentum * (middle - running_mean[f])
                running_var[f] = running_var[f] + momentum * (variance - running_var[f])
            if f == 0:
                batches[0] = batches[0] + wp.int64(1)

    @wp.kernel(enable_backward=False, module="unique")
    def differentiate(
        gradient: Rows,
        rows: Rows,
        present: Mask,
        weight: Row,
        mean: Row,
        scale: Row,
        count: Row,
        by_rows: Rows,
        by_weight: Row,
        by_bias: Row,
    ):
        f, lane = wp.tid()
        plain = T(0.0)
        weighted = T(0.0)
        for r in range(lane, rows.shape[0], wp.block_dim()):
            if present[r] != wp.uint8(0):
                plain += gradient[r, f]
                weighted += gradient[r, f] * (rows[r, f] - mean[f]) * scale[f]
        along_bias = in_block(plain)
        along_weight = in_block(weighted)
        # Every present row has the same share in the mean, and a share in the deviation that grows with its own.
        for r in range(lane, rows.shape[0], wp.block_dim()):
            by_row = T(0.0)
            if present[r] != wp.uint8(0):
                normalised = (rows[r, f] - mean[f]) * scale[f]
                through_statistics = (along_bias + normalised * along_weight) / count[f]
                by_row = (gradient[r, f] - through_statistics) * scale[f] * weight[f]
            by_rows[r, f] = by_row
        if lane == 0:
            by_weight[f] = along_weight
            by_bias[f] = along_bias

    return SimpleNamespace(normalise=normalise, differentiate=differentiate)
