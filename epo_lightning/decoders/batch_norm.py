"""Batch normalisation of the features of agents, some of which are absent."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from epo_lightning.decoders.fused_norm import FusedNormalise
from epo_lightning.host import readable
from epo_lightning.warp_kernels import installed


class _Sum(torch.autograd.Function):
    """Sum of a tensor over all processes. Its derivative assumes that the losses of all processes are summed as well."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:
        tensor = tensor.clone()
        dist.all_reduce(tensor)
        return tensor

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        gradient = gradient.clone()
        dist.all_reduce(gradient)
        return gradient


class NormalisePresent(torch.autograd.Function):
    """Batch normalisation with the statistics of the rows that are present; the result of absent rows is the bias.

    Returns also the mean, the sum of squared deviations and the number of present rows, with zeros if there are none. The
    derivative is written out: automatic differentiation launches three times as many kernels, and for so few numbers a
    GPU's time is that of launches.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rows: Float[Tensor, "rows F"],
        present: Bool[Tensor, " rows"],
        weight: Float[Tensor, " F"],
        bias: Float[Tensor, " F"],
        eps: float,
    ) -> tuple[Float[Tensor, "rows F"], Float[Tensor, " F"], Float[Tensor, " F"], Float[Tensor, ""]]:
        here = present[:, None]
        number = present.sum().to(rows.dtype)
        count = number.clamp_min(1)
        mean = torch.where(here, rows, 0.0).sum(0) / count
        deviation = torch.where(here, rows, mean) - mean
        square = deviation.square().sum(0)
        scale = (square / count + eps).rsqrt()
        normalised = deviation * scale
        ctx.save_for_backward(here, count, normalised, scale * weight)
        ctx.mark_non_differentiable(mean, square, number)
        ctx.set_materialize_grads(False)  # no zeros for them
        return torch.addcmul(bias, normalised, weight), mean, square, number

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "rows F"] | None, *_: Any) -> tuple[Tensor | None, ...]:
        if gradient is None:  # the result has no effect on the loss
            return None, None, None, None, None
        here, count, normalised, scale = ctx.saved_tensors
        gradient = torch.where(here, gradient, 0.0)
        by_bias, by_weight = gradient.sum(0), (gradient * normalised).sum(0)
        # Every present row has the same share in the mean, and a share in the deviation that grows with its own.
        through_statistics = torch.addcmul(by_bias, normalised, by_weight)
        by_rows = torch.addcmul(gradient, here / count, through_statistics, value=-1) * scale
        return by_rows, None, by_weight, by_bias, None


class MaskedBatchNorm(nn.BatchNorm1d):
    """Batch normalisation with statistics of existing agents only, over all processes of a training.

    The result does not depend on how rows are spread over processes. Without any present row the statistics stay as they
    are. One present row has no variance: on a CPU it is refused, as by ``nn.BatchNorm1d``, unless another process has rows.
    """

    def forward(self, features: Tensor, mask: Tensor | None = None) -> Tensor:
        rows = features.flatten(0, -2)
        if not self.training:
            return super().forward(rows).view_as(features)
        alone = not (dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1)
        normalise = super().forward if alone else self._together
        if mask is None:
            return normalise(rows).view_as(features)
        present = mask.flatten()
        if alone and not readable(rows):
            without_waiting = self._fused if rows.is_cuda and installed() else self._without_waiting
            return without_waiting(rows.to(self.weight.dtype), present).to(rows.dtype).view_as(features)
        normalised = torch.zeros_like(rows)
        normalised[present] = normalise(rows[present])
        return normalised.view_as(features)

    def _without_waiting(self, rows: Tensor, present: Tensor) -> Tensor:
        """The present rows, normalised as ``nn.BatchNorm1d`` does; those of the others have no meaning.

        On a GPU, the host would have to wait for the number of rows that a selection takes.
        """
        normalised, *statistics = NormalisePresent.apply(rows, present, self.weight, self.bias, self.eps)
        self._follow(*statistics)
        return normalised

    def _fused(self, rows: Tensor, present: Tensor) -> Tensor:
        """The same by one kernel."""
        running = self.running_mean, self.running_var, self.num_batches_tracked
        return FusedNormalise.apply(rows, present, self.weight, self.bias, *running, self.eps, self.momentum)

    def _together(self, rows: Tensor) -> Tensor:
        """The rows of this process, normalised as ``nn.BatchNorm1d`` does with the rows of all processes."""
        assert self.running_mean is not None
        rank, world = dist.get_rank(), dist.get_world_size()
        values = rows.to(self.running_mean.dtype)
        count = values.new_full((1,), len(values))
        own = values.sum(0) / count.clamp_min(1)
        parts = torch.cat([count, own, (values - own).square().sum(0)])
        # One exchange: every process fills its own row of a table, and the sum over processes is the whole table. Each
        # row has the process's mean and its squared deviations from that mean. Sums and sums of squares would be simpler
        # to combine, but their difference would lose digits.
        table = _Sum.apply(torch.stack([parts if r == rank else torch.zeros_like(parts) for r in range(world)]))
        counts, means, squares = table.split([1, values.shape[1], values.shape[1]], 1)
        number = counts.sum()
        total = number.clamp_min(1)
        mean = (counts * means).sum(0) / total
        square = (squares + counts * (means - mean).square()).sum(0)
        self._follow(mean, square, number)
        normalised = (values - mean) * (square / total + self.eps).rsqrt()
        return (normalised * self.weight + self.bias).to(rows.dtype)

    @torch.no_grad()
    def _follow(self, mean: Tensor, square: Tensor, count: Tensor) -> None:
        """Update the running statistics by mean and sum of squared deviations of ``count`` rows."""
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        self.num_batches_tracked += 1
        share = torch.where(count > 0, mean.new_full((), self.momentum), 0.0)
        self.running_mean.lerp_(mean, share)
        self.running_var.lerp_(square / (count - 1).clamp_min(1), share)
