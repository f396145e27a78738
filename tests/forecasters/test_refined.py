"""A refined forecaster: the suite of all forecasters, a given one that stays as it is, and checkpoints that hold it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from games import highway_scene
from suites import LOSS_WEIGHTS, ForecasterSuite, HighwaySuite, highway_model, model

import epo_lightning
from epo_lightning.forecasters import build_forecaster
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

PARTS = {
    "energy": {"name": "features", "own": ["accref", "turnrref"], "pair": ["clearance"], "margins": {"clearance": 0.5}},
    "solver": {"name": "levenberg_marquardt", "steps": 20, "step_size": 1.0, "damping": 1.0, "adaptive": True},
    "backward": {"name": "implicit"},
}
CONFIG = {"name": "refined", "own_start": {"turnrref": 5.0}}


def marginal(modes: int) -> dict[str, Any]:
    return {"name": "marginal", "modes": modes, "loss_weights": LOSS_WEIGHTS}


class Refinements:
    """What the suites have to know of a forecaster of which six numbers are trained."""

    config = CONFIG

    def assert_learns(self) -> None:
        """Only the shared weights and the temperature have gradients, and the given forecaster stays in evaluation mode."""
        forecaster = self.forecaster().train()
        assert not any(module.training for module in forecaster.given.modules())
        scene = self.crowded()
        terms = forecaster.losses(scene, forecaster(scene))
        sum(weight * value for weight, value in terms.values()).backward()
        taught = {name for name, parameter in forecaster.named_parameters() if parameter.grad is not None}
        assert taught == {"own_weights.logarithms", "pair_weights.logarithms", "log_inverse_temperature"}
        for name in taught:
            slope = forecaster.get_parameter(name).grad
            assert slope.isfinite().all(), name
            assert (slope != 0).all(), name

    def test_gradients_reach_every_parameter(self):
        self.assert_learns()

    def test_the_end_of_a_recorded_game_is_not_that_of_the_refinement(self):
        """The game of a refinement ends with the forecast; ``game_steps`` is the end of the game that was recorded."""
        forecaster, scene = self.forecaster().eval(), self.crowded()
        with torch.no_grad():
            plain = forecaster.explain(scene, forecaster(scene))
            for end in (1, 1000):
                ended = Scene(**{**vars(scene), "game_steps": torch.full((len(scene.history),), end)})
                found = forecaster.explain(ended, forecaster(ended))
                for name in ("own_energy", "pair_energy"):
                    terms = getattr(plain, name)
                    assert any((value > 0).any() for value in terms.values())
                    torch.testing.assert_close(getattr(found, name), terms, rtol=0, atol=0)

    def test_learning_fits_a_batch(self):
        """Futures that were made with other weights are better explained after some steps."""
        forecaster, scene = self.forecaster().train(), self.crowded()
        with torch.no_grad():
            forecaster.pair_weights.logarithms += 1.0
            truth = forecaster(scene).states[:, 0]
            forecaster.pair_weights.logarithms -= 1.0
        scene = Scene(**{**vars(scene), "future": truth})
        optimizer = torch.optim.Adam([p for p in forecaster.parameters() if p.requires_grad], 0.1)
        history = []
        for _ in range(15):
            terms = forecaster.losses(scene, forecaster(scene))
            optimizer.zero_grad()
            terms["imitation"][1].backward()
            optimizer.step()
            history.append(terms["imitation"][1].item())
        assert history[-1] < 0.5 * history[0]


class TestRefined(Refinements, ForecasterSuite):
    tolerance = {"rtol": 0.0, "atol": 1e-2}  # the solution of a game with random futures amplifies rounding errors

    def model(self, **changes: Any) -> dict[str, Any]:
        return model(self.config, given=model(marginal(2), **changes), **PARTS, **changes)


@pytest.mark.slow
class TestRefinedOnHighways(Refinements, HighwaySuite):
    tolerance = {"rtol": 1e-5, "atol": 1e-2}  # a game of fast vehicles amplifies rounding errors to 5 mm

    def crowded(self) -> Scene:
        """Vehicles of 4.5 m, with which 20 steps converge; those of the suite are 20 times as large."""
        return self.scene(16)

    def model(self, **changes: Any) -> dict[str, Any]:
        changes = {"backbone": {"name": self.backbone}, **changes}
        return highway_model(self.config, given=highway_model(marginal(3), **changes), **PARTS, **changes)


def refined(**changes: Any) -> epo_lightning.forecasters.Forecaster:
    torch.manual_seed(1)
    return build_forecaster(highway_model(CONFIG, given=highway_model(marginal(3)), **{**PARTS, **changes})).eval()


def save(forecaster: epo_lightning.forecasters.Forecaster, path: Path) -> None:
    trainer = lightning.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu")
    trainer.strategy.connect(forecaster)
    trainer.save_checkpoint(path)


def test_the_forecast_is_the_refinement_of_the_given_one():
    forecaster, scene = refined(), highway_scene(3)
    given, forecast = forecaster.given.predict(scene), forecaster.predict(scene)
    weights = {"accref": 1.0, "turnrref": 5.0, "clearance": 3.0}
    by_hand = epo_lightning.refine(
        given.states,
        given.probabilities,
        scene,
        forecaster.energy,
        weights,
        inverse_temperature=0.03,
        solver=forecaster.solver,
    )
    torch.testing.assert_close(forecast.states, by_hand.states, rtol=0, atol=1e-4)
    torch.testing.assert_close(forecast.probabilities, by_hand.probabilities)
    assert set(forecast.own_energy) == {"accref", "turnrref"}
    total = sum(term.sum(-1) for term in (*forecast.own_energy.values(), *forecast.pair_energy.values()))
    torch.testing.assert_close(total, forecast.solution.energy)


def test_a_run_is_refined_and_its_checkpoint_needs_that_run_no_longer(tmp_path: Path):
    run, scene = tmp_path / "run", highway_scene(3)
    (run / "checkpoints").mkdir(parents=True)
    torch.manual_seed(3)
    trained = build_forecaster(highway_model(marginal(3)))
    save(trained, run / "checkpoints" / "best.ckpt")
    for frozen in (run, run / "checkpoints" / "best.ckpt"):
        forecaster = build_forecaster(highway_model({**CONFIG, "frozen": str(frozen)}, **PARTS)).eval()
        assert torch.equal(forecaster.given.predict(scene).states, trained.predict(scene).states)
    save(forecaster, tmp_path / "refined.ckpt")
    (run / "checkpoints" / "best.ckpt").unlink()
    loaded = epo_lightning.load(tmp_path / "refined.ckpt")
    assert torch.equal(loaded.predict(scene).states, forecaster.predict(scene).states)
    assert loaded.configuration["forecaster"] == forecaster.configuration["forecaster"]


GIVEN = highway_model(marginal(3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "forecaster.frozen names no trained forecaster"),
        ({"forecaster": {**CONFIG, "frozen": "nowhere"}}, "no checkpoint at nowhere"),
        (
            {"given": highway_model(marginal(3), dt=0.1, horizon=7)},
            "horizon is 7 there and 8 here, dt is 0.1 there and 0.2",
        ),
        ({"given": highway_model(marginal(3), history=3), "history": 5}, "history is 3 there and 5 here"),
        (
            {"given": GIVEN, "energy": {"name": "features", "own": ["accref"], "pair": ["clearance"]}},
            "fix those of clearance in metres",
        ),
        ({"given": GIVEN, "energy": {"name": "features", "own": ["accref", "goal"], "pair": []}}, "knows no goals"),
        ({"given": GIVEN, "solver": {"name": "enumeration", "candidates": 3}}, "needs"),
        (
            {"given": GIVEN, "forecaster": {**CONFIG, "inverse_temperature": 0}},
            "inverse_temperature must be a number, positive",
        ),
        ({"given": GIVEN, "forecaster": {**CONFIG, "own_start": {"acref": 1.0}}}, "'accref'"),
        ({"given": GIVEN, "forecaster": {**CONFIG, "pair_start": {"clearence": 1.0}}}, "'clearance'"),
    ],
)
def test_what_cannot_be_refined_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        build_forecaster({**highway_model(CONFIG, **PARTS), **changes})
