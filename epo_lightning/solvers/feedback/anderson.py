"""Anderson acceleration of fixed-point iterations (Walker and Ni, "Anderson acceleration for fixed-point iterations", SIAM
Journal on Numerical Analysis 49(4), 2011), for many of them at a time.

An iteration u <- u + f(u) ends where its deviation f(u) is zero. Near its last points the deviation is about an affine
function of the point. The next point is the one at which this function is least, plus the deviation there.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

DEPENDENT = 1e-12
"""Part of a column, relative to its norm, from which on it is independent of other columns."""


class Anderson:
    """The last points of some iterations, and their deviations."""

    def __init__(self, iterations: int, depth: int, size: int) -> None:
        """No points yet.

        Args:
            iterations: number of iterations.
            depth: H, the largest number of points that are remembered.
            size: D, the length of a point.
        """
        self._points = torch.zeros(iterations, depth, size, dtype=torch.double)
        self._deviations = torch.zeros_like(self._points)
        self._known = torch.zeros(iterations, depth, dtype=torch.bool)

    def next(
        self, rows: Int[Tensor, " R"], points: Float[Tensor, "R D"], deviations: Float[Tensor, "R D"]
    ) -> Float[Tensor, "R D"]:
        """The next points of some iterations: those of the plain iteration where no point is remembered."""
        known = self._known[rows][..., None]
        by_points = torch.where(known, points[:, None] - self._points[rows], 0.0)
        by_deviations = torch.where(known, deviations[:, None] - self._deviations[rows], 0.0)
        shares = least_squares(by_deviations.mT, deviations)
        return points + deviations - ((by_points + by_deviations) * shares[..., None]).sum(1)

    def remember(self, rows: Int[Tensor, " R"], points: Float[Tensor, "R D"], deviations: Float[Tensor, "R D"]) -> None:
        """Remember points instead of the oldest ones."""
        for memory, new in (
            (self._points, points),
            (self._deviations, deviations),
            (self._known, self._known.new_ones(len(rows))),
        ):
            memory[rows] = torch.cat((new[:, None], memory[rows][:, :-1]), 1)

    def forget(self, rows: Int[Tensor, " R"]) -> None:
        """Begin some iterations anew."""
        self._known[rows] = False


def least_squares(columns: Float[Tensor, "R D H"], wanted: Float[Tensor, "R D"]) -> Float[Tensor, "R H"]:
    """The x with the least |columns x - wanted|, by Gram-Schmidt.

    A column that depends on those before it has a share of zero. Rows with values that are not finite do not change others.
    """
    rest = columns.mT
    whole = rest.square().sum(-1)
    along, triangle, inverse = [], [], []
    for c in range(rest.shape[1]):
        norm = rest[:, 0].square().sum(-1)
        independent = norm > DEPENDENT**2 * whole[:, c]
        inverse.append(torch.where(independent, norm.rsqrt(), 0.0))
        direction = torch.where(independent[:, None], rest[:, 0] * inverse[c][:, None], 0.0)
        along.append((direction * wanted).sum(-1))
        wanted = wanted - along[c][:, None] * direction
        triangle.append((rest[:, 1:] @ direction[..., None])[..., 0])
        rest = rest[:, 1:] - triangle[c][..., None] * direction[:, None]
    shares = wanted.new_zeros(len(wanted), len(along))
    for c in reversed(range(len(along))):
        shares[:, c] = (along[c] - (triangle[c] * shares[:, c + 1 :]).sum(-1)) * inverse[c]
    return shares
