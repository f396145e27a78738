"""Feedback equilibria of LQ games in plain PyTorch: one matrix per game, differentiable, slow."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from epo_lightning.game.pairs import pairs
from epo_lightning.solvers.feedback.compiled import CONTROL, STATE
from epo_lightning.solvers.feedback.lq_game import LQGame


def joint(blocks: Tensor) -> Tensor:
    """The blocks of all agents [S, N, K, a, b] on the diagonal of one matrix [S, K, N a, N b]."""
    return torch.stack(
        [torch.stack([torch.block_diag(*stage) for stage in game.unbind(1)]) for game in blocks.unbind(0)]
    )


def joint_costs(game: LQGame) -> tuple[Tensor, Tensor]:
    """Q [S, N, K, n, n] and q [S, N, K, n] of every agent's whole cost by the joint states."""
    count, agents, horizon = game.free.shape
    Q = torch.zeros(count, agents, horizon, STATE * agents, STATE * agents, dtype=torch.double)
    q = torch.zeros(count, agents, horizon, STATE * agents, dtype=torch.double)
    within = game.free.any(1)[..., None, None].double()
    eye = torch.eye(STATE * agents, dtype=torch.double)
    matrices, vectors = [], []
    for i in range(agents):
        matrix, vector = Q[:, i] + game.rho * within * eye, q[:, i]
        place = eye[STATE * i : STATE * (i + 1)]
        matrix = matrix + place.T @ game.own_cost[:, i, ..., :STATE] @ place
        vector = vector + game.own_cost[:, i, ..., STATE] @ place
        for p, (first, second) in enumerate(zip(*pairs(agents), strict=True)):
            if i in (first, second):
                both = torch.cat((eye[STATE * first : STATE * (first + 1)], eye[STATE * second : STATE * (second + 1)]))
                matrix = matrix + both.T @ game.pair_cost[:, p, ..., : 2 * STATE] @ both
                vector = vector + game.pair_cost[:, p, ..., 2 * STATE] @ both
        matrices.append(matrix)
        vectors.append(vector)
    return torch.stack(matrices, 1), torch.stack(vectors, 1)


def equilibrium(game: LQGame) -> tuple[Tensor, Tensor]:
    """Gains [S, K, m, n] and offsets [S, K, m]."""
    count, agents, horizon = game.free.shape
    n, m = STATE * agents, CONTROL * agents
    A, B, own_effort = joint(game.A), joint(game.B), joint(game.effort)
    Q, q = joint_costs(game)
    free = game.free.transpose(1, 2).repeat_interleave(CONTROL, -1)[..., None]
    eye = torch.eye(m, dtype=torch.double)
    V, v = torch.zeros(count, agents, n, n, dtype=torch.double), torch.zeros(count, agents, n, dtype=torch.double)
    gains, offsets = [], []
    for k in range(horizon - 1, -1, -1):
        V, v = V + Q[:, :, k], v + q[:, :, k]
        rows, right = [], []
        for i in range(agents):
            slope = game.B[:, i, k].mT @ V[:, i, STATE * i : STATE * (i + 1)]
            at = (game.B[:, i, k].mT @ v[:, i, STATE * i : STATE * (i + 1), None])[..., 0] + game.push[:, i, k]
            rows.append(slope @ B[:, k])
            right.append(torch.cat((slope @ A[:, k], at[..., None]), -1))
        matrix = torch.where(free[:, k], torch.cat(rows, 1) + own_effort[:, k] + game.rho * eye, eye)
        policy = torch.linalg.solve(matrix, torch.where(free[:, k], -torch.cat(right, 1), 0.0))
        G, f = policy[..., :n], policy[..., n]
        gains.append(G)
        offsets.append(f)
        closed, drift = A[:, k] + B[:, k] @ G, (B[:, k] @ f[..., None])[..., 0]
        values, slopes = [], []
        for i in range(agents):
            own = slice(CONTROL * i, CONTROL * (i + 1))
            R = game.rho * torch.eye(m, dtype=torch.double) + F.pad(
                game.effort[:, i, k], (own.start, m - own.stop, own.start, m - own.stop)
            )
            r = F.pad(game.push[:, i, k], (own.start, m - own.stop))
            values.append(G.mT @ R @ G + closed.mT @ V[:, i] @ closed)
            pushed = (R @ f[..., None])[..., 0] + r
            moved = v[:, i] + (V[:, i] @ drift[..., None])[..., 0]
            slopes.append((G.mT @ pushed[..., None] + closed.mT @ moved[..., None])[..., 0])
        V, v = torch.stack(values, 1), torch.stack(slopes, 1)
    return torch.stack(gains[::-1], 1), torch.stack(offsets[::-1], 1)


def deviation(game: LQGame) -> Tensor:
    """The controls [S, K, m] that the equilibrium's policies choose from x_0 = 0 on."""
    gains, offsets = equilibrium(game)
    A, B = joint(game.A), joint(game.B)
    state = torch.zeros_like(A[:, 0, :, :1])
    chosen = []
    for k in range(A.shape[1]):
        controls = gains[:, k] @ state + offsets[:, k, :, None]
        state = A[:, k] @ state + B[:, k] @ controls
        chosen.append(controls[..., 0])
    return torch.stack(chosen, 1)
