"""Densities and best choices over joint assignments, against plain loops over all of them."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.game.pairs import pairs
from epo_lightning.solvers.discrete import assignments

NAN, INF = float("nan"), float("inf")


def drawn(scenes: int = 2, agents: int = 3, count: int = 4, spread: float = 2.0):
    """Tables of random energies, all agents present."""
    unary = spread * torch.randn(scenes, agents, count, dtype=torch.float64)
    pair = spread * torch.rand(scenes, agents * (agents - 1) // 2, count, count, dtype=torch.float64)
    return unary, pair, torch.ones(scenes, agents, dtype=torch.bool)


def listed(unary: torch.Tensor, pair: torch.Tensor) -> list[tuple[float, tuple[int, ...]]]:
    """Energy and choices of all joint assignments of one scene, one by one."""
    agents, count = unary.shape
    found = []
    for choice in itertools.product(range(count), repeat=agents):
        energy, number = 0.0, 0
        for i in range(agents):
            energy += unary[i, choice[i]].item()
        for i in range(agents):
            for j in range(i + 1, agents):
                energy += pair[number, choice[i], choice[j]].item()
                number += 1
        found.append((energy, choice))
    return found


def counted(unary: torch.Tensor, pair: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Marginals and log Z of one scene, one assignment after the other."""
    marginals = torch.zeros_like(unary)
    for energy, choice in listed(unary, pair):
        for agent, candidate in enumerate(choice):
            marginals[agent, candidate] += math.exp(-energy)
    total = marginals[0].sum().item()
    return marginals / total, math.log(total)


def keep(pair: torch.Tensor, agents: int, edges: list[tuple[int, int]]) -> torch.Tensor:
    """The pair energies with all but some pairs indifferent."""
    first, second = pairs(agents)
    kept = [(i, j) in edges for i, j in zip(first.tolist(), second.tolist(), strict=True)]
    return torch.where(torch.tensor(kept, dtype=torch.bool)[None, :, None, None], pair, 0.0)


def forbid(unary: torch.Tensor, pair: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Tables with some impossible candidates and pairs; the agents' first candidates stay possible."""
    never, not_both = torch.rand_like(unary) < 0.25, torch.rand_like(pair) < 0.25
    never[..., 0] = not_both[..., 0, 0] = False
    return unary.masked_fill(never, INF), pair.masked_fill(not_both, INF)


@pytest.mark.parametrize(("agents", "count"), [(1, 5), (2, 3), (3, 4), (4, 3), (2, 1)])
@pytest.mark.parametrize("impossible", [False, True])
def test_enumeration_is_the_sum_over_all_assignments(agents, count, impossible):
    unary, pair, everyone = drawn(3, agents, count)
    if impossible:
        unary, pair = forbid(unary, pair)
    log_marginals, log_partition = assignments.enumerate_(unary, pair, everyone)
    for scene in range(3):
        marginals, total = counted(unary[scene], pair[scene])
        torch.testing.assert_close(log_marginals[scene].exp(), marginals)
        assert log_partition[scene].item() == pytest.approx(total, abs=1e-12)


def test_enumeration_has_a_limit():
    with pytest.raises(ValueError, match="sum_product"):
        assignments.enumerate_(*drawn(1, 7, 4))
    assert assignments.enumerable(6, 4)
    assert not assignments.enumerable(7, 4)


@pytest.mark.parametrize(
    ("agents", "edges"),
    [
        (1, []),
        (2, [(0, 1)]),
        (4, [(0, 1), (1, 2), (2, 3)]),  # a chain
        (4, [(0, 2), (1, 2), (2, 3)]),  # a star
        (5, [(0, 3), (3, 4), (1, 2)]),  # two trees
    ],
)
@pytest.mark.parametrize("impossible", [False, True])
def test_messages_are_exact_on_trees(agents, edges, impossible):
    unary, pair, everyone = drawn(3, agents, 3, spread=3.0)
    if impossible:
        unary, pair = forbid(unary, pair)
    pair = keep(pair, agents, edges)
    exact, total = assignments.enumerate_(unary, pair, everyone)
    found, bethe = assignments.sum_product(unary, pair, everyone, iterations=6)
    torch.testing.assert_close(found, exact)
    torch.testing.assert_close(bethe, total)
    damped, bethe = assignments.sum_product(unary, pair, everyone, iterations=80, damping=0.3)
    torch.testing.assert_close(damped, exact)
    torch.testing.assert_close(bethe, total)


@pytest.mark.parametrize("damping", [0.0, 0.3, 0.8])
def test_the_damping_is_the_weight_of_the_old_message(damping):
    """Two agents hear each other's message alone: after n updates it has the weight 1 - damping^n."""
    unary, pair, everyone = drawn(agents=2)
    to_second = (-unary[:, 0, :, None] - pair[:, 0]).logsumexp(1)
    to_first = (-unary[:, 1, None] - pair[:, 0]).logsumexp(2)
    for updates in (1, 2, 3):
        found, _ = assignments.sum_product(unary, pair, everyone, updates, damping)
        belief = -unary + (1.0 - damping**updates) * torch.stack((to_first, to_second), 1)
        torch.testing.assert_close(found, belief.log_softmax(-1))


@pytest.mark.parametrize(
    ("spread", "worst", "typical", "worst_log_z"),
    [(0.5, 1e-3, 2e-4, 2.5e-3), (2.0, 5e-2, 1e-2, 0.2), (5.0, 0.35, 8e-2, 1.5)],
)
def test_messages_on_triangles_are_as_good_as_pair_energies_are_soft(spread, worst, typical, worst_log_z):
    """Pair energies uniform in [0, spread]: about twice what is measured on 200 draws, where marginals are off by at most
    4e-4, 2e-2 and 0.17 (medians 9e-5, 5e-3 and 4e-2), and log Z by 1e-3, 0.08 and 0.9."""
    scenes = 200
    unary = torch.randn(scenes, 3, 6, dtype=torch.float64)
    pair = spread * torch.rand(scenes, 3, 6, 6, dtype=torch.float64)
    everyone = torch.ones(scenes, 3, dtype=torch.bool)
    exact, total = assignments.enumerate_(unary, pair, everyone)
    found, bethe = assignments.sum_product(unary, pair, everyone, iterations=30)
    error = (found.exp() - exact.exp()).abs().flatten(1).amax(1)
    assert error.max() < worst
    assert error.median() < typical
    assert (bethe - total).abs().max() < worst_log_z
    torch.testing.assert_close(found.exp().sum(-1), torch.ones(scenes, 3, dtype=torch.float64))


@pytest.mark.parametrize("method", ["exact", "messages"])
def test_gradients_of_log_z_are_minus_the_marginals(method):
    """d(-log p(k))/d unary = [k_i = k] - p(k_i), the analysis of every density of this form."""
    unary, pair, everyone = drawn(2, 3, 3)
    if method == "messages":
        pair = keep(pair, 3, [(0, 1), (1, 2)])
    find = assignments.enumerate_ if method == "exact" else assignments.sum_product
    unary.requires_grad_()
    chosen = torch.tensor([[[0, 2, 1]], [[1, 1, 0]]])
    log_marginals, log_partition = find(unary, pair, everyone)
    (assignments.energies(unary, pair, chosen)[:, 0] + log_partition).sum().backward()
    hot = torch.nn.functional.one_hot(chosen[:, 0], 3)
    torch.testing.assert_close(unary.grad, hot - log_marginals.detach().exp())


@pytest.mark.parametrize("find", [assignments.enumerate_, assignments.sum_product])
def test_derivatives_by_finite_differences(find):
    unary, pair, everyone = drawn(1, 3, 2)
    everyone[0, 1] = False
    given = unary.requires_grad_(), pair.requires_grad_()
    assert torch.autograd.gradcheck(lambda *tables: find(*tables, everyone)[1], given)
    # The marginals of absent agents are constants, and -inf is no number to subtract.
    assert torch.autograd.gradcheck(lambda *tables: find(*tables, everyone)[0].exp(), given)


@pytest.mark.parametrize("find", [assignments.enumerate_, assignments.sum_product])
def test_impossible_assignments_have_a_gradient_of_zero(find):
    unary, pair, everyone = drawn(2, 3, 3)
    unary[0, 0, 1] = INF
    pair[0, 1, :, 2] = INF  # nothing of agent 0 goes with agent 2's last candidate
    unary, pair = unary.requires_grad_(), pair.requires_grad_()
    log_marginals, log_partition = find(unary, pair, everyone)
    assert log_marginals[0, 0, 1] == log_marginals[0, 2, 2] == -INF
    (log_partition.sum() + log_marginals[:, :, 0].sum()).backward()
    assert unary.grad.isfinite().all()
    assert pair.grad.isfinite().all()
    assert unary.grad[0, 0, 1] == 0
    assert unary.grad[1, 0, 1] != 0
    assert (pair.grad[0, 1, :, 2] == 0).all()


@pytest.mark.parametrize("find", [assignments.enumerate_, assignments.sum_product])
def test_scenes_without_a_possible_assignment_are_marked(find):
    unary, pair, everyone = drawn(2, 3, 2)
    pair[0, 0] = INF
    unary.requires_grad_()
    _, log_partition = find(unary, pair, everyone)
    assert log_partition[0] == -INF
    assert log_partition[1].isfinite()
    torch.where(log_partition.isfinite(), log_partition, 0.0).sum().backward()
    assert unary.grad.isfinite().all()


@pytest.mark.parametrize("find", [assignments.enumerate_, assignments.sum_product])
def test_absent_agents_take_their_first_candidate(find):
    unary, pair, everyone = drawn(2, 2, 3)
    wide, wide_pair = (
        torch.full((2, 4, 3), NAN, dtype=torch.float64),
        torch.full((2, 6, 3, 3), NAN, dtype=torch.float64),
    )
    present = torch.tensor([[False, True, False, True]]).expand(2, 4)
    wide[:, present[0]] = unary
    first, second = pairs(4)
    wide_pair[:, (first == 1) & (second == 3)] = pair
    wide.requires_grad_()
    wide_pair.requires_grad_()
    log_marginals, log_partition = find(wide, wide_pair, present)
    alone, total = find(unary, pair, everyone)
    torch.testing.assert_close(log_partition, total)
    torch.testing.assert_close(log_marginals[:, present[0]], alone)
    assert torch.equal(log_marginals[:, 0], torch.tensor([0.0, -INF, -INF], dtype=torch.float64).expand(2, 3))
    log_partition.sum().backward()
    assert wide.grad.isfinite().all()
    assert wide_pair.grad.isfinite().all()
    assert (wide.grad[:, ~present[0]] == 0).all()
    chosen, energy = assignments.best(wide, wide_pair, present, 4)
    reference, lowest = assignments.best(unary, pair, everyone, 4)
    assert torch.equal(chosen[..., present[0]], reference)
    assert (chosen[..., ~present[0]] == 0).all()
    torch.testing.assert_close(energy, lowest)


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 4), st.integers(1, 12))
def test_the_best_assignments_equal_those_of_a_sorted_list(seed, agents, count, modes):
    torch.manual_seed(seed)
    unary, pair, everyone = drawn(2, agents, count)
    unary, pair = forbid(unary, pair)
    chosen, energy = assignments.best(unary, pair, everyone, modes)
    for scene in range(2):
        ranked = sorted(listed(unary[scene], pair[scene]))
        ranked = [entry for entry in ranked if entry[0] < INF]
        for mode in range(modes):
            lowest, choice = ranked[mode % len(ranked)]
            assert energy[scene, mode].item() == pytest.approx(lowest)
            assert tuple(chosen[scene, mode].tolist()) == choice


def test_more_modes_than_the_beam_keeps_are_all_different():
    unary, pair, everyone = drawn(1, 2, 20)
    _, energy = assignments.best(unary, pair, everyone, assignments.BEAM + 50)
    ranked = sorted(entry[0] for entry in listed(unary[0], pair[0]))
    assert energy[0].tolist() == pytest.approx(ranked[: assignments.BEAM + 50])


def test_distinct_modes_equal_those_of_a_plain_loop():
    scenes, agents, count, modes, apart = 4, 3, 3, 7, 1.3
    unary, pair, everyone = drawn(scenes, agents, count)
    everyone[0, 1] = False
    states = torch.randn(scenes, count, agents, 5, 4, dtype=torch.float64)
    states[0, :, 1] = NAN
    chosen, _ = assignments.best(unary, pair, everyone, modes, states, apart)
    settled = assignments.settle(unary, pair, everyone)
    filled_up = 0
    for scene in range(scenes):
        present = everyone[scene].nonzero()[:, 0].tolist()

        def distance(one, other, scene=scene, present=present):
            ways = [
                (states[scene, one[i], i, :, :2] - states[scene, other[i], i, :, :2]).norm(dim=-1).mean()
                for i in present
            ]
            return sum(ways) / len(ways)

        left = [choice for energy, choice in sorted(listed(settled[0][scene], settled[1][scene])) if energy < INF]
        picked: list[tuple[int, ...]] = []
        for mode in range(modes):
            far = [choice for choice in left if all(distance(choice, other) >= apart for other in picked)]
            filled_up += not far
            picked.append((far or left)[0])
            left.remove(picked[-1])
            assert tuple(chosen[scene, mode].tolist()) == picked[-1]
    assert 0 < filled_up < scenes * (modes - 1), "both rules are tried"
    # Fewer assignments than modes begin anew.
    few, _ = assignments.best(unary[:1, :1, :2], pair[:1, :0, :2, :2], everyone[:1, :1], 5, states[:1, :2, :1], apart)
    assert few[0, :, 0].tolist() == [few[0, 0, 0], 1 - few[0, 0, 0]] * 2 + [few[0, 0, 0]]


def test_the_beam_finds_the_best_of_small_problems(monkeypatch):
    unary, pair, everyone = drawn(20, 4, 5)
    unary, pair = forbid(unary, pair)
    exact, lowest = assignments.best(unary, pair, everyone, 4)
    monkeypatch.setattr(assignments, "LIMIT", 1)
    found, energy = assignments.best(unary, pair, everyone, 4)
    assert torch.equal(found, exact), "625 assignments, of which 125 are never more than a beam holds"
    torch.testing.assert_close(energy, lowest)
    monkeypatch.setattr(assignments, "BEAM", 8)
    _, energy = assignments.best(unary, pair, everyone, 4)
    assert (energy >= lowest[:, :1] - 1e-9).all()
    assert (energy[:, 0] == lowest[:, 0]).double().mean() >= 0.5


def test_large_problems_are_searched_and_summed():
    unary, pair, everyone = drawn(3, 9, 8)
    chosen, energy = assignments.best(unary, pair, everyone, 5)
    torch.testing.assert_close(energy, assignments.energies(unary, pair, chosen))
    assert (energy.diff(dim=1) >= 0).all()
    assert all(len({tuple(row) for row in modes.tolist()}) == 5 for modes in chosen)
    # No agent alone gains by another choice: what every good joint choice has to fulfil.
    for agent, candidate in itertools.product(range(9), range(8)):
        other = chosen[:, :1].clone()
        other[..., agent] = candidate
        assert (assignments.energies(unary, pair, other) >= energy[:, :1] - 1e-9).all()
    log_marginals, log_partition = assignments.partition(unary, pair, everyone)
    assert (log_partition > -energy[:, 0]).all(), "a sum is more than its largest part"
    torch.testing.assert_close(log_marginals.exp().sum(-1), torch.ones(3, 9, dtype=torch.float64))


@pytest.mark.parametrize("agents", [3, 8])
def test_scenes_are_independent(agents):
    unary, pair, everyone = drawn(4, agents, 4)
    everyone[1, 2] = False
    results = [*assignments.partition(unary, pair, everyone), *assignments.best(unary, pair, everyone, 3)]
    for scene in range(4):
        alone = unary[scene : scene + 1], pair[scene : scene + 1], everyone[scene : scene + 1]
        again = [*assignments.partition(*alone), *assignments.best(*alone, 3)]
        for whole, part in zip(results, again, strict=True):
            torch.testing.assert_close(whole[scene : scene + 1], part)


def test_single_precision_and_large_energies():
    unary, pair, everyone = (table.float() if table.is_floating_point() else table for table in drawn(2, 3, 4))
    unary = unary + 1e4
    log_marginals, log_partition = assignments.enumerate_(unary, pair, everyone)
    found, bethe = assignments.sum_product(unary, 0.0 * pair, everyone)
    assert log_partition.dtype == bethe.dtype == torch.float32
    assert log_marginals.isfinite().all()
    torch.testing.assert_close(found.exp(), (-unary).softmax(-1), rtol=1e-3, atol=1e-5)


def test_modes_may_be_exactly_as_far_apart_as_asked():
    """One agent with candidates at 0, 0.5, 1 and 3 m, the cheapest first."""
    unary = torch.arange(4.0)[None, None]
    states = torch.zeros(1, 4, 1, 2, 4)
    states[0, :, 0, :, 0] = torch.tensor([0.0, 0.5, 1.0, 3.0])[:, None]
    pair, everyone = torch.zeros(1, 0, 4, 4), torch.ones(1, 1, dtype=torch.bool)
    for apart, expected in ((1.0, [0, 2, 3]), (0.5, [0, 1, 2]), (1.01, [0, 3, 1])):
        found, _ = assignments.best(unary, pair, everyone, 3, states, apart)
        assert found[0, :, 0].tolist() == expected
