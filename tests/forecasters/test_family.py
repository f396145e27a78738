"""The rows of the paper's Table 1 besides EPO, in the suite of forecasters, with energies and solvers of the family.

Models are those of ``conf/experiment/table1``, over short horizons; solvers take fewer steps or candidates here, so that all
joint assignments can be looked at with and without absent agents, which an enumeration counts too.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any, ClassVar

import pytest
import torch
from games import random_scene
from suites import ForecasterSuite, HighwaySuite, highway_model, model

from epo_lightning import losses
from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecasters import Forecaster
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.scene import Scene

SECTIONS = ("forecaster", "backbone", "dynamics", "energy", "solver", "backward", "objective", "optimizer", "goal")
HORIZON = 8


@cache
def written(row: str) -> dict[str, Any]:
    """The model's sections of a row as its file has them."""
    composed = compose("train", [f"experiment=table1/{row}"])
    return {name: composed[name] for name in SECTIONS}


class _Row(ForecasterSuite):
    """A row of Table 1 as a configuration file, with an objective whose terms are all trained.

    Attributes:
        row: its name.
        data: the first half of the file's name.
        solver: keys of the solver that are changed.
        learned: terms of the objective that must fall by a fifth.
        rate: learning rate of the test.
        closer: whether its forecasts come closer to what they learn from in that time.
    """

    row: ClassVar[str]
    data: ClassVar[str]
    closer: ClassVar[bool] = True
    solver: ClassVar[dict[str, Any]] = {}
    learned: ClassVar[tuple[str, ...]]
    rate: ClassVar[float] = 3e-3

    def sections(self) -> dict[str, Any]:
        found = written(f"{self.data}_{self.row}")
        assert self.solver.keys() <= found["solver"].keys()
        forecaster = {**found["forecaster"], "modes": self.modes}
        return {**found, "forecaster": forecaster, "solver": {**found["solver"], **self.solver}}

    def test_learning_fits_a_batch(self):
        forecaster, scene = self.forecaster().train(), self.lesson()
        optimizer = torch.optim.Adam([p for p in forecaster.parameters() if p.requires_grad], self.rate)
        before, first = minsade(forecaster, scene), {}
        for _ in range(self.lessons):
            terms = forecaster.losses(scene, forecaster(scene))
            optimizer.zero_grad()
            sum(weight * value for weight, value in terms.values()).backward()
            optimizer.step()
            first = first or {name: value.item() for name, (_, value) in terms.items()}
        last = {name: value.item() for name, (_, value) in terms.items()}
        for name in self.learned:
            assert last[name] < first[name] - 0.2 * abs(first[name]), name
        assert minsade(forecaster, scene) < before or not self.closer


def minsade(forecaster: Forecaster, scene: Scene) -> float:
    """Distance of the closest mode of the forecast."""
    assert scene.future is not None
    assert scene.future_mask is not None
    distance = losses.distances(forecaster.predict(scene).states[..., :2], scene.future, scene.future_mask)
    return losses.scene_imitation(distance, scene.future_mask)[0].item()


class Row(_Row):
    """A row on scenes like those of RPI: two agents, each told its goal."""

    data = "rpi"

    def model(self, **changes: Any) -> dict[str, Any]:
        found = self.sections()
        return model(found.pop("forecaster"), **{"horizon": HORIZON, **found, **changes})

    def scene(self, scenes: int, **details: Any) -> Scene:
        return random_scene(scenes, 2, history=5, horizon=HORIZON, **details)

    def lesson(self) -> Scene:
        """Scenes in which all agents accelerate at 1 m/s^2 and turn left at 1 rad/s towards their goals."""
        scene = self.scene(8)
        future = Unicycle().rollout(scene.current, torch.ones(8, 2, HORIZON, 2), scene.dt)
        return dataclasses.replace(scene, future=future, goal_candidates=future[:, :, -1:, :2])


class HighwayRow(HighwaySuite, _Row):
    """A row on highways: four agents, goal candidates, a map. With one backbone: test_highway.py has the others."""

    data = "highway"

    @pytest.fixture(autouse=True)
    def name(self) -> None:
        self.backbone = "v_lstm"

    def model(self, **changes: Any) -> dict[str, Any]:
        found = self.sections()
        return highway_model(found.pop("forecaster"), **{**found, **changes})


class Sampled(_Row):
    """Random samples in training: for comparisons, present agents must get the same noise in both forecasts."""

    def test_padding_does_not_change_training(self, monkeypatch):
        forecaster, scene = self.forecaster().train(), self.scene(6)
        assert not torch.equal(forecaster(scene).solution.states, forecaster(scene).solution.states)
        values = []
        for given in (scene, self.padded(scene)):
            noise = torch.Generator().manual_seed(3)

            def draw(controls: torch.Tensor, noise: torch.Generator = noise) -> torch.Tensor:
                batch, modes, agents, *rest = controls.shape
                return torch.randn(batch, modes, 8, *rest, generator=noise)[:, :, :agents]

            with monkeypatch.context() as patch:
                patch.setattr(torch, "randn_like", draw)
                terms = forecaster.losses(given, forecaster(given))
            values.append({name: value for name, (_, value) in terms.items()})
        assert values[0].keys() == values[1].keys()
        for name, value in values[0].items():
            # Squares of energies, in single precision.
            torch.testing.assert_close(values[1][name], value, rtol=1e-4, atol=1e-5)

    def test_forecasts_have_no_noise_while_training(self):
        """Probabilities are taught on the forecasts that they are decoded for; the samples are the chains' ends."""
        forecaster, scene = self.forecaster().train(), self.scene(6)
        one, other = forecaster(scene), forecaster(scene)
        assert torch.equal(one.states, other.states)
        assert torch.equal(one.probabilities, other.probabilities)
        assert not torch.equal(one.states, one.solution.states)

    def test_one_set_of_weights_for_all_scenes(self):
        """EBIOC's theta, of agents and of pairs, is the same in every scene, mode and agent."""
        forecaster = self.forecaster().train()
        game = forecaster(self.scene(6)).parameters
        for name, weight in (*game.own_weights.items(), *game.pair_weights.items()):
            assert len(weight[weight != 0].unique()) == 1, name


class JFP(_Row):
    row = "jfp"
    learned = ("density", "marginal")

    def test_the_density_teaches_energies_and_the_regression_candidates(self):
        forecaster, scene = self.forecaster().train(), self.lesson()
        decoder = list(forecaster.strategies.parameters())
        terms = forecaster.losses(scene, forecaster(scene))
        for name, taught in (("density", False), ("marginal", False), ("regression", True)):
            found = torch.autograd.grad(terms[name][1], decoder, retain_graph=True, allow_unused=True)
            assert any(slope is not None and (slope != 0).any() for slope in found) == taught, name


class DSDNet(_Row):
    row = "dsdnet"
    learned = ("density",)
    solver: ClassVar[dict[str, Any]] = {"candidates": 12}

    def test_the_row_has_a_hundred_candidates_and_no_loss_of_another_row(self):
        found = written(f"{self.data}_{self.row}")
        assert found["solver"]["candidates"] == 100
        assert found["objective"]["weights"]["marginal"] == 0

    def test_sampled_motions_are_not_trained(self):
        """The term ``regression`` only measures how well motions cover the observed future."""
        forecaster, scene = self.forecaster().train(), self.lesson()
        terms = forecaster.losses(scene, forecaster(scene))
        assert {name for name, (_, value) in terms.items() if not value.requires_grad} == {"regression"}


class TGL(_Row):
    row = "tgl"
    learned = ("probability", "initial")

    def test_the_modes_of_a_scene_have_the_same_weights(self):
        """TGL predicts preferences once for all orders."""
        game = self.forecaster().train()(self.scene(6)).parameters
        for name, weight in (*game.own_weights.items(), *game.pair_weights.items()):
            assert torch.equal(weight, weight[:, :1].expand_as(weight)), name
            assert len(weight[:, 0].unique()) > 2, name

    def test_games_are_taught_in_the_observed_order(self):
        forecaster, scene = self.forecaster(), self.scene(16)
        observed, known = forecaster.energy.pair_order.observed(scene)
        assert known.any()
        known = known[:, None].expand(-1, self.modes, -1)
        given = forecaster.train()(scene).parameters.order[known]
        assert torch.equal(given, observed[:, None].expand(-1, self.modes, -1)[known])
        decoded = forecaster.eval()(scene).parameters.order
        assert not torch.equal(decoded[known], given)
        assert forecaster.train().predict(dataclasses.replace(scene, future=None, future_mask=None)) is not None


class EBIOC(Sampled):
    """EBIOC with chains of four steps: some updates lower the energy of the observed future, but not the error."""

    row = "ebioc"
    rate = 3e-2  # of a shared weight, which changes by 3% at most in every update
    lessons = 12
    learned = ("contrastive",)
    closer = False
    solver: ClassVar[dict[str, Any]] = {"steps": 4, "delta": 0.1}


class Laplace(_Row):
    """Laplace. Acceptance of adaptive steps may depend on the last digit, which batches change; float64 avoids this."""

    row = "laplace"
    learned = ("density", "initial")
    solver: ClassVar[dict[str, Any]] = {"steps": 6}
    precision = torch.float32

    def forecaster(self, **changes: Any) -> Forecaster:
        return super().forecaster(**changes).to(self.precision)

    def test_batch_independence(self):
        self.precision, self.tolerance = torch.float64, {"rtol": 0.0, "atol": 1e-9}
        super().test_batch_independence()

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_independence(self, filling):
        self.precision, self.tolerance = torch.float64, {"rtol": 0.0, "atol": 1e-9}
        super().test_padding_independence(filling)


class TestJFP(JFP, Row):
    learned = ("density", "marginal", "regression")


class TestDSDNet(DSDNet, Row):
    closer = False  # the given goals choose near motions before any training


class TestTGL(TGL, Row):
    learned = ("imitation", "probability", "initial")


class TestEBIOC(EBIOC, Row):
    pass


class TestLaplace(Laplace, Row):
    pass


@pytest.mark.parametrize("row", ["jfp", "dsdnet", "tgl", "ebioc", "epo", "laplace"])
def test_every_row_on_rpi_is_given_the_goals(row):
    assert "goal" in written(f"rpi_{row}")["energy"]["own"]


class TestHighwayJFP(JFP, HighwayRow):
    solver: ClassVar[dict[str, Any]] = {"candidates": 4}


class TestHighwayDSDNet(DSDNet, HighwayRow):
    solver: ClassVar[dict[str, Any]] = {"candidates": 4}
    lessons = 40


class TestHighwayTGL(TGL, HighwayRow):
    lessons = 60  # who goes first is hard to see of agents that are near each other, and only those count


class TestHighwayEBIOC(EBIOC, HighwayRow):
    pass


class TestHighwayLaplace(Laplace, HighwayRow):
    pass
