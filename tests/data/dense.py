"""Independent references: dense linear algebra for LQ problems, plain numpy and torch for the game."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def random_lq(random, steps=6, n=5, m=4, players=None):
    """A random convex LQ problem; with ``players``, one cost per player."""

    def positive(size, least):
        a = random.normal(size=(size, size))
        return a @ a.T / size + least * np.eye(size)

    A = np.eye(n) + 0.3 * random.normal(size=(steps, n, n))
    B = random.normal(size=(steps, n, m))

    def cost():
        Q = np.stack([positive(n, 0.0) for _ in range(steps + 1)])
        R = np.stack([positive(m, 1.0) for _ in range(steps)])
        return Q, random.normal(size=(steps + 1, n)), R, random.normal(size=(steps, m))

    if players is None:
        return A, B, *cost()
    return A, B, *(np.stack(values) for values in zip(*(cost() for _ in range(players)), strict=True))


def transfer(A, B):
    """States as a linear map of the start and of all controls: x = F x0 + G u, rows x_0 .. x_K stacked."""
    steps, n, m = B.shape
    F, G = np.zeros((steps + 1, n, n)), np.zeros((steps + 1, n, steps, m))
    F[0] = np.eye(n)
    for k in range(steps):
        F[k + 1] = A[k] @ F[k]
        G[k + 1] = np.einsum("ij,jkl->ikl", A[k], G[k])
        G[k + 1, :, k] += B[k]
    return F.reshape(-1, n), G.reshape((steps + 1) * n, steps * m)


def block_diagonal(blocks):
    size = blocks.shape[1]
    full = np.zeros((len(blocks) * size, len(blocks) * size))
    for k, block in enumerate(blocks):
        full[k * size : (k + 1) * size, k * size : (k + 1) * size] = block
    return full


def open_loop(A, B, Q, q, R, r, start):
    """The minimiser [K, m] by one dense linear system in all controls."""
    steps, _, m = B.shape
    F, G = transfer(A, B)
    QQ, RR = block_diagonal(Q), block_diagonal(R)
    hessian = G.T @ QQ @ G + RR
    gradient = G.T @ (QQ @ F @ start + q.ravel()) + r.ravel()
    return -np.linalg.solve(hessian, gradient).reshape(steps, m)


def best_response_policy(A, B, Q, q, R, r, gains, offsets, mine):
    """The cheapest affine policy of the controls ``mine`` while the others follow (gains, offsets).

    Plain dynamic programming in homogeneous coordinates z = (x, 1): one symmetric matrix holds the value function.
    """
    steps, n, _ = B.shape
    others = ~mine

    def homogeneous(M, v):
        return np.block([[M, v[:, None]], [v[None], np.zeros((1, 1))]])

    P = homogeneous(Q[steps], q[steps])
    policies = []
    for k in range(steps - 1, -1, -1):
        L = np.hstack([gains[k][others], offsets[k][others][:, None]])
        A1 = np.zeros((n + 1, n + 1))
        A1[:n, :n], A1[n, n] = A[k], 1.0
        A1[:n] += B[k][:, others] @ L
        B1 = np.vstack([B[k][:, mine], np.zeros((1, mine.sum()))])
        one = np.zeros(n + 1)
        one[n] = 1.0
        C = homogeneous(Q[k], q[k]) + L.T @ R[k][np.ix_(others, others)] @ L
        linear = np.outer(one, r[k][others]) @ L
        C += linear + linear.T
        S = R[k][np.ix_(mine, others)] @ L + np.outer(r[k][mine], one)
        H = R[k][np.ix_(mine, mine)] + B1.T @ P @ B1
        N = S + B1.T @ P @ A1
        policy = -np.linalg.solve(H, N)
        P = C + A1.T @ P @ A1 + N.T @ policy
        P = 0.5 * (P + P.T)
        policies.append(policy)
    found = np.stack(policies[::-1])
    return found[:, :, :n], found[:, :, n]


def coupled_riccati(A, B, Q, q, R, r, owner):
    """Feedback Nash equilibrium in homogeneous coordinates, all players' conditions stacked at each step."""
    steps, n, m = B.shape
    players = len(Q)

    def homogeneous(M, v):
        return np.block([[M, v[:, None]], [v[None], np.zeros((1, 1))]])

    P = [homogeneous(Q[i][steps], q[i][steps]) for i in range(players)]
    gains, offsets = np.zeros((steps, m, n)), np.zeros((steps, m))
    one = np.zeros(n + 1)
    one[n] = 1.0
    for k in range(steps - 1, -1, -1):
        A1, B1 = np.zeros((n + 1, n + 1)), np.vstack([B[k], np.zeros((1, m))])
        A1[:n, :n], A1[n, n] = A[k], 1.0
        rows = [(R[owner[j]][k] + B1.T @ P[owner[j]] @ B1)[j] for j in range(m)]
        right = [(np.outer(r[owner[j]][k], one) + B1.T @ P[owner[j]] @ A1)[j] for j in range(m)]
        policy = -np.linalg.solve(np.stack(rows), np.stack(right))
        gains[k], offsets[k] = policy[:, :n], policy[:, n]
        closed = A1 + B1 @ policy
        for i in range(players):
            linear = np.outer(one, r[i][k]) @ policy
            P[i] = (
                homogeneous(Q[i][k], q[i][k])
                + policy.T @ R[i][k] @ policy
                + linear
                + linear.T
                + closed.T @ P[i] @ closed
            )
    return gains, offsets


def torch_costs(start: Tensor, u: Tensor, constants, goals: Tensor, weight: float) -> Tensor:
    """Costs of both agents [2] by cumulative sums in torch, independent of the compiled kernels."""
    dt = constants.dt
    u = u.reshape(-1, 2, 2)
    first = start.reshape(2, 4)
    speed = first[:, 3] + dt * torch.cumsum(u[..., 0], 0)
    heading = first[:, 2] + dt * torch.cumsum(u[..., 1], 0)
    v, t = torch.cat([first[None, :, 3], speed[:-1]]), torch.cat([first[None, :, 2], heading[:-1]])
    position = first[:, :2] + dt * torch.cumsum(torch.stack([v * t.cos(), v * t.sin()], -1), 0)

    def over(value, low, high):
        return (value - high).clamp(min=0) + (low - value).clamp(min=0)

    a, w = u[..., 0], u[..., 1]
    own = 0.5 * constants.effort * (a**2 + w**2) + 0.5 * constants.slowness * speed**2
    own = own + constants.bound * over(w, -constants.turn_limit, constants.turn_limit) ** 2
    own = own + constants.bound * over(a, -constants.acceleration_limit, constants.acceleration_limit) ** 2
    own = own + constants.bound * over(speed, constants.speed_min, constants.speed_max) ** 2
    error = torch.cat([position[-1], heading[-1][:, None]], -1) - goals
    pair = weight * (constants.radius - (position[:, 1] - position[:, 0]).norm(dim=-1)).clamp(min=0) ** 2
    return own.sum(0) + 0.5 * constants.terminal * (error**2).sum(-1) + pair.sum()


def alone(start, u, constants, goals, weight, agent):
    """Cost and gradient [2 K] of one agent's own controls while the other's strategy stands, in plain numpy.

    Returns:
        a function of the agent's flat controls.
    """
    dt, steps = constants.dt, len(u)

    def states(first, controls):
        speed = first[3] + dt * np.concatenate([[0.0], np.cumsum(controls[:, 0])])
        heading = first[2] + dt * np.concatenate([[0.0], np.cumsum(controls[:, 1])])
        velocity = speed[:-1, None] * np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], -1)
        return first[:2] + dt * np.cumsum(velocity, 0), heading, speed

    first, goal = start.reshape(2, 4)[agent], goals[agent]
    other, _, _ = states(start.reshape(2, 4)[1 - agent], u.reshape(steps, 2, 2)[:, 1 - agent])

    def excess(value, low, high):
        return np.minimum(value - low, 0) + np.maximum(value - high, 0)

    def value(flat):
        controls = flat.reshape(steps, 2)
        position, heading, speed = states(first, controls)
        over_u = np.stack(
            [
                excess(controls[:, 0], -constants.acceleration_limit, constants.acceleration_limit),
                excess(controls[:, 1], -constants.turn_limit, constants.turn_limit),
            ],
            -1,
        )
        over_v = excess(speed[1:], constants.speed_min, constants.speed_max)
        apart = position - other
        distance = np.linalg.norm(apart, axis=1)
        depth = np.maximum(0.0, constants.radius - distance)
        miss = np.array([*position[-1], heading[-1]]) - goal
        cost = (
            0.5 * constants.effort * (controls**2).sum()
            + 0.5 * constants.slowness * (speed[1:] ** 2).sum()
            + constants.bound * ((over_u**2).sum() + (over_v**2).sum())
            + 0.5 * constants.terminal * (miss**2).sum()
            + weight * (depth**2).sum()
        )
        by_position = -2 * weight * (depth / distance)[:, None] * apart
        by_position[-1] += constants.terminal * miss[:2]
        by_speed = constants.slowness * speed[1:] + 2 * constants.bound * over_v
        by_heading = np.zeros(steps)
        by_heading[-1] = constants.terminal * miss[2]
        later = np.cumsum(by_position[::-1], 0)[::-1]  # later[k]: all positions that the velocity of step k moves
        cos, sin = np.cos(heading[1:-1]), np.sin(heading[1:-1])
        by_speed[:-1] += dt * (cos * later[1:, 0] + sin * later[1:, 1])
        by_heading[:-1] += dt * speed[1:-1] * (cos * later[1:, 1] - sin * later[1:, 0])
        gradient = constants.effort * controls + 2 * constants.bound * over_u
        gradient[:, 0] += dt * np.cumsum(by_speed[::-1])[::-1]
        gradient[:, 1] += dt * np.cumsum(by_heading[::-1])[::-1]
        return cost, gradient.ravel()

    return value
