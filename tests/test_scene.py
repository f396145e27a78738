"""Scenes: validation of tensors, and indexing and conversion of all of them together."""

from __future__ import annotations

import dataclasses

import jaxtyping
import numpy as np
import pytest
import torch
from games import random_scene

from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.scene import FIELDS as DECLARED
from epo_lightning.scene import Scene


@pytest.fixture(autouse=True)
def as_users_run_it(monkeypatch):
    """Without the tests' own checks of annotations, which would come first."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


FIELDS = {
    "future": torch.zeros(2, 3, 7, 4),
    "goal_candidates": torch.zeros(2, 3, 6, 2),
    "size": torch.ones(2, 3, 2),
    "lanes": torch.zeros(2, 5, 8, 4),
    "references": torch.zeros(2, 3, 4, 6, 2),
}
"""Fields that fit a history [2, 3, 5, 4]."""


def a_mask(*shape: int) -> torch.Tensor:
    return torch.ones(*shape, dtype=torch.bool)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"history": torch.zeros(2, 3, 5, 3)}, r"scene\.history has shape \[2, 3, 5, 3\]; .* takes \[B, N, H, 4\]"),
        ({"history": torch.zeros(2, 3, 4)}, r"scene\.history has shape \[2, 3, 4\]"),
        ({"history": torch.zeros(2, 3, 0, 4)}, r"scene\.history .* at least 1 step; the last one is the current state"),
        ({"history": torch.zeros(2, 3, 5, 4, dtype=torch.long)}, r"scene\.history is of type torch\.int64"),
        ({"history_mask": a_mask(2, 3, 4)}, r"scene\.history_mask has shape \[2, 3, 4\]; .* takes \[2, 3, 5\]"),
        ({"agent_mask": a_mask(2, 4)}, r"scene\.agent_mask has shape \[2, 4\]; this scene takes \[2, 3\]"),
        ({"future": torch.zeros(2, 3, 4)}, r"scene\.future has shape \[2, 3, 4\]; this scene takes \[2, 3, K, 4\]"),
        ({"future": torch.zeros(2, 2, 7, 4)}, r"scene\.future has shape \[2, 2, 7, 4\]"),
        ({"future": torch.zeros(2, 3, 7, 2)}, r"scene\.future has shape \[2, 3, 7, 2\]"),
        ({"future": torch.zeros(2, 3, 0, 4)}, r"scene\.future has shape .* at least 1 step"),
        ({"future_mask": a_mask(2, 3, 6)}, r"scene\.future_mask has shape \[2, 3, 6\]; this scene takes \[2, 3, 7\]"),
        (
            {"future": None, "future_mask": a_mask(2, 3, 7)},
            r"scene\.future_mask describes scene\.future, which is None",
        ),
        ({"goal_candidates": torch.zeros(2, 3, 2)}, r"scene\.goal_candidates has shape .* takes \[2, 3, G, 2\]"),
        ({"goal_candidates": torch.zeros(2, 4, 6, 2)}, r"scene\.goal_candidates has shape \[2, 4, 6, 2\]"),
        ({"goal_mask": a_mask(2, 3, 5)}, r"scene\.goal_mask has shape \[2, 3, 5\]; this scene takes \[2, 3, 6\]"),
        ({"goal_reference": torch.zeros(2, 3, 6)}, r"scene\.goal_reference is of type torch\.float32, .* integer"),
        ({"size": torch.ones(2, 2, 2)}, r"scene\.size has shape \[2, 2, 2\]; this scene takes \[2, 3, 2\]"),
        ({"size": torch.ones(2, 3)}, r"scene\.size has shape \[2, 3\]"),
        ({"kind": torch.zeros(2, 2, dtype=torch.long)}, r"scene\.kind has shape \[2, 2\]"),
        ({"lanes": torch.zeros(3, 5, 8, 4)}, r"scene\.lanes has shape .* takes \[2, L, V, 4\]"),
        ({"lane_mask": a_mask(2, 5)}, r"scene\.lane_mask has shape \[2, 5\]; this scene takes \[2, 5, 8\]"),
        ({"lanes": None, "lane_mask": a_mask(2, 5, 8)}, r"scene\.lane_mask describes scene\.lanes, which is None"),
        ({"references": torch.zeros(2, 3, 4, 1, 2)}, r"scene\.references has shape .* at least 2 points"),
        ({"reference_mask": a_mask(2, 3, 1)}, r"scene\.reference_mask has shape .* takes \[2, 3, 4\]"),
        ({"references": None, "reference_mask": a_mask(2, 3, 4)}, r"scene\.reference_mask describes scene\.references"),
        ({"reference_speed": torch.ones(2)}, r"scene\.reference_speed has shape \[2\]; this scene takes \[2, 3\]"),
        ({"frame": torch.zeros(2, 2)}, r"scene\.frame has shape \[2, 2\]; this scene takes \[2, 3\]"),
        ({"subset": torch.zeros(3, dtype=torch.long)}, r"scene\.subset has shape \[3\]; this scene takes \[2\]"),
        ({"goal_headings": torch.zeros(2, 3, 5)}, r"scene\.goal_headings has shape .* takes \[2, 3, 6\]"),
        (
            {"goal_candidates": None, "goal_headings": torch.zeros(2, 3, 6)},
            r"scene\.goal_headings describes scene\.goal_candidates, which is None",
        ),
        ({"game_steps": torch.ones(3, dtype=torch.long)}, r"scene\.game_steps has shape \[3\]; this scene takes \[2\]"),
        ({"game_steps": torch.ones(2)}, r"scene\.game_steps is of type torch\.float32, expected integer"),
        ({"id": torch.zeros(2)}, r"scene\.id is of type torch\.float32, expected integer"),
        ({"agent_mask": torch.ones(2, 3)}, r"scene\.agent_mask is of type torch\.float32, .* masks are torch\.bool"),
        ({"history_mask": torch.ones(2, 3, 5)}, r"scene\.history_mask is of type torch\.float32"),
        ({"dt": 0.0}, r"scene\.dt must be positive and finite \[s\], not 0\.0"),
        ({"dt": -0.1}, r"scene\.dt must be positive"),
        ({"dt": float("nan")}, r"scene\.dt must be positive and finite \[s\], not nan"),
        ({"dt": float("inf")}, r"scene\.dt must be positive and finite \[s\], not inf"),
    ],
)
def test_tensors_of_wrong_shape_are_refused_by_name(wrong, message):
    Scene(torch.zeros(2, 3, 5, 4), 0.1, **FIELDS)
    with pytest.raises(ValueError, match=message):
        Scene(**{"history": torch.zeros(2, 3, 5, 4), "dt": 0.1, **FIELDS, **wrong})


@pytest.mark.parametrize("name", ["history", *FIELDS])
def test_arrays_and_lists_are_refused_by_name(name):
    fields = {"history": torch.zeros(2, 3, 5, 4), **FIELDS}
    for given, kind in ((fields[name].numpy(), r"numpy\.ndarray"), (fields[name].tolist(), r"builtins\.list")):
        with pytest.raises(TypeError, match=rf"scene\.{name} is a {kind}; convert it with torch\.as_tensor"):
            Scene(**{**fields, "dt": 0.1, name: given})
    with pytest.raises(TypeError, match=r"scene\.dt is a Tensor; it takes a number of seconds"):
        Scene(**fields, dt=torch.tensor(0.1))


def test_masks_default_to_true():
    scene = Scene(torch.zeros(2, 3, 5, 4), 0.1, **FIELDS)
    shapes = {"history": (2, 3, 5), "agent": (2, 3), "future": (2, 3, 7), "goal": (2, 3, 6), "lane": (2, 5, 8)}
    for name, shape in {**shapes, "reference": (2, 3, 4)}.items():
        mask = getattr(scene, f"{name}_mask")
        assert mask.shape == shape
        assert mask.all()
    bare = Scene(torch.zeros(2, 3, 5, 4), 0.1)
    assert bare.future_mask is bare.goal_mask is bare.lane_mask is bare.reference_mask is None


def test_invalid_values_of_present_agents_are_refused():
    scene = random_scene(3, 2)
    scene.validate_values()
    for bad in (0.0, -1.0, float("inf"), float("nan")):
        scene.size[1, 1, 0] = bad
        with pytest.raises(ValueError, match=r"scene\.size\[1, 1\] is .*length and width must be positive"):
            scene.validate_values()
        scene.agent_mask[1, 1] = False
        scene.validate_values()
        scene.agent_mask[1, 1] = True
    scene.size[1, 1, 0] = 1.0
    named = Scene(**{**vars(scene), "goal_reference": torch.ones(3, 2, 1, dtype=torch.long)})
    named.validate_values()
    for bad in (2, -1):
        named.goal_reference[2, 0, 0] = bad
        with pytest.raises(ValueError, match=rf"scene\.goal_reference\[2, 0, 0\] is {bad}; .* lines 0 to 1"):
            named.validate_values()
    named.goal_mask[2, 0, 0] = False
    named.validate_values()
    scene.history_mask[2, 1, -1] = False
    with pytest.raises(ValueError, match=r"scene\.history_mask\[2, 1, -1\] is False; .* is observed at t0"):
        scene.validate_values()
    scene.history_mask[2, 1, -1] = True
    scene.history[2, 1, 0, 2] = 1e5
    with pytest.raises(ValueError, match=r"scene\.history\[2, 1, 0\] has the heading 100000 rad"):
        scene.validate_values()


def test_indexing_and_conversion_apply_to_all_tensors_of_a_scene():
    scene = random_scene(4, 2)
    chosen = scene[[2, 0]].to(torch.float64)
    assert torch.equal(chosen.id, torch.tensor([2, 0]))
    assert chosen.history.dtype == chosen.size.dtype == torch.float64
    assert torch.equal(chosen.history.float(), scene.history[[2, 0]])
    for one in (1, np.int64(1), torch.tensor(1), -3):
        assert torch.equal(scene[one].history, scene.history[1:2])
    single = scene[0]
    for nothing in (torch.tensor([False]), np.array([False])):
        assert len(single[nothing].history) == 0
    with pytest.raises((IndexError, ValueError)):
        scene[torch.tensor(False)]  # a mask, not the first scene


def test_only_unmasked_values_must_be_finite():
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
    headed = dataclasses.replace(scene, goal_headings=torch.zeros(3, 2, 1))
    headed.goal_headings[1, 1] = torch.nan
    assert headed.finite.tolist() == [True, False, True]
    headed.goal_mask[1, 1] = False
    assert headed.finite.all()


PADDING = {
    "history": "history_mask",
    "future": "future_mask",
    "goal_candidates": "goal_mask",
    "goal_headings": "goal_mask",
    "size": "agent_mask",
    "lanes": "lane_mask",
    "references": "reference_mask",
    "reference_speed": "agent_mask",
}
"""For every field of floating-point numbers, the mask that makes its entries padding; frames have none."""


def whole_scene() -> Scene:
    """Two scenes of two agents with every field, all numbers zero and nothing masked."""
    sizes = dict(zip("BNHKGLVRQ", (2, 2, 3, 4, 2, 2, 3, 2, 3), strict=True))
    shapes = {name: [sizes.get(str(size), size) for size in shape] for name, (_, shape, _) in DECLARED.items()}
    masks = {name: torch.ones(shape, dtype=torch.bool) for name, shape in shapes.items() if name.endswith("_mask")}
    return Scene(dt=0.1, **{name: torch.zeros(shapes[name]) for name in PADDING}, **masks)


@pytest.mark.parametrize("field", PADDING)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_every_field_must_be_finite_where_it_is_no_padding(field: str, bad: float) -> None:
    scene, last = whole_scene(), -1
    assert scene.finite.all()
    values, mask = getattr(scene, field), getattr(scene, PADDING[field])
    entry = (1, *[last] * (values.dim() - 1))
    values[entry] = bad
    assert scene.finite.tolist() == [True, False]
    mask[entry[: mask.dim()]] = False
    assert scene.finite.all()


def test_the_fields_of_numbers_are_those_that_are_checked() -> None:
    numbers = {name for name, (kind, _, _) in DECLARED.items() if kind == DECLARED["history"][0]}
    assert numbers == PADDING.keys() | {"frame"}


def test_nested_data_classes_are_indexed_with_the_batch():
    goals = torch.arange(3.0).view(3, 1, 1, 1).expand(3, 1, 1, 2)
    margins = {"clearance": goals[..., 0]}
    game = GameParameters({"goal": goals[..., 0]}, {}, torch.zeros(3, 1, 1, 2, 2), goals, margins=margins)
    forecast = JointForecast(torch.zeros(3, 1, 1, 2, 4), torch.ones(3, 1), parameters=game)
    assert torch.equal(forecast[2].parameters.goals, goals[2:])
    assert torch.equal(forecast[2].parameters.own_weights["goal"], goals[2:, ..., 0])
    assert torch.equal(forecast[2].parameters.margins["clearance"], goals[2:, ..., 0])


def test_batches_are_printed_as_types_and_shapes() -> None:
    scene = random_scene(3, references=False)
    text = repr(scene)
    assert "    history=float32[3, 2, 19, 4],\n    dt=0.1,\n" in text
    assert "references" not in text, "fields that are not there"
    weights = {"goal": torch.ones(3, 1, 2)}
    game = GameParameters(weights, {}, initial_controls=torch.zeros(3, 1, 2, 40, 2))
    assert "    own_weights={'goal': float32[3, 1, 2]}," in repr(game)
    nested = repr(JointForecast(torch.zeros(3, 1, 2, 40, 4), torch.ones(3, 1), parameters=game))
    assert "    parameters=GameParameters(\n        own_weights={'goal': float32[3, 1, 2]},\n" in nested


def test_batches_are_joined_field_by_field_and_name_by_name() -> None:
    game = GameParameters({"a": torch.zeros(2, 1, 2), "b": torch.ones(2, 1, 2)}, {}, torch.zeros(2, 1, 2, 4, 2))
    turned = GameParameters({"b": torch.ones(1, 1, 2), "a": torch.zeros(1, 1, 2)}, {}, torch.ones(1, 1, 2, 4, 2))
    joined = GameParameters.concatenated([game, turned])
    assert (joined.own_weights["a"] == 0).all()
    assert joined.own_weights["b"].shape == (3, 1, 2)
    assert joined.initial_controls[:, 0, 0, 0, 0].tolist() == [0.0, 0.0, 1.0]
    assert GameParameters.concatenated([game, game], 1).initial_controls.shape == (2, 2, 2, 4, 2)


@pytest.mark.parametrize(
    ("change", "field"),
    [({"id": None}, "Scene.id"), ({"dt": 0.2}, "Scene.dt"), ({"id": None, "subset": torch.zeros(3).long()}, "Scene.")],
)
def test_batches_of_different_fields_are_not_joined(change: dict[str, object], field: str) -> None:
    scene = dataclasses.replace(random_scene(3), subset=None)
    with pytest.raises(ValueError, match=f"{field}.* differs between the parts"):
        Scene.concatenated([scene, dataclasses.replace(scene, **change)])
    with pytest.raises(ValueError, match="no Scene to concatenate"):
        Scene.concatenated([])
