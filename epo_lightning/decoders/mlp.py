"""The multilayer perceptron of all decoders."""

from __future__ import annotations

from itertools import pairwise

from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.decoders.batch_norm import MaskedBatchNorm


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
        normalisation = {"batch": MaskedBatchNorm, "layer": nn.LayerNorm}[norm]
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
            features = norm(features, mask) if isinstance(norm, MaskedBatchNorm) else norm(features)
            features = linear(features.relu())
        return features
