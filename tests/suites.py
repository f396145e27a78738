"""What every part of a kind must do: subclass the suite, say which part, and inherit its tests."""

from __future__ import annotations

from typing import Any, ClassVar

import lightning
import pytest
import torch
from games import pad, random_scene

import epo_lightning
from epo_lightning.forecasters import build_forecaster
from epo_lightning.registry import build
from epo_lightning.scene import Scene

OWN = ["goal", "vel", "acc", "turnr", "jerk", "turnacc", "velb", "accb", "turnrb", "jerkb", "turnaccb"]
LOSS_WEIGHTS = {"imitation": 1.0, "probability": 0.1}


def model(forecaster: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A complete configuration of a model for random scenes."""
    bounds = {
        "vel": [-0.05, 2.0],
        "acc": [-1.0, 1.0],
        "turnr": [-0.2, 0.2],
        "jerk": [-1.0, 1.0],
        "turnacc": [-1.0, 1.0],
    }
    return {
        "forecaster": forecaster,
        "backbone": {"name": "v_lstm"},
        "dynamics": {"name": "unicycle"},
        "energy": {"name": "features", "own": OWN, "pair": ["proximity"], "bounds": bounds},
        "solver": {"name": "levenberg_marquardt", "steps": 2, "step_size": 0.3, "damping": 10.0},
        "optimizer": {"name": "adam"},
        "goal": "energy",
        "horizon": 40,
        "dt": 0.1,
        "subsets": ["executed", "alternative"],
        **changes,
    }


class BackboneSuite:
    """A backbone gives every agent a feature, which depends on its scene alone."""

    config: ClassVar[dict[str, Any]]

    def backbone(self) -> torch.nn.Module:
        torch.manual_seed(1)
        return build("backbone", self.config).eval()

    def test_shape_and_gradient_flow(self):
        backbone = self.backbone()
        z = backbone(random_scene(3, 4))
        assert z.shape == (3, 4, backbone.width)
        z.square().sum().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in backbone.parameters())

    def test_every_agent_sees_every_other_one(self):
        backbone, scene = self.backbone(), random_scene(1, 3)
        before = backbone(scene)
        scene.history[0, 2] += 1.0
        assert (backbone(scene)[0, 0] - before[0, 0]).abs().max() > 1e-6

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_independence(self, filling):
        backbone, scene = self.backbone(), random_scene(3, 2)
        padded = backbone(pad(scene, agents=3, steps=4, filling=filling))
        torch.testing.assert_close(padded[:, :2], backbone(scene), rtol=0, atol=1e-5)

    def test_batch_independence(self):
        backbone, scene = self.backbone(), random_scene(4, 2)
        together = backbone(scene)
        for index in range(4):
            torch.testing.assert_close(backbone(scene[index])[0], together[index], rtol=0, atol=1e-5)


class ForecasterSuite:
    """A forecaster keeps its samples apart, learns, is deterministic and survives being saved."""

    config: ClassVar[dict[str, Any]]
    modes: ClassVar[int] = 2

    def forecaster(self, **changes: Any) -> epo_lightning.forecasters.Forecaster:
        torch.manual_seed(1)
        forecaster = build_forecaster(model(self.config, **changes))
        # Statistics of batch normalisation that have seen something.
        forecaster.train()
        with torch.no_grad():
            forecaster(random_scene(16, 2))
        return forecaster.eval()

    def test_shapes_and_probabilities(self):
        forecast = self.forecaster().predict(random_scene(3, 2))
        assert forecast.states.shape == (3, self.modes, 2, 40, 4)
        assert forecast.states.isfinite().all()
        torch.testing.assert_close(forecast.probabilities.sum(1), torch.ones(3))
        assert (forecast.probabilities >= 0).all()

    def test_gradients_reach_every_parameter(self):
        forecaster = self.forecaster().train()
        scene = random_scene(16, 2, size=2.0)
        terms = forecaster.losses(scene, forecaster(scene))
        sum(weight * value for weight, value in terms.values()).backward() if self.trained(forecaster) else None
        for name, parameter in forecaster.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.abs().sum() > 0, name

    def test_learning_fits_a_batch(self):
        forecaster = self.forecaster().train()
        if not self.trained(forecaster):
            pytest.skip("nothing to train")
        scene = random_scene(8, 2)
        truth = self.forecaster().predict(random_scene(8, 2)).states[:, 0]
        scene = Scene(**{**vars(scene), "future": truth})
        optimizer = torch.optim.Adam(forecaster.parameters(), 3e-3)
        history = []
        for _ in range(30):
            loss = sum(weight * value for weight, value in forecaster.losses(scene, forecaster(scene)).values())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            history.append(loss.item())
        assert history[-1] < 0.8 * history[0]

    @pytest.mark.parametrize("goal", ["energy", "all"])
    def test_batch_independence(self, goal):
        forecaster, scene = self.forecaster(goal=goal), random_scene(5, 2)
        together = forecaster.predict(scene)
        for index in range(5):
            alone = forecaster.predict(scene[index])
            # Headings of agents that stand still are of no meaning: positions are compared.
            torch.testing.assert_close(alone.states[0, ..., :2], together.states[index, ..., :2], rtol=0, atol=1e-5)
            torch.testing.assert_close(alone.probabilities[0], together.probabilities[index], rtol=0, atol=1e-5)

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    @pytest.mark.parametrize("goal", ["energy", "all"])
    def test_padding_independence(self, filling, goal):
        forecaster, scene = self.forecaster(goal=goal), random_scene(3, 2)
        alone = forecaster.predict(scene)
        padded = forecaster.predict(pad(scene, agents=2, steps=3, filling=filling))
        torch.testing.assert_close(padded.states[:, :, :2, :, :2], alone.states[..., :2], rtol=0, atol=1e-5)
        torch.testing.assert_close(padded.probabilities, alone.probabilities, rtol=0, atol=1e-5)

    def test_padding_does_not_change_training(self):
        forecaster, scene = self.forecaster().train(), random_scene(6, 2)
        alone = forecaster.losses(scene, forecaster(scene))
        padded = pad(scene, agents=2)
        for name, (_, value) in forecaster.losses(padded, forecaster(padded)).items():
            torch.testing.assert_close(value, alone[name][1], rtol=0, atol=1e-5)

    def test_a_poisoned_scene_leaves_the_others_bit_identical(self):
        forecaster, scene = self.forecaster(), random_scene(4, 2)
        sound = forecaster.predict(scene)
        history = scene.history.clone()
        history[1, 0, 5] = torch.nan
        with pytest.warns(UserWarning, match=r"scene\(s\) \[1\]"):
            poisoned = forecaster.predict(Scene(**{**vars(scene), "history": history}))
        others = [0, 2, 3]
        assert torch.equal(poisoned.states[others], sound.states[others])
        assert torch.equal(poisoned.probabilities[others], sound.probabilities[others])
        assert poisoned.states[1].isnan().all()

    def test_save_and_load(self, tmp_path):
        forecaster, scene = self.forecaster(), random_scene(3, 2)
        trainer = lightning.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu")
        trainer.strategy.connect(forecaster)
        trainer.save_checkpoint(tmp_path / "model.ckpt")
        loaded = epo_lightning.load(tmp_path / "model.ckpt")
        assert type(loaded) is type(forecaster)
        assert torch.equal(loaded.predict(scene).states, forecaster.predict(scene).states)

    def test_determinism(self):
        scene = random_scene(3, 2)
        assert torch.equal(self.forecaster().predict(scene).states, self.forecaster().predict(scene).states)

    def test_another_time_step_is_refused(self):
        scene = Scene(**{**vars(random_scene(1, 2)), "dt": 0.2})
        with pytest.raises(ValueError, match=r"dt = 0\.2 s"):
            self.forecaster().predict(scene)

    @staticmethod
    def trained(forecaster) -> bool:
        return any(parameter.requires_grad for parameter in forecaster.parameters())
