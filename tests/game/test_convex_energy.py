"""The convex energy against loops over agents and steps; its convexity, its symmetries, and invalid settings."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
import yaml
from convex_games import OWN, convex_energy, convex_game, unaware, widen_convex
from games import pad, reordered
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.experiment.config.compose import tree
from epo_lightning.game.convex_energy import FLOOR, ConvexEnergy
from epo_lightning.game.double_integrator import DoubleIntegrator
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.registry import ConfigError, build
from epo_lightning.scene import Scene
from epo_lightning.solvers.general import dense
from epo_lightning.solvers.general.dense import gradient, hessian

DIRECTIONS = ("along", "across")


def unit(x, y):
    return x / math.hypot(x, y), y / math.hypot(x, y)


def by_loops(energy, scene, game, b, m):
    """The energy of one scene and mode, agent by agent and step by step."""
    agents, steps = game.initial_controls.shape[2:4]
    dt, total = scene.dt, 0.0
    places, now = [], scene.history[b, :, -1].tolist()
    for i in range(agents):
        x, y, theta, along = now[i]
        across = 0.0
        ahead, left = (math.cos(theta), math.sin(theta)), (-math.sin(theta), math.cos(theta))
        goal = game.goals[b, m, i].tolist()
        weight = {name: values[b, m, i].item() for name, values in game.own_weights.items()}
        squares = dict.fromkeys(OWN, 0.0)
        controls = game.initial_controls[b, m, i].tolist()
        path = []
        for k, (a, c) in enumerate(controls):
            x, y = x + dt * (along * ahead[0] + across * left[0]), y + dt * (along * ahead[1] + across * left[1])
            along, across = along + dt * a, across + dt * c
            path.append((x, y))
            squares["lateral"] += ((x - goal[0]) * left[0] + (y - goal[1]) * left[1]) ** 2
            squares["velref"] += (along - scene.reference_speed[b, i].item()) ** 2
            squares["lat_vel"] += across**2
            squares["acc"] += a**2
            squares["lat_acc"] += c**2
            if k:
                squares["jerk"] += ((a - controls[k - 1][0]) / dt) ** 2
                squares["lat_jerk"] += ((c - controls[k - 1][1]) / dt) ** 2
        squares["goal"] = (x - goal[0]) ** 2 + (y - goal[1]) ** 2
        for name in energy.own:
            factor = {"acc": 1.0, "lat_acc": weight["lat_acc"] ** 2 + FLOOR}.get(name, weight[name] ** 2)
            total += 0.5 * factor * squares[name]
        places.append(path)
    pair = 0
    for i in range(agents):
        for j in range(i + 1, agents):
            (xi, yi, ti, vi), (xj, yj, tj, vj) = now[i], now[j]
            velocity = [(v * math.cos(t), v * math.sin(t)) for v, t in ((vi, ti), (vj, tj))]
            if energy.direction == "along":
                n = unit(math.cos(ti) + math.cos(tj), math.sin(ti) + math.sin(tj))
            else:
                dx, dy = unit(velocity[0][0] - velocity[1][0], velocity[0][1] - velocity[1][1])
                n = -dy, dx
            keep = 0.5 * (scene.size[b, i, 0] + scene.size[b, j, 0]).item() + energy.gap
            for k in range(steps):
                t = (k + 1) * dt
                free = math.hypot(
                    xi + t * velocity[0][0] - xj - t * velocity[1][0], yi + t * velocity[0][1] - yj - t * velocity[1][1]
                )
                offsets = [(xi - xj, yi - yj), (game.goals[b, m, i] - game.goals[b, m, j]).tolist()]
                before, after = (n[0] * y - n[1] * x for x, y in offsets)
                beside = abs(before + (k + 1) / steps * (after - before))
                if free <= energy.within and (energy.lane is None or beside <= energy.lane):
                    (px, py), (qx, qy) = places[i][k], places[j][k]
                    ahead_by = game.order[b, m, pair].item() * (n[0] * (px - qx) + n[1] * (py - qy))
                    total += 0.5 * (game.pair_weights["order"][b, m, pair].item() * max(0.0, keep - ahead_by)) ** 2
            pair += 1
    return total


@pytest.mark.parametrize("lane", [None, 0.7])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_energy_equals_loops_over_agents_and_steps(direction, lane):
    scene, game = convex_game()
    energy = convex_energy(direction=direction, within=2.0, lane=lane)
    values = energy(scene, game, game.initial_controls)
    expected = [[by_loops(energy, scene, game, b, m) for m in range(2)] for b in range(2)]
    torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=0)
    near = energy.pair_order.near(scene, 6)
    assert near.any()
    assert not near.all()
    residuals = energy.residuals(scene, game, game.initial_controls)
    assert list(residuals) == [*OWN, "order"]
    halves = sum(0.5 * residual.square().sum((-1, -2)) for residual in residuals.values())
    torch.testing.assert_close(halves, values, rtol=1e-12, atol=0)


@settings(max_examples=25)
@given(
    direction=st.sampled_from(DIRECTIONS),
    agents=st.integers(1, 4),
    share=st.floats(0.05, 0.95),
    scale=st.sampled_from([0.0, 0.3, 10.0]),
    seed=st.integers(0, 1000),
)
def test_energies_are_convex_whatever_the_order(direction, agents, share, scale, seed):
    torch.manual_seed(seed)
    scene, game = convex_game(agents=agents, horizon=4)
    game = dataclasses.replace(game, own_weights={name: scale * w for name, w in game.own_weights.items()})
    energy = convex_energy(direction=direction)
    one, other = (3.0 * torch.randn_like(game.initial_controls) for _ in range(2))
    between = energy(scene, game, share * one + (1 - share) * other)
    chord = share * energy(scene, game, one) + (1 - share) * energy(scene, game, other)
    assert (between < chord).all()
    # Strictly: every control has a curvature.
    least = torch.linalg.eigvalsh(hessian(energy, scene, game, one).detach())[..., 0]
    assert (least > 0.999 * FLOOR).all()


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_energy_is_invariant_to_agents_order_and_frame(direction):
    scene, game = convex_game()
    energy = convex_energy(direction=direction)
    value = energy(scene, game, game.initial_controls)
    names = [2, 1, 0]
    renamed = dataclasses.replace(
        game,
        own_weights={name: weight[..., names] for name, weight in game.own_weights.items()},
        pair_weights={name: weight[..., names] for name, weight in game.pair_weights.items()},  # (1, 2), (0, 2), (0, 1)
        order=(1.0 if energy.pair_order.symmetric else -1.0) * game.order[..., names],
        goals=game.goals[:, :, names],
        initial_controls=game.initial_controls[:, :, names],
    )
    again = energy(reordered(scene, names), renamed, renamed.initial_controls)
    torch.testing.assert_close(again, value, rtol=1e-12, atol=0)

    angle, shift = torch.tensor(0.8, dtype=torch.float64), torch.tensor([5.0, -3.0], dtype=torch.float64)
    turn = torch.stack((torch.stack((angle.cos(), angle.sin())), torch.stack((-angle.sin(), angle.cos()))))
    moved = scene.history.clone()
    moved[..., :2] = moved[..., :2] @ turn + shift
    moved[..., 2] += angle
    turned = dataclasses.replace(game, goals=game.goals @ turn + shift)
    there = energy(dataclasses.replace(scene, history=moved), turned, game.initial_controls)
    torch.testing.assert_close(there, value, rtol=1e-11, atol=0)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_absent_agents_do_not_change_the_energy(direction):
    scene, game = convex_game()
    energy = convex_energy(direction=direction)
    value, slope = gradient(energy, scene, game, game.initial_controls)
    wide = widen_convex(game, 2)
    again, more = gradient(energy, pad(scene, 2), wide, wide.initial_controls)
    torch.testing.assert_close(again, value, rtol=1e-13, atol=0)
    torch.testing.assert_close(more[:, :, :3], slope, rtol=0, atol=1e-12)
    assert (more[:, :, 3:] == 0).all()
    matrix = hessian(energy, pad(scene, 2), wide, wide.initial_controls)
    assert matrix.isfinite().all()


@settings(max_examples=25)
@given(
    direction=st.sampled_from(DIRECTIONS),
    agents=st.integers(1, 4),
    own=st.sets(st.sampled_from(OWN)),
    pair=st.sampled_from([("order",), ()]),
    modes=st.integers(1, 2),
    shared=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_curvatures_in_closed_form_equal_automatic_ones(direction, agents, own, pair, modes, shared, seed):
    torch.manual_seed(seed)
    scene, game = convex_game(agents=agents, modes=1 if shared else modes)  # or one game for all modes
    present = torch.rand(scene.agent_mask.shape) < 0.7
    nobody = ~present[:, None, :, None, None]
    controls = torch.where(nobody, torch.nan, torch.randn(2, modes, agents, 6, 2, dtype=torch.float64))
    scene = dataclasses.replace(scene, agent_mask=present)
    energy = convex_energy([*own | {"acc", "lat_acc"}], direction, pair=pair)
    expected = hessian(unaware(energy), scene, game, controls)
    torch.testing.assert_close(hessian(energy, scene, game, controls), expected, rtol=1e-12, atol=1e-10)
    by_residuals = dense.gauss_newton(unaware(energy), scene, game, controls)
    torch.testing.assert_close(dense.gauss_newton(energy, scene, game, controls), by_residuals, rtol=1e-12, atol=1e-10)
    alone = hessian(energy, scene[1], game[1], controls[1:])
    torch.testing.assert_close(alone, expected[1:], rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_curvatures_have_active_hinges_and_are_differentiable_by_every_weight(direction):
    scene, game = convex_game()
    energy = convex_energy(direction=direction)
    short = energy.residuals(scene, game, game.initial_controls)["order"]
    assert (short > 0).any()
    assert (short == 0).any()
    shape = hessian(energy, scene, game, game.initial_controls).shape
    cotangent = torch.randn(shape, dtype=torch.float64)
    own, pair = energy.weighted
    for kind, name in [("own_weights", name) for name in own] + [("pair_weights", name) for name in pair]:

        def value(weights, kind=kind, name=name):
            changed = dataclasses.replace(game, **{kind: {**getattr(game, kind), name: weights}})
            return (cotangent * hessian(energy, scene, changed, game.initial_controls)).sum()

        weights = getattr(game, kind)[name].clone().requires_grad_()
        (slope,) = torch.autograd.grad(value(weights), weights)
        shift = torch.randn_like(weights)
        with torch.no_grad():
            numeric = (value(weights + 1e-5 * shift) - value(weights - 1e-5 * shift)) / 2e-5
        assert numeric != 0
        torch.testing.assert_close((slope * shift).sum(), numeric, rtol=1e-5, atol=1e-7)


def still(states) -> Scene:
    history = torch.tensor(states, dtype=torch.float64)[None, :, None]
    return Scene(history=history, dt=0.1, size=torch.ones(1, len(states), 2, dtype=torch.float64))


def test_directions_have_a_fallback_where_the_first_choice_vanishes():
    along, across = (convex_energy(["acc", "lat_acc"], direction) for direction in DIRECTIONS)

    def direction(energy, *states):
        return energy.pair_order.directions(still(states))[0, 0].tolist()

    # Oncoming: their line, the same for both.
    assert direction(along, (0, 0, 0, 1), (9, 0, math.pi, 1)) == pytest.approx([1, 0])
    assert direction(along, (9, 0, math.pi, 1), (0, 0, 0, 1)) == pytest.approx([1, 0])
    assert direction(along, (0, 9, -math.pi / 2, 1), (0, 0, math.pi / 2, 1)) == pytest.approx([0, 1])
    # Going the same way at the same speed: the line between them, turned to the left. At the same place: the y axis.
    assert direction(across, (3, 1, 0.3, 1), (1, 1, 0.3, 1)) == pytest.approx([0, 1])
    assert direction(across, (1, 1, 0.3, 1), (1, 1, 0.3, 1)) == pytest.approx([0, 1])
    # Standing agents have headings, and no velocity.
    assert direction(along, (0, 0, 1.0, 0), (1, 0, 1.0, 0)) == pytest.approx([math.cos(1.0), math.sin(1.0)])
    assert direction(across, (0, 2, 1.0, 0), (0, 0, 2.0, 0)) == pytest.approx([-1, 0])


def test_orders_of_distant_agents_have_no_effect():
    scene, game = convex_game()
    energy = convex_energy(within=1e-6)
    assert (energy.terms(scene, game, game.initial_controls)["order"] == 0).all()
    assert (convex_energy(within=1e6).terms(scene, game, game.initial_controls)["order"] > 0).any()


def test_candidates_of_one_game_add_up():
    scene, game = convex_game(modes=1)
    energy = convex_energy()
    candidates = torch.randn(2, 4, 3, 6, 2, dtype=torch.float64)
    unary, pair = energy.tables(scene, game, candidates)
    chosen = torch.stack((candidates[:, 2, 0], candidates[:, 0, 1], candidates[:, 3, 2]), 1)[:, None]
    total = unary[:, 0, 2] + unary[:, 1, 0] + unary[:, 2, 3] + pair[:, 0, 2, 0] + pair[:, 1, 2, 3] + pair[:, 2, 0, 3]
    torch.testing.assert_close(total[:, None], energy(scene, game, chosen), rtol=1e-12, atol=0)


def test_the_order_counts_from_the_merge_on():
    """A vehicle beside another one is in its lane, 3.5 m away, when the last 2.5 m of the change begin."""
    scene, game = convex_game(1, 2, 1, 10)
    place = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 3.5, 0.0, 0.0]], dtype=torch.float64)
    scene = dataclasses.replace(scene, history=place[None, :, None].expand(1, 2, 2, 4))
    goals = torch.tensor([[9.0, 0.0], [20.0, 0.0]], dtype=torch.float64)
    game = dataclasses.replace(game, goals=goals[None, None], initial_controls=torch.zeros_like(game.initial_controls))
    found = {}
    for lane in (None, 2.5):
        order = convex_energy(lane=lane).residuals(scene, game, game.initial_controls)["order"]
        found[lane] = (order[0, 0, 0] != 0).tolist()
    assert found == {None: [True] * 10, 2.5: [False] * 2 + [True] * 8}


def test_the_weight_of_accelerations_is_not_decoded():
    energy = convex_energy()
    assert "acc" not in energy.weighted[0]
    assert {"acc", *energy.weighted[0]} == set(OWN)
    scene, game = convex_game()
    without = {name: weight for name, weight in game.own_weights.items() if name != "acc"}
    same = energy(scene, dataclasses.replace(game, own_weights=without), game.initial_controls)
    assert torch.equal(same, energy(scene, game, game.initial_controls))


def test_the_energy_declares_its_needs():
    assert convex_energy().needs == {"goals", "reference_speed", "size", "order"}
    assert convex_energy().goal_terms == {"goal", "lateral"}
    alone = convex_energy(["acc", "lat_acc"], pair=())
    assert alone.needs == set()
    scene, game = convex_game()
    bare = dataclasses.replace(game, goals=None, order=None, pair_weights={})
    nobody = dataclasses.replace(scene, size=None, reference_speed=None)
    assert torch.equal(alone(nobody, bare, bare.initial_controls), alone(scene, game, game.initial_controls))


@pytest.mark.parametrize("name", ["convex", "convex_highway"])
def test_configurations_can_be_built(name):
    config = yaml.safe_load((tree() / "conf" / "energy" / f"{name}.yaml").read_text())
    dynamics = yaml.safe_load((tree() / "conf" / "dynamics" / "double_integrator.yaml").read_text())
    energy = build("energy", config, dynamics=build("dynamics", dynamics))
    assert isinstance(energy, ConvexEnergy)
    assert set(config) - {"lane"} == {"name", "own", "pair", "gap", "direction", "within"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"own": ["acc", "lat_acc", "gaol"]}, "did you mean 'goal'"),
        ({"own": ["acc", "goal"]}, "must name acc and lat_acc"),
        ({"own": "acc"}, "energy.own must be a list of names"),
        ({"own": ["acc", "lat_acc", "acc"]}, "twice"),
        ({"pair": ["proximity"]}, "unknown pair term 'proximity'"),
        ({"direction": "accross"}, "did you mean 'across'"),
        ({"gap": -1.0}, r"energy.gap \[m\] must be a number, 0 or more"),
        ({"gap": float("nan")}, r"energy.gap \[m\] must be a number, 0 or more, and finite, not nan"),
        ({"within": 0.0}, r"energy.within \[m\] must be a number, positive, not 0.0"),
        ({"within": float("nan")}, r"energy.within \[m\] must be a number, positive, not nan"),
        ({"lane": 0.0, "own": ["acc", "lat_acc", "goal"]}, r"energy.lane \[m\] must be a number, positive"),
        ({"lane": 2.5}, r"energy\.lane needs goals: name goal or lateral in energy\.own"),
        ({"dynamics": Unicycle()}, "dynamics=double_integrator, not Unicycle"),
    ],
)
def test_invalid_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        ConvexEnergy(**{"own": ["acc", "lat_acc"], "dynamics": DoubleIntegrator(), **settings})


def test_invalid_tensors_are_refused():
    scene, game = convex_game()
    energy = convex_energy()

    def refused(message, scene=scene, **changes):
        with pytest.raises(ValueError, match=message):
            energy(scene, dataclasses.replace(game, **changes), game.initial_controls)

    refused("parameters.order is None", order=None)
    refused("own_weights lacks the term 'goal'", own_weights={})
    refused("scene.size", scene=dataclasses.replace(scene, size=None))
    refused("scene.reference_speed", scene=dataclasses.replace(scene, reference_speed=None))
    _, more = convex_game(modes=3)
    with pytest.raises(
        ValueError, match=r"own_weights\['goal'\] has shape \[2, 3, 3\]; these controls take \[2, 2, 3\]"
    ):
        energy(scene, more, game.initial_controls)
