"""The four forecasters: the common suite, and the properties of each."""

from __future__ import annotations

import dataclasses
import math

import jaxtyping
import numpy
import pytest
import torch
from games import random_scene
from suites import LOSS_WEIGHTS, OWN, ForecasterSuite, highway_model, model

import epo_lightning
from epo_lightning.forecasters import build_forecaster
from epo_lightning.game import features
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene


class TestConstantVelocity(ForecasterSuite):
    config = {"name": "constant_velocity"}
    modes = 1

    def test_constant_velocity_continues_straight(self):
        scene = Scene(torch.tensor([[[[1.0, 2.0, math.pi / 2, 3.0]]]]), 0.1)
        states = self.forecaster().predict(scene).states[0, 0, 0]
        torch.testing.assert_close(states[:, 0], torch.ones(40))
        torch.testing.assert_close(states[:, 1], 2.0 + 0.3 * torch.arange(1.0, 41.0))


class TestMarginal(ForecasterSuite):
    config = {"name": "marginal", "modes": 2, "loss_weights": LOSS_WEIGHTS}

    def test_modes_are_ordered_by_probability(self):
        forecast = self.forecaster().predict(random_scene(8, 2))
        assert (forecast.agent_probabilities[:, 0] >= forecast.agent_probabilities[:, 1]).all()
        assert (forecast.probabilities[:, 0] >= forecast.probabilities[:, 1]).all()

    def test_the_probability_of_a_joint_mode_is_the_normalised_product_of_the_agents(self):
        scene = random_scene(3, 2)
        scene.agent_mask[1, 1] = False
        forecast = self.forecaster().predict(scene)
        of_agents, expected = forecast.agent_probabilities.double(), []
        for row, present in enumerate(scene.agent_mask.tolist()):
            products = [
                math.prod(mode[agent] for agent in (0, 1) if present[agent]) for mode in of_agents[row].tolist()
            ]
            expected.append([product / sum(products) for product in products])
        torch.testing.assert_close(forecast.probabilities, torch.tensor(expected))
        assert (forecast.probabilities[:, 0] > 0.5).all()

    def test_heading_and_speed_follow_from_positions(self):
        scene = random_scene(2, 2)
        states = self.forecaster().predict(scene).states
        step = states[..., 1:, :2] - states[..., :-1, :2]
        torch.testing.assert_close(states[..., 1:, 3], step.norm(dim=-1) / 0.1, rtol=1e-3, atol=1e-3)

    def test_a_standing_agent_keeps_its_heading(self):
        forecaster, scene = self.forecaster(), random_scene(2, 2)
        torch.nn.init.zeros_(forecaster.decoder.positions.output.weight)
        torch.nn.init.zeros_(forecaster.decoder.positions.output.bias)
        states = forecaster.predict(scene).states
        still = torch.cat((scene.current[..., :3], torch.zeros(2, 2, 1)), -1)
        assert torch.equal(states, still[:, None, :, None].expand_as(states))


class TestSceneConsistent(ForecasterSuite):
    config = {"name": "scene_consistent", "modes": 2, "loss_weights": LOSS_WEIGHTS}

    def test_futures_obey_the_dynamics(self):
        scene = random_scene(2, 2)
        forecast = self.forecaster().predict(scene)
        speed = scene.current[:, None, :, 3, None] + 0.1 * forecast.controls[..., 0].cumsum(-1)
        torch.testing.assert_close(forecast.states[..., 3], speed)


class TestEPO(ForecasterSuite):
    config = {"name": "epo", "modes": 2}

    def test_the_forecast_is_the_solution_of_the_inferred_game(self):
        forecaster, scene = self.forecaster(), random_scene(3, 2)
        forecast = forecaster.predict(scene)
        again = forecaster.solver(forecaster.energy, scene, forecast.parameters)
        assert torch.equal(again.controls, forecast.controls)
        assert set(forecast.parameters.own_weights) == set(OWN)
        assert torch.equal(forecast.parameters.goals[:, 1], scene.goal_candidates[:, :, 0])
        total = sum(term.sum(-1) for term in (*forecast.own_energy.values(), *forecast.pair_energy.values()))
        torch.testing.assert_close(total, forecast.solution.energy)

    def test_forecasts_take_the_solvers_steps_outside_training(self):
        solver = {"name": "levenberg_marquardt", "steps": 1, "test_steps": 3}
        forecaster, scene = self.forecaster(solver=solver), random_scene(3, 2)
        for forecast, steps in ((forecaster.predict(scene), 3), (forecaster.train()(scene), 1)):
            again = forecaster.solver.with_steps(steps)(forecaster.energy, scene, forecast.parameters)
            assert torch.equal(again.controls, forecast.controls)

    def test_weights_start_at_their_configured_values(self):
        forecaster = self.forecaster()
        for decoder in (forecaster.own_weights, forecaster.pair_weights, forecaster.strategies):
            torch.nn.init.zeros_(decoder.mlp.output.weight)
            torch.nn.init.zeros_(decoder.mlp.output.bias)
        parameters = forecaster.predict(random_scene(2, 2)).parameters
        assert all((weight == 1.0).all() for weight in parameters.own_weights.values())
        assert (parameters.pair_weights["proximity"] == 3.0).all()
        assert (parameters.initial_controls == 0.0).all()

    def test_a_scene_without_a_goal_is_refused(self):
        scene = Scene(**{**vars(random_scene(2, 2)), "goal_candidates": None, "goal_mask": None})
        with pytest.raises(ValueError, match=r"scene\.goal_candidates \[B, N, 1, 2\] is None"):
            self.forecaster().predict(scene)

    def test_masked_goals_are_ignored(self):
        """A masked goal has no effect: neither its value nor the origin attracts the agent."""
        forecaster, scene = self.forecaster(), random_scene(2, 2)
        scene.goal_mask[0, 1] = False
        forecasts = []
        for filling in (0.0, 1e6, torch.nan):
            scene.goal_candidates[0, 1] = filling
            forecasts.append(forecaster.predict(scene))
        assert torch.equal(forecasts[1].states, forecasts[0].states)
        assert torch.equal(forecasts[2].states, forecasts[0].states)
        assert (forecasts[0].parameters.own_weights["goal"][0, :, 1] == 0).all()


class TestPairwiseSceneConsistent(ForecasterSuite):
    config = {**TestSceneConsistent.config, "probabilities": "pairwise"}


class TestPairwiseEPO(ForecasterSuite):
    config = {**TestEPO.config, "probabilities": "pairwise"}


EPO = TestEPO.config
KEEPING = {"name": "features", "own": ["goal", "heading", "vel", "acc", "turnr"], "pair": ["clearance"]}


def test_margins_and_goal_headings_are_part_of_the_game():
    torch.manual_seed(0)
    forecaster = build_forecaster(model(forecaster={**EPO, "margin": {"largest": 1.5}}, energy=KEEPING))
    scene = dataclasses.replace(
        random_scene(3, 2), goal_headings=torch.randn(3, 2, 1), game_steps=torch.tensor([40, 9, 1])
    )
    game = forecaster.predict(scene).parameters
    assert torch.equal(game.goal_headings, scene.goal_headings[:, :, 0][:, None].expand(-1, 2, -1))
    assert ((game.margins["clearance"] > 0) & (game.margins["clearance"] < 1.5)).all()
    forecaster.train()
    forecaster(scene).states.square().sum().backward()
    assert forecaster.margins.outputs.mlp.output.weight.grad.isfinite().all()
    scene.goal_mask[0, 1] = False
    assert (forecaster.eval().predict(scene).parameters.own_weights["heading"][0, :, 1] == 0).all()
    with pytest.raises(ValueError, match=r"scene\.goal_headings \[B, N, G\] is None"):
        forecaster.predict(random_scene(3, 2))


def test_the_decoder_of_margins_leaves_the_other_networks_as_they_are():
    """Energies whose margins are fixed, or that have none, draw the same initial weights as ever."""
    drawn = []
    for energy in (KEEPING, {**KEEPING, "margins": {"clearance": 0.5}}):
        torch.manual_seed(0)
        drawn.append(build_forecaster(model(forecaster=EPO, energy=energy)).state_dict())
    with_decoder, without = drawn
    assert {name.partition(".")[0] for name in with_decoder.keys() - without.keys()} == {"margins"}
    assert all(torch.equal(value, with_decoder[name]) for name, value in without.items())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": "everyone"}, "unknown goal 'everyone'"),
        ({"backbone": {"name": "v_lsmt"}}, "did you mean 'v_lstm'"),
        ({"backbone": {"name": "v_lstm", "widht": 3}}, "did you mean 'width'"),
        ({"backbone": {}}, r"backbone\.name is missing"),
        ({"energy": {"name": "features", "own": ["gaol"]}}, "did you mean 'goal'"),
        (
            {"energy": {"name": "features", "own": ["lane", "velref"]}},
            r"energy\.own \(lane, velref\) need reference, reference_speed, which this data does not provide: choose .*rpi/",
        ),
        (
            {"candidates": 0},
            r"energy\.own \(goal\) need goals, .* experiment=dut/\.\.\. or ucy/\.\.\. \(without experiment=",
        ),
        ({"energy": {"name": "features"}}, r"missing key energy\.own"),
        (
            {"energy": {**KEEPING, "margins": {"proximity": 1.0}}},
            r"energy\.margins\.proximity: no pair feature with a margin has this name",
        ),
        (
            {"energy": {**KEEPING, "margins": {"clearance": -1.0}}},
            r"energy\.margins\.clearance must be a number of metres",
        ),
        ({"forecaster": {**EPO, "margin": {"most": 1.0}}}, r"forecaster\.margin has the keys largest and start"),
        ({"forecaster": {**EPO, "margin": {"start": 2.0}}}, r"forecaster\.margin takes 0 < start < largest"),
        ({"solver": {"name": "levenberg_marquardt", "stepsize": 1}}, "did you mean 'step_size'"),
        ({"optimizer": {"name": "adam", "lr": -1.0}}, "optimizer.lr must be a number, positive"),
        ({"optimizer": {"name": "adam", "schedule": "cosin"}}, "did you mean 'cosine'"),
        (
            {"objective": {"name": "imitation", "weights": {"imitation": 1.0, "probability": 1.0, "final": 1.0}}},
            r"objective\.weights must name imitation, .* \(unknown: final; missing: goal, initial\); a new term",
        ),
        ({"forecaster": {**EPO, "modes": 0}}, "modes must be 1 or more"),
        ({"speed": 1}, "unknown key 'speed'"),
    ],
)
def test_invalid_configurations_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        build_forecaster(model(**{"forecaster": EPO, **changes}))


def test_files_that_are_no_checkpoints_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="no checkpoint at"):
        epo_lightning.load(tmp_path / "missing.ckpt")
    (tmp_path / "text.ckpt").write_text("not a checkpoint")
    with pytest.raises(ConfigError, match="not a checkpoint that epo_lightning wrote"):
        epo_lightning.load(tmp_path / "text.ckpt")
    torch.save({"state_dict": {}}, tmp_path / "other.ckpt")
    with pytest.raises(ConfigError, match="not a checkpoint that epo_lightning wrote"):
        epo_lightning.load(tmp_path / "other.ckpt")


def test_checkpoints_of_another_architecture_are_refused(tmp_path):
    forecaster = build_forecaster(model(EPO))
    configuration = model(EPO, backbone={"name": "v_lstm", "width": 64})
    torch.save({"configuration": configuration, "state_dict": forecaster.state_dict()}, tmp_path / "wide.ckpt")
    with pytest.raises(ConfigError, match="does not fit the architecture"):
        epo_lightning.load(tmp_path / "wide.ckpt")


def test_expensive_diagnostics_are_computed_for_a_share_of_scenes(monkeypatch):
    monkeypatch.setattr("epo_lightning.forecasters.epo.EXAMINED", 3)
    monkeypatch.setattr("epo_lightning.solvers.diagnostics.quasi_newton._EVALUATIONS", 40)  # far from a minimum
    solver = {"name": "gradient_descent", "steps": 2, "step_size": 1e-3}
    forecaster = build_forecaster(model(EPO, energy={"name": "neural"}, solver=solver, horizon=5)).eval()
    scene = random_scene(6, 2, horizon=5)
    forecast = forecaster(scene)
    report = forecaster.examine(scene, forecast).equilibrium
    assert report.energy.isfinite().tolist() == [True, False] * 3
    alone = forecaster.examine(scene[[2]], forecast[[2]]).equilibrium
    torch.testing.assert_close(report.energy[2], alone.energy[0])


def test_invalid_scenes_are_refused(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it
    forecaster = build_forecaster(model({"name": "constant_velocity"}))
    with pytest.raises(TypeError, match=r"predict takes an epo_lightning\.scene\.Scene, not a ndarray"):
        forecaster.predict(numpy.zeros((1, 2, 5, 4)))
    scene = random_scene(2, 2)
    scene.size[1, 0] = 0.0
    with pytest.raises(ValueError, match=r"scene\.size\[1, 0\] is \[0\.0, 0\.0\]; length and width must be positive"):
        forecaster.predict(scene)


@pytest.mark.parametrize(
    ("name", "decoders"),
    [("marginal", ["decoder"]), ("scene_consistent", ["probabilities"]), ("epo", ["goals", "probabilities"])],
)
def test_every_network_of_positions_has_the_unit_of_its_task(name, decoders):
    config = {"name": name, "modes": 2, **({} if name == "epo" else {"loss_weights": LOSS_WEIGHTS})}
    forecaster = build_forecaster(highway_model(config, scale=20.0))
    networks = ["backbone", "backbone.history", "backbone.lanes", *decoders]
    assert {network: forecaster.get_submodule(network).scale for network in networks} == dict.fromkeys(networks, 20.0)


@pytest.mark.parametrize("config", [TestSceneConsistent.config, EPO])
def test_decoded_controls_have_the_configured_scale(config):
    start = {}
    for scale in (0.3, 0.6):
        torch.manual_seed(1)
        forecaster = build_forecaster(model({**config, "control_scale": scale})).eval()
        scene = random_scene(2, 2)
        start[scale] = forecaster.strategies(forecaster.backbone(scene), scene)
    torch.testing.assert_close(start[0.6], 2.0 * start[0.3])
    assert (start[0.3] != 0).any()


@pytest.mark.parametrize("config", [TestMarginal.config, TestSceneConsistent.config])
def test_a_given_goal_is_told_to_the_network_if_asked_for_alone(config):
    for goal, told in (("energy", False), ("all", True)):
        forecaster = build_forecaster(model(config, goal=goal)).eval()
        scene = random_scene(2, 2)
        here = forecaster.predict(scene).states
        scene.goal_candidates[:] += 1.0
        assert torch.equal(forecaster.predict(scene).states, here) != told


def test_nash_gaps_of_features_of_trajectories_are_measured_in_some_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their derivatives are automatic, and all scenes of a test split would take minutes."""
    monkeypatch.setattr("epo_lightning.forecasters.epo.EXAMINED", 2)
    undeclared = features.OwnFeature(
        features.Source.TRAJECTORY, "sway", function=lambda states, controls: controls[..., 1]
    )
    monkeypatch.setitem(features.OWN_FEATURES, "sway", undeclared)
    turn = features.OwnFeature(features.Source.STEP, "turn", function=lambda states, controls: controls[..., 1])
    monkeypatch.setitem(features.OWN_FEATURES, "turn", turn)
    plain = ["goal", "acc", "turnr"]
    for own, measured in ((plain, 4), ([*plain, "turn"], 4), ([*plain, "sway"], 2)):
        energy = {"name": "features", "own": own, "pair": ["proximity"]}
        forecaster = build_forecaster(model({"name": "epo", "modes": 2}, energy=energy)).eval()
        scene = random_scene(4, 2)
        found = forecaster.examine(scene, forecaster(scene)).equilibrium
        assert int(found.nash_gap.isfinite().all(1).sum()) == measured
