"""The trial call of a backbone before a training: what it refuses, and that it leaves no trace."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import nn

from epo_lightning import registry
from epo_lightning.backbones.base import Backbone
from epo_lightning.backbones.trial import AGENTS, SCENES, trial_scene, try_backbone
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.schema import read
from epo_lightning.task import Task

TASK = Task(horizon=6, dt=0.1, history=7, candidates=0)


class Mine(Backbone):
    """Positions at t0 through a layer that is given, and what a test wants of them."""

    width = 8

    def __init__(self, layer: nn.Module, change: Callable[[torch.Tensor], torch.Tensor] = lambda z: z) -> None:
        super().__init__()
        self.layer, self.change = layer, change

    def forward(self, scene: Scene) -> torch.Tensor:
        return self.change(self.layer(scene.history[:, :, -1]))


def test_an_exception_is_refused_with_the_line_that_raised_it() -> None:
    with pytest.raises(ConfigError) as refused:
        try_backbone(Mine(nn.Linear(5, 8)), TASK)
    line = Mine.forward.__code__.co_firstlineno + 1
    assert str(refused.value).startswith(
        f"the backbone Mine fails at {__file__}:{line} on trial scenes of 3 agents: RuntimeError: mat1 and mat2"
    )


def test_features_that_do_not_depend_on_the_weights_are_refused() -> None:
    with pytest.raises(ConfigError, match="would not learn: its features do not depend on its weights"):
        try_backbone(Mine(nn.Linear(4, 8), torch.Tensor.detach), TASK)
    try_backbone(Mine(nn.Linear(4, 8).requires_grad_(False)), TASK)
    try_backbone(Mine(nn.Identity(), lambda z: z.repeat(1, 1, 2)), TASK)
    with torch.no_grad():
        try_backbone(Mine(nn.Linear(4, 8)), TASK)


def test_no_trace_is_left() -> None:
    noisy = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.5), nn.BatchNorm1d(AGENTS))
    backbone = Mine(noisy, lambda z: z + torch.randn_like(z))
    noisy[1].eval()  # a part that its author has switched off
    kept = {name: value.clone() for name, value in backbone.state_dict().items()}
    modes = [module.training for module in backbone.modules()]
    state = torch.get_rng_state()
    try_backbone(backbone, TASK)
    assert torch.equal(torch.get_rng_state(), state)
    assert [module.training for module in backbone.modules()] == modes
    assert all(torch.equal(value, kept[name]) for name, value in backbone.state_dict().items())
    assert all(weights.grad is None for weights in backbone.parameters())


@pytest.mark.parametrize(
    "task",
    [
        TASK,
        Task(horizon=6, dt=0.1, candidates=1, scale=2.0),
        Task(horizon=20, dt=0.2, candidates=12, map=True, scale=20.0, history=10, shape="box"),
    ],
)
def test_trial_scenes_have_the_fields_of_the_task(task: Task) -> None:
    scene = trial_scene(task)
    assert scene.history.shape == (SCENES, AGENTS, task.history or 10, 4)
    assert scene.history.abs().max() <= task.scale
    assert (scene.lanes is not None) == task.map
    assert (0 if scene.goal_candidates is None else scene.goal_candidates.shape[2]) == task.candidates


def test_a_lazy_layer_can_be_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Optimisers refuse layers without sizes, so the sizes must be known when a forecaster has been built."""
    monkeypatch.setitem(registry._PARTS, "backbone", dict(registry.parts("backbone")))  # it stays in this test

    @register("backbone", "lazy")
    class Lazy(Mine):
        def __init__(self) -> None:
            super().__init__(nn.LazyLinear(8))

    settings = read(Settings, compose("train", ["experiment=rpi/v_lstm_sc", "data=drawn"]))
    settings = dataclasses.replace(settings, backbone={"name": "lazy"})
    _, forecaster = assembly.build(settings)
    assert forecaster.backbone.layer.in_features == 4
    assert assembly.parameters(forecaster) > 8 * 5
