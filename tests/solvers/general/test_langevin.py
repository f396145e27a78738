"""Langevin samples against their exact distribution on quadratic energies, after some steps and in the limit."""

from __future__ import annotations

import dataclasses

import torch
from games import ALL, BOUNDS, leaves_of, pad, random_game, random_scene, widen

from epo_lightning.forecast import Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.general.dense import gauss_newton, gradient
from epo_lightning.solvers.general.gradient_descent import GradientDescent, Progress, descend
from epo_lightning.solvers.general.langevin import Langevin

GAME = FeatureEnergy(own=ALL, pair=["proximity"], bounds=BOUNDS)
CHAINS = 20_000


def chains(own, weights, horizon=3):
    """One agent with the same game in many modes, all starting at the same controls."""
    scene = random_scene(1, 1, dtype=torch.float64)
    parameters = random_game(scene, 1, horizon, own=own)
    for name, weight in weights.items():
        parameters.own_weights[name].fill_(weight)
    many = parameters.map(lambda tensor: tensor.expand(-1, CHAINS, *tensor.shape[2:]))
    return FeatureEnergy(own=own, pair=[]), scene, parameters, many


def assert_within_error(samples, mean, covariance):
    """Assert that mean and covariance of samples [C, n] are as given, up to five standard errors."""
    count = len(samples)
    deviation = (samples.mean(0) - mean).abs()
    assert (deviation < 5.0 * (covariance.diagonal() / count).sqrt()).all()
    variance = covariance.diagonal()
    error = ((variance[:, None] * variance + covariance.square()) / count).sqrt()
    assert ((samples.T.cov() - covariance).abs() < 5.0 * error).all()


def test_samples_have_the_mean_and_covariance_of_the_linear_recursion():
    # Jerk couples neighbouring accelerations, and speeds those of all steps: the covariance is full.
    own = ("acc", "turnr", "jerk", "vel")
    energy, scene, one, many = chains(own, {"acc": 1.0, "turnr": 3.0, "jerk": 0.05, "vel": 2.0})
    delta, scale, steps = 0.5, [1.0, 0.5], 6
    found = Langevin(steps, delta, scale)(energy, scene, many).controls[0].flatten(1)

    start = one.initial_controls
    curvature = gauss_newton(energy, scene, one, start)[0, 0]
    _, slope = gradient(energy, scene, one, torch.zeros_like(start))
    minimum = -torch.linalg.solve(curvature, slope.flatten())
    spread = torch.tensor(scale, dtype=torch.float64).repeat(3)
    carry = torch.eye(6, dtype=torch.float64) - 0.5 * delta**2 * spread.square()[:, None] * curvature
    mean, covariance = start.flatten() - minimum, torch.zeros(6, 6, dtype=torch.float64)
    for _ in range(steps):
        mean, covariance = carry @ mean, carry @ covariance @ carry.T + delta**2 * spread.square().diag()
    assert_within_error(found, minimum + mean, covariance)


def test_long_chains_sample_the_density_widened_by_the_step_size():
    weights = {"acc": 1.0, "turnr": 2.0}
    energy, scene, _, many = chains(("acc", "turnr"), weights, horizon=2)
    delta = 0.8
    found = Langevin(100, delta)(energy, scene, many).controls[0].flatten(1)
    curvature = torch.tensor([1.0, 4.0], dtype=torch.float64).repeat(2)
    widened = 1.0 / (curvature * (1.0 - 0.25 * delta**2 * curvature))
    assert widened[1] > 2.0 / curvature[1]  # by far more than the error of this test
    assert_within_error(found, torch.zeros(4, dtype=torch.float64), widened.diag())


def test_short_steps_sample_the_density_whatever_the_scale():
    energy, scene, _, many = chains(("acc", "turnr"), {"acc": 1.0, "turnr": 20.0}, horizon=2)
    found = Langevin(200, 0.2, [1.0, 0.05])(energy, scene, many).controls[0].flatten(1)
    exact = torch.tensor([1.0, 1.0 / 400.0], dtype=torch.float64).repeat(2)
    assert ((found.var(0) / exact - 1.0).abs() < 0.06).all()  # 1 % of it from the steps


def test_noise_comes_from_the_generator_and_has_no_derivative():
    scene = random_scene(dtype=torch.float64)
    parameters = leaves_of(random_game(scene))
    first, second = (Langevin(3)(GAME, scene, parameters) for _ in range(2))
    assert not torch.equal(first.controls, second.controls)
    torch.manual_seed(5)
    again = Langevin(3)(GAME, scene, parameters).controls
    torch.manual_seed(5)
    assert torch.equal(again, Langevin(3)(GAME, scene, parameters).controls)
    assert not any(getattr(first, name).requires_grad for name in ("controls", "states", "energy"))


def test_forecasts_are_made_without_noise():
    scene = random_scene(dtype=torch.float64)
    parameters = random_game(scene)
    quiet = Langevin(5, 0.2, [1.0, 0.3]).for_test()
    assert quiet == GradientDescent(5, 0.5 * 0.2**2, [1.0, 0.3])
    assert quiet.for_test() is quiet
    assert torch.equal(quiet(GAME, scene, parameters).controls, quiet(GAME, scene, parameters).controls)


def test_absent_agents_keep_zero_controls():
    scene = random_scene(dtype=torch.float64)
    parameters = random_game(scene)
    solution = Langevin(5)(GAME, pad(scene), widen(parameters))
    assert (solution.controls[:, :, 2:] == 0).all()
    assert (solution.controls[:, :, :2] != parameters.initial_controls).all()
    assert solution.energy.isfinite().all()
    assert (solution.status != Status.STOPPED).all()


def test_a_stopped_chain_stays_stopped():
    scene = random_scene(2, dtype=torch.float64)
    parameters = random_game(scene)
    start = parameters.initial_controls.clone()
    start[0, 1] = float("inf")
    solution = Langevin(5)(GAME, scene, dataclasses.replace(parameters, initial_controls=start))
    stopped = torch.zeros(2, 2, dtype=torch.bool)
    stopped[0, 1] = True
    assert torch.equal(solution.status == Status.STOPPED, stopped)
    assert solution.controls[1].isfinite().all()
    assert torch.equal(solution.controls[0, 1], start[0, 1])


def test_shorter_steps_have_the_noise_of_their_length():
    """A step of eta / 4 has half the noise: the variance is 2 eta at any length, or the samples would not be of exp(-E)."""
    scene = random_scene(dtype=torch.float64)
    parameters = random_game(scene)
    start = parameters.initial_controls
    value, slope = gradient(GAME, scene, parameters, start)
    progress = Progress(torch.full_like(value, 0.25), value, torch.ones_like(value, dtype=torch.bool))
    delta, scale = 0.02, torch.tensor([1.0, 0.5], dtype=torch.float64)
    torch.manual_seed(3)
    found, _ = descend(GAME, scene, parameters, 1, 0.5 * delta**2, scale.tolist(), delta, progress)
    torch.manual_seed(3)
    noise = 0.5 * delta * scale * torch.randn_like(start)
    expected = start - 0.25 * 0.5 * delta**2 * scale.square() * slope + noise
    torch.testing.assert_close(found.controls, expected, rtol=0, atol=1e-12)


def test_chains_do_not_drift_away_from_their_lowest_energy():
    """What counts is the lowest energy so far, and not the present one: else the energy could rise at every step."""
    scene = random_scene(dtype=torch.float64)
    parameters = random_game(scene)
    start = parameters.initial_controls
    value, _ = gradient(GAME, scene, parameters, start)
    slack = 10.0 * (5.0 + start[0, 0].numel() / 2)  # ten times the n / 2 of n controls, and some more for few of them
    full, taken = torch.ones_like(value), torch.ones_like(value, dtype=torch.bool)
    for above, good in ((0.9 * slack, True), (1.1 * slack, False)):
        torch.manual_seed(3)
        found, progress = descend(
            GAME, scene, parameters, 1, 1e-8, [1.0, 1.0], 1e-4, Progress(full, value - above, taken)
        )
        assert (progress.length == (1.0 if good else 0.5)).all()
        assert (found.controls != start).all() == good
