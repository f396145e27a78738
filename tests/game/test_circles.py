"""Rows of circles against a loop over circles, against boxes, and against finite differences through the layer."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import BOUNDS, leaves_of, normal_equations, pad, random_game, random_scene, widen
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, MultiPoint, Point, Polygon
from shapely.affinity import rotate, translate

from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecast import Status
from epo_lightning.game.circles import places, row_extent, row_overlap, rows_may_overlap
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import PAIR_FEATURES, Source, pair_feature
from epo_lightning.registry import ConfigError
from epo_lightning.solvers.backward import Implicit, Unrolled
from epo_lightning.solvers.gauss_newton.backends import pytorch
from epo_lightning.solvers.gauss_newton.expansion import expand
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OWN = ("goal", "velref", "acc", "turnr", "jerk")
SIZES = ((1.8, 0.6), (0.5, 0.5), (3.9, 1.7), (4.0, 1.8), (4.7, 1.9), (7.9, 2.2), (8.0, 2.3), (16.0, 2.5), (0.4, 0.7))
"""Length and width of a bicycle, a pedestrian, cars, vans, trucks, and of an agent that is wider than long."""


def circles_of(state, size):
    """Centres and radius by the rule, in plain arithmetic."""
    (x, y, heading), (length, width) = state[:3], size
    end = (length - width) / 2
    along = [-end, end] if length < 4 else [-end, 0.0, end] if length < 8 else [-end, -end / 2, 0.0, end / 2, end]
    centres = [(x + a * math.cos(heading), y + a * math.sin(heading)) for a in along]
    return centres, width / math.sqrt(2)


def slow_overlap(first, second, first_size, second_size):
    (ours, r), (theirs, s) = circles_of(first, first_size), circles_of(second, second_size)
    return max(0.0, *(r + s - math.dist(a, b) for a in ours for b in theirs))


def traffic(scenes=2, agents=4, dtype=torch.float64, apart=3.0, **options):
    """Vehicles of all sizes, some of them overlapping, and a game with weights for circles."""
    scene = random_scene(scenes, agents, history=2, dtype=dtype, **options)
    scene.history[..., :2] *= apart
    scene.size.copy_(torch.tensor(SIZES, dtype=dtype)[torch.randint(len(SIZES), (scenes, agents))])
    game = random_game(scene, 2, 6)
    return scene, dataclasses.replace(game, pair_weights={"circles": game.pair_weights["proximity"]})


def pair_of_states(batch, steps=1):
    states = torch.randn(2, batch, steps, 4, dtype=torch.float64)
    states[..., :2] *= 2.0
    states[..., 2] *= 3.0
    sizes = torch.tensor(SIZES, dtype=torch.float64)[torch.randint(len(SIZES), (2, batch, 1))]
    return states, sizes


@pytest.mark.parametrize("stride", [1, 3])
def test_residuals_equal_a_loop_over_circles(stride):
    scene, parameters = traffic(scenes=6)
    energy = FeatureEnergy(OWN, ["circles"], pair_stride=stride)
    controls = parameters.initial_controls
    found = energy.residuals(scene, parameters, controls)["circles"]
    states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)[..., stride - 1 :: stride, :]
    expected = torch.zeros_like(found)
    for b, m, p, k in torch.cartesian_prod(*(torch.arange(count) for count in found.shape)).tolist():
        i, j = torch.triu_indices(4, 4, 1)[:, p].tolist()
        both = states[b, m, i, k].tolist(), states[b, m, j, k].tolist()
        depth = slow_overlap(*both, scene.size[b, i].tolist(), scene.size[b, j].tolist())
        expected[b, m, p, k] = parameters.pair_weights["circles"][b, m, p] * depth
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    assert 0.1 < (found > 0).double().mean() < 0.9


@pytest.mark.parametrize(("length", "count"), [(3.999, 2), (4.0, 3), (7.999, 3), (8.0, 5)])
def test_how_many_circles_a_vehicle_has(length, count):
    size = torch.tensor([length, 2.0], dtype=torch.float64)
    along = {round(place, 9) for place in places(size).tolist()}
    assert len(along) == count
    assert max(along) == pytest.approx((length - 2.0) / 2)
    assert along == {-place for place in along}


@pytest.mark.parametrize("size", SIZES)
def test_circles_cover_the_box_as_long_as_their_squares_do(size):
    length, width = size
    centres, radius = circles_of((0.0, 0.0, 0.0), size)
    shape = Point(centres[0]).buffer(radius, 256)
    for centre in centres[1:]:
        shape = shape.union(Point(centre).buffer(radius, 256))
    box = Polygon([(sx * length / 2, sy * width / 2) for sx, sy in ((1, 1), (1, -1), (-1, -1), (-1, 1))])
    compact = length <= len(centres) * width
    assert shape.buffer(1e-3).contains(box) == compact
    assert compact == (size not in [(1.8, 0.6), (3.9, 1.7), (7.9, 2.2), (16.0, 2.5)])
    beyond = width * (1 / math.sqrt(2) - 1 / 2)
    assert max(Point(c).distance(Point(0, 0)) + radius for c in centres) == pytest.approx(
        row_extent(torch.tensor(size, dtype=torch.float64)).item()
    )
    if length >= width:
        assert max(shape.bounds[2] - length / 2, shape.bounds[3] - width / 2) == pytest.approx(beyond, abs=1e-3)


def box_of(state, size):
    (length, width), (x, y, heading) = size, state[:3]
    corners = MultiPoint([(sx * length / 2, sy * width / 2) for sx in (1, -1) for sy in (1, -1)]).convex_hull
    return translate(rotate(corners, heading, (0, 0), use_radians=True), x, y)


def test_boxes_that_touch_overlap_and_circles_that_overlap_are_near_boxes():
    states, sizes = pair_of_states(600)
    depth = row_overlap(*states, *sizes)
    touching = 0
    for n in range(states.shape[1]):
        size = sizes[:, n, 0].tolist()
        boxes = [box_of(states[side, n, 0].tolist(), size[side]) for side in range(2)]
        compact = all(length <= w * (2 if length < 4 else 3 if length < 8 else 5) for length, w in size)
        if boxes[0].intersects(boxes[1]) and compact:
            touching += 1
            assert depth[n, 0] > 0
        if depth[n, 0] > 0 and all(length >= width for length, width in size):
            assert boxes[0].distance(boxes[1]) <= (1 / math.sqrt(2) - 0.5) * (size[0][1] + size[1][1]) + 1e-9
    assert touching > 50


def test_cars_in_adjacent_lanes_do_not_overlap_and_cars_in_a_row_do():
    size = torch.tensor([[4.7, 1.9]])

    def depth(x, y):
        other = torch.tensor([[x, y, 0.0, 0.0]])
        return row_overlap(torch.zeros(1, 4), other, size, size).item(), 4.7 - math.hypot(x, y)

    beside, of_discs = depth(0.5, 3.5)
    assert beside == 0.0 < of_discs
    behind, of_discs = depth(5.0, 0.0)  # 30 cm from bumper to bumper: the circles reach 39 cm beyond each
    assert behind == pytest.approx(1.9 * math.sqrt(2) - (5.0 - 2.8), abs=1e-5)
    assert of_discs < 0.0 < behind


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), turn=st.floats(-7.0, 7.0), x=st.floats(-50.0, 50.0), y=st.floats(-50.0, 50.0))
def test_residuals_are_symmetric_and_invariant_to_rigid_motion(seed, turn, x, y):
    torch.manual_seed(seed)
    (first, second), sizes = pair_of_states(30)
    depth = row_overlap(first, second, *sizes)
    torch.testing.assert_close(row_overlap(second, first, *sizes.flip(0)), depth, rtol=0, atol=1e-12)
    rotation = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)

    def move(states):
        position = states[..., :2] @ rotation.T + torch.tensor([x, y], dtype=torch.float64)
        return torch.cat((position, states[..., 2:3] + turn, states[..., 3:]), -1)

    torch.testing.assert_close(row_overlap(move(first), move(second), *sizes), depth, rtol=0, atol=1e-12)
    backwards = first.clone()
    backwards[..., 2] += math.pi
    torch.testing.assert_close(row_overlap(backwards, second, *sizes), depth, rtol=0, atol=1e-12)


def test_gradients_of_the_energy_equal_finite_differences():
    scene, parameters = traffic(apart=1.5)
    energy = FeatureEnergy(["acc"], ["circles"])
    assert (energy.residuals(scene, parameters, parameters.initial_controls)["circles"] > 0).any()
    controls = parameters.initial_controls.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda u: energy(scene, parameters, u), controls, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("stride", [1, 2])
def test_normal_equations_equal_automatic_differentiation(stride):
    scene, parameters = traffic(agents=3, apart=1.5)
    energy, controls = FeatureEnergy(OWN, ["circles"], pair_stride=stride), parameters.initial_controls

    def stacked(u):
        return torch.cat([r.flatten(2) for r in energy.residuals(scene, parameters, u).values()], -1)

    jacobian = torch.func.jacfwd(lambda u: stacked(u).sum((0, 1)))(controls).permute(1, 2, 0, 3, 4, 5).flatten(3)
    gradient, matrix = normal_equations(energy, scene, parameters, controls)
    expected = (jacobian.mT @ stacked(controls)[..., None])[..., 0]
    torch.testing.assert_close(matrix, jacobian.mT @ jacobian, rtol=0, atol=1e-11 * matrix.abs().max().item())
    torch.testing.assert_close(gradient.flatten(2), expected, rtol=0, atol=1e-11 * expected.abs().max().item())
    directions = torch.randn(2, *controls.shape, dtype=torch.float64)
    _, changes = energy.linearisation(scene, parameters, controls, directions)
    expected = (jacobian @ directions.flatten(3)[..., None])[..., 0]
    torch.testing.assert_close(changes, expected, rtol=0, atol=1e-11 * expected.abs().max().item())


def directional(function, parameters, along, step=1e-6):
    """The central difference of a function of a game as everything moves along ``along``."""
    values = [
        function(dataclasses.replace(parameters, **{name: moved(sign * step) for name, moved in along.items()}))
        for sign in (1.0, -1.0)
    ]
    return (values[0] - values[1]) / (2.0 * step)


@pytest.mark.parametrize("mode", ["unrolled", "implicit"])
def test_gradients_of_the_layer_equal_finite_differences(mode):
    scene, parameters = traffic(scenes=6, agents=3 if mode == "unrolled" else 2, apart=0.7)
    parameters = dataclasses.replace(parameters, initial_controls=0.2 * parameters.initial_controls)
    energy = FeatureEnergy(OWN, ["circles"])
    few, many = LevenbergMarquardt(3), LevenbergMarquardt(60, 1.0, 1e-2)
    solve = dataclasses.replace(few if mode == "unrolled" else many, backend="pytorch")
    leaves = leaves_of(parameters)
    backward = Unrolled() if mode == "unrolled" else Implicit()
    solution = backward(solve, energy, scene, leaves)
    solved = solution.status == Status.COMPLETED
    cotangent = torch.randn_like(solution.controls)
    if mode == "unrolled":
        assert solved.all()
    else:
        # Other minima lie on a kink, where two pairs of circles are equally deep in each other.
        smooth = solved & (solution.gradient_norm < 1e-9)
        assert smooth.double().mean() > 0.3
        cotangent *= smooth[..., None, None, None]
        touching = energy.residuals(scene, parameters, solution.controls.detach())["circles"].flatten(2).any(-1)
        assert (smooth & touching).any()
    (solution.controls * cotangent).sum().backward()
    again = solve
    kinds = ["own_weights", "pair_weights", "goals", "initial_controls"]
    if mode == "implicit":
        kinds.pop()
        again = solve.with_steps(20)
        parameters = dataclasses.replace(parameters, initial_controls=solution.controls.detach())
    used = {"own_weights": OWN, "pair_weights": ["circles"]}
    for kind in kinds:
        given, leaf = getattr(parameters, kind), getattr(leaves, kind)
        if kind not in used:
            given, leaf = {kind: given}, {kind: leaf}
        way = {name: torch.randn_like(tensor) for name, tensor in given.items()}
        value = []
        for step in (1e-6, -1e-6):
            moved = {name: tensor + step * way[name] for name, tensor in given.items()}
            game = dataclasses.replace(parameters, **{kind: moved if kind in used else moved[kind]})
            value.append((again(energy, scene, game).controls * cotangent).sum().item())
        analytic = sum((leaf[name].grad * way[name]).sum().item() for name in used.get(kind, [kind]))
        assert analytic == pytest.approx((value[0] - value[1]) / 2e-6, rel=1e-6, abs=1e-6), kind


def test_coincident_vehicles_stay_finite():
    scene, parameters = traffic(agents=3)
    scene.history[0, 1] = scene.history[0, 0]
    scene.size[0] = torch.tensor([4.7, 1.9])
    parameters.initial_controls[0, :, 1] = parameters.initial_controls[0, :, 0]
    states = scene.current[0, 0].clone().requires_grad_()
    size = scene.size[0, :1]
    depth = row_overlap(states[None], states.detach()[None], size, size)
    assert depth.item() == pytest.approx(1.9 * math.sqrt(2))
    depth.sum().backward()
    assert (states.grad == 0).all()
    leaves = leaves_of(parameters)
    for backward in (Unrolled(), Implicit()):
        solve = LevenbergMarquardt(2, backend="pytorch")
        solution = backward(solve, FeatureEnergy(OWN, ["circles"]), scene, leaves)
        solution.states.sum().backward()
        assert solution.states.isfinite().all()
    grads = [leaves.initial_controls.grad, leaves.goals.grad, leaves.pair_weights["circles"].grad]
    assert all(gradient.isfinite().all() for gradient in grads)


def test_pairs_that_only_outer_circles_reach_are_edges():
    """Bumper to bumper, farther apart than a length: the discs of ``proximity`` do not reach each other."""
    scene, parameters = traffic(scenes=1, agents=2)
    scene.history[:] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    scene.history[:, 1, :, 0] = 5.2
    scene.size[:] = torch.tensor([4.7, 1.9])
    game = dataclasses.replace(
        parameters,
        initial_controls=torch.zeros_like(parameters.initial_controls),
        pair_weights={name: torch.ones(1, 2, 1, dtype=torch.float64) for name in ("circles", "proximity")},
    )
    found = {}
    for pair in (["circles"], ["proximity"], ["proximity", "circles"]):
        energy = FeatureEnergy(["acc", "turnr"], pair)
        model = expand(energy, scene, game, game.initial_controls, every_pair=False)
        found[tuple(pair)] = len(model.edges.pair)
        torch.testing.assert_close(
            model.value, energy(scene, game, game.initial_controls).flatten(), rtol=0, atol=1e-12
        )
    assert found == {("circles",): 2, ("proximity",): 0, ("proximity", "circles"): 2}


@pytest.mark.parametrize("size", SIZES)
def test_the_extent_bounds_where_circles_are_felt(size):
    """Edges leave out pairs that are farther apart, which cannot overlap."""
    extent = row_extent(torch.tensor(size, dtype=torch.float64)).item()
    centres, radius = circles_of((0.0, 0.0, 0.7), size)
    reach = Point(0.0, 0.0).buffer(extent + 1e-6, 512)
    assert reach.buffer(1e-3).contains(LineString(centres).buffer(radius))


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_rows_that_are_beside_each_other_do_not_overlap(seed, dtype):
    torch.manual_seed(seed)
    (first, second), (size, other_size) = pair_of_states(2000)
    first[..., :2] *= 3.0
    first, second, size, other_size = (values[:, 0].to(dtype) for values in (first, second, size, other_size))
    may = rows_may_overlap(first, second, size, other_size)
    overlap = row_overlap(first[:, None], second[:, None], size[:, None], other_size[:, None])[:, 0]
    assert may[overlap > 0].all()
    assert (may == (overlap > 0)).float().mean() > 0.7


def test_samples_depend_on_neither_batch_nor_padding_to_the_last_bit():
    scene, parameters = traffic(scenes=7, agents=4, dtype=torch.float32)
    energy = FeatureEnergy(OWN, ["circles"])

    def result(scene, parameters, chosen=slice(None)):
        leaves = leaves_of(parameters)
        damping = torch.full(leaves.initial_controls.shape[:2], 10.0)
        solution = pytorch.solve(energy, scene, leaves, 2, 0.3, damping)
        assert (solution.status == Status.COMPLETED).all()
        solution.states[:, :, :4].square().sum().backward()
        by = [leaves.initial_controls.grad, leaves.goals.grad, *(leaves.own_weights[name].grad for name in OWN)]
        weight = leaves.pair_weights["circles"].grad
        agents = solution.states.shape[2]
        weight = weight[:, :, torch.triu_indices(agents, agents, 1)[1] < 4]
        parts = [part.detach()[:, :, :4] for part in (solution.controls, solution.states, *by)]
        return [part[chosen] for part in (*parts, weight, solution.energy, solution.gradient_norm)]

    together = result(scene, parameters)
    assert together[-3].abs().max() > 0
    for chosen in ([3], [5, 0, 2]):
        few = result(scene[chosen], parameters[chosen])
        assert all(torch.equal(part, all_of_them[chosen]) for part, all_of_them in zip(few, together, strict=True))
    padded = result(pad(scene, 3), widen(parameters, 3))
    assert all(torch.equal(part, without) for part, without in zip(padded, together, strict=True))


def test_sizes_that_are_missing_or_no_numbers_are_noticed():
    scene, parameters = traffic(scenes=3)
    energy, solve = FeatureEnergy(OWN, ["circles"]), LevenbergMarquardt()
    with pytest.raises(ValueError, match=r"pair features take the agents' sizes from scene\.size"):
        solve(energy, dataclasses.replace(scene, size=None), parameters)
    scene.size[1, 2, 1] = torch.nan
    assert solve(energy, scene, parameters).status.tolist() == [[0, 0], [Status.STOPPED] * 2, [0, 0]]
    scene.agent_mask[1, 2] = False
    assert (solve(energy, scene, parameters).status == Status.COMPLETED).all()


def test_both_backends_solve_rows_of_circles():
    scene, parameters = traffic()
    energy = FeatureEnergy(OWN, ["circles"])
    results = []
    for backend in ("auto", "compiled", "pytorch"):
        leaves = leaves_of(parameters)
        solution = LevenbergMarquardt(backend=backend)(energy, scene, leaves)
        solution.states.square().sum().backward()
        results.append([solution.controls, leaves.pair_weights["circles"].grad, leaves.initial_controls.grad])
    assert results[0][1].abs().max() > 0
    for by_default, by_kernel, by_pytorch in zip(*results, strict=True):
        assert torch.equal(by_default, by_kernel)
        torch.testing.assert_close(by_kernel, by_pytorch, rtol=1e-9, atol=1e-9)


@pytest.fixture
def mine():
    yield "mine"
    PAIR_FEATURES.pop("mine", None)


def test_user_defined_functions_receive_sizes(mine):
    pair_feature(mine, needs="size")(lambda *both: row_overlap(*both))
    scene, parameters = traffic(agents=3, apart=1.0)
    twin = dataclasses.replace(parameters, pair_weights={mine: parameters.pair_weights["circles"]})
    solve = LevenbergMarquardt(backend="pytorch")
    built_in, own = (
        solve(FeatureEnergy(OWN, ["circles"]), scene, parameters),
        solve(FeatureEnergy(OWN, [mine]), scene, twin),
    )
    torch.testing.assert_close(own.controls, built_in.controls, rtol=0, atol=1e-12)
    for needs, source in (("goals", Source.TRAJECTORY), ("size", Source.DISTANCE)):
        with pytest.raises(ConfigError, match=f"not '{needs}' as {source.name}"):
            pair_feature("other", source, needs=needs)


def test_the_configured_energy_can_be_built():
    config = compose("train", ["experiment=rpi/v_lstm_epo", "energy=exid_circles"])["energy"]
    plain = compose("train", ["experiment=rpi/v_lstm_epo", "energy=exid"])["energy"]
    assert config == {**plain, "pair": ["circles"]}
    assert FeatureEnergy(**{key: value for key, value in config.items() if key != "name"}).extent is not None


def test_energies_with_bounds_and_both_shapes_solve():
    scene, parameters = traffic()
    weights = dict.fromkeys(("circles", "proximity"), parameters.pair_weights["circles"])
    game = dataclasses.replace(parameters, pair_weights=weights)
    solution = LevenbergMarquardt(30)(FeatureEnergy([*OWN, "velb"], ["proximity", "circles"], BOUNDS), scene, game)
    assert (solution.energy < solution.initial_energy).all()
