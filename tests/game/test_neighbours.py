"""Choice of the pairs that interact."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from games import pad, random_scene

from epo_lightning.game.neighbours import closest_approach, group_sizes, grouped, nearest, within
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import Scene


def crowd(scenes: int = 3, agents: int = 7) -> Scene:
    torch.manual_seed(0)
    scene = random_scene(scenes, agents, dtype=torch.float64)
    scene.history[..., :2] *= 10.0
    return scene


def test_the_closest_approach_is_the_least_gap_of_many_moments():
    scene = crowd()
    found, ahead = closest_approach(scene, 4.0), torch.linspace(0.0, 4.0, 4001, dtype=torch.float64)
    current = scene.current
    velocity = current[..., 3:] * torch.stack((current[..., 2].cos(), current[..., 2].sin()), -1)
    path = current[..., None, :2] + ahead[:, None] * velocity[..., None, :]
    for pair, (i, j) in enumerate(itertools.combinations(range(7), 2)):
        gap = (path[:, i] - path[:, j]).norm(dim=-1).amin(-1) - scene.size[:, i, 0] / 2 - scene.size[:, j, 0] / 2
        torch.testing.assert_close(found[:, pair], gap, rtol=0, atol=2e-3)


def test_without_time_ahead_it_is_the_present_gap_and_parallel_agents_keep_theirs():
    current = torch.tensor([[[0.0, 0.0, 0.3, 5.0], [3.0, 4.0, 0.3, 5.0]]])
    scene = Scene(current[:, :, None], dt=0.1, size=torch.ones(1, 2, 2))
    assert closest_approach(scene, 0.0).item() == pytest.approx(4.0)
    assert closest_approach(scene, 5.0).item() == pytest.approx(4.0)
    assert closest_approach(dataclasses.replace(scene, size=None), 5.0).item() == pytest.approx(5.0)


def test_absent_agents_have_no_neighbours_and_change_none():
    scene = crowd()
    padded = pad(scene, agents=2, steps=0, filling=float("nan"))
    distance, wider = closest_approach(scene, 4.0), closest_approach(padded, 4.0)
    _, second = pairs(9)
    real = second < 7
    assert torch.equal(wider[:, real], distance)
    assert (wider[:, ~real] == torch.inf).all()
    for most in (3, 9):
        one, other = nearest(distance, 7, 2), nearest(wider, 9, 2)
        assert torch.equal(grouped(other, wider, 9, most)[:, real], grouped(one, distance, 7, most))
        assert not other[:, ~real].any()


@pytest.mark.parametrize("count", [1, 2, 6, 20])
def test_every_agent_has_its_nearest_ones(count):
    distance = closest_approach(crowd(), 4.0)
    chosen = nearest(distance, 7, count)
    table = torch.full((3, 7, 7), torch.inf, dtype=torch.float64)
    for pair, (i, j) in enumerate(itertools.combinations(range(7), 2)):
        table[:, i, j] = table[:, j, i] = distance[:, pair]
    limit = table.sort(-1).values[:, :, min(count, 6) - 1]
    for pair, (i, j) in enumerate(itertools.combinations(range(7), 2)):
        assert torch.equal(chosen[:, pair], (table[:, i, j] <= limit[:, i]) | (table[:, i, j] <= limit[:, j]))
    assert (chosen.sum(1) <= 7 * count).all()


def test_within_takes_pairs_up_to_a_distance():
    distance = torch.tensor([[-1.0, 2.0, torch.inf]])
    assert within(distance, 2.0).tolist() == [[True, True, False]]


@pytest.mark.parametrize("most", [2, 3, 5, 7])
def test_groups_are_limited_and_the_nearest_pairs_come_first(most):
    distance = closest_approach(crowd(), 4.0)
    chosen = within(distance, 10.0)
    kept = grouped(chosen, distance, 7, most)
    assert not (kept & ~chosen).any()
    sizes = group_sizes(kept, 7)
    assert all(sum(row) == 7 and max(row) <= most for row in sizes)
    if most == 7:
        assert torch.equal(kept, chosen)
    for row in range(3):
        if chosen[row].any():
            assert kept[row, torch.where(chosen[row], distance[row], torch.inf).argmin()]


def test_a_pair_that_closes_a_chain_within_a_group_stays():
    distance = torch.tensor([[1.0, 3.0, 9.0, 2.0, 9.0, 4.0]])  # 0-1, 0-2, 0-3, 1-2, 1-3, 2-3
    kept = grouped(torch.ones(1, 6, dtype=torch.bool), distance, 4, 3)
    assert kept.tolist() == [[True, True, False, True, False, False]]
    assert group_sizes(kept, 4) == [[3, 1]]
