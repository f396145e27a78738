"""Precisions that a run may have."""

from __future__ import annotations

import pytest
import torch
from games import random_scene
from suites import model
from torch import nn

from epo_lightning.experiment.config.settings import PRECISIONS, TrainerSettings
from epo_lightning.experiment.precision import PLUGINS, Mixed
from epo_lightning.forecasters import build_forecaster
from epo_lightning.registry import ConfigError

EPO = {"name": "epo", "modes": 2}


@pytest.mark.parametrize("precision", ["16-mixed", "bf16-true", "32 true"])
def test_unsupported_precisions_are_refused_before_the_run(precision: str) -> None:
    with pytest.raises(
        ConfigError, match=r"trainer\.precision must be one of 32-true, 64-true, bf16-mixed, not .* digits"
    ):
        TrainerSettings(precision=precision)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_other_precisions_are_accepted_and_have_a_plugin(precision: str) -> None:
    assert TrainerSettings(precision=precision).precision == precision
    assert PLUGINS[precision]().precision == precision


def test_mixed_precision_rounds_the_backbone_and_nothing_else() -> None:
    """The forecast of a rounded backbone equals the forecast in single precision from its features."""
    scene = random_scene(3, 2, horizon=8)
    forecaster = build_forecaster(model(EPO)).eval()
    exact = forecaster(scene)
    Mixed().convert_module(forecaster)
    rounded, features = forecaster(scene), forecaster.backbone(scene)
    forecaster.backbone = Given(features, forecaster.backbone.width)
    torch.testing.assert_close(forecaster(scene).states, rounded.states, rtol=0, atol=0)
    assert not torch.equal(rounded.states, exact.states)
    torch.testing.assert_close(rounded.states, exact.states, rtol=0.05, atol=0.05)


class Given(nn.Module):
    """Features that do not depend on the scene."""

    def __init__(self, features: torch.Tensor, width: int) -> None:
        super().__init__()
        self.features, self.width = features.detach(), width

    def forward(self, scene: object) -> torch.Tensor:
        return self.features
