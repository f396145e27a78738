"""Feedback equilibria of LQ games: against a plain recursion, against best responses, and their derivative."""

from __future__ import annotations

import dataclasses
import platform

import plain_lq
import pytest
import torch
from torch import Tensor

from epo_lightning.game.pairs import pairs
from epo_lightning.solvers.feedback.lq_game import LQGame
from epo_lightning.solvers.gauss_newton.kernel import interface

SIZES = pytest.mark.parametrize(("agents", "horizon"), [(1, 4), (2, 7), (3, 5), (5, 3)])


def convex(*shape: int) -> Tensor:
    """Positive semidefinite matrices."""
    root = torch.randn(*shape, dtype=torch.double)
    return root.mT @ root / shape[-1]


def random_game(agents: int, horizon: int, *, linear: bool = True, games: int = 3, rho: float = 0.7) -> LQGame:
    """Games with random costs; those without linear terms have an equilibrium at zero."""
    torch.manual_seed(agents)
    shape = (games, agents, horizon)
    couples = (games, len(pairs(agents)[0]), horizon)

    def cost(matrix: Tensor) -> Tensor:
        vector = torch.randn(*matrix.shape[:-1], 1, dtype=torch.double)
        return torch.cat((matrix, vector if linear else torch.zeros_like(vector)), -1)

    free = torch.ones(shape, dtype=torch.bool)
    free[0, :, horizon - 1] = False  # a game that ends earlier
    within = free.any(1)[:, None, :, None, None].double()
    push = torch.randn(*shape, 2, dtype=torch.double)
    return LQGame(
        A=torch.eye(4, dtype=torch.double) + 0.2 * torch.randn(*shape, 4, 4, dtype=torch.double),
        B=0.5 * torch.randn(*shape, 4, 2, dtype=torch.double),
        own_cost=within * cost(convex(*shape, 4, 4)),
        pair_cost=within[:, :1].expand(-1, couples[1], -1, -1, -1) * cost(convex(*couples, 8, 8)),
        effort=within * convex(*shape, 2, 2),
        push=free[..., None] * push if linear else torch.zeros_like(push),
        rho=rho,
        free=free,
    )


@SIZES
def test_the_compiled_recursion_agrees_with_a_plain_one(agents: int, horizon: int) -> None:
    game = random_game(agents, horizon)
    policy = game.equilibrium()
    gains, offsets = plain_lq.equilibrium(game)
    assert policy.unique.all()
    torch.testing.assert_close(policy.gains, gains, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(policy.offsets, offsets, rtol=1e-9, atol=1e-11)
    assert (policy.gains[0, -1] == 0).all(), "nothing is chosen after the end of a game"


@SIZES
def test_every_policy_is_the_best_answer_to_the_others(agents: int, horizon: int) -> None:
    """No agent gains by other controls than its policy chooses, if the others keep their policies, from any state.

    Its cost is quadratic in a deviation of its controls, so a gradient of zero and a convex Hessian prove it.
    """
    game = random_game(agents, horizon)
    policy = game.equilibrium()
    A, B = plain_lq.joint(game.A), plain_lq.joint(game.B)
    Q, q = plain_lq.joint_costs(game)
    start = torch.randn(3, 4 * agents, dtype=torch.double)
    for i in range(agents):
        own = slice(2 * i, 2 * i + 2)

        def cost(deviation: Tensor, i: int = i, own: slice = own) -> Tensor:
            """Agent i's cost if it adds ``deviation`` [S, K, 2] to what its policy chooses."""
            state, total = start, 0.0
            for k in range(horizon):
                controls = (policy.gains[:, k] @ state[..., None])[..., 0] + policy.offsets[:, k]
                parts = controls[:, : own.start], controls[:, own] + deviation[:, k], controls[:, own.stop :]
                controls = torch.cat(parts, 1)
                state = (A[:, k] @ state[..., None] + B[:, k] @ controls[..., None])[..., 0]
                total = (
                    total + 0.5 * torch.einsum("sx,sxy,sy->s", state, Q[:, i, k], state) + (q[:, i, k] * state).sum(-1)
                )
                mine = controls[:, own]
                total = total + 0.5 * torch.einsum("sx,sxy,sy->s", mine, game.effort[:, i, k], mine)
                total = total + (game.push[:, i, k] * mine).sum(-1) + 0.5 * game.rho * controls.square().sum(-1)
            return total.sum()

        none = torch.zeros(3, horizon, 2, dtype=torch.double)
        slope = torch.func.grad(cost)(none)
        torch.testing.assert_close(slope, none, rtol=0, atol=1e-9)
        curvature = torch.func.hessian(cost)(none).reshape(6 * horizon, 6 * horizon)
        assert torch.linalg.eigvalsh(curvature).min() > -1e-9, "the policy is a minimum"


@SIZES
def test_the_derivative_at_an_equilibrium_is_that_of_the_plain_recursion(agents: int, horizon: int) -> None:
    game = random_game(agents, horizon, linear=False)
    names = ("A", "B", "own_cost", "pair_cost", "effort", "push")
    leaves = [getattr(game, name).requires_grad_() for name in names]
    cotangent = torch.randn(3, agents, horizon, 2, dtype=torch.double)
    found = game.pull_back(game.equilibrium(), cotangent, leaves)
    suggested = plain_lq.deviation(game)
    wanted = torch.autograd.grad(
        suggested, leaves, cotangent.transpose(1, 2).flatten(2), allow_unused=True, materialize_grads=True
    )
    for name, one, other in zip(names, found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-10, msg=lambda text, name=name: f"{name}: {text}")


@SIZES
def test_the_derivative_by_costs_is_that_of_finite_differences(agents: int, horizon: int) -> None:
    """Linear terms move the offsets away from zero; their derivative there is that of the equilibrium."""
    game = random_game(agents, horizon, linear=False)
    game.push.requires_grad_()
    cotangent = torch.randn(3, agents, horizon, 2, dtype=torch.double)
    (slope,) = game.pull_back(game.equilibrium(), cotangent, [game.push])
    way = torch.randn_like(game.push) * game.free[..., None]

    def chosen(step: float) -> Tensor:
        moved = dataclasses.replace(game, push=step * way)
        return (plain_lq.deviation(moved) * cotangent.transpose(1, 2).flatten(2)).sum()

    torch.testing.assert_close((slope * way).sum(), (chosen(1e-4) - chosen(-1e-4)) / 2e-4, rtol=1e-7, atol=1e-9)


def test_a_game_without_a_unique_equilibrium_is_reported_and_has_no_effect_on_the_others() -> None:
    game = random_game(2, 3, rho=0.0)
    effort, B, cotangent = game.effort.clone(), game.B.clone(), torch.ones(3, 2, 3, 2, dtype=torch.double)
    effort[1], B[1] = 0.0, 0.0  # controls without any effect
    broken = dataclasses.replace(game, effort=effort, B=B.requires_grad_())
    policy, sound = broken.equilibrium(), game.equilibrium()
    assert policy.unique.tolist() == [True, False, True]
    assert torch.equal(policy.gains[[0, 2]], sound.gains[[0, 2]])
    assert not policy.gains[1].any()
    (slope,) = broken.pull_back(policy, cotangent, [B])
    assert slope[[0, 2]].any()
    assert not slope[1].any()


@pytest.mark.parametrize("agents", [2, 4])
def test_a_game_depends_neither_on_its_neighbours_nor_on_the_number_of_threads(agents: int) -> None:
    game = random_game(agents, 4, games=19)
    game.own_cost.requires_grad_()
    cotangent = torch.randn(19, agents, 4, 2, dtype=torch.double)
    policy = game.equilibrium()
    (slope,) = game.pull_back(policy, cotangent, [game.own_cost])
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        again = game.equilibrium()
        (slope_again,) = game.pull_back(again, cotangent, [game.own_cost])
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(again.gains, policy.gains)
    assert torch.equal(slope_again, slope)
    some = dataclasses.replace(
        game,
        **{field.name: getattr(game, field.name)[5:7] for field in dataclasses.fields(game) if field.name != "rho"},
    )
    few = some.equilibrium()
    assert torch.equal(few.gains, policy.gains[5:7])
    assert torch.equal(few.offsets, policy.offsets[5:7])
    (slope_few,) = some.pull_back(few, cotangent[5:7], [some.own_cost])
    assert torch.equal(slope_few, slope[5:7])
    poisoned = dataclasses.replace(game, own_cost=game.own_cost.detach().clone())
    poisoned.own_cost[6] = torch.nan
    others = torch.arange(19) != 6
    found = poisoned.equilibrium()
    assert found.unique.tolist() == others.tolist()
    assert torch.equal(found.gains[others], policy.gains[others])
    assert found.gains[6].isfinite().all()


def test_all_levels_of_instructions_agree() -> None:
    library = interface.library()
    count = library.epo_levels()
    if library.epo_built() == 1 and platform.machine() == "x86_64":
        pytest.skip("the kernel was built for this machine only; build.py --portable builds all levels")
    game = random_game(2, 5, linear=False, games=9)
    game.own_cost.requires_grad_()
    cotangent = torch.randn(9, 2, 5, 2, dtype=torch.double)
    gains, slopes = [], []
    try:
        for level in range(count):
            library.epo_choose(level)
            policy = game.equilibrium()
            gains.append(policy.gains)
            slopes += game.pull_back(policy, cotangent, [game.own_cost])
    finally:
        library.epo_choose(count - 1)
    for found in (gains, slopes):
        for one in found[:-1]:
            torch.testing.assert_close(one, found[-1], rtol=1e-10, atol=1e-10)
