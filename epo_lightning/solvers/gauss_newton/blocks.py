"""Factorisation of the damped Gauss-Newton matrix, a few nodes at a time: dynamic programming in blocks.

The nodes (speeds and headings after every step) are eliminated backwards in time, a block of nodes at a time. The nodes up
to s affect the costs after s only through three quantities: the displacement of the next position, and the changes of the
nodes s and s - 1 (a difference of nodes is a control, and a difference of controls is its rate). With this state x =
(dp_{s+1}, dz_{s-1}, dz_s) and the nodes Z = (dz_{s+1} .. dz_e) of a block, the block is eliminated by

    L L^T = H_ZZ,   G = L^-1 H_Zx,   P = H_xx - G^T G,

where P is the cost-to-go, which is added to the costs of the block before. Blocks of 32 unknowns or more need few and large
operations; the total cost is O(K N^3).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.solvers.gauss_newton.edges import Group
from epo_lightning.solvers.gauss_newton.quadratic_model import QuadraticModel

_UNKNOWNS = 32
"""Target number of unknowns per block: smaller blocks take more operations, larger ones more arithmetic."""
_ALIGNED = 16
"""Unknowns are padded to a multiple of this. Libraries round differently for matrices that are not aligned to cache lines,
and the result of a problem must not depend on its position in a batch."""


def block_bounds(steps: int, agents: int) -> list[tuple[int, int]]:
    """First node (exclusive) and last node (inclusive) of every block; each has two nodes at least."""
    count = max(1, steps // max(2, _UNKNOWNS // (2 * agents)))
    edges = [steps * block // count for block in range(count + 1)]
    return list(pairwise(edges))


@dataclass(frozen=True)
class Block:
    """One block's part of the factors, for C sets of m agents, F = 2 m unknowns at each of its nodes.

    Attributes:
        unknowns: number of unknowns; entries beyond them, up to n, are padding.
        moves: derivatives dt M of all later positions by the nodes; rows are (component, agent), columns are (axis, agent).
        factor: L.
        gain: G^T; None for the first block, because the state at t0 is given and not an unknown.
    """

    unknowns: int
    moves: Float[Tensor, "C n F"]
    factor: Float[Tensor, "C n n"]
    gain: Float[Tensor, "C X n"] | None


@dataclass(frozen=True)
class Factors:
    """J^T J + lambda I of a group of agents, factorised block by block."""

    blocks: list[Block]

    def put(self, where: Int[Tensor, " D"], others: Factors, chosen: Bool[Tensor, " D"]) -> None:
        """Overwrite the factors at ``where`` with the chosen ones of ``others``, in place."""
        for mine, theirs in zip(self.blocks, others.blocks, strict=True):
            mine.factor[where[chosen]] = theirs.factor[chosen]
            if mine.gain is not None and theirs.gain is not None:
                mine.gain[where[chosen]] = theirs.gain[chosen]

    def solve(self, right: Float[Tensor, "C n"]) -> Float[Tensor, "C n"]:
        """(J^T J + lambda I)^-1 times a covector of all nodes, in the order node, component, agent."""
        width = self.blocks[0].moves.shape[-1]
        parts = list(right[..., None].split([block.unknowns for block in self.blocks], 1))
        carried: Tensor | None = None
        for index in range(len(self.blocks) - 1, -1, -1):
            block = self.blocks[index]
            part = parts[index].new_zeros(right.shape[0], block.factor.shape[-1], 1)
            part[:, : block.unknowns] = parts[index]
            if carried is not None:
                part += _times(block.moves, carried[:, :width])
                part[:, block.unknowns - 2 * width : block.unknowns] += carried[:, width:]
            parts[index] = torch.linalg.solve_triangular(block.factor, part, upper=False)
            if block.gain is not None:
                spread = -_times(block.gain, parts[index])
                if carried is not None:
                    spread[:, :width] += carried[:, :width]
                carried = spread
        state: Tensor | None = None
        for index, block in enumerate(self.blocks):
            part = parts[index]
            if state is not None:
                assert block.gain is not None
                part = torch.baddbmm(part, block.gain.mT, state, alpha=-1)
            nodes = torch.linalg.solve_triangular(block.factor.mT, part, upper=True)
            moved = block.moves.mT @ nodes
            parts[index] = nodes = nodes[:, : block.unknowns]
            state = torch.cat((moved if state is None else state[:, :width] + moved, nodes[:, -2 * width :]), 1)
        return torch.cat(parts, 1)[..., 0]


def _times(matrix: Float[Tensor, "C a b"], vector: Float[Tensor, "C b 1"]) -> Float[Tensor, "C a 1"]:
    # Matrix-vector products round differently in a batch of one, for which libraries have a separate routine.
    return (matrix * vector.mT).sum(-1, keepdim=True)


def factorise(
    model: QuadraticModel, damping: Float[Tensor, " problems *agents"], group: Group
) -> tuple[Factors, Bool[Tensor, " C"]]:
    """Factors of a group's matrices, and a mask of those that are not positive definite.

    Args:
        model: the quadratic model of the energy.
        damping: lambda of every problem or of every agent, added to the diagonal of the controls.
        group: the sets of agents.
    """
    parts = _Parts(model, damping, group)
    failed = torch.zeros(group.count, dtype=torch.bool, device=damping.device)
    blocks: list[Block] = []
    cost: Tensor | None = None
    # Undeclared features may couple any two steps, so that all nodes are one block.
    whole = model.own_dense is not None or model.pair_dense is not None
    for start, end in reversed([(0, model.at.horizon)] if whole else block_bounds(model.at.horizon, group.size)):
        block, cost, info = parts.eliminate(start, end, cost)
        blocks.insert(0, block)
        failed |= info != 0
    return Factors(blocks), failed


class _Parts:
    """The stiffness of a model for one group, laid out [C, .., nodes, .., m]."""

    def __init__(self, model: QuadraticModel, damping: Float[Tensor, " problems *agents"], group: Group) -> None:
        self.model, self.group, self.size = model, group, group.size

        # Double precision is needed: rates of controls enter the nodes divided by dt^4.
        def double(values: Tensor) -> Tensor:
            return values.to(torch.float64)

        # Absent agents and steps after the end of a game get unit matrices, so that they are regular even without damping.
        control = double(model.control) + damping.reshape(damping.shape[0], -1, 1, 1)
        present = model.at.present[..., None, None]
        control = torch.where(present if model.at.within_game is None else present & model.at.within_game, control, 1.0)
        moves, node, pull = double(model.at.moves), double(model.node), double(model.position)
        rows = [model.at.dt * moves.flatten(2, 3), control / model.at.dt**2, node, pull]
        sizes = [4, 2, 2, 3]
        for optional, scale in ((model.rate, model.at.dt**-4), (model.cross, 1.0)):
            if optional is not None:
                rows.append(double(optional) * scale)
            sizes.append(2 * (optional is not None))
        packed = torch.cat(rows, 2).flatten(0, 1)
        if group.agents is not None:
            packed = packed.index_select(0, group.agents.flatten())
        packed = (
            packed.view(group.count, group.size, -1, model.at.horizon).permute(0, 3, 2, 1).contiguous()
        )  # [C, K, f, m]
        moves, self.control, self.node, pull, self.rate, self.cross = packed.split(sizes, 2)
        self.moves = moves.unflatten(2, (2, 2))  # [C, K, component, axis, m]
        # Stiffness of the positions, [C, K, axis m, axis m].
        shared = None if model.pair_position is None else double(model.pair_position)
        xx, xy, yy = group.coupled(pull.transpose(1, 2), shared).movedim(3, 1).unbind(2)  # [C, K, m, m]
        self.position = torch.stack((torch.stack((xx, xy), -2), torch.stack((xy, yy), -2)), 2).view(
            group.count, model.at.horizon, 2 * group.size, 2 * group.size
        )

    def eliminate(self, start: int, end: int, cost: Tensor | None) -> tuple[Block, Tensor | None, Tensor]:
        """The block of nodes start + 1 .. end, the cost-to-go P, and LAPACK's info; ``cost`` is P of the block after."""
        width, count = 2 * self.size, end - start
        batch = self.moves.shape[0]
        moves = self.moves[:, start:end]
        # ahead[l]: sum of the stiffness of all positions after node start + l, which are those that this node moves. The
        # state's displacement moves all positions from this block on.
        ahead = self.position.new_zeros(batch, count + 1, width, width)
        ahead[:, :-1] = self.position[:, start:end].flip(1).cumsum(1).flip(1)
        if cost is not None:
            ahead += cost[:, None, :width, :width]
        beta = self.model.at.beta
        later = ahead[:, 1:]
        if beta != 1.0:
            # Node l also moves position l, by the share 1 - beta. On the diagonal this share should be squared: the branch
            # `beta not in (0.0, 1.0)` below corrects it.
            later = later + (1.0 - beta) * self.position[:, start:end]
        by_axis = later.view(batch, count, 2, self.size, width)
        unknowns = count * width
        filled = -(-unknowns // _ALIGNED) * _ALIGNED
        both = moves.new_zeros(2, batch, filled, width)
        left, right = both[0], both[1]  # views that a compiler can write to, unlike those of `unbind`
        product = left[:, :unknowns].view(batch, count, 2, self.size, width)
        for axis in range(2):
            product.addcmul_(moves[:, :, :, axis, :, None], by_axis[:, :, None, axis])
        apart = right[:, :unknowns].view(batch, count, 2, self.size, 2, self.size)
        apart.diagonal(dim1=3, dim2=5).copy_(moves)
        # Column-major, for in-place factorisations and triangular solves.
        matrix = torch.bmm(right, left.mT).mT
        if cost is not None:
            tail = slice(unknowns - 2 * width, unknowns)
            across = torch.bmm(cost[:, width:, :width], right.mT)
            matrix[:, tail] += across
            matrix[:, tail, tail] += across[:, :, tail].mT
            matrix[:, tail, tail] += cost[:, width:, width:]
        state = None
        if start > 0:
            # Against the state (position, node start - 1, node start).
            state = left.new_zeros(batch, 3 * width, matrix.shape[1]).mT
            state[:, :, :width] = left
            if cost is not None:
                state[:, tail, :width] += cost[:, width:, :width]
        nodes = matrix[:, :unknowns, :unknowns]
        own = self._bands(nodes, state, start, end)
        matrix.diagonal(0, 1, 2)[:, unknowns:] = 1.0
        if beta not in (0.0, 1.0):
            diagonal = nodes.unflatten(1, (count, width)).unflatten(3, (count, width)).diagonal(0, 1, 3)
            by_node = apart.view(batch, count, width, width)
            at_node = by_node @ (self.position[:, start:end] @ by_node.mT)
            diagonal -= beta * (1.0 - beta) * at_node.permute(0, 2, 3, 1)
        if start == 0 and end == self.model.at.horizon:
            self._add_undeclared(nodes)
        info = torch.empty(batch, dtype=torch.int32, device=matrix.device)
        # In place, but for programs that are exported: the size of an output cannot be checked there.
        exported = torch.compiler.is_exporting()
        matrix, info = torch.linalg.cholesky_ex(matrix, out=None if exported else (matrix, info))
        if state is None:
            return Block(unknowns, right, matrix, None), None, info
        gain = torch.linalg.solve_triangular(matrix, state, upper=False, out=None if exported else state)
        own[:, :width, :width] += ahead[:, 0]
        own = torch.baddbmm(own, gain.mT, gain, alpha=-1)
        return Block(unknowns, right, matrix, gain.mT), own, info

    def _bands(self, matrix: Tensor, state: Tensor | None, start: int, end: int) -> Tensor:
        """Add the costs of controls, of their rates and of the nodes themselves to ``matrix`` and ``state``.

        Controls and rates are differences of nodes. A difference belongs to the block of its last node. Returns the part of
        the costs that depends on the state only.
        """
        width, count = 2 * self.size, end - start
        batch = matrix.shape[0]
        # Over nodes start - 1 .. end: diagonals 0, 1 and 2 of a banded matrix [C, T + 2, F]. A control is a difference of
        # two nodes: c (z' - z)^2 adds c, c to the diagonal and -c beside it. A rate is one of three nodes:
        # r (z'' - 2 z' + z)^2 adds r, 4 r, r to the diagonal, -2 r, -2 r beside it and r two nodes away.
        diagonal = matrix.new_zeros(batch, count + 2, 2, self.size)
        first, second = torch.zeros_like(diagonal), torch.zeros_like(diagonal)
        control = self.control[:, start:end]
        diagonal[:, 1:-1] += control
        diagonal[:, 2:] += control
        first[:, 2:] -= control
        diagonal[:, 2:] += self.node[:, start:end]
        if self.rate.shape[2]:
            # Rates between the controls l and l + 1, for l = start - 1 .. end - 2. At start = 0 there is no control before.
            low = max(start - 1, 0)
            rate, shift = self.rate[:, low : end - 1], low - (start - 1)
            diagonal[:, shift:-2] += rate
            diagonal[:, shift + 1 : -1] += 4.0 * rate
            diagonal[:, shift + 2 :] += rate
            first[:, shift + 1 : -1] -= 2.0 * rate
            first[:, shift + 2 :] -= 2.0 * rate
            second[:, shift + 2 :] += rate
        bands = [band.view(batch, count + 2, width) for band in (diagonal, first, second)]
        for offset, band in enumerate(bands):
            # Entry a of the band with this offset couples node a with node a - offset; entry 2 is node start + 1, the first
            # one of the block.
            inner = band[:, 2 + offset :].flatten(1)
            if inner.shape[1]:
                matrix.diagonal(-offset * width, 1, 2).add_(inner)
        if self.cross.shape[2]:
            # Stiffness between the speed of a node (column) and two headings (rows): of the same node, and of the next one.
            nodes = matrix.mT.unflatten(1, (count, 2, self.size)).unflatten(4, (count, 2, self.size))
            here, following = self.cross[:, start:end].unbind(2)
            heading_by_speed = nodes[:, :, 0, :, :, 1].diagonal(0, 2, 4).transpose(1, 2)  # [C, T, T, m]
            heading_by_speed.diagonal(0, 1, 2).add_(here.transpose(1, 2))
            if count > 1:
                heading_by_speed.diagonal(-1, 1, 2).add_(following[:, :-1].transpose(1, 2))
        own = matrix.new_zeros(batch, 3 * width, 3 * width)
        if state is None:
            return own
        before, at = slice(width, 2 * width), slice(2 * width, 3 * width)
        own[:, before, before].diagonal(0, 1, 2).add_(bands[0][:, 0])
        own[:, at, at].diagonal(0, 1, 2).add_(bands[0][:, 1])
        own[:, at, before].diagonal(0, 1, 2).add_(bands[1][:, 1])
        own[:, before, at].diagonal(0, 1, 2).add_(bands[1][:, 1])
        state[:, :width, at].diagonal(0, 1, 2).add_(bands[1][:, 2])
        state[:, :width, before].diagonal(0, 1, 2).add_(bands[2][:, 2])
        state[:, width : 2 * width, at].diagonal(0, 1, 2).add_(bands[2][:, 3])
        if self.cross.shape[2]:
            following = self.cross[:, start - 1, 1]
            state[:, self.size : width, 2 * width : 2 * width + self.size].diagonal(0, 1, 2).add_(following)
        return own

    def _add_undeclared(self, matrix: Tensor) -> None:
        """Add the dense stiffness of undeclared features to the matrix of all nodes."""
        steps, size = self.model.at.horizon, self.size
        nodes = matrix.unflatten(1, (steps, 2, size)).unflatten(4, (steps, 2, size))
        if self.model.own_dense is not None:
            blocks = self.model.own_dense
            blocks = blocks if self.group.agents is None else blocks.flatten(0, 1)[self.group.agents]
            blocks = blocks.view(-1, size, 2, steps, 2, steps)
            nodes.diagonal(dim1=3, dim2=6).add_(blocks.permute(0, 3, 2, 5, 4, 1))
        if self.model.pair_dense is not None:
            shared = self.group.of_edges(self.model.pair_dense).to(matrix.dtype).view(-1, 2, steps, 2, steps)
            of = self.group
            nodes[of.component, :, :, of.second, :, :, of.first] += shared.permute(0, 4, 3, 2, 1)
            nodes[of.component, :, :, of.first, :, :, of.second] += shared.permute(0, 2, 1, 4, 3)
