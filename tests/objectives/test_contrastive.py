"""Contrastive maximum likelihood against the gradient of the exact likelihood, and parameters without a gradient."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
import yaml
from games import ALL, BOUNDS, leaves_of, pad, random_game, random_scene, widen
from torch.testing import assert_close

from epo_lightning.forecast import JointForecast
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.selection import games
from epo_lightning.objectives.contrastive import Contrastive
from epo_lightning.solvers.general.gradient_descent import GradientDescent
from epo_lightning.solvers.general.langevin import Langevin

CONF = Path(__file__).parents[2] / "conf" / "objective" / "contrastive.yaml"
WEIGHTS = {"contrastive": 1.0, "magnitude": 0.5, "initial": 1.0, "goal": 0.1, "probability": 0.1}
QUADRATIC = FeatureEnergy(own=["acc", "turnr"], pair=[])
GAME = FeatureEnergy(own=ALL, pair=["proximity"], bounds=BOUNDS)
STILL = GradientDescent(steps=0)


def demonstrate(scene, controls):
    """The scene in which these controls were taken."""
    return dataclasses.replace(scene, future=QUADRATIC.dynamics.rollout(scene.current, controls, scene.dt))


def forecast_of(energy, scene, parameters, solver=STILL, probabilities=None):
    solution = solver(energy, scene, parameters)
    scenes, modes = solution.energy.shape
    start = torch.where(scene.agent_mask[:, None, :, None, None], parameters.initial_controls, 0.0)
    return JointForecast(
        states=solution.states,
        probabilities=torch.full((scenes, modes), 1.0 / modes) if probabilities is None else probabilities,
        initial_states=energy.dynamics.rollout(energy.current_states(scene), start, scene.dt),
        parameters=parameters,
        solution=solution,
    )


def setting(energy=GAME, own=ALL, scenes=3, modes=3, agents=2):
    scene = random_scene(scenes, agents, horizon=7, size=2.0, dtype=torch.float64)
    scene = demonstrate(scene, 0.5 * torch.randn(scenes, agents, 7, 2, dtype=torch.float64))
    return scene, leaves_of(random_game(scene, modes, 7, own=own))


def test_with_exact_samples_the_gradient_is_that_of_the_likelihood():
    # Precision w^2: -log p = w^2 u^2 / 2 - log w + ..., per control. Samples +-1 / w have exactly the right second moment.
    scene, parameters = setting(QUADRATIC, ("acc", "turnr"), modes=1)
    weights = torch.stack([parameters.own_weights[name] for name in ("acc", "turnr")], -1)[..., None, :]
    signs = torch.randint(2, parameters.initial_controls.shape) * 2.0 - 1.0
    exact = dataclasses.replace(parameters, initial_controls=(signs / weights).detach())
    controls = torch.randn(3, 2, 7, 2, dtype=torch.float64)
    terms = Contrastive(WEIGHTS)(demonstrate(scene, controls), forecast_of(QUADRATIC, scene, exact), QUADRATIC)
    terms["contrastive"][1].backward()
    for channel, name in enumerate(("acc", "turnr")):
        weight = parameters.own_weights[name]
        leaf = weight.detach().clone().requires_grad_()
        normal = torch.distributions.Normal(torch.zeros_like(leaf)[..., None], 1.0 / leaf[..., None])
        likelihood = -normal.log_prob(controls[:, None, ..., channel]).sum((1, 2, 3)).mean()
        likelihood.backward()
        assert_close(weight.grad, leaf.grad)


def test_the_configured_weights_leave_the_temperature_to_the_data():
    """With exact samples, the loss of 160 controls of unit variance is stationary at precision 1, and nowhere near it."""
    shape = (1, 2, 40, 2)
    scene = random_scene(1, 2, horizon=40, dtype=torch.float64)
    scene = demonstrate(scene, torch.randint(2, shape) * 2.0 - 1.0)
    objective, slopes = Contrastive(**{k: v for k, v in yaml.safe_load(CONF.read_text()).items() if k != "name"}), []
    for precision in (0.8, 1.0, 1.25):
        root = torch.tensor(precision, dtype=torch.float64).sqrt().requires_grad_()
        exact = random_game(scene, 1, 40, own=("acc", "turnr"))
        own = {name: root.expand(1, 1, 2) for name in ("acc", "turnr")}
        samples = (torch.randint(2, shape) * 2.0 - 1.0)[:, None] / root.detach()
        exact = dataclasses.replace(exact, own_weights=own, initial_controls=samples)
        terms = objective(scene, forecast_of(QUADRATIC, scene, exact), QUADRATIC)
        loss = sum(terms[name][0] * terms[name][1] for name in ("contrastive", "magnitude"))
        slopes += torch.autograd.grad(loss, root)
    assert slopes[0] < -0.05
    assert abs(slopes[1]) < 1e-6
    assert slopes[2] > 0.05


def test_with_langevin_samples_the_gradient_is_within_sampling_error():
    scene = random_scene(4000, 1, horizon=2, dtype=torch.float64)
    controls = torch.randn(4000, 1, 2, 2, dtype=torch.float64)
    scene = demonstrate(scene, controls)
    weight = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    parameters = random_game(scene, 1, 2, own=("acc", "turnr"))
    parameters = dataclasses.replace(parameters, own_weights={n: weight.expand(4000, 1, 1) for n in ("acc", "turnr")})
    forecast = forecast_of(QUADRATIC, scene, parameters, Langevin(80, 0.25))
    Contrastive(WEIGHTS)(scene, forecast, QUADRATIC)["contrastive"][1].backward()
    exact = (1.5 * controls.square().sum((1, 2, 3))).mean() - 4 / 1.5
    # Four squares of samples per scene: 1.5 <u_s^2> is 1 / 1.5 on average, sqrt(2) of that as spread; the steps add 4 %.
    bias = 4 / 1.5 * (1.0 / (1.0 - 0.25 * 0.25**2 * 1.5**2) - 1.0)
    error = (4 * 2.0 / 4000) ** 0.5 / 1.5
    assert abs(weight.grad - (exact - bias)) < 5 * error


def test_a_step_makes_the_demonstration_cheaper_than_the_sample():
    scene, parameters = setting(modes=1)
    forecast = forecast_of(GAME, scene, parameters)
    objective = Contrastive(WEIGHTS)
    value = objective(scene, forecast, GAME)["contrastive"][1]
    value.backward()
    with torch.no_grad():
        for weight in (*parameters.own_weights.values(), *parameters.pair_weights.values()):
            weight -= 1e-5 * weight.grad
        assert objective(scene, forecast, GAME)["contrastive"][1] < value


def test_the_value_is_the_difference_of_energies_of_the_mode_that_came_closest():
    scene, parameters = setting(scenes=8)
    forecast = forecast_of(GAME, scene, parameters, Langevin(2, 0.01))
    offset = forecast.states[..., :2] - scene.future[:, None, ..., :2]
    mode = offset.norm(dim=-1).mean((2, 3)).argmin(1)
    assert len(mode.unique()) > 1
    controls = (
        scene.future[..., [3, 2]] - torch.cat((scene.current[:, :, None], scene.future[:, :, :-1]), 2)[..., [3, 2]]
    )
    everyone = (controls / scene.dt)[:, None].expand(-1, 3, -1, -1, -1)
    index = torch.arange(8), mode
    shown, drawn = GAME(scene, parameters, everyone)[index], GAME(scene, parameters, forecast.solution.controls)[index]
    terms = Contrastive(WEIGHTS)(scene, forecast, GAME)
    assert_close(terms["contrastive"][1], (shown - drawn).mean())
    assert_close(terms["magnitude"][1], (shown.square() + drawn.square()).mean())
    assert terms["tracking"][0] == 0.0
    assert terms["tracking"][1] < 1e-9
    (terms["contrastive"][1] + terms["magnitude"][1]).backward()
    taught = torch.zeros(8, 3, dtype=torch.bool)
    taught[index] = True
    assert torch.equal(parameters.own_weights["vel"].grad.abs().sum(-1) > 0, taught)


def test_samples_have_no_gradient():
    scene, parameters = setting()
    forecast = forecast_of(GAME, scene, parameters, GradientDescent(2, 1e-3))
    assert forecast.solution.controls.requires_grad
    terms = Contrastive(WEIGHTS)(scene, forecast, GAME)
    terms["contrastive"][1].backward()
    assert parameters.initial_controls.grad is None
    assert parameters.own_weights["vel"].grad.abs().sum() > 0


def test_initial_strategies_are_trained_towards_the_ends_of_chains():
    scene, parameters = setting(agents=1)
    scene = pad(scene)
    parameters = leaves_of(widen(parameters))
    forecast = forecast_of(GAME, scene, parameters, Langevin(3, 0.01))
    moved = dataclasses.replace(forecast, initial_states=forecast.initial_states.detach().requires_grad_())
    value = Contrastive(WEIGHTS)(scene, moved, GAME)["initial"][1]
    apart = (moved.initial_states - forecast.solution.states)[:, :, 0, :, :2].norm(dim=-1)
    assert_close(value, apart.mean())
    value.backward()
    with torch.no_grad():
        nearer = moved.initial_states - 1e-4 * moved.initial_states.grad
        closer = dataclasses.replace(forecast, initial_states=nearer)
        assert Contrastive(WEIGHTS)(scene, closer, GAME)["initial"][1] < value
    same = forecast_of(GAME, scene, parameters)
    assert Contrastive(WEIGHTS)(scene, same, GAME)["initial"][1] == 0


def test_the_probability_is_of_the_mode_that_came_closest():
    scene, parameters = setting()
    forecast = forecast_of(GAME, scene, parameters)
    mode = (forecast.states - scene.future[:, None])[..., :2].norm(dim=-1).mean((2, 3)).argmin(1)
    probabilities = torch.rand(3, 3, dtype=torch.float64).softmax(-1)
    forecast = dataclasses.replace(forecast, probabilities=probabilities)
    value = Contrastive(WEIGHTS)(scene, forecast, GAME)["probability"][1]
    assert_close(value, -probabilities[torch.arange(3), mode].log().mean())


def test_goals_are_learned_where_they_are_decoded():
    scene, parameters = setting()
    forecast = forecast_of(GAME, scene, parameters)
    assert "goal" not in Contrastive(WEIGHTS)(scene, forecast, GAME)
    scene = dataclasses.replace(
        scene,
        goal_candidates=torch.randn(3, 2, 4, 2, dtype=torch.float64),
        goal_mask=None,
    )
    logits = torch.randn(3, 2, 4, dtype=torch.float64)
    forecast = dataclasses.replace(forecast, goal_probabilities=logits.softmax(-1))
    weight, value = Contrastive(WEIGHTS)(scene, forecast, GAME)["goal"]
    closest = (scene.goal_candidates - scene.future[:, :, -1:, :2]).norm(dim=-1).argmin(-1)
    assert weight == 0.1
    assert_close(value, torch.nn.functional.cross_entropy(logits.flatten(0, 1), closest.flatten()))


def test_unobserved_controls_are_taken_from_the_sample():
    scene, parameters = setting(QUADRATIC, ("acc", "turnr"), modes=1)
    mask = torch.ones(3, 2, 7, dtype=torch.bool)
    mask[0] = False  # a scene of which nothing was observed
    mask[1, 0, 4:] = False
    future = torch.where(mask[..., None], scene.future, torch.nan)
    seen = dataclasses.replace(scene, future=future, future_mask=mask)
    terms = Contrastive(WEIGHTS)(seen, forecast_of(QUADRATIC, scene, parameters), QUADRATIC)
    terms["contrastive"][1].backward()
    weight = parameters.own_weights["acc"].detach()
    speeds = torch.cat((scene.current[:, :, None], scene.future), 2)[..., 3]
    shown, drawn = speeds.diff(dim=-1) / scene.dt, parameters.initial_controls.detach()[:, 0, ..., 0]
    difference = torch.where(mask, shown.square() - drawn.square(), 0.0).sum(-1)[:, None]
    assert_close(parameters.own_weights["acc"].grad, weight * difference / 3)
    assert (parameters.own_weights["acc"].grad[0] == 0).all()


def test_a_scene_without_observations_has_no_gradient():
    scene, parameters = setting()
    mask = torch.ones(3, 2, 7, dtype=torch.bool)
    mask[1] = False
    seen = dataclasses.replace(
        scene,
        future=torch.where(mask[..., None], scene.future, torch.nan),
        future_mask=mask,
        goal_candidates=torch.randn(3, 2, 4, 2, dtype=torch.float64),
        goal_mask=None,
    )
    logits, choice = (
        torch.randn(3, 3, requires_grad=True),
        torch.randn(3, 2, 4, dtype=torch.float64, requires_grad=True),
    )
    forecast = forecast_of(GAME, seen, parameters, Langevin(3, 0.01), logits.softmax(-1))
    forecast = dataclasses.replace(
        forecast,
        initial_states=forecast.initial_states.detach().requires_grad_(),
        goal_probabilities=choice.softmax(-1),
    )
    terms = Contrastive(WEIGHTS)(seen, forecast, GAME)
    sum(weight * value for weight, value in terms.values()).backward()
    leaves = (*parameters.own_weights.values(), parameters.goals)
    assert (parameters.pair_weights["proximity"].grad[1] == 0).all()
    for tensor in (*leaves, logits, choice, forecast.initial_states):
        assert (tensor.grad[1] == 0).all()
        assert (tensor.grad[[0, 2]] != 0).any()
    # The others count as before.
    alone = dataclasses.replace(seen[[0, 2]], goal_candidates=None, goal_mask=None)
    rest = dataclasses.replace(forecast, goal_probabilities=None)[[0, 2]]
    for name, (_, value) in Contrastive(WEIGHTS)(alone, rest, GAME).items():
        share = 1.0 if name == "tracking" else 2.0 / 3.0
        assert_close(terms[name][1], share * value, msg=name)


def test_padding_does_not_change_the_loss():
    scene, parameters = setting()
    narrow = Contrastive(WEIGHTS)(scene, forecast_of(GAME, scene, parameters), GAME)
    padded = leaves_of(widen(parameters.map(torch.Tensor.detach)))
    wide = Contrastive(WEIGHTS)(pad(scene), forecast_of(GAME, pad(scene), padded), GAME)
    for name, (weight, value) in narrow.items():
        assert_close(wide[name][1], value, msg=name)
        assert wide[name][0] == weight
    sum(weight * value for weight, value in narrow.values()).backward()
    sum(weight * value for weight, value in wide.values()).backward()
    for name in ALL:
        assert_close(padded.own_weights[name].grad[:, :, :2], parameters.own_weights[name].grad)
        assert (padded.own_weights[name].grad[:, :, 2:] == 0).all()


def test_game_parameters_are_indexed_together():
    scene, parameters = setting()
    parameters = dataclasses.replace(parameters, context=torch.randn(3, 2, 5, dtype=torch.float64))
    scenes, modes = torch.tensor([2, 0, 2]), torch.tensor([1, 2, 0])
    chosen = games(parameters, scenes, modes)
    assert torch.equal(chosen.own_weights["lane"][:, 0], parameters.own_weights["lane"][scenes, modes])
    assert torch.equal(chosen.reference[:, 0], parameters.reference[scenes, modes])
    assert torch.equal(chosen.context, parameters.context[scenes])
    assert chosen.order is None
    drawn = parameters.initial_controls
    energies = GAME(scene[scenes], chosen, drawn[scenes, modes][:, None])[:, 0]
    assert_close(energies, GAME(scene, parameters, drawn)[scenes, modes])


@pytest.mark.parametrize("weights", [{"contrastive": 1.0}, {**WEIGHTS, "imitation": 1.0}])
def test_weights_are_named_by_the_terms(weights):
    with pytest.raises(ValueError, match="weights must name"):
        Contrastive(weights)


def test_a_scene_without_a_future_is_refused():
    scene, parameters = setting()
    forecast = forecast_of(GAME, scene, parameters)
    with pytest.raises(ValueError, match=r"scene\.future"):
        Contrastive(WEIGHTS)(dataclasses.replace(scene, future=None, future_mask=None), forecast, GAME)


def test_the_configuration_file_states_the_defaults():
    given = yaml.safe_load(CONF.read_text())
    assert given.pop("name") == "contrastive"
    assert tuple(Contrastive(**given).weights) == Contrastive.term_names
