"""The layer against a dense reference, finite differences, Theseus and closed-form solutions."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import jaxtyping
import pytest
import torch
from games import ALL, BOUNDS, leaves_of, random_game, random_scene

from epo_lightning.forecast import Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.solvers.backward import Detached, Implicit, Truncated, Unrolled
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt


def central_differences(function, tensor, cotangent, step=1e-5):
    """d <cotangent, function(tensor)> / d tensor, one entry of all (independent) scenes and modes at a time."""
    columns = []
    for index in range(tensor[0, 0].numel()):
        shift = torch.zeros_like(tensor)
        shift.flatten(2)[..., index] = step
        change = function(tensor + shift) - function(tensor - shift)
        columns.append((change * cotangent).flatten(2).sum(-1) / (2 * step))
    return torch.stack(columns, -1).view_as(tensor)


@pytest.mark.parametrize("size", [0.01, 2.0], ids=["pairs apart", "pairs overlapping"])
@pytest.mark.parametrize("bounds", [BOUNDS, dict.fromkeys(BOUNDS, (-99.0, 99.0))], ids=["bounds active", "bounds idle"])
@pytest.mark.parametrize("agents", [2, 3])
def test_unrolled_gradients_equal_central_differences(size, bounds, agents):
    scene = random_scene(2, agents, history=2, size=size, dtype=torch.float64)
    parameters = random_game(scene, modes=2, horizon=5)
    energy = FeatureEnergy(ALL, bounds=bounds)
    residuals = energy.residuals(scene, parameters, parameters.initial_controls)
    assert (residuals["proximity"] != 0).any() == (size == 2.0)
    assert (residuals["velb"] != 0).any() == (bounds is BOUNDS)
    solve = LevenbergMarquardt(2, 0.3, 10.0)
    cotangent = torch.randn_like(parameters.initial_controls)

    leaves = leaves_of(parameters)
    (solve(energy, scene, leaves).controls * cotangent).sum().backward()

    def compare(analytic, replace, tensor):
        numeric = central_differences(lambda t: solve(energy, scene, replace(t)).controls, tensor, cotangent)
        error = (analytic - numeric).norm() / numeric.norm().clamp_min(
            1e-2
        )  # rounding of the differences themselves: 1e-9
        assert error < 1e-6

    compare(leaves.goals.grad, lambda t: dataclasses.replace(parameters, goals=t), parameters.goals)
    compare(
        leaves.initial_controls.grad,
        lambda t: dataclasses.replace(parameters, initial_controls=t),
        parameters.initial_controls,
    )
    for kind in ("own_weights", "pair_weights"):
        given_weights = getattr(parameters, kind)
        for name, weight in given_weights.items():
            compare(
                getattr(leaves, kind)[name].grad,
                lambda t, kind=kind, name=name, rest=given_weights: dataclasses.replace(
                    parameters, **{kind: {**rest, name: t}}
                ),
                weight,
            )


def test_a_linear_quadratic_game_is_solved_in_one_full_step():
    """An energy of speed and control features is quadratic, with a minimiser in closed form."""
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    parameters = random_game(scene, horizon=6)
    energy = FeatureEnergy(["vel", "acc", "turnr"], pair=[])
    solution = LevenbergMarquardt(1, 1.0, 0.0)(energy, scene, parameters)
    # Nothing pulls on turn rates, so they vanish; accelerations solve (w_v^2 S^T S + w_a^2 I) a = -w_v^2 S^T v0.
    sums = 0.1 * torch.ones(6, 6, dtype=torch.float64).tril()
    for b in range(2):
        for m in range(2):
            for i in range(2):
                speed = parameters.own_weights["vel"][b, m, i] ** 2
                effort = parameters.own_weights["acc"][b, m, i] ** 2
                matrix = speed * sums.T @ sums + effort * torch.eye(6, dtype=torch.float64)
                right = -speed * sums.T @ scene.current[b, i, 3].expand(6)
                expected = torch.linalg.solve(matrix, right)
                torch.testing.assert_close(solution.controls[b, m, i, :, 0], expected, rtol=0, atol=1e-12)
    assert solution.controls[..., 1].abs().max() < 1e-12
    assert solution.gradient_norm.max() < 1e-10


def test_many_steps_reach_an_equilibrium():
    scene = random_scene(4, 3, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, horizon=8)
    energy = FeatureEnergy(["goal", "vel", "acc", "turnr"])
    solution = LevenbergMarquardt(200, 1.0, 1.0, keep_iterates=True)(energy, scene, parameters)
    assert solution.gradient_norm.max() < 1e-8
    assert (solution.energy < solution.initial_energy).all()
    assert len(solution.iterates) == 201
    assert (solution.iterates[0] == parameters.initial_controls).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": -1}, "solver.steps"),
        ({"steps": 1.5}, "solver.steps must be a whole number, 0 or more, not 1.5"),
        ({"step_size": 0.0}, r"solver.step_size must be a number in \(0, 1\]"),
        ({"step_size": "0.3"}, r"solver.step_size must be a number in \(0, 1\], not '0.3'"),
        ({"step_size": 1.5}, "solver.step_size"),
        ({"damping": -1.0}, "solver.damping"),
        ({"damping": float("nan")}, "solver.damping must be a number, 0 or more, and finite, not nan"),
        ({"damping": float("inf")}, "solver.damping"),
        ({"damping": 1e308}, r"solver.damping must be 1e\+30 or less"),
        ({"test_steps": -1}, "solver.test_steps"),
        ({"backend": "cuda"}, "unknown solver.backend"),
    ],
)
def test_bad_settings_are_refused(arguments, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checks would come first
    with pytest.raises(ConfigError, match=message):
        LevenbergMarquardt(**arguments)


def test_bad_settings_of_derivatives_are_refused():
    with pytest.raises(ConfigError, match=r"backward\.steps must be a whole number, 1 or more"):
        Truncated(0)
    with pytest.raises(ConfigError, match=r"unknown backward\.hessian 'newton'"):
        Implicit("newton")


@pytest.mark.parametrize("backend", ["compiled", "pytorch"])
def test_the_gradient_of_a_float32_layer_is_close_to_float64(backend):
    scene = random_scene(16, 2, size=0.5, dtype=torch.float64)
    parameters = random_game(scene, horizon=40, spread=0.1)
    energy, solve = FeatureEnergy(ALL, bounds=BOUNDS), LevenbergMarquardt(backend=backend)

    def gradient(dtype):
        leaves = leaves_of(parameters.to(dtype))
        solve(energy, scene.to(dtype), leaves).states.sum().backward()
        return leaves.initial_controls.grad.double().flatten(2)

    exact = gradient(torch.float64)
    error = (gradient(torch.float32) - exact).norm(dim=-1) / exact.norm(dim=-1)
    # A sample whose hinge, or nearest segment, rounding decides may have another gradient altogether: few of them do.
    assert error.median() < 1e-5
    assert error.quantile(0.9) < 1e-4


def test_the_ten_line_example_of_the_readme():
    from epo_lightning import FeatureEnergy, GameParameters, LevenbergMarquardt, Scene

    history = torch.tensor([[[[-2.0, 0.0, 0.0, 1.0]], [[2.0, 0.1, torch.pi, 1.0]]]])  # [B=1, N=2, H=1, 4]
    scene = Scene(history, dt=0.1, size=torch.full((1, 2, 2), 0.5))
    parameters = GameParameters(
        own_weights={name: torch.ones(1, 1, 2) for name in ("goal", "acc", "turnr")},
        pair_weights={"proximity": torch.full((1, 1, 1), 10.0)},
        goals=torch.tensor([[[[2.0, 0.0], [-2.0, 0.0]]]]),
        initial_controls=torch.zeros(1, 1, 2, 40, 2),
    )
    solve = LevenbergMarquardt(steps=100, step_size=0.3, damping=1.0)
    solution = solve(FeatureEnergy(own=["goal", "acc", "turnr"], pair=["proximity"]), scene, parameters)
    gap = (solution.states[0, 0, 0, :, :2] - solution.states[0, 0, 1, :, :2]).norm(dim=-1).min()
    assert gap > 0.4, "they start on a collision course and should pass each other"
    assert solution.energy < solution.initial_energy
    assert isinstance(scene, Scene)


SMOOTH = ["goal", "velref", "vel", "acc", "jerk", "steer", "turnr", "turnacc"]
"""Features whose minimum moves smoothly with the game; a lane has corners."""


def solved_game(own, agents=2, horizon=4, scenes=2):
    """A game whose minimum a full Gauss-Newton method finds to the last digits."""
    scene = random_scene(scenes, agents, history=2, size=1.0, dtype=torch.float64)
    scene.history[..., :2] *= 0.3
    parameters = random_game(scene, 1, horizon, tuple(own), spread=0.1)
    return scene, parameters, LevenbergMarquardt(300, 1.0, 1e-2)


@pytest.mark.parametrize("own", [SMOOTH, [*SMOOTH, "lane"], ["goal", "acc", "turnr", "accb", "velb", "turnrb"]])
def test_implicit_gradients_equal_central_differences_of_the_minimum(own):
    scene, parameters, solve = solved_game(own)
    energy = FeatureEnergy(own, bounds=BOUNDS)
    leaves = leaves_of(parameters)
    solution = Implicit()(solve, energy, scene, leaves)
    assert solution.gradient_norm.max() < 1e-9
    assert (energy.residuals(scene, parameters, solution.controls.detach())["proximity"] != 0).any()
    assert (solution.status == Status.COMPLETED).all()
    cotangent = torch.randn_like(parameters.initial_controls)
    (solution.controls * cotangent).sum().backward()
    assert leaves.initial_controls.grad is None
    again = solve.with_steps(40)
    for kind, name in [*(("own_weights", name) for name in own), ("pair_weights", "proximity"), ("goals", None)]:
        given = getattr(parameters, kind)
        tensor = given if name is None else given[name]

        def replace(t, kind=kind, name=name, given=given):
            return dataclasses.replace(parameters, **{kind: t if name is None else {**given, name: t}})

        def minimum(t, replace=replace):
            from_there = dataclasses.replace(replace(t), initial_controls=solution.controls.detach())
            return again(energy, scene, from_there).controls

        numeric = central_differences(minimum, tensor, cotangent)
        analytic = getattr(leaves, kind).grad if name is None else getattr(leaves, kind)[name].grad
        assert (analytic - numeric).norm() / numeric.norm().clamp_min(1e-2) < 1e-6

    # Scaling all weights together does not move a minimum: the gradient along them vanishes.
    along = [(w * w.grad).sum((1, 2)) for w in (*leaves.own_weights.values(), *leaves.pair_weights.values())]
    size = sum(part.abs() for part in along)
    assert (sum(along).abs() < 1e-9 * size).all()


@pytest.mark.parametrize("backend", ["auto", "pytorch"])
def test_agents_of_a_negative_size_stop_their_game(backend):
    """A negative distance of touching would switch their interaction off, without a trace; one agent alone has none."""
    scene = random_scene(2, 2, history=2, size=2.0)
    scene.size[1, 0, 0] = -2.0
    solve = LevenbergMarquardt(2, backend=backend)
    status = solve(FeatureEnergy(["acc"]), scene, random_game(scene, own=("acc",))).status
    assert (status[0] == Status.COMPLETED).all()
    assert (status[1] == Status.STOPPED).all()
    alone = random_scene(1, 1, history=2, size=-2.0)
    assert (solve(FeatureEnergy(["acc"]), alone, random_game(alone, own=("acc",))).status == Status.COMPLETED).all()


def test_gauss_newton_hessians_give_another_implicit_gradient():
    scene, parameters, solve = solved_game(SMOOTH)
    energy, gradients = FeatureEnergy(SMOOTH), []
    for hessian in ("exact", "gauss_newton"):
        leaves = leaves_of(parameters)
        Implicit(hessian)(solve, energy, scene, leaves).controls.sum().backward()
        gradients.append(leaves.goals.grad.flatten())
    cosine = torch.nn.functional.cosine_similarity(*gradients, dim=0)
    assert 0.9 < cosine < 1.0 - 1e-9


def test_points_that_are_no_minimum_have_zero_implicit_gradients():
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    parameters = random_game(scene, 1, 4, ("goal",))
    parameters.own_weights["goal"][1] = 0.0
    scene.history[0, :, :, 2] = 0.0  # both drive on to goals ahead, which they have yet to reach
    leaves = leaves_of(parameters)
    solution = Implicit()(LevenbergMarquardt(2), FeatureEnergy(["goal"], []), scene, leaves)
    assert (solution.status[1] == Status.STOPPED).all()
    solution.states.sum().backward()
    assert (leaves.own_weights["goal"].grad[1] == 0).all()
    assert (leaves.goals.grad[1] == 0).all()


@pytest.mark.parametrize("adaptive", [False, True])
def test_truncated_gradients_are_those_of_the_last_steps(adaptive):
    scene = random_scene(2, 2, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, horizon=5)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    solve = LevenbergMarquardt(5, 0.3, 10.0, True, adaptive=adaptive)
    leaves = leaves_of(parameters)
    solution = Truncated(2)(solve, energy, scene, leaves)
    full = solve(energy, scene, parameters)
    for name in ("controls", "states", "energy", "initial_energy", "gradient_norm", "status"):
        torch.testing.assert_close(getattr(solution, name), getattr(full, name), rtol=0, atol=0)
    assert len(solution.iterates) == 6
    solution.controls.sum().backward()
    assert leaves.initial_controls.grad is None
    if adaptive:
        return  # the damping of the last steps is what the first ones left
    again = leaves_of(dataclasses.replace(parameters, initial_controls=full.iterates[3]))
    LevenbergMarquardt(2, 0.3, 10.0)(energy, scene, again).controls.sum().backward()
    for truncated, last in zip(leaves.own_weights.values(), again.own_weights.values(), strict=True):
        torch.testing.assert_close(truncated.grad, last.grad, rtol=0, atol=0)
    torch.testing.assert_close(leaves.goals.grad, again.goals.grad, rtol=0, atol=0)


def test_detached_solutions_have_no_gradient():
    scene = random_scene(2, 2, history=2)
    energy, leaves = FeatureEnergy(ALL, bounds=BOUNDS), leaves_of(random_game(scene))
    solution = Detached()(LevenbergMarquardt(), energy, scene, leaves)
    assert not solution.controls.requires_grad
    assert not solution.states.requires_grad


def test_adaptive_steps_never_raise_the_energy_of_any_sample():
    scene = random_scene(6, 3, history=2, size=2.0, dtype=torch.float64)
    scene = dataclasses.replace(scene, dt=0.5)  # long ways, on which a linearised heading is far from the truth
    parameters = random_game(scene, horizon=10, spread=1.0)
    energy = FeatureEnergy(["goal", "vel", "acc", "turnr"])
    solve = LevenbergMarquardt(12, 1.0, 1e-3, keep_iterates=True, adaptive=True)
    solution = solve(energy, scene, parameters)
    energies = torch.stack([energy(scene, parameters, controls) for controls in solution.iterates])
    assert (energies.diff(dim=0) <= 1e-12 * energies[:-1]).all()
    still = torch.stack([(a == b).flatten(2).all(-1) for a, b in pairwise(solution.iterates)])
    rejected = still & (solution.gradient_norm > 1e-6)
    assert rejected.any(), "the problem should be hard enough for steps to be rejected"
    assert not rejected.all(-1).all(-1).any()
    torch.testing.assert_close(solution.energy, energies[-1], rtol=1e-12, atol=0)
    controls = solution.controls.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(scene, parameters, controls).sum(), controls)
    torch.testing.assert_close(solution.gradient_norm, gradient.flatten(2).norm(dim=-1), rtol=1e-6, atol=1e-9)
    for index in range(6):
        alone = solve(energy, scene[index], parameters[index])
        assert torch.equal(alone.controls[0], solution.controls[index])


@pytest.mark.parametrize("backend", ["compiled", "pytorch"])
def test_adaptive_damping_stays_in_its_range(backend):
    scene, own = random_scene(4, 2, history=2, size=0.01, dtype=torch.float64), ("goal", "acc", "turnr")
    energy, game = FeatureEnergy(own), random_game(scene, 2, 8, own=own)
    game.own_weights["goal"].fill_(0.05)
    solve = LevenbergMarquardt(step_size=1.0, adaptive=True, backend=backend)
    with torch.no_grad():
        found, damping = solve.run(energy, scene, game, 1, torch.full((4, 2), 1e-7, dtype=torch.float64))
        assert (found.energy < found.initial_energy).all()
        assert (damping == 1e-7).all(), "an accepted step divides it by ten, down to this"
        game = dataclasses.replace(game, initial_controls=torch.zeros_like(game.initial_controls))
        for weight in game.own_weights.values():
            weight.fill_(0.0)
        _, damping = solve.run(energy, scene, game, 1, torch.full((4, 2), 1e3, dtype=torch.float64))
        assert (damping == 1e4).all(), "a step that changes nothing multiplies it by ten"


def test_adaptive_gradients_equal_central_differences():
    scene = random_scene(2, 2, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, 1, 5, spread=2.0)
    energy, solve = FeatureEnergy(SMOOTH), LevenbergMarquardt(4, 1.0, 1.0, adaptive=True)
    leaves = leaves_of(parameters)
    cotangent = torch.randn_like(parameters.initial_controls)
    (solve(energy, scene, leaves).controls * cotangent).sum().backward()
    numeric = central_differences(
        lambda goals: solve(energy, scene, dataclasses.replace(parameters, goals=goals)).controls,
        parameters.goals,
        cotangent,
    )
    assert (leaves.goals.grad - numeric).norm() / numeric.norm() < 1e-5


def test_another_number_of_steps_outside_training():
    solve = LevenbergMarquardt(2, test_steps=7)
    assert solve.for_test().steps == 7
    assert LevenbergMarquardt(2).for_test().steps == 2


@pytest.mark.parametrize("backend", ["compiled", "pytorch"])
@pytest.mark.parametrize("backward", [Unrolled(), Truncated(), Implicit(), Detached()])
@pytest.mark.parametrize(("scenes", "modes", "agents"), [(0, 2, 2), (2, 0, 2), (2, 2, 0)])
def test_empty_games_have_empty_solutions(backend, backward, scenes, modes, agents):
    scene = random_scene(scenes, agents, history=2)
    energy, game = FeatureEnergy(ALL, bounds=BOUNDS), random_game(scene, modes)
    solution = backward(LevenbergMarquardt(backend=backend), energy, scene, game)
    assert solution.states.shape == (scenes, modes, agents, 7, 4)
    assert solution.status.shape == (scenes, modes)


@pytest.mark.parametrize("backend", ["compiled", "pytorch"])
def test_scenes_are_converted_to_the_precision_of_the_game(backend):
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    parameters = random_game(scene).to(torch.float32)
    solve, energy = LevenbergMarquardt(backend=backend), FeatureEnergy(ALL, bounds=BOUNDS)
    mixed = solve(energy, scene, parameters)
    assert torch.equal(mixed.controls, solve(energy, scene.to(torch.float32), parameters).controls)
    with pytest.raises(ValueError, match=r"torch\.float16; the layer takes float32 and float64"):
        solve(energy, scene, parameters.to(torch.float16))
