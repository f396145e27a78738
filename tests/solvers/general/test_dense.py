"""Dense derivatives against structured ones and finite differences."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from convex_games import convex_energy, convex_game, unaware, widen_convex
from dense_games import FEATURES, Learned, feature_game, learned_game
from games import normal_equations, pad, random_game, random_scene, widen

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import TURN_RATE
from epo_lightning.solvers.general.dense import factorise, gauss_newton, gradient, hessian


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize(
    "own", [["goal", "vel", "acc", "turnr"], ["lane", "velref", "steer", "jerk", "turnacc", "goal"]]
)
def test_dense_equals_structured(own, exact):
    scene = random_scene(2, 3, history=2, size=1.0, dtype=torch.float64)
    game, energy = random_game(scene, 2, 5), FeatureEnergy(own)
    if exact and "lane" in own:
        energy = FeatureEnergy([name for name in own if name != "lane"])  # its nearest point slides
    slope, matrix = normal_equations(energy, scene, game, game.initial_controls, exact)
    found = (hessian if exact else gauss_newton)(energy, scene, game, game.initial_controls)
    torch.testing.assert_close(found, matrix, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(gradient(energy, scene, game, game.initial_controls)[1], slope, rtol=1e-10, atol=1e-10)


@pytest.fixture
def curved():
    """Declared features with functions of every linear signal and of the distance, all with second derivatives."""
    for source in (Source.CONTROL, Source.RATE, Source.SPEED):
        own_feature(f"curved_{source.value}", source, TURN_RATE)(lambda signal: (0.5 * signal).sin() + signal.square())
    pair_feature("curved", Source.DISTANCE)(lambda distance, reach: (reach - distance).exp() * distance)
    yield [name for name in OWN_FEATURES if name.startswith("curved")]
    for known in (OWN_FEATURES, PAIR_FEATURES):
        for name in [name for name in known if name.startswith("curved")]:
            del known[name]


@pytest.mark.parametrize("exact", [True, False])
def test_dense_equals_structured_for_custom_features(curved, exact):
    assert len(curved) == 3
    scene = random_scene(2, 3, history=2, size=1.0, dtype=torch.float64)
    game = random_game(scene, 2, 5, tuple(curved), pair=("curved",))
    for energy in [FeatureEnergy([name]) for name in curved] + [FeatureEnergy(["acc"], ["curved"])]:
        some = dataclasses.replace(game, own_weights={**game.own_weights, "acc": game.own_weights[curved[0]]})
        some = dataclasses.replace(some, pair_weights={**some.pair_weights, "proximity": some.pair_weights["curved"]})
        _, matrix = normal_equations(energy, scene, some, game.initial_controls, exact)
        found = (hessian if exact else gauss_newton)(energy, scene, some, game.initial_controls)
        torch.testing.assert_close(found, matrix, rtol=1e-10, atol=1e-9)


def test_hessians_equal_central_differences_of_gradients():
    scene, game = learned_game()
    energy, controls = Learned(), game.initial_controls
    matrix = hessian(energy, scene, game, controls)
    for index in (0, 7, 29):
        shift = torch.zeros_like(controls)
        shift.flatten(2)[..., index] = 1e-5
        with torch.no_grad():
            change = (
                gradient(energy, scene, game, controls + shift)[1] - gradient(energy, scene, game, controls - shift)[1]
            ) / 2e-5
        torch.testing.assert_close(matrix[..., index], change.flatten(2), rtol=0, atol=1e-7)


def test_gauss_newton_is_exact_where_residuals_are_linear():
    scene, game = convex_game()
    for direction in ("along", "across"):
        energy = unaware(convex_energy(direction=direction))
        approximate = gauss_newton(energy, scene, game, game.initial_controls)
        torch.testing.assert_close(approximate, hessian(energy, scene, game, game.initial_controls), rtol=0, atol=1e-10)


@pytest.mark.parametrize("function", [hessian, gauss_newton])
@pytest.mark.parametrize("convex", [True, False])
def test_matrices_are_differentiable_by_the_game(function, convex):
    """The gradient of log det H, which a Laplace approximation needs, against central differences."""
    scene, game = convex_game() if convex else feature_game()
    energy = convex_energy() if convex else FEATURES
    name, kind = ("order", "pair_weights") if convex else ("goal", "own_weights")

    def logdet(weights):
        changed = dataclasses.replace(game, **{kind: {**getattr(game, kind), name: weights}})
        matrix = function(energy, scene, changed, game.initial_controls)
        return torch.logdet(matrix + 50.0 * torch.eye(matrix.shape[-1], dtype=torch.float64)).sum()

    weights = (4.0 * getattr(game, kind)[name]).requires_grad_()
    (slope,) = torch.autograd.grad(logdet(weights), weights)
    shift = torch.randn_like(weights)
    with torch.no_grad():
        numeric = (logdet(weights + 1e-5 * shift) - logdet(weights - 1e-5 * shift)) / 2e-5
    assert numeric.abs() > 1e-3
    torch.testing.assert_close((slope * shift).sum(), numeric, rtol=1e-6, atol=0)


@pytest.mark.parametrize("function", [hessian, gauss_newton])
@pytest.mark.parametrize("convex", [True, False])
def test_absent_agents_have_rows_of_the_identity(function, convex):
    scene, game = convex_game() if convex else feature_game()
    energy = convex_energy() if convex else FEATURES
    matrix = function(energy, scene, game, game.initial_controls)
    wide = widen_convex(game, 1) if convex else widen(game, 1)
    padded = function(energy, pad(scene, 1), wide, wide.initial_controls)
    size = matrix.shape[-1]
    torch.testing.assert_close(padded[..., :size, :size], matrix, rtol=0, atol=1e-11)
    assert (padded[..., size:, :size] == 0).all()
    assert (padded[..., :size, size:] == 0).all()
    rest = padded[..., size:, size:]
    assert torch.equal(rest, torch.eye(rest.shape[-1], dtype=torch.float64).expand_as(rest))


def test_matrices_without_a_factor_are_found_and_leave_the_others_alone():
    square = torch.randn(6, 4, 4, dtype=torch.float64)
    matrix = square @ square.mT + torch.eye(4, dtype=torch.float64)
    expected = torch.linalg.cholesky(matrix)
    assert torch.equal(factorise(matrix)[0], expected)
    matrix[1, 3, 0] = matrix[1, 0, 3] = torch.nan
    matrix[2, 1, 1] = torch.inf
    matrix[3, 2, 1] = matrix[3, 1, 2] = -torch.inf
    matrix[4] -= 50.0 * torch.eye(4, dtype=torch.float64)
    factor, sound = factorise(matrix)
    assert sound.tolist() == [True, False, False, False, False, True]
    assert torch.equal(factor[sound], expected[sound])
    assert torch.equal(factor[~sound], torch.eye(4, dtype=torch.float64).expand(4, 4, 4))


def test_energies_without_residuals_have_no_gauss_newton_matrix():
    scene, game = learned_game()
    with pytest.raises(ValueError, match="Learned has no residuals"):
        gauss_newton(Learned(), scene, game, game.initial_controls)
