"""Newton's method and L-BFGS: closed forms, SciPy, each other, one minimiser for every order, independence of samples."""

from __future__ import annotations

import dataclasses
import itertools

import jaxtyping
import numpy as np
import pytest
import scipy.optimize
import torch
import yaml
from convex_games import convex_energy, convex_game, widen_convex
from games import leaves_of, pad, random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.experiment.config.compose import tree
from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.convex_energy import FLOOR, ConvexEnergy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general.dense import gradient, hessian
from epo_lightning.solvers.general.lbfgs import LBFGS
from epo_lightning.solvers.general.newton import Newton

PRECISE = [Newton(100, 1e-11), LBFGS(1000, 1e-8, history=40)]
both = pytest.mark.parametrize("minimise", PRECISE, ids=["newton", "lbfgs"])
FEATURES = FeatureEnergy(["goal", "vel", "acc", "turnr"], ["proximity"])


def feature_game(scenes=3, modes=2, size=1.0, spread=0.1):
    scene = random_scene(scenes, 3, history=2, size=size, dtype=torch.float64)
    return scene, dataclasses.replace(random_game(scene, modes, 6, FEATURES.own, spread=spread), reference=None)


@both
def test_two_agents_on_a_line_have_a_closed_form(minimise):
    """Two agents along x that never keep the distance of the order: all hinges are active, so the energy is quadratic."""
    steps, dt, gap = 7, 0.2, 50.0
    start, speed, goal = np.array([0.0, -3.0]), np.array([2.0, 3.0]), np.array([6.0, 4.0])
    reach, order, touch = np.array([1.3, 0.7]), -1.0, 0.4
    # p_k = start + k dt speed + dt^2 sum_l max(0, k - 1 - l) u_l
    by = dt**2 * np.maximum(0.0, np.arange(1, steps + 1)[:, None] - 1 - np.arange(steps))
    free = start[:, None] + speed[:, None] * dt * np.arange(1, steps + 1)
    matrix, right = np.eye(2 * steps), np.zeros(2 * steps)
    for i in range(2):
        own = slice(i * steps, (i + 1) * steps)
        matrix[own, own] += reach[i] ** 2 * np.outer(by[-1], by[-1])
        right[own] -= reach[i] ** 2 * by[-1] * (free[i, -1] - goal[i])
    apart = np.hstack((by, -by))  # x_1 - x_2
    matrix += touch**2 * apart.T @ apart
    right += touch**2 * order * apart.T @ ((gap + 1.0) - order * (free[0] - free[1]))
    expected = np.linalg.solve(matrix, right).reshape(2, steps)

    history = np.stack((start, [0.0, 2.0], [0.0, 0.0], speed), -1)
    scene = Scene(history=torch.tensor(history)[None, :, None], dt=dt, size=torch.ones(1, 2, 2, dtype=torch.float64))
    game = GameParameters(
        own_weights={"goal": torch.tensor(reach)[None, None], "lat_acc": torch.ones(1, 1, 2, dtype=torch.float64)},
        pair_weights={"order": torch.full((1, 1, 1), touch, dtype=torch.float64)},
        initial_controls=torch.randn(1, 1, 2, steps, 2, dtype=torch.float64),
        goals=torch.tensor(np.stack((goal, [0.0, 2.0]), -1))[None, None],
        order=torch.full((1, 1, 1), order, dtype=torch.float64),
    )
    solution = minimise(convex_energy(["goal", "acc", "lat_acc"], gap=gap, within=100.0), scene, game)
    assert (torch.tensor(expected) - solution.controls[0, 0, ..., 0]).abs().max() < 1e-8
    assert solution.controls[..., 1].abs().max() < 1e-8
    assert solution.energy < solution.initial_energy


@both
@settings(max_examples=3)
@given(direction=st.sampled_from(["along", "across"]), agents=st.integers(2, 3), seed=st.integers(0, 1000))
def test_one_minimiser_for_every_order_whatever_the_start(minimise, direction, agents, seed):
    torch.manual_seed(seed)
    scene, game = convex_game(scenes=1, agents=agents, modes=1, horizon=4)
    pairs = agents * (agents - 1) // 2
    signs = torch.tensor(list(itertools.product((1.0, -1.0), repeat=pairs)), dtype=torch.float64)
    starts = 3

    def of_all(tensor):
        return tensor.expand(1, len(signs) * starts, *tensor.shape[2:])

    game = GameParameters(
        own_weights={name: of_all(weight) for name, weight in game.own_weights.items()},
        pair_weights={"order": of_all(game.pair_weights["order"])},
        initial_controls=5.0 * torch.randn(1, len(signs) * starts, agents, 4, 2, dtype=torch.float64),
        goals=of_all(game.goals),
        order=signs.repeat_interleave(starts, 0)[None],
    )
    energy = convex_energy(direction=direction, within=50.0)
    controls = minimise(energy, scene, game).controls.unflatten(1, (len(signs), starts))[0]
    # L-BFGS ends at gradients of 1e-8, and games are so flat in some directions that controls then differ by up to 1e-6.
    assert (controls - controls[:, :1]).abs().max() < 5e-6
    # An order that is not kept at the start pushes: different orders have different minimisers.
    different = (controls[:, None, 0] - controls[None, :, 0]).abs().flatten(2).amax(-1)
    assert (different + torch.eye(len(signs)) > 1e-5).all()


@both
@pytest.mark.parametrize("convex", [True, False])
def test_minimum_and_energy_equal_those_of_scipy(minimise, convex):
    scene, game = convex_game(scenes=1, modes=1) if convex else feature_game(1, 1)
    energy = convex_energy() if convex else FEATURES
    solution = minimise(energy, scene, game)
    shape = game.initial_controls.shape

    def function(flat):
        value, slope = gradient(energy, scene, game, torch.tensor(flat).view(shape))
        return value.item(), slope.flatten().detach().numpy()

    peer = scipy.optimize.minimize(
        function,
        game.initial_controls.flatten().numpy(),
        jac=True,
        method="BFGS",
        options={"gtol": 1e-9, "maxiter": 5000},
    )
    assert solution.energy.item() == pytest.approx(peer.fun, rel=1e-10)
    assert (solution.controls.flatten() - torch.tensor(peer.x)).abs().max() < 1e-6
    expected = gradient(energy, scene, game, solution.controls)
    torch.testing.assert_close(solution.energy, expected[0].detach(), rtol=1e-12, atol=0)
    torch.testing.assert_close(
        solution.gradient_norm, expected[1].detach().flatten(2).norm(dim=-1), rtol=1e-3, atol=1e-12
    )
    torch.testing.assert_close(solution.initial_energy, energy(scene, game, game.initial_controls), rtol=1e-12, atol=0)
    states = energy.dynamics.rollout(energy.current_states(scene), solution.controls, scene.dt)
    assert torch.equal(solution.states, states)


@both
def test_the_papers_energy_has_the_minimum_that_levenberg_marquardt_finds(minimise):
    scene, game = feature_game()
    peer = LevenbergMarquardt(40, 1.0, 1e-3, adaptive=True, backend="pytorch")(FEATURES, scene, game)
    solution = minimise(FEATURES, scene, game)
    assert (solution.controls - peer.controls).abs().max() < 1e-7
    torch.testing.assert_close(solution.energy, peer.energy, rtol=1e-8, atol=0)
    assert (solution.status == Status.COMPLETED).all()
    assert solution.gradient_norm.max() < 1e-7


def test_newton_leaves_regions_with_an_indefinite_hessian():
    """Overlapping agents: hinges make the Hessian indefinite, and undamped steps would raise the energy."""
    scene, game = feature_game(size=3.0)
    scene = dataclasses.replace(scene, dt=0.4)
    least = torch.linalg.eigvalsh(hessian(FEATURES, scene, game, game.initial_controls).detach())[..., 0]
    assert least.min() < -1.0
    solution = PRECISE[0](FEATURES, scene, game)
    assert (solution.status[least < -1e-3] == Status.DAMPED).all()
    assert (solution.energy < solution.initial_energy).all()
    assert solution.gradient_norm.max() < 1e-8
    assert (torch.linalg.eigvalsh(hessian(FEATURES, scene, game, solution.controls).detach())[..., 0] > 0).all()


@pytest.mark.parametrize("direction", ["along", "across"])
def test_newton_converges_across_hinges_from_any_start(direction):
    """Whole Newton steps between the pieces of a quadratic may go up, or in a circle; here they are shortened."""
    scene, game = convex_game(scenes=8, agents=4, modes=2, horizon=10)
    scene = dataclasses.replace(scene, dt=0.4)
    game = dataclasses.replace(
        game,
        initial_controls=100.0 * game.initial_controls,
        pair_weights={name: 10.0 * weight for name, weight in game.pair_weights.items()},
    )
    energy = convex_energy(direction=direction, gap=2.0, within=20.0)
    exact = PRECISE[0](energy, scene, game)
    assert exact.gradient_norm.max() < 1e-8
    assert (exact.status == Status.COMPLETED).all()
    energies = [Newton(steps, 1e-8)(energy, scene, game).energy for steps in (0, 1, 2, 3, 5, 8, 12, 40)]
    for before, after in itertools.pairwise(energies):
        assert (after <= before * (1 + 1e-14)).all()
    torch.testing.assert_close(energies[-1], exact.energy, rtol=1e-12, atol=0)
    single = Newton(40, 1e-4)(energy, scene, game.to(torch.float32))
    assert (single.controls.double() - exact.controls).abs().max() < 0.01
    torch.testing.assert_close(single.energy.double(), exact.energy, rtol=1e-5, atol=0)


class Counted(ConvexEnergy):
    """Remembers of how many scenes second derivatives were asked for."""

    asked = ()

    def hessian(self, scene, parameters, controls):
        Counted.asked += (len(controls),)
        return super().hessian(scene, parameters, controls)


def test_hessians_are_computed_only_for_unconverged_scenes():
    scene, game = convex_game(scenes=4)
    energy = Counted(convex_energy().own)
    minimum = Newton(50, 1e-9)(energy, scene[:3], game[:3])
    assert len(Counted.asked) < 12
    start = torch.cat((minimum.controls, game.initial_controls[3:]))
    Counted.asked = ()
    solution = Newton(50, 1e-8)(energy, scene, dataclasses.replace(game, initial_controls=start))
    assert set(Counted.asked) == {1}
    assert torch.equal(solution.controls[:3], minimum.controls)
    assert solution.gradient_norm.max() < 1e-7


@pytest.mark.parametrize("minimise", [Newton(), LBFGS()], ids=["newton", "lbfgs"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_default_settings_converge(minimise, dtype):
    scene, game = convex_game(scenes=2, agents=3, dtype=torch.float64)
    exact = PRECISE[0](convex_energy(), scene, game)
    solution = minimise(convex_energy(), scene, game.to(dtype))  # the scene follows
    assert solution.controls.dtype == dtype
    assert (solution.controls.double() - exact.controls).abs().max() < 1e-3
    torch.testing.assert_close(solution.energy.double(), exact.energy, rtol=1e-5, atol=0)


@both
def test_energies_never_rise_with_more_steps(minimise):
    scene, game = feature_game(size=3.0, spread=1.0)
    energies = [
        dataclasses.replace(minimise, steps=steps)(FEATURES, scene, game).energy for steps in (0, 1, 2, 4, 8, 16)
    ]
    assert torch.equal(energies[0], FEATURES(scene, game, game.initial_controls))
    for before, after in itertools.pairwise(energies):
        assert (after <= before * (1 + 1e-14)).all()
    assert (energies[-1] < energies[0]).all()


@both
def test_samples_are_independent(minimise):
    """A sample has the same result alone and in any batch."""
    scene, game = convex_game(scenes=3, agents=2, modes=2)
    easy = PRECISE[0](convex_energy(), scene[0], game[0]).controls
    game = dataclasses.replace(game, initial_controls=torch.cat((easy, game.initial_controls[1:])))
    minimise = dataclasses.replace(minimise, tolerance=1e-6)
    together = minimise(convex_energy(), scene, game)
    assert torch.equal(together.controls[:1], easy)  # converged before it begins: bit for bit
    for index in range(3):
        alone = minimise(convex_energy(), scene[index], game[index])
        assert (alone.controls - together.controls[index : index + 1]).abs().max() < 1e-12
        assert (alone.energy - together.energy[index : index + 1]).abs().max() < 1e-10


@both
def test_absent_agents_do_not_change_solutions(minimise):
    scene, game = convex_game(scenes=2, agents=2)
    minimise = dataclasses.replace(minimise, tolerance=1e-6)
    expected = minimise(convex_energy(), scene, game)
    solution = minimise(convex_energy(), pad(scene, 2), widen_convex(game, 2))
    assert (solution.controls[:, :, :2] - expected.controls).abs().max() < 1e-9
    assert (solution.controls[:, :, 2:] == 0).all()
    assert (solution.status == Status.COMPLETED).all()
    assert solution.gradient_norm.isfinite().all()


@both
def test_a_start_whose_largest_derivative_is_the_tolerance_is_a_solution(minimise):
    energy = FeatureEnergy(["goal", "acc", "turnr"], [])
    scene, game = feature_game(scenes=1, modes=1)
    _, slope = gradient(energy, scene, game, game.initial_controls)
    largest = float(slope.detach().abs().max())
    assert slope.norm() > 1.1 * largest, "other entries are not zero"
    stays, moves = (
        dataclasses.replace(minimise, tolerance=share * largest)(energy, scene, game).controls for share in (1.01, 0.99)
    )
    assert torch.equal(stays, game.initial_controls)
    assert not torch.equal(moves, game.initial_controls)


@both
def test_a_nan_sample_stops_at_its_start_and_leaves_the_others_unchanged(minimise):
    scene, game = convex_game(scenes=2, modes=2, agents=2)
    expected = minimise(convex_energy(), scene, game)
    weight = game.own_weights["lateral"].clone()
    weight[1, 0] = torch.nan
    broken = dataclasses.replace(game, own_weights={**game.own_weights, "lateral": weight})
    solution = minimise(convex_energy(), scene, broken)
    stopped = torch.zeros(2, 2, dtype=torch.bool)
    stopped[1, 0] = True
    assert torch.equal(solution.status == Status.STOPPED, stopped)
    assert torch.equal(solution.controls[stopped], game.initial_controls[stopped])
    assert torch.equal(solution.controls[~stopped], expected.controls[~stopped])


@both
def test_solutions_are_constants(minimise):
    scene, game = convex_game(scenes=1, modes=1)
    leaves = leaves_of(game)
    solution = minimise(convex_energy(), scene, leaves)
    for tensor in (
        solution.controls,
        solution.states,
        solution.energy,
        solution.initial_energy,
        solution.gradient_norm,
    ):
        assert not tensor.requires_grad
    assert leaves.initial_controls.grad is None


@both
def test_empty_games_have_empty_solutions(minimise):
    scene, game = convex_game(scenes=2, agents=1)
    lone = minimise(convex_energy(), scene, game)
    assert (lone.energy < lone.initial_energy).all()
    empty = minimise(convex_energy(), scene[:0], game[:0])
    assert empty.controls.shape == (0, 2, 1, 6, 2)
    assert empty.states.shape == (0, 2, 1, 6, 4)
    with pytest.raises(ValueError, match="float32 and float64"):
        minimise(convex_energy(), scene, game.to(torch.float16))


def test_a_weight_of_zero_keeps_the_smallest_curvature():
    scene, game = convex_game(scenes=1, agents=2)
    none = {name: torch.zeros_like(weight) for name, weight in game.own_weights.items()}
    game = dataclasses.replace(game, own_weights=none, pair_weights={"order": torch.zeros_like(game.order)})
    energy = convex_energy()
    matrix = hessian(energy, scene, game, game.initial_controls)
    diagonal = torch.tensor([1.0, FLOOR], dtype=torch.float64).repeat(12).diag()
    torch.testing.assert_close(matrix.detach(), diagonal.expand_as(matrix), rtol=1e-12, atol=1e-15)
    assert PRECISE[0](energy, scene, game).controls.abs().max() < 1e-7


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (Newton, {"steps": -1}, "solver.steps must be a whole number, 0 or more, not -1"),
        (Newton, {"steps": 1.5}, "solver.steps must be a whole number, 0 or more, not 1.5"),
        (Newton, {"tolerance": float("nan")}, "solver.tolerance must be a number, 0 or more, and finite, not nan"),
        (Newton, {"tolerance": "1e-6"}, "solver.tolerance must be a number, 0 or more, and finite, not '1e-6'"),
        (Newton, {"tolerance": -1.0}, "solver.tolerance"),
        (LBFGS, {"steps": -1}, "solver.steps"),
        (LBFGS, {"tolerance": float("inf")}, "solver.tolerance"),
        (LBFGS, {"history": 0}, "solver.history"),
    ],
)
def test_invalid_settings_are_refused(kind, changes, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checks would come first
    with pytest.raises(ConfigError, match=message):
        kind(**changes)


@pytest.mark.parametrize(("name", "kind"), [("newton", Newton), ("lbfgs", LBFGS)])
def test_configuration_files_state_the_defaults(name, kind):
    config = yaml.safe_load((tree() / "conf" / "solver" / f"{name}.yaml").read_text())
    assert config.pop("name") == name
    assert kind(**config) == kind()
    assert set(config) == {field.name for field in dataclasses.fields(kind)}
