"""Games in the fused kernels that random scenes do not contain: long lines and vehicles, points, matrices of any sign."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import pytest
import torch
from games import BOUNDS, random_game, random_scene

from epo_lightning.forecast import Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.gauss_newton.backends import pytorch, warp

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install 'epo_lightning[gpu]'")
from test_warp import assert_same_as_pytorch

ON_LINES = ("lane", "acc", "turnr")


def ten(scene, modes=2):
    return torch.full((len(scene.history), modes), 10.0, dtype=torch.float64)


@pytest.mark.parametrize("points", [2, 9, 10, 30])
def test_lines_have_any_number_of_points(points):
    """The kernels read eight points at a time."""
    scene = random_scene(6, 2, history=2, dtype=torch.float64)
    way = torch.linspace(-3.0, 3.0, points, dtype=torch.float64).expand(6, 2, 2, points)
    scene = dataclasses.replace(scene, references=torch.stack((way, torch.randn_like(way)), -1))
    assert_same_as_pytorch(FeatureEnergy(ON_LINES, lane_slides=True), scene, random_game(scene), ten(scene))


@pytest.mark.parametrize("slides", [False, True])
def test_lines_may_repeat_points(slides):
    """Also the first one, with the agents before it, and all of them: the nearest segment then has no length."""
    scene = random_scene(6, 2, history=2, dtype=torch.float64)
    scene.references[..., 0] += 6.0
    scene.references[:, :, :, 1] = scene.references[:, :, :, 0]
    scene.references[:, :, :, 4] = scene.references[:, :, :, 3]
    scene.references[0] = scene.references[0, :, :, :1].clone()
    assert_same_as_pytorch(FeatureEnergy(ON_LINES, lane_slides=slides), scene, random_game(scene), ten(scene))


@pytest.mark.parametrize("lengths", [(9.0, 9.0), (9.0, 5.0), (5.0, 3.0)])
def test_long_vehicles_have_three_or_five_circles(lengths):
    scene = random_scene(8, 2, history=2, dtype=torch.float64)
    scene.size[..., 0], scene.size[..., 1] = torch.tensor(lengths), 2.0
    scene.history[:, 1, :, :2] += torch.tensor([2.0, 2.0])
    energy = FeatureEnergy(("acc", "turnr"), ("circles",))
    assert_same_as_pytorch(energy, scene, random_game(scene, pair=("circles",)), ten(scene))


@pytest.mark.parametrize("size", [0.0, 1.0])
@pytest.mark.parametrize(
    "pair", ["proximity", "clearance", "circles", "headway", "longitudinal", "lateral", "time_to_conflict"]
)
def test_agents_at_the_same_point_and_one_behind_the_other(pair, size):
    """Distances of zero have no direction, and agents without a size no length by which distances are divided."""
    scene = random_scene(3, 2, history=2, size=size, dtype=torch.float64)
    scene.history[..., :3] = 0.0
    scene.history[..., 3] = 2.0
    scene.history[1, 1, :, 0] = 1.5
    scene.history[2, 1, :, 1] = 0.5
    game = random_game(scene, pair=(pair,))
    game.initial_controls.zero_()
    assert_same_as_pytorch(FeatureEnergy(("acc", "turnr"), (pair,)), scene, game, ten(scene), steps=1)


def test_matrices_that_are_not_positive_get_more_and_more_damping():
    """The first attempt that succeeds is the last one of -3, and none succeeds of -99; a game is damped as a whole."""
    scene, own = random_scene(4, 2, history=2, size=9.0, dtype=torch.float64), ("acc", "turnr")
    game = random_game(scene, 1, own=own)
    for weight in game.own_weights.values():
        weight.fill_(1.0)
    damping = torch.tensor([[5.0, 5.0], [5.0, -3.0], [-99.0, 5.0], [0.3, -1.05]], dtype=torch.float64)[:, None]
    found = assert_same_as_pytorch(FeatureEnergy(own), scene, game, damping)
    assert found.status[:, 0].tolist() == [Status.COMPLETED, Status.DAMPED, Status.STOPPED, Status.DAMPED]
    assert torch.equal(found.controls[2], game.initial_controls[2])


def test_a_game_may_stop_after_its_first_step():
    """Within the bounds nothing outweighs a negative damping. The derivative of the step that was taken stays."""
    scene, own = random_scene(2, 2, history=2, dtype=torch.float64), ("accb", "turnrb")
    game = random_game(scene, 1, own=own, pair=())
    for weight in game.own_weights.values():
        weight.fill_(5.0)
    game.initial_controls[..., 0], game.initial_controls[..., 1] = 0.35, 0.25
    damping = torch.tensor([[-21.0], [10.0]], dtype=torch.float64)
    found = assert_same_as_pytorch(FeatureEnergy(own, (), BOUNDS), scene, game, damping)
    assert found.status.tolist() == [[Status.STOPPED], [Status.COMPLETED]]
    assert [not torch.equal(one[0], other[0]) for one, other in pairwise(found.iterates)] == [True, False, False]


@pytest.mark.parametrize("steps", [0, 2])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_state_that_is_no_number_stops_its_game(value, steps):
    """Also where no feature reads it."""
    scene, own = random_scene(5, 2, history=2), ("acc", "turnr")
    for entry in range(4):
        scene.history[entry, entry % 2, -1, entry] = value
    game, energy = random_game(scene, own=own, pair=()), FeatureEnergy(own, ())
    for solve in (warp.solve, pytorch.solve):
        status = solve(energy, scene, game, steps, 0.3, torch.full((5, 2), 10.0)).status
        assert status.tolist() == [*4 * [2 * [Status.STOPPED]], 2 * [Status.COMPLETED]]


@pytest.mark.parametrize("value", [-2.0, float("nan")])
@pytest.mark.parametrize(("side", "pair"), [(0, "proximity"), (0, "circles"), (1, "proximity"), (1, "circles")])
def test_sizes_that_are_none_stop_their_game_if_a_feature_reads_them(side, pair, value):
    scene = random_scene(2, 2, history=2, size=2.0)
    scene.size[1, 0, side] = value
    game, energy = random_game(scene, own=("acc",), pair=(pair,)), FeatureEnergy(["acc"], (pair,))
    expected = Status.COMPLETED if (side, pair) == (1, "proximity") else Status.STOPPED
    for solve in (warp.solve, pytorch.solve):
        status = solve(energy, scene, game, 2, 0.3, torch.full((2, 2), 10.0)).status
        assert status.tolist() == [2 * [Status.COMPLETED], 2 * [expected]]
