"""The multilayer perceptron of all decoders."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from epo_lightning.host import readable


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


class _NormalisePresent(torch.autograd.Function):
    """Batch normalisation with the statistics of the rows that are present; the result of absent rows is the bias.

    Returns also the mean, the sum of squared deviations and the number of present rows. The derivative is written out:
    automatic differentiation launches three times as many kernels, and for so few numbers a GPU's time is that of launches.
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
        count = present.sum().clamp_min(1).to(rows.dtype)
        mean = torch.where(here, rows, 0.0).sum(0) / count
        deviation = torch.where(here, rows, mean) - mean
        square = deviation.square().sum(0)
        scale = (square / count + eps).rsqrt()
        normalised = deviation * scale
        ctx.save_for_backward(here, count, normalised, scale * weight)
        ctx.mark_non_differentiable(mean, square, count)
        ctx.set_materialize_grads(False)  # no zeros for them
        return torch.addcmul(bias, normalised, weight), mean, square, count

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


class _MaskedBatchNorm(nn.BatchNorm1d):
    """Batch normalisation with statistics of existing agents only, over all processes of a training.

    The result does not depend on how rows are spread over processes.
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
            return self._without_waiting(rows, present).view_as(features)
        normalised = torch.zeros_like(rows)
        normalised[present] = normalise(rows[present])
        return normalised.view_as(features)

    def _without_waiting(self, rows: Tensor, present: Tensor) -> Tensor:
        """The present rows, normalised as ``nn.BatchNorm1d`` does; those of the others have no meaning.

        On a GPU, the host would have to wait for the number of rows that a selection takes.
        """
        assert self.running_mean is not None
        values = rows.to(self.running_mean.dtype)
        normalised, *statistics = _NormalisePresent.apply(values, present, self.weight, self.bias, self.eps)
        self._follow(*statistics)
        return normalised.to(rows.dtype)

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
        total = counts.sum().clamp_min(1)
        mean = (counts * means).sum(0) / total
        square = (squares + counts * (means - mean).square()).sum(0)
        self._follow(mean, square, total)
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
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(square / (count - 1).clamp_min(1), self.momentum)


class MLP(nn.Module):
    """Linear layers with normalisation and ReLU between them.

    Args:
        inputs, outputs: sizes of the features that come in and go out.
        width: size of the hidden features.
        layers: number of linear layers.
        norm: ``batch`` or ``layer`` normalisation of hidden features.
        bias: whether the output layer has a bias. (A softmax over rows cancels it.)
    """

    def __init__(
        self, inputs: int, width: int, outputs: int, layers: int = 3, norm: str = "layer", bias: bool = True
    ) -> None:
        super().__init__()
        sizes = [inputs, *[width] * (layers - 1)]
        normalisation = {"batch": _MaskedBatchNorm, "layer": nn.LayerNorm}[norm]
        hidden = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        self.hidden = nn.ModuleList(hidden)
        self.norms = nn.ModuleList(normalisation(size) for size in sizes[1:])
        self.output = nn.Linear(sizes[-1], outputs, bias=bias)
        if norm == "batch":
            # Batch normalisation cancels these biases, so their gradients are only rounding errors, which Adam would
            # scale to steps of normal size. In evaluation such steps have an effect, because the running means follow
            # with a delay.
            for linear in hidden:
                linear.bias.requires_grad_(False)

    def forward(
        self, features: Float[Tensor, "*batch inputs"], mask: Bool[Tensor, "*batch"] | None = None
    ) -> Float[Tensor, "*batch outputs"]:
        """The output for every row; ``mask`` marks the rows that count for batch normalisation."""
        return self.after_first(self.hidden[0](features), mask)

    def after_first(
        self, features: Float[Tensor, "*batch width"], mask: Bool[Tensor, "*batch"] | None = None
    ) -> Float[Tensor, "*batch outputs"]:
        """The output from the result of the first linear layer, for callers that compute it in a cheaper way."""
        for norm, linear in zip(self.norms, [*self.hidden[1:], self.output], strict=True):
            features = norm(features, mask) if isinstance(norm, _MaskedBatchNorm) else norm(features)
            features = linear(features.relu())
        return features
