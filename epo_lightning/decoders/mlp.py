"""The multilayer perceptron that all decoders are made of."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


class _MaskedBatchNorm(nn.BatchNorm1d):
    """Batch normalisation whose statistics are those of existing agents alone."""

    def forward(self, features: Tensor, mask: Tensor | None = None) -> Tensor:
        rows = features.flatten(0, -2)
        if mask is None or not self.training:
            return super().forward(rows).view_as(features)
        present = mask.flatten()
        normalised = torch.zeros_like(rows)
        normalised[present] = super().forward(rows[present])
        return normalised.view_as(features)


class MLP(nn.Module):
    """Linear layers with normalisation and ReLU between them.

    Args:
        inputs, outputs: sizes of the features that come in and go out.
        width: size of the hidden features.
        layers: number of linear layers.
        norm: ``batch`` or ``layer`` normalisation of hidden features.
        bias: whether the output has one; a softmax over rows takes no notice of it.
    """

    def __init__(
        self, inputs: int, width: int, outputs: int, layers: int = 3, norm: str = "layer", bias: bool = True
    ) -> None:
        super().__init__()
        sizes = [inputs, *[width] * (layers - 1)]
        normalisation = {"batch": _MaskedBatchNorm, "layer": nn.LayerNorm}[norm]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.norms = nn.ModuleList(normalisation(size) for size in sizes[1:])
        self.output = nn.Linear(sizes[-1], outputs, bias=bias)

    def forward(
        self, features: Float[Tensor, "*batch inputs"], mask: Bool[Tensor, "*batch"] | None = None
    ) -> Float[Tensor, "*batch outputs"]:
        """Apply the layers to every row; ``mask`` tells which rows count for batch normalisation."""
        return self.after_first(self.hidden[0](features), mask)

    def after_first(
        self, features: Float[Tensor, "*batch width"], mask: Bool[Tensor, "*batch"] | None = None
    ) -> Float[Tensor, "*batch outputs"]:
        """What follows the first linear layer, for those who have a cheaper way to compute that one."""
        for norm, linear in zip(self.norms, [*self.hidden[1:], self.output], strict=True):
            features = norm(features, mask) if isinstance(norm, _MaskedBatchNorm) else norm(features)
            features = linear(features.relu())
        return features
