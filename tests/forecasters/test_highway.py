"""Every forecaster on highway scenes, with every backbone: lanes, goal candidates, missing future steps."""

from __future__ import annotations

import pytest
import torch
from games import EXID, highway_scene, pad
from suites import LOSS_WEIGHTS, HighwaySuite, highway_model, model

from epo_lightning.forecasters import build_forecaster
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

EPO = {
    "name": "epo",
    "modes": 3,
    "own_start": {"vel": 0.05},
    "symmetric_pairs": True,
}
WITHOUT_GOAL = {"name": "features", "own": [name for name in EXID if name not in ("goal", "lane")]}


class TestMarginal(HighwaySuite):
    config = {"name": "marginal", "modes": 3, "loss_weights": LOSS_WEIGHTS}


class TestSceneConsistent(HighwaySuite):
    config = {"name": "scene_consistent", "modes": 3, "loss_weights": LOSS_WEIGHTS}


class TestEPO(HighwaySuite):
    config = EPO


def forecaster(config=EPO, **changes):
    torch.manual_seed(1)
    return build_forecaster(highway_model(config, **changes))


def test_mode_m_heads_for_the_mth_most_likely_candidate_along_its_line():
    epo, scene = forecaster(), highway_scene(4)
    forecast = epo.predict(scene)
    probabilities = forecast.goal_probabilities
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(4, 4))
    assert (probabilities[~scene.goal_mask] == 0).all()
    for b in range(4):
        for i in range(4):
            ranked = probabilities[b, i].argsort(descending=True, stable=True)[: scene.goal_mask[b, i].sum()]
            for m in range(3):
                chosen = ranked[m % len(ranked)]
                assert torch.equal(forecast.parameters.goals[b, m, i], scene.goal_candidates[b, i, chosen])
                assert forecast.parameters.reference[b, m, i] == scene.goal_reference[b, i, chosen]


def test_the_goal_loss_trains_only_the_goal_decoder():
    epo, scene = forecaster().train(), highway_scene(8)
    terms = epo.losses(scene, epo(scene))
    assert {name: weight for name, (weight, _) in terms.items()} == {**LOSS_WEIGHTS, "goal": 0.1}
    terms["goal"][1].backward()
    taught = {name.split(".")[0] for name, parameter in epo.named_parameters() if parameter.grad is not None}
    assert taught == {"backbone", "goals"}


def test_agents_without_candidates_have_zero_goal_weights():
    epo, scene = forecaster(), highway_scene(2)
    scene.goal_mask[0, 1] = False
    forecast = epo.predict(scene)
    assert forecast.states.isfinite().all()
    weights = forecast.parameters.own_weights
    for name in EXID:
        assert (weights[name][0, :, 1] == 0).all() == (name in ("goal", "lane"))
        assert (weights[name][0, :, 0] != 0).all()
    assert (forecast.goal_probabilities[0, 1] == 0).all()
    padded = epo.predict(pad(scene, agents=1))
    assert (padded.goal_probabilities[:, 4] == 0).all()
    assert (padded.parameters.goals[:, :, 4] == 0).all()


def test_without_a_decoder_of_strategies_solutions_start_at_zero():
    """The ablation "no init"."""
    epo = forecaster({**EPO, "initial": "zero"}).train()
    scene = highway_scene(16)
    scene = Scene(**{**vars(scene), "size": 20.0 * scene.size})
    forecast = epo(scene)
    assert (forecast.parameters.initial_controls == 0).all()
    assert (forecast.controls != 0).any()
    sum(weight * value for weight, value in epo.losses(scene, forecast).values()).backward()
    for name, parameter in epo.named_parameters():
        assert not name.startswith("strategies")
        assert not parameter.requires_grad or parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("backbone", ["v_lstm", "vibes", "hivt_m"])
def test_without_a_goal_in_the_energy_no_goal_is_decoded(backbone):
    """The ablation "no goal"."""
    epo = forecaster(energy=WITHOUT_GOAL, backbone={"name": backbone}).train()
    scene = highway_scene(16)
    scene = Scene(**{**vars(scene), "size": 20.0 * scene.size})
    forecast = epo(scene)
    assert forecast.goal_probabilities is None
    assert forecast.parameters.goals is None
    terms = epo.losses(scene, forecast)
    assert set(terms) == {"imitation", "probability"}
    sum(weight * value for weight, value in terms.values()).backward()
    for name, parameter in epo.named_parameters():
        assert "goal" not in name
        assert not parameter.requires_grad or parameter.grad.abs().sum() > 0, name


def test_constant_velocity_keeps_heading_and_speed_on_a_map():
    scene = highway_scene(3)
    scene.history[:, :, -1, 2] = 0.3
    forecast = forecaster({"name": "constant_velocity"}).predict(scene)
    time = 0.2 * torch.arange(1.0, 9.0)
    way = scene.current[..., 3, None] * time
    direction = torch.tensor([0.3]).cos(), torch.tensor([0.3]).sin()
    expected = torch.stack([scene.current[..., axis, None] + way * direction[axis] for axis in (0, 1)], -1)
    torch.testing.assert_close(forecast.states[:, 0, ..., :2], expected, rtol=1e-5, atol=1e-4)
    assert (forecast.states[..., 2] == 0.3).all()


def test_agents_without_a_future_have_no_gradient():
    """Masked values of the future do not change losses and gradients."""
    for config in (EPO, TestSceneConsistent.config, TestMarginal.config):
        gradients = []
        for filling in (0.0, float("nan")):
            learner = forecaster(config).train()
            torch.manual_seed(2)
            scene = highway_scene(6)
            scene.future_mask[:, 1] = False
            scene.future[~scene.future_mask] = filling
            sum(weight * value for weight, value in learner.losses(scene, learner(scene)).values()).backward()
            gradients.append([p.grad for p in learner.parameters() if p.requires_grad])
        torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=0)
        assert all(gradient.isfinite().all() for gradient in gradients[1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": "all"}, "goal is 'all', .* but this data has 6 candidates"),
        ({"candidates": 1}, "need reference, reference_speed, which this data does not provide"),
        ({"forecaster": {**EPO, "initial": "zeros"}}, "unknown forecaster.initial 'zeros': did you mean 'zero'"),
        ({"forecaster": {**EPO, "own_start": {"val": 1.0}}}, "own_start.val: did you mean 'vel'"),
        ({"forecaster": {**EPO, "own_start": {"all": 0.1}}}, r"unknown feature forecaster\.own_start\.all"),
        (
            {"forecaster": {**EPO, "own_start": {"vel": 0.0}}},
            r"own_start\.vel must be a number, positive, .* not 0\.0$",
        ),
        (
            {"forecaster": {**EPO, "own_start": -1.0}},
            r"^forecaster\.own_start must be a number, positive, .* not -1\.0$",
        ),
        ({"objective": {"name": "imitation", "weights": LOSS_WEIGHTS}}, "weights must name"),
    ],
)
def test_invalid_configurations_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        build_forecaster(highway_model(**{"forecaster": EPO, **changes}))


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (("goal_candidates", "goal_mask", "goal_reference"), "goal_candidates .* is None"),
        (("goal_reference",), "goal_reference .* is None"),
        (("lanes", "lane_mask"), "lanes .* is None"),
        (("references", "reference_mask"), "references is None"),
        (("reference_speed",), "reference_speed is None"),
    ],
)
def test_scenes_that_lack_what_is_needed_are_refused(gone, message):
    scene = Scene(**{**vars(highway_scene(2)), **dict.fromkeys(gone)})
    with pytest.raises(ValueError, match=message):
        forecaster().predict(scene)


def test_configurations_from_before_maps_still_build():
    """The keys that old checkpoints lack."""
    old = model({"name": "epo", "modes": 2, "own_start": 1.0})
    assert not {"candidates", "map"} & set(old)
    task = build_forecaster(old).task
    assert (task.candidates, task.map) == (1, False)


def test_joint_probabilities_of_many_modes_and_agents_do_not_vanish():
    model = forecaster({"name": "marginal", "modes": 64, "loss_weights": LOSS_WEIGHTS})
    probabilities = model.predict(highway_scene(2, 32)).probabilities
    torch.testing.assert_close(probabilities.sum(1), torch.ones(2))
