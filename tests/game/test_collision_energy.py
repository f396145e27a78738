"""DSDNet's energy: collisions against a loop in plain arithmetic and against the metric that counts overlaps."""

from __future__ import annotations

import dataclasses
import math
import time

import pytest
import torch
from games import highway_scene, random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.forecast import GameParameters
from epo_lightning.game.collision_energy import CollisionEnergy
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.metrics.functional.overlap import overlapping_pairs
from epo_lightning.registry import ConfigError

WIDTH, HORIZON = 3, 4
SIZES = ((1.6, 0.7), (0.5, 0.5), (3.6, 1.9), (4.0, 1.8), (4.7, 1.9), (8.0, 2.3), (11.0, 2.5))
"""Length and width of agents whose circles cover their boxes."""


def drawn(shape, agents=4, scenes=4, modes=3, dtype=torch.float64):
    """Vehicles of all sizes in a small area, with long steps."""
    scene = dataclasses.replace(random_scene(scenes, agents, history=2, dtype=dtype), dt=1.0)
    scene.history[..., :2] *= 5.0
    scene.size.copy_(torch.tensor(SIZES, dtype=dtype)[torch.randint(len(SIZES), (scenes, agents))])
    game = random_game(scene, modes, HORIZON, own=(), spread=1.0)
    context = torch.randn(scenes, agents, WIDTH, dtype=dtype)
    energy = CollisionEnergy(Unicycle(), WIDTH, HORIZON, 2.0, shape, gamma=7.0, hidden=5).to(dtype)
    return energy, scene, dataclasses.replace(game, context=context, pair_weights={}, goals=None, reference=None)


def circles_of(state, size, shape):
    (x, y, heading), (length, width) = state[:3], size
    if shape == "disc":
        return [(x, y)], length / 2
    end = (length - width) / 2
    along = [-end, end] if length < 4 else [-end, 0.0, end] if length < 8 else [-end, -end / 2, 0.0, end / 2, end]
    return [(x + a * math.cos(heading), y + a * math.sin(heading)) for a in along], width / math.sqrt(2)


def collide(first, second, first_size, second_size, shape):
    for one, other in zip(first, second, strict=True):
        (ours, r), (theirs, s) = circles_of(one, first_size, shape), circles_of(other, second_size, shape)
        if any(math.dist(a, b) < r + s for a in ours for b in theirs):
            return True
    return False


@settings(max_examples=10)
@given(shape=st.sampled_from(["disc", "box"]), seed=st.integers(0, 1000))
def test_collisions_equal_a_loop_over_circles(shape, seed):
    torch.manual_seed(seed)
    energy, scene, game = drawn(shape, agents=3, scenes=2)
    states = energy.dynamics.rollout(energy.current_states(scene), game.initial_controls, scene.dt)
    terms = energy.terms(scene, game, game.initial_controls)["collision"]
    one_game = dataclasses.replace(game, initial_controls=game.initial_controls[:, :1])
    _, table = energy.tables(scene, one_game, game.initial_controls)
    for b in range(2):
        for p, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            sizes = scene.size[b, i].tolist(), scene.size[b, j].tolist()
            for k in range(3):
                for m in range(3):
                    expected = collide(states[b, k, i].tolist(), states[b, m, j].tolist(), *sizes, shape)
                    assert table[b, p, k, m] == 7.0 * expected
                assert terms[b, k, p] == table[b, p, k, k]


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_collisions_are_the_overlaps_of_the_metric(shape):
    """Discs are the metric's own; rows of circles cover the metric's boxes, so that they miss no overlap."""
    energy, scene, game = drawn(shape, scenes=40)
    states = energy.dynamics.rollout(energy.current_states(scene), game.initial_controls, scene.dt)
    found = energy.terms(scene, game, game.initial_controls)["collision"] > 0
    counted = torch.stack(
        [overlapping_pairs(states[:, m], scene.size, scene.agent_mask, shape) for m in range(states.shape[1])], 1
    )
    assert 0.1 < counted.float().mean() < 0.9
    if shape == "disc":
        assert (found == counted).all()
    else:
        assert found[counted].all()
        assert (found == counted).float().mean() > 0.9


def test_touching_agents_do_not_collide():
    for shape in ("disc", "box"):
        energy, scene, game = drawn(shape, agents=2, scenes=1, modes=1)
        scene.history[:], scene.size[:] = 0.0, 2.0
        controls = torch.zeros(1, 1, 2, HORIZON, 2, dtype=torch.float64)
        reach = 2.0 if shape == "disc" else math.sqrt(8.0)
        for apart, expected in ((reach, 0.0), (reach - 1e-6, 7.0)):
            scene.history[0, 1, :, 0] = apart
            assert energy.terms(scene, game, controls)["collision"].item() == expected


def test_the_network_reads_only_waypoints():
    """Straight motion at constant speed: positions, no turn, and the distance travelled."""
    energy, scene, game = drawn("disc", agents=1, scenes=1, modes=1)
    assert energy.waypoints == [0, 1, 2, 3]
    assert CollisionEnergy(Unicycle(), WIDTH, 20, 1.0, "disc").waypoints == [3, 7, 11, 15, 19]
    scene.history[..., 3] = 4.0
    seen = []
    energy.layers.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[1]))
    controls = torch.zeros(1, 1, 1, HORIZON, 2, dtype=torch.float64)
    energy(scene, game, controls)
    expected = torch.tensor([[2.0 * k, 0.0, 1.0, 0.0, 2.0 * k] for k in range(1, 5)], dtype=torch.float64)
    torch.testing.assert_close(seen[0].view(4, 5), expected, rtol=0, atol=1e-12)
    controls[..., 1] = math.pi / 2  # a square: ahead, left, back, right
    energy(scene, game, controls)
    expected = torch.tensor([[2, 0, 0, 1, 2], [2, 2, -1, 0, 4], [0, 2, 0, -1, 6], [0, 0, 1, 0, 8]], dtype=torch.float64)
    torch.testing.assert_close(seen[1].view(4, 5), expected, rtol=0, atol=1e-12)


def test_the_network_is_learned_also_from_candidates_that_stand_still():
    energy, scene, game = drawn("box", scenes=1)
    context = game.context.clone().requires_grad_()
    scene.history[..., 3] = 0.0
    candidates = torch.zeros(1, 2, 4, HORIZON, 2, dtype=torch.float64, requires_grad=True)
    unary, pair = energy.tables(scene, dataclasses.replace(game, context=context), candidates)
    (unary.sum() + pair.sum()).backward()
    assert candidates.grad.isfinite().all()
    assert (context.grad != 0).any(-1).all()
    assert all(parameter.grad.abs().max() > 0 for parameter in energy.parameters())


def test_a_hundred_candidates_of_four_agents_take_less_than_a_second_each_scene():
    """Pairs of candidates are 60 000 in a scene; going through them one by one would take minutes."""
    scene = highway_scene(4, horizon=20)
    energy = CollisionEnergy(Unicycle(), WIDTH, 20, 20.0, "disc")
    game = GameParameters({}, {}, torch.zeros(4, 1, 4, 20, 2), context=torch.randn(4, 4, WIDTH))
    start = time.perf_counter()
    with torch.no_grad():
        _, pair = energy.tables(scene, game, torch.randn(4, 100, 4, 20, 2))
    assert time.perf_counter() - start < 4.0
    assert pair.shape == (4, 6, 100, 100)


def test_bad_settings_are_refused():
    for settings_, message in (
        ({"shape": "bxo"}, "unknown shape 'bxo' of agents: did you mean 'box'"),
        ({"shape": "box", "gamma": 0.0}, "energy.gamma must be a number, positive, and finite, not 0.0"),
        ({"shape": "box", "gamma": float("nan")}, "energy.gamma must be a number, positive, and finite, not nan"),
        ({"shape": "box", "waypoints": 0}, "waypoints must be a whole number, 1 or more, not 0"),
        ({"shape": "box", "hidden": 0}, "energy.hidden must be a whole number, 1 or more, not 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            CollisionEnergy(Unicycle(), WIDTH, HORIZON, 1.0, **settings_)
    energy, scene, game = drawn("box")
    with pytest.raises(ValueError, match=r"scene\.size \[B, N, 2\], which is None"):
        energy.validate(dataclasses.replace(scene, size=None), game, game.initial_controls)
