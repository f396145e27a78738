"""Gradient descent: closed forms on quadratic energies, its derivative, and its treatment of NaN."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
import yaml
from games import ALL, BOUNDS, leaves_of, pad, random_game, random_scene, widen
from torch.testing import assert_close

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.solvers.backward import Truncated
from epo_lightning.solvers.general.dense import gradient
from epo_lightning.solvers.general.gradient_descent import GradientDescent
from epo_lightning.solvers.general.langevin import Langevin

CONF = Path(__file__).parents[3] / "conf" / "solver"
QUADRATIC = FeatureEnergy(own=["acc", "turnr"], pair=[])
GAME = FeatureEnergy(own=ALL, pair=["proximity"], bounds=BOUNDS)


def quadratic(scenes=3, modes=2, agents=2, horizon=5):
    scene = random_scene(scenes, agents, dtype=torch.float64)
    return scene, random_game(scene, modes, horizon, own=("acc", "turnr"))


def game(scenes=3, agents=2, modes=2):
    # Large discs: pairs matter.
    scene = random_scene(scenes, agents, size=2.0, dtype=torch.float64)
    return scene, random_game(scene, modes)


def broken(parameters: GameParameters, sample: tuple[int, int], weight: float) -> GameParameters:
    """The game with one weight of one sample replaced."""
    weights = {name: value.clone() for name, value in parameters.own_weights.items()}
    weights["acc"][sample] = weight
    return dataclasses.replace(parameters, own_weights=weights)


def floats(parameters: GameParameters) -> list[torch.Tensor]:
    """The tensors that a solution is differentiated by, in the order in which ``map`` visits them."""
    found: list[torch.Tensor] = []

    def visit(tensor: torch.Tensor) -> torch.Tensor:
        if tensor.is_floating_point():
            found.append(tensor)
        return tensor

    parameters.map(visit)
    return found


def test_steps_on_a_quadratic_energy_are_powers():
    scene, parameters = quadratic()
    scale = torch.tensor([1.0, 0.5], dtype=torch.float64)
    solution = GradientDescent(steps=7, step_size=0.2, scale=[1.0, 0.5])(QUADRATIC, scene, parameters)
    stiffness = torch.stack([parameters.own_weights[name] for name in ("acc", "turnr")], -1).square()[..., None, :]
    expected = (1.0 - 0.2 * scale.square() * stiffness) ** 7 * parameters.initial_controls
    assert_close(solution.controls, expected)
    assert_close(solution.initial_energy, 0.5 * (stiffness * parameters.initial_controls.square()).sum((2, 3, 4)))
    assert_close(solution.energy, 0.5 * (stiffness * expected.square()).sum((2, 3, 4)))
    assert_close(solution.gradient_norm, (stiffness * expected).flatten(2).norm(dim=-1))
    assert_close(solution.states, QUADRATIC.dynamics.rollout(scene.current[:, None], expected, scene.dt))
    assert (solution.status == Status.COMPLETED).all()


def test_steps_contract_up_to_the_bound_and_are_shortened_beyond_it():
    scene, parameters = quadratic()
    parameters.own_weights["acc"].fill_(2.0)
    parameters.own_weights["turnr"].fill_(20.0)
    bound = 2.0 / max(2.0**2, 20.0**2 * 0.1**2)  # 2 / lambda_max(S H S)
    for share, status in ((0.99, Status.COMPLETED), (1.01, Status.DAMPED), (50.0, Status.DAMPED)):
        solution = GradientDescent(60, share * bound, [1.0, 0.1])(QUADRATIC, scene, parameters)
        assert (solution.energy < 0.2 * solution.initial_energy).all()
        assert (solution.status == status).all()


@pytest.mark.parametrize("steps", [1, 3])
def test_path_derivative_is_that_of_the_truncated_problem(steps):
    scene, parameters = game(scenes=2)
    solve = GradientDescent(steps, 0.02, [1.0, 0.3])
    leaves = leaves_of(parameters)
    cotangent = torch.randn_like(parameters.initial_controls)
    (cotangent * solve(GAME, scene, leaves).controls).sum().backward()
    found = [tensor.grad for tensor in floats(leaves)]
    assert len(found) == len(ALL) + 5  # own weights, one pair weight, goals, headings, initial and reference controls
    moves = [torch.randn_like(tensor) for tensor in found]

    def value(size: float) -> torch.Tensor:
        rest = iter(moves)
        at = parameters.map(lambda t: t + size * next(rest) if t.is_floating_point() else t)
        return (cotangent * solve(GAME, scene, at).controls).sum()

    with torch.no_grad():
        numeric = (value(1e-6) - value(-1e-6)) / 2e-6
    analytic = sum((a * b).sum() for a, b in zip(found, moves, strict=True))
    assert_close(analytic, numeric, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("taught", [1, 3, 9, 20])
def test_truncation_changes_what_is_learned_and_not_what_is_found(taught):
    # Steps so long that samples halve them, some after others.
    scene, parameters = game(scenes=4)
    solve = GradientDescent(9, 0.5, [1.0, 0.3])
    whole = solve(GAME, scene, leaves_of(parameters))
    leaves = leaves_of(parameters)
    parts = Truncated(taught)(solve, GAME, scene, leaves)
    for name in ("controls", "states", "energy", "initial_energy", "gradient_norm", "status"):
        assert torch.equal(getattr(parts, name), getattr(whole, name)), name
    assert (whole.status == Status.DAMPED).sum() > 4
    assert (whole.status != Status.STOPPED).all()
    parts.controls.square().sum().backward()
    gradients = torch.cat([leaves.own_weights[name].grad for name in ALL])
    assert gradients.isfinite().all()
    assert (gradients != 0).any()


@torch.no_grad()
def test_continued_descent_keeps_its_step_size():
    scene, parameters = game(scenes=4)
    solve = GradientDescent(9, 0.5, [1.0, 0.3])
    first, memory = solve.run(GAME, scene, parameters, 6)
    onward = dataclasses.replace(parameters, initial_controls=first.controls)
    whole = solve(GAME, scene, parameters).controls
    assert torch.equal(solve.run(GAME, scene, onward, 3, memory)[0].controls, whole)
    assert not torch.equal(solve.run(GAME, scene, onward, 3)[0].controls, whole)


@torch.no_grad()
@pytest.mark.parametrize("first", range(8))
def test_the_status_covers_all_steps(first):
    # One control with curvature 1, nine times too long: halved thrice before anything is taken, or at the end.
    scene, parameters = quadratic(scenes=1, modes=1, agents=1)
    for name in QUADRATIC.own:
        parameters.own_weights[name].fill_(1.0)
    for steps, size, status in ((8, 9.0, Status.DAMPED), (8, 1e9, Status.STOPPED), (8, 1.0, Status.COMPLETED)):
        whole = GradientDescent(steps, size)(QUADRATIC, scene, parameters)
        parts = Truncated(steps - first)(GradientDescent(steps, size), QUADRATIC, scene, parameters)
        assert whole.status.item() == parts.status.item() == status
        assert torch.equal(whole.controls, parts.controls)


@torch.no_grad()
def test_many_steps_approach_a_minimum():
    scene, parameters = game()
    solution = GradientDescent(60, 5e-4)(GAME, scene, parameters)
    assert (solution.energy < solution.initial_energy).all()
    _, slope = gradient(GAME, scene, parameters, solution.controls)
    assert_close(solution.gradient_norm, slope.flatten(2).norm(dim=-1))
    start = GradientDescent(0)(GAME, scene, parameters).gradient_norm
    assert (solution.gradient_norm < 0.3 * start).all()


def test_no_steps_return_the_start():
    scene, parameters = game()
    solution = GradientDescent(0)(GAME, scene, parameters)
    assert torch.equal(solution.controls, parameters.initial_controls)
    assert torch.equal(solution.energy, solution.initial_energy)


@pytest.mark.parametrize("weight", [float("nan"), 1e100])
@pytest.mark.parametrize("solve", [GradientDescent(4, 0.01), Langevin(4, 0.1)])
def test_a_stopped_sample_keeps_its_last_finite_iterate(solve, weight):
    scene, parameters = game()
    bad = broken(parameters, (1, 0), weight)
    torch.manual_seed(3)
    whole = solve(GAME, scene, parameters)
    torch.manual_seed(3)
    solution = solve(GAME, scene, bad)
    stopped = torch.zeros(3, 2, dtype=torch.bool)
    stopped[1, 0] = True
    assert torch.equal(solution.status == Status.STOPPED, stopped)
    assert torch.equal(solution.controls[stopped], parameters.initial_controls[stopped])
    assert_close(solution.controls[~stopped], whole.controls[~stopped], rtol=1e-12, atol=1e-12)
    assert solution.states.isfinite().all()


@pytest.mark.parametrize("weight", [float("nan"), 1e100])
def test_a_stopped_sample_leaves_gradients_finite(weight):
    scene, parameters = game()
    solve = GradientDescent(4, 0.02)
    leaves, bad = leaves_of(parameters), leaves_of(broken(parameters, (1, 0), weight))
    solve(GAME, scene, leaves).controls.square().sum().backward()
    solve(GAME, scene, bad).controls.square().sum().backward()
    for name in ALL:
        assert bad.own_weights[name].grad.isfinite().all()
        good = torch.ones(3, 2, dtype=torch.bool)
        good[1, 0] = False
        assert_close(bad.own_weights[name].grad[good], leaves.own_weights[name].grad[good])
    # What stays where it began moves with it.
    start = bad.initial_controls
    assert_close(start.grad[1, 0], 2.0 * start.detach()[1, 0])


def test_solutions_do_not_depend_on_padding_or_batch():
    scene, parameters = game()
    solve = GradientDescent(5, 0.02)
    leaves = leaves_of(parameters)
    solution = solve(GAME, scene, leaves)
    solution.controls.square().sum().backward()
    padded = leaves_of(widen(parameters))
    wide = solve(GAME, pad(scene), padded)
    wide.controls.square().sum().backward()
    assert_close(wide.controls[:, :, :2], solution.controls)
    assert (wide.controls[:, :, 2:] == 0).all()
    assert_close(wide.energy, solution.energy)
    for name in ALL:
        grad = padded.own_weights[name].grad
        assert_close(grad[:, :, :2], leaves.own_weights[name].grad)
        assert (grad[:, :, 2:] == 0).all()
    alone = solve(GAME, scene[1], parameters[1])
    assert_close(alone.controls[0], solution.controls[1])


def test_solutions_have_the_precision_of_the_game():
    scene, parameters = game()
    solution = GradientDescent(3)(GAME, scene.to(torch.float32), parameters)
    assert solution.controls.dtype == torch.float64


@pytest.mark.parametrize("shape", [(0, 2, 2), (2, 0, 2), (2, 2, 0)])
def test_empty_games_have_empty_solutions(shape):
    scenes, modes, agents = shape
    scene = random_scene(scenes, agents)
    solution = GradientDescent(2)(GAME, scene, random_game(scene, modes))
    assert solution.controls.shape == (scenes, modes, agents, 7, 2)
    assert solution.states.shape == (scenes, modes, agents, 7, 4)


@pytest.mark.parametrize(
    ("part", "settings", "key"),
    [
        (GradientDescent, {"steps": -1}, "solver.steps"),
        (GradientDescent, {"step_size": 0.0}, "solver.step_size"),
        (GradientDescent, {"step_size": float("inf")}, "solver.step_size"),
        (GradientDescent, {"scale": [1.0]}, "solver.scale"),
        (GradientDescent, {"scale": [1.0, 0.0]}, "solver.scale"),
        (Langevin, {"steps": -1}, "solver.steps"),
        (Langevin, {"delta": -0.1}, "solver.delta"),
        (Langevin, {"scale": [1.0, -1.0]}, "solver.scale"),
    ],
)
def test_invalid_settings_are_refused(part, settings, key):
    with pytest.raises(ConfigError, match=key):
        part(**settings)


@pytest.mark.parametrize(("name", "part"), [("gradient_descent", GradientDescent), ("langevin", Langevin)])
def test_the_configuration_states_the_defaults(name, part):
    given = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    assert given.pop("name") == name
    given["scale"] = tuple(given["scale"])
    assert part(**given) == part()
    assert set(given) == {field.name for field in dataclasses.fields(part)}
