"""Suite of every forecaster."""

from __future__ import annotations

from typing import Any, ClassVar

import lightning
import pytest
import torch
from games import highway_scene, pad, random_scene, reordered

import epo_lightning
from epo_lightning.forecasters import build_forecaster
from epo_lightning.scene import Scene

from .models import highway_model, model


class ForecasterSuite:
    """A forecaster keeps its samples apart, learns, is deterministic and survives being saved.

    Attributes:
        config: the forecaster's own section.
        modes: how many joint modes it forecasts.
        goals: values of ``goal`` with which the forecaster is built.
        lessons: in how many optimisation steps it should have learned something.
        tolerance: relative and absolute, of positions that two ways of computing should agree on.
    """

    config: ClassVar[dict[str, Any]]
    modes: ClassVar[int] = 2
    goals: ClassVar[tuple[str, ...]] = ("energy", "all")
    lessons: ClassVar[int] = 30
    tolerance: ClassVar[dict[str, float]] = {"rtol": 0.0, "atol": 1e-5}

    def model(self, **changes: Any) -> dict[str, Any]:
        return model(self.config, **changes)

    def scene(self, scenes: int, **details: Any) -> Scene:
        return random_scene(scenes, 2, **details)

    def forecaster(self, **changes: Any) -> epo_lightning.forecasters.Forecaster:
        torch.manual_seed(1)
        forecaster = build_forecaster(self.model(**changes))
        # Statistics of batch normalisation that have seen something.
        forecaster.train()
        with torch.no_grad():
            forecaster(self.scene(16))
        return forecaster.eval()

    def assert_same(self, one: torch.Tensor, other: torch.Tensor) -> None:
        """Headings of agents that stand still are of no meaning: positions are compared."""
        torch.testing.assert_close(one[..., :2], other[..., :2], **self.tolerance)

    def test_shapes_and_probabilities(self):
        forecaster, scene = self.forecaster(), self.scene(3)
        forecast = forecaster.predict(scene)
        assert forecast.states.shape == (3, self.modes, scene.history.shape[1], forecaster.task.horizon, 4)
        assert forecast.states.isfinite().all()
        torch.testing.assert_close(forecast.probabilities.sum(1), torch.ones(3))
        assert (forecast.probabilities >= 0).all()

    def test_gradients_reach_every_parameter(self):
        forecaster = self.forecaster().train()
        scene = self.crowded()
        terms = forecaster.losses(scene, forecaster(scene))
        sum(weight * value for weight, value in terms.values()).backward() if self.trained(forecaster) else None
        for name, parameter in forecaster.named_parameters():
            if not parameter.requires_grad:  # a bias that batch normalisation takes away
                assert ".mlp.hidden." in name or ".scene.hidden." in name, name
                continue
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.abs().sum() > 0, name

    def crowded(self) -> Scene:
        """Scenes in which agents come so close that they have to mind each other."""
        return self.scene(16, size=2.0)

    def lesson(self) -> Scene:
        """Scenes whose futures can be learned."""
        truth = self.forecaster().predict(self.scene(8)).states[:, 0]
        return Scene(**{**vars(self.scene(8)), "future": truth})

    def test_learning_fits_a_batch(self):
        forecaster = self.forecaster().train()
        if not self.trained(forecaster):
            pytest.skip("nothing to train")
        scene = self.lesson()
        optimizer = torch.optim.Adam(forecaster.parameters(), 3e-3)
        history = []
        for _ in range(self.lessons):
            loss = sum(weight * value for weight, value in forecaster.losses(scene, forecaster(scene)).values())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            history.append(loss.item())
        assert history[-1] < 0.8 * history[0]

    def test_batch_independence(self):
        for goal in self.goals:
            forecaster, scene = self.forecaster(goal=goal), self.scene(5)
            together = forecaster.predict(scene)
            for index in range(5):
                alone = forecaster.predict(scene[index])
                self.assert_same(alone.states[0], together.states[index])
                torch.testing.assert_close(alone.probabilities[0], together.probabilities[index], rtol=0, atol=1e-5)

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_independence(self, filling):
        for goal in self.goals:
            forecaster, scene = self.forecaster(goal=goal), self.scene(3)
            alone = forecaster.predict(scene)
            padded = forecaster.predict(self.padded(scene, steps=3, filling=filling))
            self.assert_same(padded.states[:, :, : scene.history.shape[1]], alone.states)
            torch.testing.assert_close(padded.probabilities, alone.probabilities, rtol=0, atol=1e-5)

    def padded(self, scene: Scene, **details: Any) -> Scene:
        return pad(scene, agents=2, **details)

    def test_padding_does_not_change_training(self):
        forecaster, scene = self.forecaster().train(), self.scene(6)
        alone = forecaster.losses(scene, forecaster(scene))
        padded = self.padded(scene)
        for name, (_, value) in forecaster.losses(padded, forecaster(padded)).items():
            torch.testing.assert_close(value, alone[name][1], rtol=1e-5, atol=1e-5)

    def test_a_poisoned_scene_leaves_the_others_bit_identical(self):
        forecaster, scene = self.forecaster(), self.scene(4)
        sound = forecaster.predict(scene)
        history = scene.history.clone()
        history[1, 0, -2] = torch.nan
        scene.history_mask[1, 0, -2] = True
        with pytest.warns(UserWarning, match=r"scene\(s\) \[1\]"):
            poisoned = forecaster.predict(Scene(**{**vars(scene), "history": history}))
        others = [0, 2, 3]
        assert torch.equal(poisoned.states[others], sound.states[others])
        assert torch.equal(poisoned.probabilities[others], sound.probabilities[others])
        assert poisoned.states[1].isnan().all()

    def test_save_and_load(self, tmp_path):
        forecaster, scene = self.forecaster(), self.scene(3)
        trainer = lightning.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu")
        trainer.strategy.connect(forecaster)
        trainer.save_checkpoint(tmp_path / "model.ckpt")
        loaded = epo_lightning.load(tmp_path / "model.ckpt")
        assert type(loaded) is type(forecaster)
        assert torch.equal(loaded.predict(scene).states, forecaster.predict(scene).states)

    def test_determinism(self):
        scene = self.scene(3)
        assert torch.equal(self.forecaster().predict(scene).states, self.forecaster().predict(scene).states)

    def test_another_time_step_is_refused(self):
        scene = Scene(**{**vars(self.scene(1)), "dt": 0.05})
        with pytest.raises(ValueError, match=r"dt = 0\.05 s"):
            self.forecaster().predict(scene)

    @staticmethod
    def trained(forecaster) -> bool:
        return any(parameter.requires_grad for parameter in forecaster.parameters())


class HighwaySuite(ForecasterSuite):
    """The suite on highway scenes with every backbone, and equivariance to the order of agents."""

    modes = 3
    goals = ("energy",)
    lessons = 20
    tolerance: ClassVar[dict[str, float]] = {"rtol": 1e-5, "atol": 2e-4}

    @pytest.fixture(autouse=True, params=["v_lstm", "vibes", "hivt_m"])
    def name(self, request: pytest.FixtureRequest) -> None:
        self.backbone = request.param

    def model(self, **changes: Any) -> dict[str, Any]:
        return highway_model(self.config, **{"backbone": {"name": self.backbone}, **changes})

    def scene(self, scenes: int) -> Scene:
        return highway_scene(scenes)

    def crowded(self) -> Scene:
        scene = self.scene(16)
        return Scene(**{**vars(scene), "size": 20.0 * scene.size})

    def lesson(self) -> Scene:
        """Scenes in which all agents keep their lane and brake at 2 m/s^2."""
        scene = self.scene(8)
        scene.future[..., 0] -= (0.2 * torch.arange(1.0, 9.0)).square()
        scene.future[..., 1] = scene.current[..., 1, None]
        return scene

    def padded(self, scene: Scene, **details: Any) -> Scene:
        return pad(scene, agents=2, **details, lanes=2, vectors=3, candidates=4)

    def test_forecasts_are_equivariant_to_the_order_of_agents(self):
        forecaster, scene, order = self.forecaster(), self.scene(3), [2, 0, 3, 1]
        forecast, other = forecaster.predict(scene), forecaster.predict(reordered(scene, order))
        self.assert_same(other.states, forecast.states[:, :, order])
        torch.testing.assert_close(other.probabilities, forecast.probabilities, rtol=0, atol=1e-5)
