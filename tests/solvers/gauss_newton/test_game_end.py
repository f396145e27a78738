"""Games of different lengths in one batch, against each game alone with controls of its own length; and wanted headings."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from backends import gradients
from games import ALL, BOUNDS, leaves_of, random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Implicit, Truncated, Unrolled
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.gauss_newton.normal_equations import normal_equations

PAIR = ("proximity", "clearance")
BACKENDS = ("pytorch", "compiled")


@pytest.fixture(autouse=True, scope="module")
def undeclared():
    """A feature of whole trajectories of agents, and one of pairs: neither is a residual per step."""
    own_feature("smooth")(lambda states, controls: states[..., 3].diff(dim=-1).square() + controls[..., 1:, 0])
    own_feature("bend")(lambda states, controls: (controls[..., 1].sum(-1) * states[..., -1, 3])[..., None])

    def mean(first, second, margin):
        gap = (first[..., :2] - second[..., :2]).square().sum(-1)
        return (torch.exp(-gap).mean(-1, keepdim=True) * (1.0 + margin))[..., :1]

    pair_feature("mean", margin=True)(mean)
    pair_feature("soft", Source.DISTANCE, margin=True)(lambda distance, reach: torch.exp(reach - distance) * reach)
    yield
    for known, names in ((OWN_FEATURES, ("smooth", "bend")), (PAIR_FEATURES, ("mean", "soft"))):
        for name in names:
            del known[name]


def make(seed, scenes=3, agents=2, horizon=6, own=ALL, pair=PAIR, size=1.5, spread=0.5):
    torch.manual_seed(seed)
    scene = random_scene(scenes, agents, history=2, size=size, dtype=torch.float64)
    return scene, random_game(scene, 2, horizon, own, spread, pair)


def alone(scene: Scene, parameters: GameParameters, index: int, end: int) -> tuple[Scene, GameParameters]:
    """One game, with controls up to its end only."""
    one = parameters[index].map(torch.clone)
    cut = {name: getattr(one, name)[..., :end, :].contiguous() for name in ("initial_controls", "reference_controls")}
    return dataclasses.replace(scene[index], game_steps=None), dataclasses.replace(one, **cut)


def pulled(minimise, energy, scene, parameters, ends):
    """Solution and gradients of a functional of its controls and states up to the end of each game."""
    leaves = leaves_of(parameters)
    solution = minimise(energy, scene, leaves)
    modes, agents, steps, _ = solution.controls.shape[1:]
    place = [torch.arange(count, dtype=torch.float64) for count in (modes, agents, steps, 2)]
    weigh = torch.cos(sum(7.3**n * axis for n, axis in enumerate(torch.meshgrid(*place, indexing="ij"))))
    total = 0.0
    for index, end in enumerate(ends):
        total = total + (solution.controls[index] * weigh)[..., :end, :].sum()
        total = total + solution.states[index][..., :end, :].square().sum()
    total.backward()
    return solution, gradients(leaves)


@settings(max_examples=15)
@given(
    ends=st.tuples(*[st.integers(2, 6)] * 3),
    agents=st.integers(1, 3),
    own=st.sets(st.sampled_from(("smooth", "bend", *ALL)), min_size=1),
    pair=st.sampled_from([PAIR, ("mean",), ("soft",), ("circles", "clearance"), ("headway", "lateral"), ()]),
    stride=st.sampled_from([1, 2]),
    seed=st.integers(0, 1000),
)
def test_energies_and_their_quadratic_models_are_those_of_each_game_alone(ends, agents, own, pair, stride, seed):
    scene, parameters = make(seed, agents=agents, own=tuple(own), pair=pair)
    energy = FeatureEnergy(sorted(own), pair, BOUNDS, pair_stride=stride)
    mixed = dataclasses.replace(scene, game_steps=torch.tensor(ends))
    controls = parameters.initial_controls.clone().requires_grad_()
    value = energy(mixed, parameters, controls)
    (slope,) = torch.autograd.grad(value.sum(), controls)
    gradient, matrix = normal_equations(energy, mixed, parameters, controls.detach(), 0.3)
    terms = energy.terms(mixed, parameters, controls.detach())
    for index, end in enumerate(ends):
        its_scene, game = alone(scene, parameters, index, end)
        its_controls = game.initial_controls.requires_grad_()
        expected = energy(its_scene, game, its_controls)
        (its_slope,) = torch.autograd.grad(expected.sum(), its_controls)
        torch.testing.assert_close(value[[index]], expected, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(slope[[index]][..., :end, :], its_slope, rtol=0, atol=1e-11)
        assert (slope[index][..., end:, :] == 0).all()
        for name, term in energy.terms(its_scene, game, its_controls.detach()).items():
            torch.testing.assert_close(terms[name][[index]], term, rtol=1e-12, atol=1e-12, msg=name)
        its_gradient, its_matrix = normal_equations(energy, its_scene, game, its_controls.detach(), 0.3)
        inside = (torch.arange(6) < end).expand(agents, 2, 6).flatten()
        torch.testing.assert_close(gradient[[index]][..., inside], its_gradient, rtol=0, atol=1e-10)
        block = matrix[[index]][..., inside, :][..., inside].triu()
        torch.testing.assert_close(block, its_matrix.triu(), rtol=0, atol=1e-9)
        rest = matrix[index][..., ~inside, :]
        assert (rest.triu(1)[..., inside] == 0).all()
        assert (rest[..., ~inside].diagonal(dim1=-2, dim2=-1) == 1.0).all(), (
            "log-determinants get nothing from the rest"
        )


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=15)
@given(
    ends=st.tuples(*[st.integers(2, 9)] * 3),
    agents=st.integers(1, 3),
    own=st.sets(st.sampled_from(ALL), min_size=1),
    pair=st.sampled_from([PAIR, ("proximity",), ("clearance",), ("circles",), ("headway", "time_to_conflict"), ()]),
    stride=st.sampled_from([1, 2]),
    way=st.sampled_from([(Unrolled(), False), (Unrolled(), True), (Truncated(2), False)]),
    seed=st.integers(0, 1000),
)
def test_solutions_and_gradients_are_those_of_each_game_alone(backend, ends, agents, own, pair, stride, way, seed):
    scene, parameters = make(seed, agents=agents, horizon=9, own=tuple(own), pair=pair)
    backward, adaptive = way
    energy = FeatureEnergy(sorted(own), pair, BOUNDS, pair_stride=stride)
    solver = LevenbergMarquardt(3, 0.5, 2.0, adaptive=adaptive, backend=backend)
    assert_alone(lambda *game: backward(solver, *game), energy, scene, parameters, ends, 1e-10)


def assert_alone(minimise, energy, scene, parameters, ends, tolerance):
    mixed = dataclasses.replace(scene, game_steps=torch.tensor(ends))
    together, by_together = pulled(minimise, energy, mixed, parameters, ends)
    for index, end in enumerate(ends):
        one, by_one = pulled(minimise, energy, *alone(scene, parameters, index, end), (end,))
        for name in ("controls", "states"):
            mine = getattr(together, name)[[index]][..., :end, :]
            torch.testing.assert_close(mine, getattr(one, name), rtol=0, atol=tolerance, msg=name)
        for name in ("energy", "initial_energy", "gradient_norm"):
            mine, its = getattr(together, name)[[index]], getattr(one, name)
            torch.testing.assert_close(mine, its, rtol=tolerance, atol=tolerance, msg=name)
        assert torch.equal(together.status[[index]], one.status)
        assert torch.equal(together.controls[index, ..., end:, :], parameters.initial_controls[index, ..., end:, :])
        for name, its in by_one.items():
            mine = by_together[name][[index]]
            if name in ("initial_controls", "reference_controls"):
                assert (mine[..., end:, :] == 0).all(), "controls after the end get no gradient"
                mine = mine[..., :end, :]
            scale = its.abs().max().clamp_min(1.0) if its.numel() else 1.0
            torch.testing.assert_close(mine / scale, its / scale, rtol=0, atol=tolerance, msg=name)


@pytest.mark.parametrize("backend", BACKENDS)
def test_implicit_gradients_are_those_of_each_game_alone(backend):
    own = ("goal", "heading", "vel", "acc", "turnr", "jerk", "velb", "accref", "turnrref")
    scene, parameters = make(5, 4, 3, 8, own, spread=0.1)
    solver = LevenbergMarquardt(10, 1.0, 1e-1, adaptive=True, newton_steps=10, backend=backend)
    energy = FeatureEnergy(own, PAIR, BOUNDS)
    assert_alone(lambda *g: Implicit()(solver, *g), energy, scene, parameters, (8, 2, 5, 3), 1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_damping_the_matrix_of_a_short_game_is_regular(backend):
    scene, parameters = make(1, own=("acc", "turnr"), pair=("proximity",), size=0.01)
    mixed = dataclasses.replace(scene, game_steps=torch.tensor([2, 6, 4]))
    solution = LevenbergMarquardt(1, 1.0, 0.0, backend=backend)(FeatureEnergy(("acc", "turnr")), mixed, parameters)
    assert (solution.status == 0).all()
    assert solution.controls[0, ..., :2, :].abs().max() < 1e-12
    assert torch.equal(solution.controls[0, ..., 2:, :], parameters.initial_controls[0, ..., 2:, :])


@pytest.mark.parametrize(("backend", "pair"), [*((backend, "clearance") for backend in BACKENDS), ("pytorch", "soft")])
@pytest.mark.parametrize("backward", [Unrolled(), Implicit()], ids=["unrolled", "implicit"])
def test_gradients_by_margins_and_headings_equal_finite_differences(backend, pair, backward):
    """The margin of ``soft`` changes also the slope by the distance; that of ``clearance`` does not."""
    own = ("goal", "heading", "vel", "acc", "turnr")
    scene, parameters = make(8, 2, 3, 5, own, (pair,), size=0.7, spread=0.1)
    scene = dataclasses.replace(scene, game_steps=torch.tensor([5, 3]))
    energy = FeatureEnergy(own, [pair])
    implicit = isinstance(backward, Implicit)
    solver = (
        LevenbergMarquardt(40, 1.0, 0.1, backend=backend)
        if implicit
        else LevenbergMarquardt(2, 0.3, 3.0, backend=backend)
    )
    cotangent = torch.randn_like(parameters.initial_controls)

    def total(game):
        return (backward(solver, energy, scene, game).controls * cotangent).sum()

    leaves = leaves_of(parameters)
    total(leaves).backward()
    for name in ("margins", "goal_headings"):
        pick = (lambda game: game.margins[pair]) if name == "margins" else (lambda game: game.goal_headings)
        for direction in torch.randn(2, *pick(parameters).shape, dtype=torch.float64):
            ends = []
            for sign in (1.0, -1.0):
                moved = pick(parameters) + sign * 1e-6 * direction
                value = {pair: moved} if name == "margins" else moved
                ends.append(total(dataclasses.replace(parameters, **{name: value})).item())
            slope = (pick(leaves).grad * direction).sum().item()
            assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-7)
        assert (pick(leaves).grad != 0).any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_heading_is_reached_and_not_wrapped(backend):
    scene, parameters = make(2, own=("heading", "turnr"), pair=("proximity",), horizon=20, size=0.01)
    wanted = scene.current[..., 2][:, None] + 7.0
    weights = {"heading": torch.full((3, 2, 2), 100.0).double(), "turnr": torch.full((3, 2, 2), 0.01).double()}
    game = dataclasses.replace(parameters, own_weights=weights, goal_headings=wanted.expand(-1, 2, -1).contiguous())
    solution = LevenbergMarquardt(1, 1.0, 0.0, backend=backend)(FeatureEnergy(("heading", "turnr")), scene, game)
    reached = solution.states[..., -1, 2]
    torch.testing.assert_close(reached, game.goal_headings, rtol=0, atol=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_fixed_margin_equals_the_same_decoded_margin(backend):
    scene, parameters = make(4, pair=("clearance",))
    parameters.margins["clearance"].fill_(0.7)
    solver = LevenbergMarquardt(2, 0.3, 3.0, backend=backend)
    decoded = solver(FeatureEnergy(ALL, ["clearance"], BOUNDS), scene, parameters)
    energy = FeatureEnergy(ALL, ["clearance"], BOUNDS, margins={"clearance": 0.7})
    assert energy.decoded_margins == []
    fixed = solver(energy, scene, dataclasses.replace(parameters, margins={}))
    assert torch.equal(fixed.controls, decoded.controls)
    bare = FeatureEnergy(ALL, ["proximity"], BOUNDS)
    same_weights = dataclasses.replace(parameters, pair_weights={"proximity": parameters.pair_weights["clearance"]})
    none = FeatureEnergy(ALL, ["clearance"], BOUNDS, margins={"clearance": 0.0})
    assert torch.equal(solver(none, scene, parameters).controls, solver(bare, scene, same_weights).controls)
    assert not torch.equal(fixed.controls, solver(bare, scene, same_weights).controls), "the margin acts"


def test_equilibria_ignore_what_is_after_the_end():
    scene, parameters = make(3, own=("goal", "vel", "acc", "turnr"))
    energy = FeatureEnergy(("goal", "vel", "acc", "turnr"), PAIR)
    mixed = dataclasses.replace(scene, game_steps=torch.tensor([3, 6, 4]))

    def report(scene, parameters):
        solution = LevenbergMarquardt(2)(energy, scene, parameters)
        likely = torch.ones(len(solution.energy), 2) * torch.tensor([0.7, 0.3])
        forecast = JointForecast(solution.states, likely, parameters=parameters, solution=solution)
        return equilibrium(energy, scene, forecast)

    together = report(mixed, parameters)
    for index, end in enumerate((3, 6, 4)):
        one = report(*alone(scene, parameters, index, end))
        for name in ("energy", "optimum", "gradient_norm", "nash_gap", "objective"):
            mine = getattr(together, name)[[index]]
            torch.testing.assert_close(mine, getattr(one, name), rtol=1e-7, atol=1e-9, msg=name)


@pytest.mark.parametrize(
    ("ends", "message"),
    [([6, 7, 1], r"scene\.game_steps\[1\] is 7: .* 1 to K = 6"), ([1, 2, 0], r"scene\.game_steps\[2\] is 0: ")],
)
def test_ends_outside_of_the_controls_are_refused(ends, message):
    scene, parameters = make(0)
    scene = dataclasses.replace(scene, game_steps=torch.tensor(ends))
    with pytest.raises(ValueError, match=message):
        LevenbergMarquardt()(FeatureEnergy(ALL, PAIR, BOUNDS), scene, parameters)


def test_missing_and_negative_margins_are_refused():
    scene, parameters = make(0)
    energy = FeatureEnergy(["acc"], ["clearance"])
    with pytest.raises(ValueError, match=r"'clearance' takes a margin, but parameters\.margins lacks it"):
        LevenbergMarquardt()(energy, scene, dataclasses.replace(parameters, margins={}))
    parameters.margins["clearance"][0, 0, 0] = -0.1
    with pytest.raises(ValueError, match=r"margins\['clearance'\] must be 0 or more"):
        LevenbergMarquardt()(energy, scene, parameters)
    parameters.margins["clearance"][0, 0, 0] = torch.nan
    assert LevenbergMarquardt()(energy, scene, parameters).status.tolist() == [[2, 0], [0, 0], [0, 0]]
    scene.agent_mask[0, 0] = False
    assert (LevenbergMarquardt()(energy, scene, parameters).status == 0).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("field", ["margins", "pair_weights"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_margins_and_weights_that_are_no_numbers_stop_games_also_where_agents_never_touch(backend, field, value):
    own = ("goal", "acc", "turnr")
    scene, parameters = make(0, own=own, pair=("clearance",), spread=0.1)
    scene.history[:, 1, :, 0] += 1e3
    parameters.goals[:, :, 1, 0] += 1e3
    solver = LevenbergMarquardt(3, backend=backend)
    energy = FeatureEnergy(own, ["clearance"])
    assert (solver(energy, scene, parameters).status == 0).all()
    getattr(parameters, field)["clearance"][1, 1, 0] = value
    assert solver(energy, scene, parameters).status.tolist() == [[0, 0], [0, 2], [0, 0]]
