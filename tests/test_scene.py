"""Scenes: what they refuse, and that their tensors move together."""

from __future__ import annotations

import jaxtyping
import pytest
import torch
from games import random_scene

from epo_lightning.scene import GameParameters, JointForecast, Scene


@pytest.fixture(autouse=True)
def as_users_run_it(monkeypatch):
    """Without the tests' own checks of annotations, which would come first."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def test_what_does_not_fit_is_refused_by_name():
    history = torch.zeros(2, 3, 5, 4)
    with pytest.raises(ValueError, match=r"scene\.dt must be positive"):
        Scene(history, 0.0)
    with pytest.raises(ValueError, match=r"scene\.size has shape \[2, 2, 2\]; this history takes \[2, 3, 2\]"):
        Scene(history, 0.1, size=torch.ones(2, 2, 2))
    with pytest.raises(ValueError, match=r"scene\.agent_mask has shape \[2, 4\]"):
        Scene(history, 0.1, agent_mask=torch.ones(2, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"scene\.reference_speed has shape \[2\]; this history takes \[2, 3\]"):
        Scene(history, 0.1, reference_speed=torch.ones(2))
    with pytest.raises(ValueError, match=r"scene\.references has shape \[2, 3, 4, 1, 2\]"):
        Scene(history, 0.1, references=torch.zeros(2, 3, 4, 1, 2))
    with pytest.raises(ValueError, match=r"scene\.reference_mask has shape \[2, 3, 1\]; these references take"):
        mask = torch.ones(2, 3, 1, dtype=torch.bool)
        Scene(history, 0.1, references=torch.zeros(2, 3, 4, 6, 2), reference_mask=mask)
    with pytest.raises(ValueError, match=r"scene\.reference_mask says which"):
        Scene(history, 0.1, reference_mask=mask)
    with pytest.raises(ValueError, match=r"scene\.history has shape \[2, 3, 5, 3\]"):
        Scene(history[..., :3], 0.1)


def test_scenes_are_chosen_and_converted_as_a_whole():
    scene = random_scene(4, 2)
    chosen = scene[[2, 0]].to(torch.float64)
    assert torch.equal(chosen.id, torch.tensor([2, 0]))
    assert chosen.history.dtype == chosen.size.dtype == torch.float64
    assert torch.equal(chosen.history.float(), scene.history[[2, 0]])
    assert scene[1].history.shape == (1, 2, 19, 4)


def test_only_what_is_real_has_to_be_finite():
    scene = random_scene(3, 2)
    scene.history[1, 0, 4] = torch.nan
    assert scene.finite.tolist() == [True, False, True]
    scene.history_mask[1, 0, 4] = False
    assert scene.finite.all()
    scene.references[2, 1, 1] = torch.inf
    scene.reference_speed[0, 0] = torch.nan
    assert scene.finite.tolist() == [False, True, False]
    scene.reference_mask[2, 1, 1] = False
    scene.agent_mask[0, 0] = False
    assert scene.finite.all()


@pytest.mark.parametrize("name", ["agent_mask", "history_mask"])
def test_masks_are_boolean(name):
    mask = torch.ones((1, 2) if name == "agent_mask" else (1, 2, 3))
    with pytest.raises(ValueError, match=rf"scene\.{name} is of type torch\.float32; masks are torch\.bool"):
        Scene(torch.zeros(1, 2, 3, 4), 0.1, **{name: mask})


def test_a_history_has_a_current_state():
    with pytest.raises(ValueError, match="has no step"):
        Scene(torch.zeros(1, 2, 0, 4), 0.1)


def test_batches_within_a_batch_are_indexed_with_it():
    goals = torch.arange(3.0).view(3, 1, 1, 1).expand(3, 1, 1, 2)
    game = GameParameters({"goal": goals[..., 0]}, {}, torch.zeros(3, 1, 1, 2, 2), goals)
    forecast = JointForecast(torch.zeros(3, 1, 1, 2, 4), torch.ones(3, 1), parameters=game)
    assert torch.equal(forecast[2].parameters.goals, goals[2:])
    assert torch.equal(forecast[2].parameters.own_weights["goal"], goals[2:, ..., 0])
