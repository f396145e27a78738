"""Lane encoder: from the vectors of a polyline to one feature vector."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

VECTOR = 4
"""Features of a lane vector: where it starts and where it ends (x, y each)."""


class LanePolylines(nn.Module):
    """PointNet-like lane encoder (Appendix C.1, "Lane Encoder"; VectorNet, Section 3.2).

    Every layer is a linear map, layer normalisation and ReLU of each vector, whose maximum over the polyline's vectors is
    then concatenated to all of them. The feature is the last layer's maximum: VectorNet concatenates once more before the
    last maximum, which would only repeat it.

    Args:
        width: size of the layers and of the feature.
        depth: number of layers.
        scale: metres that an input of one stands for.

    Raises:
        ValueError: no layer.
    """

    def __init__(self, width: int = 64, depth: int = 3, scale: float = 1.0) -> None:
        super().__init__()
        if depth < 1:
            raise ValueError(f"a lane encoder takes one layer or more, not {depth}")
        self.width, self.scale = width, scale
        self.linears = nn.ModuleList(nn.Linear(a, width) for a in [VECTOR, *[2 * width] * (depth - 1)])
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(depth))

    def forward(
        self, lanes: Float[Tensor, "B L V 4"], mask: Bool[Tensor, "B L V"]
    ) -> Float[Tensor, "B L {self.width}"]:
        """The feature of every polyline, in any order of its vectors; of no meaning for polylines without any vector."""
        exists = mask.any(-1)[..., None, None]
        # Absent vectors repeat the first existing one, which no maximum notices.
        first = mask.to(torch.uint8).argmax(-1)[..., None, None].expand(-1, -1, -1, VECTOR)
        vectors = torch.where(mask[..., None], lanes, lanes.gather(2, first))
        features = self.norms[0](self.linears[0](torch.where(exists, vectors, 0.0) / self.scale)).relu_()
        for linear, norm in zip(self.linears[1:], self.norms[1:], strict=True):
            assert isinstance(linear, nn.Linear)
            # The linear map of the concatenation, without writing the maximum down once for every vector.
            of_vector, of_polyline = linear.weight.split(self.width, 1)
            of_maximum = F.linear(features.amax(-2), of_polyline, linear.bias)
            features = norm(F.linear(features, of_vector).add_(of_maximum[..., None, :])).relu_()
        return features.amax(-2)
