"""Backbones whose features are of no use are refused with the name of their class and its file."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import pytest
import torch
from games import random_scene

from epo_lightning import registry
from epo_lightning.backbones.base import Backbone
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.schema import read

WIDTH = 8
FEATURES: dict[str, tuple[Any, str]] = {
    "of the scene": (lambda b, n: torch.zeros(b, WIDTH), "shape [3, 8]"),
    "too few": (lambda b, n: torch.zeros(b, n, 4), "shape [3, 2, 4]"),
    "transposed": (lambda b, n: torch.zeros(n, b, WIDTH), "shape [2, 3, 8]"),
    "of nn.GRU": (lambda b, n: (torch.zeros(b, n, WIDTH), None), "a tuple"),
}


@pytest.mark.parametrize("kind", FEATURES)
def test_features_of_another_shape(kind: str) -> None:
    made, found = FEATURES[kind]

    class Mine(Backbone):
        width = WIDTH

        def forward(self, scene: Scene) -> Any:
            return made(*scene.agent_mask.shape)

    words = r"must return features z of shape \[B, N, width\] = \[3, 2, 8\], but it returns " + re.escape(found)
    with pytest.raises(ConfigError, match=rf"the backbone Mine \({__file__}:\d+\) {words}"):
        Mine()(random_scene(3, 2))


def test_a_backbone_without_a_width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._PARTS, "backbone", dict(registry.parts("backbone")))  # it stays in this test

    @register("backbone", "without width")
    class Mine(Backbone):
        def __init__(self) -> None:
            super().__init__()

        def forward(self, scene: Scene) -> Any:
            return torch.zeros(*scene.agent_mask.shape, WIDTH)

    settings = read(Settings, compose("train", ["experiment=rpi/v_lstm_sc", "data=drawn"]))
    settings = dataclasses.replace(settings, backbone={"name": "without width"})
    with pytest.raises(
        ConfigError, match=rf"the backbone Mine \({__file__}:\d+\) must set self.width, the size of its"
    ):
        assembly.build(settings)
