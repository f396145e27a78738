"""Orders of pairs: the most likely ones against full enumeration, permuted agents, and observed orders."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from games import pad, random_scene, reordered
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.decoders.orders import Orders, most_likely, order_loss, repeated
from epo_lightning.game.convex_energy import ConvexEnergy
from epo_lightning.scene import Scene


@settings(max_examples=40)
@given(count=st.integers(0, 7), modes=st.integers(1, 12), ties=st.booleans(), seed=st.integers(0, 1000))
def test_the_most_likely_orders_equal_those_of_full_enumeration(count, modes, ties, seed):
    torch.manual_seed(seed)
    logits = torch.randn(3, count, dtype=torch.float64)
    logits = logits.round() if ties else logits
    present = torch.rand(3, count) < 0.7
    order = most_likely(logits, present, modes)
    assert order.shape == (3, modes, count)
    for scene in range(3):
        exist = present[scene].nonzero()[:, 0].tolist()
        scores = {}
        for signs in itertools.product((1.0, -1.0), repeat=len(exist)):
            pattern = torch.ones(count, dtype=torch.float64)
            pattern[exist] = torch.tensor(signs, dtype=torch.float64)
            scores[tuple(pattern.tolist())] = (pattern * logits[scene])[exist].sigmoid().log().sum().item()
        best = sorted(scores.values(), reverse=True)[:modes]
        found = [tuple(one.tolist()) for one in order[scene]]
        distinct = found[: len(best)]
        assert len(set(distinct)) == len(distinct)
        assert [scores[one] for one in distinct] == pytest.approx(best, abs=1e-12)
        assert found == [distinct[m % len(distinct)] for m in range(modes)]


def all_pairs(mask: torch.Tensor) -> torch.Tensor:
    agents = mask.shape[1]
    return torch.ones(len(mask), agents * (agents - 1) // 2, dtype=torch.bool)


def decoder(symmetric: bool, modes: int = 3) -> Orders:
    made = Orders(8, modes, symmetric).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(torch.randn_like(parameter))
    return made


@pytest.mark.parametrize("symmetric", [False, True])
def test_orders_are_equivariant_to_the_order_of_agents(symmetric):
    orders, z, mask = decoder(symmetric), torch.randn(2, 4, 8, dtype=torch.float64), torch.ones(2, 4, dtype=torch.bool)
    names = [2, 0, 3, 1]
    _, scores, logits = orders(z, mask, all_pairs(mask))
    _, again, renamed = orders(z[:, names], mask, all_pairs(mask))
    matrix = torch.zeros(2, 4, 4, dtype=torch.float64)
    first, second = torch.triu_indices(4, 4, 1)
    matrix[:, first, second] = logits
    matrix[:, second, first] = logits if symmetric else -logits
    expected = matrix[:, names][:, :, names][:, first, second]
    torch.testing.assert_close(renamed, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(again, scores, rtol=0, atol=1e-12)


def test_absent_agents_do_not_change_orders():
    orders, z = decoder(False), torch.randn(2, 3, 8, dtype=torch.float64)
    mask = torch.ones(2, 3, dtype=torch.bool)
    order, scores, logits = orders(z, mask, all_pairs(mask))
    wide = torch.cat((z, torch.full_like(z[:, :1], torch.nan)), 1).requires_grad_()
    absent = torch.cat((mask, torch.zeros_like(mask[:, :1])), 1)
    padded, again, more = orders(wide, absent, all_pairs(absent))
    _, second = torch.triu_indices(4, 4, 1)
    real = second < 3
    assert torch.equal(padded[:, :, real], order)
    assert (padded[:, :, ~real] == 1).all()
    assert (more[:, ~real] == 0).all()
    torch.testing.assert_close(more[:, real], logits, rtol=0, atol=1e-12)
    torch.testing.assert_close(again, scores, rtol=0, atol=1e-12)
    again[:, 0].sum().backward()
    assert wide.grad.isfinite().all()
    assert (wide.grad[:, :3] != 0).any()


def test_log_probabilities_are_those_of_independent_pairs():
    orders = decoder(False, modes=4)
    z, mask = torch.randn(2, 3, 8, dtype=torch.float64), torch.ones(2, 3, dtype=torch.bool)
    order, scores, logits = orders(z, mask, all_pairs(mask))
    joint = (order * logits[:, None]).sigmoid().prod(-1)
    torch.testing.assert_close(scores.exp(), joint, rtol=1e-12, atol=0)
    assert (scores.diff(dim=-1) <= 0).all()


def test_distant_pairs_are_not_varied_scored_or_learned():
    orders, z = decoder(False, modes=4), torch.randn(1, 3, 8, dtype=torch.float64, requires_grad=True)
    mask, matter = torch.ones(1, 3, dtype=torch.bool), torch.tensor([[True, False, False]])
    order, scores, logits = orders(z, mask, matter)
    assert order[0, :, 0].tolist() in ([1.0, -1.0, 1.0, -1.0], [-1.0, 1.0, -1.0, 1.0])
    assert (order[..., 1:] == 1).all()
    assert (logits[:, 1:] == 0).all()
    torch.testing.assert_close(scores[:, :2].exp().sum(), torch.ones((), dtype=torch.float64))
    (scores[:, 0].sum() + logits.sum()).backward()
    assert (z.grad[0, :2] != 0).any(1).all()
    assert (z.grad[0, 2] == 0).all()


def test_a_single_agent_has_one_empty_order():
    mask = torch.ones(2, 1, dtype=torch.bool)
    order, scores, logits = Orders(8, 3)(torch.randn(2, 1, 8), mask, all_pairs(mask))
    assert order.shape == (2, 3, 0)
    assert logits.shape == (2, 0)
    assert (scores == 0).all()
    assert repeated(order).tolist() == [[False, True, True]] * 2


@settings(max_examples=40)
@given(modes=st.integers(1, 6), width=st.integers(0, 3), seed=st.integers(0, 1000))
def test_surplus_modes_repeat_earlier_orders(modes, width, seed):
    torch.manual_seed(seed)
    rows = torch.randint(2, (3, modes, width))
    for found, row in zip(repeated(rows).tolist(), rows.tolist(), strict=True):
        assert found == [mode in row[:number] for number, mode in enumerate(row)]


def crossing(future: list[list[tuple[float, float]]], speeds=(1.0, 1.0), headings=(0.0, 0.0)) -> Scene:
    positions = torch.tensor(future, dtype=torch.float64)[None]
    current = torch.tensor(
        [[x[0], x[1], h, v] for x, h, v in zip(((0.0, 0.0), (0.0, 3.0)), headings, speeds, strict=True)]
    )
    return Scene(
        history=current[None, :, None].double(),
        dt=1.0,
        future=torch.cat((positions, torch.zeros_like(positions)), -1),
        size=torch.ones(1, 2, 2, dtype=torch.float64),
    )


def test_the_observed_order_is_that_of_the_last_positions():
    energy = ConvexEnergy(["acc", "lat_acc"], direction="along")
    # The second one overtakes: behind at first, and in the end too where only then both are seen.
    scene = crossing([[(1.0, 0.0), (2.0, 0.0), (3.0, 0.0)], [(0.5, 3.0), (1.9, 1.0), (6.0, 1.0)]])
    order, known = energy.pair_order.observed(scene)
    assert order.tolist() == [[-1.0]]
    assert known.all()
    unseen = dataclasses.replace(scene, future_mask=torch.tensor([[[True, True, True], [True, True, False]]]))
    assert energy.pair_order.observed(unseen)[0].tolist() == [[1.0]]
    apart = dataclasses.replace(scene, future_mask=torch.tensor([[[True, False, False], [False, True, True]]]))
    assert not energy.pair_order.observed(apart)[1].any()
    with pytest.raises(ValueError, match=r"scene\.future"):
        energy.pair_order.observed(dataclasses.replace(scene, future=None, future_mask=None))


@pytest.mark.parametrize("slip", [-0.2, 0.2])
def test_the_order_of_overtaking_ignores_positions_side_by_side(slip):
    energy = ConvexEnergy(["acc", "lat_acc"], direction="along")
    scene = crossing([[(1.0, 0.0), (2.0, 0.0), (3.0, 0.0)], [(-3.0, 3.0), (2.0 + slip, 3.0), (8.0, 3.0)]])
    assert energy.pair_order.observed(scene)[0].tolist() == [[-1.0]]


def test_pairs_that_are_never_near_have_no_order():
    scene = crossing([[(1.0, 0.0), (2.0, 0.0)], [(1.0, 3.0), (2.0, 3.0)]])
    for within, matters in ((2.9, False), (3.1, True)):
        energy = ConvexEnergy(["acc", "lat_acc"], within=within)
        assert energy.pair_order.matters(scene, 2).tolist() == [[matters]]
        order, known = energy.pair_order.observed(scene)
        assert known.tolist() == [[matters]]
        assert order_loss(torch.full_like(order, 2.0), order, known).item() == pytest.approx(
            matters * 0.126928, abs=1e-6
        )
        padded = energy.pair_order.matters(pad(scene, 1), 2)
        assert padded.tolist() == [[matters, False, False]]


def test_the_observed_passing_side_is_recognised():
    energy = ConvexEnergy(["acc", "lat_acc"], direction="across")
    # Oncoming along x; the first keeps left of the second as it drives, which thus is on its right.
    scene = crossing([[(1.0, 0.5), (2.0, 0.5)], [(3.0, -0.5), (2.0, -0.5)]], headings=(0.0, torch.pi))
    assert energy.pair_order.observed(scene)[0].tolist() == [[1.0]]
    assert energy.pair_order.observed(reordered(scene, [1, 0]))[0].tolist() == [[1.0]]
    mirrored = crossing([[(1.0, -0.5), (2.0, -0.5)], [(3.0, 0.5), (2.0, 0.5)]], headings=(0.0, torch.pi))
    assert energy.pair_order.observed(mirrored)[0].tolist() == [[-1.0]]
    # What counts is where they are closest: later the first one is on the other side.
    later = crossing(
        [[(1.0, 0.5), (2.0, 0.5), (9.0, -5.0)], [(3.0, -0.5), (2.0, -0.5), (-9.0, 5.0)]], headings=(0.0, torch.pi)
    )
    assert energy.pair_order.observed(later)[0].tolist() == [[1.0]]


@pytest.mark.parametrize("direction", ["along", "across"])
def test_observed_orders_of_padded_and_renamed_agents(direction):
    energy = ConvexEnergy(["acc", "lat_acc"], direction=direction)
    scene = random_scene(4, 3, horizon=5, history=2, dtype=torch.float64)
    order, known = energy.pair_order.observed(scene)
    padded, unknown = energy.pair_order.observed(pad(scene, 1))
    _, second = torch.triu_indices(4, 4, 1)
    assert torch.equal(padded[:, second < 3], order)
    assert torch.equal(unknown[:, second < 3], known)
    assert not unknown[:, second == 3].any()
    swapped, _ = energy.pair_order.observed(reordered(scene, [2, 1, 0]))
    sign = 1.0 if energy.pair_order.symmetric else -1.0
    assert torch.equal(swapped, sign * order[:, [2, 1, 0]])
    assert order.min() < order.max()


def test_the_loss_is_the_cross_entropy_of_known_pairs():
    logits = torch.tensor([[1.0, -2.0, torch.nan], [0.5, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    order = torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]], dtype=torch.float64)
    known = torch.tensor([[True, True, False], [False, False, False]])
    loss = order_loss(logits, order, known)
    expected = torch.nn.functional.binary_cross_entropy(logits[0, :2].detach().sigmoid(), torch.ones(2).double()) / 2
    torch.testing.assert_close(loss.detach(), expected)
    loss.backward()
    assert logits.grad.isfinite().all()
    assert (logits.grad[~known] == 0).all()
