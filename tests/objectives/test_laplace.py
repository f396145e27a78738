"""Laplace's likelihood against exact Gaussians, dense matrices and finite differences, and games without a density."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
import yaml
from games import ALL, BOUNDS, EXID, leaves_of, pad, random_game, random_scene, widen
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

from epo_lightning.forecast import JointForecast
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import GRADIENT, RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.objectives.laplace import Laplace, log_densities
from epo_lightning.solvers.general import dense

CONF = Path(__file__).parents[2] / "conf" / "objective" / "laplace.yaml"
WEIGHTS = {"density": 1.0, "initial": 0.5, "goal": 0.1}
LINEAR = ("acc", "turnr", "jerk", "turnacc", "vel", "velref")
"""Features that are linear in the controls: the energy is quadratic."""
QUADRATIC = FeatureEnergy(own=LINEAR, pair=[])
GAME = FeatureEnergy(own=ALL, pair=["proximity"], bounds=BOUNDS)
HORIZON = 5


def setting(own=LINEAR, scenes=3, modes=3, agents=2):
    """A scene, its game and the controls that were taken in it."""
    scene = random_scene(scenes, agents, horizon=HORIZON, size=2.0, dtype=torch.float64)
    controls = 0.5 * torch.randn(scenes, agents, HORIZON, 2, dtype=torch.float64)
    scene = dataclasses.replace(scene, future=Unicycle().rollout(scene.current, controls, scene.dt))
    return scene, leaves_of(random_game(scene, modes, HORIZON, own=own)), controls


def forecast_of(energy, scene, parameters, logits=None):
    scenes, modes = parameters.initial_controls.shape[:2]
    logits = torch.zeros(scenes, modes, dtype=torch.float64) if logits is None else logits
    start = torch.where(scene.agent_mask[:, None, :, None, None], parameters.initial_controls, 0.0)
    states = energy.dynamics.rollout(energy.current_states(scene), start, scene.dt)
    return JointForecast(states, logits.softmax(-1), initial_states=states, parameters=parameters)


def gaussians(scene, parameters, damping=0.0):
    """The exact Gaussian of all controls of a scene: the energy is quadratic, expanded at zero controls."""
    origin = torch.zeros_like(parameters.initial_controls)
    with torch.enable_grad():
        at = origin.requires_grad_()
        (slope,) = torch.autograd.grad(QUADRATIC(scene, parameters, at).sum(), at, create_graph=True)
        rows = [torch.autograd.grad(part.sum(), at, retain_graph=True)[0] for part in slope.flatten(2).unbind(-1)]
    precision = torch.stack([row.flatten(2) for row in rows], -1).detach()
    precision = precision + damping * torch.eye(precision.shape[-1], dtype=torch.float64)
    mean = -torch.linalg.solve(precision, slope.detach().flatten(2))
    return MultivariateNormal(mean, precision_matrix=precision)


def mixture(scene, parameters, logits, controls):
    """Negative log-likelihood per control under the exact mixture."""
    density = gaussians(scene, parameters).log_prob(controls.flatten(1)[:, None])
    return (-(logits.log_softmax(-1) + density).logsumexp(-1) / controls[0].numel()).mean()


def test_on_quadratic_energies_it_is_the_exact_likelihood_of_a_mixture():
    scene, parameters, controls = setting()
    logits = torch.randn(3, 3, dtype=torch.float64)
    terms = Laplace(WEIGHTS, damping=0.0)(scene, forecast_of(QUADRATIC, scene, parameters, logits), QUADRATIC)
    assert_close(terms["density"][1], mixture(scene, parameters, logits, controls))
    assert terms["flat"] == (0.0, torch.tensor(0.0))
    assert terms["tracking"][1] < 1e-9


def test_its_gradient_is_that_of_the_exact_likelihood():
    scene, parameters, controls = setting(scenes=2, modes=2)
    logits = torch.randn(2, 2, dtype=torch.float64, requires_grad=True)
    Laplace(WEIGHTS, damping=0.0)(scene, forecast_of(QUADRATIC, scene, parameters, logits), QUADRATIC)["density"][
        1
    ].backward()
    leaves = [logits, *parameters.own_weights.values()]
    moves = [torch.randn_like(leaf) for leaf in leaves]

    def value(size: float) -> torch.Tensor:
        first, *rest = [leaf.detach() + size * move for leaf, move in zip(leaves, moves, strict=True)]
        at = dataclasses.replace(parameters, own_weights=dict(zip(LINEAR, rest, strict=True)))
        return mixture(scene, at, first, controls)

    numeric = (value(1e-5) - value(-1e-5)) / 2e-5
    analytic = sum((leaf.grad * move).sum() for leaf, move in zip(leaves, moves, strict=True))
    assert_close(analytic, numeric, rtol=1e-6, atol=1e-8)


def test_the_best_weight_is_the_precision_of_the_data():
    # Many demonstrations of one Gaussian: maximum likelihood finds w^2 = 1 / <u^2>.
    energy = FeatureEnergy(own=["acc", "turnr"], pair=[])
    scene, _, controls = setting(("acc", "turnr"), scenes=500, modes=1, agents=1)
    parameters = random_game(scene, 1, HORIZON, own=("acc", "turnr"))
    best = controls.square().mean((0, 1, 2)).rsqrt()
    for shift, sign in ((0.0, 0.0), (0.1, 1.0), (-0.1, -1.0)):
        weights = (best + shift).requires_grad_()
        named = {n: w.expand(500, 1, 1) for n, w in zip(("acc", "turnr"), weights, strict=True)}
        game = dataclasses.replace(parameters, own_weights=named)
        Laplace(WEIGHTS, damping=0.0)(scene, forecast_of(energy, scene, game), energy)["density"][1].backward()
        assert (weights.grad * sign > 0).all() if sign else (weights.grad.abs() < 1e-9).all()


def test_gradients_are_weighted_by_responsibilities():
    scene, parameters, controls = setting()
    logits = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    Laplace(WEIGHTS, damping=0.0)(scene, forecast_of(QUADRATIC, scene, parameters, logits), QUADRATIC)["density"][
        1
    ].backward()
    density = gaussians(scene, parameters).log_prob(controls.flatten(1)[:, None])
    prior, posterior = logits.softmax(-1), (logits.log_softmax(-1) + density).softmax(-1)
    assert_close(logits.grad, ((prior - posterior) / (3 * controls[0].numel())).detach())


def test_controls_that_were_not_observed_are_integrated_out():
    scene, parameters, controls = setting(modes=2)
    mask = torch.ones(3, 2, HORIZON, dtype=torch.bool)
    mask[0, 1, 3:] = False
    mask[1, 0] = False
    mask[2] = False
    future = torch.where(mask[..., None], scene.future, torch.nan)
    seen = dataclasses.replace(scene, future=future, future_mask=mask)
    terms = Laplace(WEIGHTS, damping=0.01)(seen, forecast_of(QUADRATIC, seen, parameters), QUADRATIC)
    losses = []
    # A damped parabola is one around the demonstration, wherever controls are not known around zero.
    shown = torch.where(mask[..., None], controls, 0.0)[:, None].expand(-1, 2, -1, -1, -1)
    for index in range(2):
        told = mask[index].flatten().repeat_interleave(2)
        game = parameters[index].map(torch.Tensor.detach)
        _, slope = dense.gradient(QUADRATIC, scene[index], game, shown[index : index + 1])
        matrix = dense.gauss_newton(QUADRATIC, scene[index], game, shown[index : index + 1])
        covariance = torch.linalg.inv(matrix + 0.01 * torch.eye(4 * HORIZON, dtype=torch.float64))[0]
        mean = shown[index].flatten(1) - (covariance @ slope[0].flatten(1)[..., None])[..., 0]
        some = MultivariateNormal(mean[:, told], covariance[:, told][:, :, told])
        density = some.log_prob(controls[index].flatten()[told])
        losses.append(-(density - math.log(2)).logsumexp(0) / told.sum())
    assert_close(terms["density"][1], sum(losses) / 3)  # nothing was observed of the third scene
    terms["density"][1].backward()
    assert (parameters.own_weights["jerk"].grad[:2] != 0).any()
    assert (parameters.own_weights["jerk"].grad[2] == 0).all()


class Other(Energy):
    """An energy that offers residuals only."""

    offers = frozenset({GRADIENT, RESIDUALS})

    def __init__(self, energy):
        self.energy, self.own, self.pair, self.dynamics = energy, energy.own, energy.pair, energy.dynamics

    def own_terms(self, *arguments):
        return self.energy.own_terms(*arguments)

    def pair_terms(self, *arguments):
        return self.energy.pair_terms(*arguments)

    def residuals(self, *arguments):
        return self.energy.residuals(*arguments)


@pytest.mark.parametrize("energy", [GAME, FeatureEnergy(own=EXID, pair=["proximity", "circles"], pair_stride=2)])
def test_any_game_gives_its_gradient_and_gauss_newton_matrix(energy):
    scene, parameters, controls = setting(tuple(energy.own), agents=3)
    parameters.pair_weights["circles"] = torch.rand(3, 3, 3, dtype=torch.float64, requires_grad=True)
    shown = controls[:, None].expand(-1, 3, -1, -1, -1)
    value, sound = log_densities(energy, scene, parameters, shown, 0.1)
    assert sound.all()
    _, slope = dense.gradient(energy, scene, parameters, shown)
    matrix = dense.gauss_newton(Other(energy), scene, parameters, shown.contiguous())
    blocks = matrix.unflatten(-1, (3, -1)).unflatten(-3, (3, -1))
    assert (blocks[:, :, 0, :, 1] != 0).any()  # pairs touch
    matrix = matrix + 0.1 * torch.eye(matrix.shape[-1], dtype=torch.float64)
    flat = slope.flatten(2)
    best = torch.linalg.solve(matrix, flat)
    expected = 0.5 * (torch.linalg.slogdet(matrix)[1] - (flat * best).sum(-1) - flat.shape[-1] * math.log(2 * math.pi))
    assert_close(value, expected)
    leaves = list(parameters.own_weights.values()) + [parameters.pair_weights[name] for name in energy.pair]
    found, correct = (torch.autograd.grad(v.sum(), leaves, retain_graph=True) for v in (value, expected))
    for one, other in zip(found, correct, strict=True):
        assert_close(one, other)


def test_coupled_agents_inform_each_others_missing_controls():
    scene, parameters, controls = setting(ALL, agents=3)
    mask = torch.ones(3, 3, HORIZON, dtype=torch.bool)
    mask[0, 1, 2:] = False
    mask[1, 0] = False
    mask[2, 1:, 1:] = False
    seen = dataclasses.replace(scene, future_mask=mask)
    shown = controls[:, None].expand(-1, 3, -1, -1, -1).contiguous()
    value, sound = log_densities(GAME, seen, parameters, shown, 0.1)
    assert sound.all()
    _, slope = dense.gradient(GAME, scene, parameters, shown)
    matrix = dense.gauss_newton(Other(GAME), scene, parameters, shown)
    covariance = torch.linalg.inv(matrix + 0.1 * torch.eye(matrix.shape[-1], dtype=torch.float64))
    away = (covariance @ slope.flatten(2)[..., None])[..., 0]  # of the demonstration from the mean
    expected = []
    for index, told in enumerate(mask.flatten(1).repeat_interleave(2, 1)):
        some = covariance[index][:, told][:, :, told]
        distance = (away[index][:, told] * torch.linalg.solve(some, away[index][:, told])).sum(-1)
        expected.append(-0.5 * (distance + torch.linalg.slogdet(some)[1] + told.sum() * math.log(2 * math.pi)))
    expected = torch.stack(expected)
    assert_close(value, expected)
    leaves = list(parameters.own_weights.values()) + list(parameters.pair_weights.values())
    found, correct = (torch.autograd.grad(v.sum(), leaves, retain_graph=True) for v in (value, expected))
    assert (found[-1] != 0).any()
    for one, other in zip(found, correct, strict=True):
        assert_close(one, other)


@pytest.mark.parametrize("pair", [[], ["proximity"], ["proximity", "circles"]])
def test_an_agent_on_its_own_has_no_pairs(pair):
    energy = FeatureEnergy(own=ALL, pair=pair, bounds=BOUNDS)
    scene, parameters, controls = setting(ALL, modes=2, agents=1)
    parameters.pair_weights["circles"] = parameters.pair_weights["proximity"]
    shown = controls[:, None].expand(-1, 2, -1, -1, -1)
    value, _ = log_densities(energy, scene, parameters, shown, 0.1)
    expected, _ = log_densities(Other(dataclasses.replace(energy, pair=[])), scene, parameters, shown, 0.1)
    assert_close(value, expected)
    leaves = list(parameters.own_weights.values())
    for one, other in zip(*(torch.autograd.grad(v.sum(), leaves) for v in (value, expected)), strict=True):
        assert_close(one, other)


def test_energies_of_other_kinds_have_the_same_likelihood():
    scene, parameters, controls = setting(ALL)
    shown = controls[:, None].expand(-1, 3, -1, -1, -1)
    known, unknown = (log_densities(energy, scene, parameters, shown, 0.1)[0] for energy in (GAME, Other(GAME)))
    assert_close(unknown, known)
    leaves = list(parameters.own_weights.values())
    for one, other in zip(*(torch.autograd.grad(v.sum(), leaves) for v in (unknown, known)), strict=True):
        assert_close(one, other)
    padded, wide = pad(scene), widen(parameters.map(torch.Tensor.detach), filling=7.0)
    shown = torch.nn.functional.pad(shown, (0, 0, 0, 0, 0, 2))
    assert_close(log_densities(Other(GAME), padded, wide, shown, 0.1)[0], known)


def test_longitudinal_progress_has_no_gradient_to_lateral_weights():
    # A straight line ahead, and an agent on it: acceleration costs nothing that the lane would see.
    energy = FeatureEnergy(own=["lane", "acc", "turnr"], pair=[])
    scene, parameters, controls = setting(tuple(energy.own), modes=1, agents=1)
    history, way = scene.history.clone(), torch.linspace(-50.0, 50.0, 6, dtype=torch.float64)
    history[..., 0] = history[..., 1] = history[..., 2] = 0.0
    line = torch.stack((way, torch.zeros_like(way)), -1).expand(3, 1, 2, 6, 2)
    controls = torch.where(torch.tensor([True, False]), controls, 0.0)
    future = Unicycle().rollout(history[:, :, -1], controls, scene.dt)
    scene = dataclasses.replace(scene, history=history, references=line, future=future)
    heavy = dataclasses.replace(
        parameters, own_weights={**parameters.own_weights, "turnr": torch.full((3, 1, 1), 1e4).double()}
    )
    value, _ = log_densities(energy, scene, heavy, controls[:, None], 0.0)
    acc = torch.distributions.Normal(torch.zeros(3, 1, 1).double(), 1.0 / heavy.own_weights["acc"])
    turn = torch.distributions.Normal(torch.zeros(3, 1, 1).double(), 1e-4)
    along = acc.log_prob(controls[..., 0]) + turn.log_prob(controls[..., 1])
    assert_close(value[:, 0], along.sum((1, 2)), rtol=1e-5, atol=1e-5)


def test_the_loss_does_not_depend_on_padding_or_batch():
    scene, parameters, controls = setting(ALL)
    objective = Laplace(WEIGHTS)
    narrow = objective(scene, forecast_of(GAME, scene, parameters), GAME)
    padded = leaves_of(widen(parameters.map(torch.Tensor.detach)))
    wide = objective(pad(scene), forecast_of(GAME, pad(scene), padded), GAME)
    for name, (weight, value) in narrow.items():
        assert_close(wide[name][1], value, msg=name)
        assert wide[name][0] == weight
    narrow["density"][1].backward()
    wide["density"][1].backward()
    for name in ALL:
        assert_close(padded.own_weights[name].grad[:, :, :2], parameters.own_weights[name].grad)
        assert (padded.own_weights[name].grad[:, :, 2:] == 0).all()
    shown = controls[:, None].expand(-1, 3, -1, -1, -1)
    whole, _ = log_densities(GAME, scene, parameters, shown, 0.1)
    alone, _ = log_densities(GAME, scene[1], parameters[1], shown[1:2], 0.1)
    assert_close(alone[0], whole[1])


@pytest.mark.parametrize("weight", [float("nan"), float("inf")])
def test_games_without_a_density_are_left_out(weight):
    scene, parameters, controls = setting()
    logits = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    spoiled = {name: value.detach().clone() for name, value in parameters.own_weights.items()}
    spoiled["vel"][0, 1] = weight
    spoiled["vel"][2] = weight
    bad = leaves_of(dataclasses.replace(parameters.map(torch.Tensor.detach), own_weights=spoiled))
    terms = Laplace(WEIGHTS, damping=0.0)(scene, forecast_of(QUADRATIC, scene, bad, logits), QUADRATIC)
    density = gaussians(scene, parameters).log_prob(controls.flatten(1)[:, None]) + logits.log_softmax(-1)
    first, second = density[0, [0, 2]].logsumexp(0), density[1].logsumexp(0)
    assert_close(terms["density"][1], -(first + second) / (3 * controls[0].numel()))
    assert_close(terms["flat"][1], torch.tensor(4 / 9, dtype=torch.float64))
    terms["density"][1].backward()
    for name in LINEAR:
        grad = bad.own_weights[name].grad
        assert grad.isfinite().all()
        assert (grad[0, 1] == 0).all()
        assert (grad[2] == 0).all()
        assert (grad[1] != 0).all()
    assert logits.grad.isfinite().all()


def test_a_matrix_without_a_factor_is_left_out():
    energy = FeatureEnergy(own=["acc"], pair=[])  # turn rates cost nothing: singular without damping
    scene, parameters, _ = setting(("acc",))
    forecast = forecast_of(energy, scene, parameters)
    terms = Laplace(WEIGHTS, damping=0.0)(scene, forecast, energy)
    assert terms["density"][1] == 0
    assert terms["flat"][1] == 1
    terms["density"][1].backward()
    assert (parameters.own_weights["acc"].grad == 0).all()
    assert Laplace(WEIGHTS)(scene, forecast, energy)["flat"][1] == 0


def test_initial_strategies_imitate():
    scene, parameters, _ = setting()
    forecast = forecast_of(QUADRATIC, scene, parameters)
    weight, value = Laplace(WEIGHTS)(scene, forecast, QUADRATIC)["initial"]
    assert weight == 0.5
    distance = (forecast.initial_states - scene.future[:, None])[..., :2].norm(dim=-1).mean((2, 3))
    assert_close(value, distance.min(1).values.mean())
    value.backward()
    assert (parameters.initial_controls.grad.flatten(2).norm(dim=-1) > 0).sum() == 3


def test_the_solution_has_no_gradient():
    scene, parameters, _ = setting()
    Laplace(WEIGHTS)(scene, forecast_of(QUADRATIC, scene, parameters), QUADRATIC)["density"][1].backward()
    assert parameters.initial_controls.grad is None


@pytest.mark.parametrize("damping", [-1.0, float("inf"), float("nan")])
def test_an_invalid_damping_is_refused(damping):
    with pytest.raises(ValueError, match="damping"):
        Laplace(WEIGHTS, damping)


def test_weights_are_named_by_the_terms():
    with pytest.raises(ValueError, match="weights must name"):
        Laplace({"density": 1.0})


def test_the_configuration_states_the_default():
    given = yaml.safe_load(CONF.read_text())
    assert given.pop("name") == "laplace"
    part = Laplace(**given)
    assert part.damping == Laplace(part.weights).damping
    assert tuple(part.weights) == Laplace.term_names
