"""Lane encoder: one feature vector from the vectors of a polyline."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

VECTOR = 4
"""Entries of a lane vector: start and end position (x, y each)."""


class LanePolylines(nn.Module):
    """PointNet-like lane encoder (Appendix E.1, "Lane Encoder"; VectorNet, Section 3.2).

    Every layer is a linear map, layer normalisation and ReLU of each vector; the maximum over the polyline's vectors is then
    concatenated to each of them. The feature is the maximum over the last layer. (VectorNet concatenates once more before
    the last maximum, which would only repeat each number.)

    Args:
        width: size of the layers and of the feature.
        depth: number of layers.
        scale: metres that an input of one stands for.

    Raises:
        ValueError: ``depth`` is less than 1.
    """

    def __init__(self, width: int = 64, depth: int = 3, scale: float = 1.0) -> None:
        super().__init__()
        if depth < 1:
            raise ValueError(f"lane_depth must be 1 or more, not {depth}")
        self.width, self.scale = width, scale
        self.linears = nn.ModuleList(nn.Linear(a, width) for a in [VECTOR, *[2 * width] * (depth - 1)])
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(depth))

    def forward(
        self, lanes: Float[Tensor, "B L V 4"], mask: Bool[Tensor, "B L V"]
    ) -> Float[Tensor, "B L {self.width}"]:
        """The feature of every polyline, independent of the order of its vectors; meaningless for empty polylines."""
        exists = mask.any(-1)[..., None, None]
        # Absent vectors become copies of the first existing one, which leave the maximum as it is.
        first = mask.to(torch.uint8).argmax(-1)[..., None, None].expand(-1, -1, -1, VECTOR)
        vectors = torch.where(mask[..., None], lanes, lanes.gather(2, first))
        features = self.norms[0](self.linears[0](torch.where(exists, vectors, 0.0) / self.scale)).relu_()
        for linear, norm in zip(self.linears[1:], self.norms[1:], strict=True):
            assert isinstance(linear, nn.Linear)
            # The linear map of the concatenation, without a copy of the maximum for every vector.
            of_vector, of_polyline = linear.weight.split(self.width, 1)
            of_maximum = F.linear(_Largest.apply(features), of_polyline, linear.bias)
            features = norm(F.linear(features, of_vector).add_(of_maximum[..., None, :])).relu_()
        return _Largest.apply(features)


class _Largest(torch.autograd.Function):
    """Maximum over the last dimension but one, with the gradient of ``Tensor.amax``: equal entries share it.

    The backward pass of ``amax`` is a quarter of the encoder's, because it makes a tensor of booleans and converts it.
    """

    @staticmethod
    def forward(ctx: Any, values: Float[Tensor, "*batch V F"]) -> Float[Tensor, "*batch F"]:
        largest = values.amax(-2)
        ctx.save_for_backward(values, largest)
        return largest

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "*batch F"]) -> Float[Tensor, "*batch V F"]:
        values, largest = ctx.saved_tensors
        # The sign of the difference is -1, and 0 for the largest.
        is_largest = values.sub(largest[..., None, :]).sign_().add_(1)
        return is_largest.mul_((gradient / is_largest.sum(-2))[..., None, :])
