"""Scenes without a map, as forecasters of mapped roads read them: candidates by small steps, and an empty map."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from epo_lightning.data.drawn import DrawnData
from epo_lightning.data.open_space import OpenSpace, in_open_space
from epo_lightning.experiment.assembly import build_model
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.scene import KINDS, Scene
from epo_lightning.schema import read


def walkers(count: int = 6) -> Scene:
    """Drawn pedestrians with masked agents, at 0.4 s and 12 steps."""
    return DrawnData("pedestrians", scenes=count).open("test")[torch.arange(count)]


def one(speed: float, heading: float, kind: str) -> Scene:
    """One agent at (3, -2), which moves straight ahead for 4 s."""
    state = torch.tensor([3.0, -2.0, heading, speed])
    return Scene(
        history=state.expand(1, 1, 2, 4).clone(),
        dt=0.2,
        future=state.expand(1, 1, 20, 4).clone(),
        size=torch.ones(1, 1, 2),
        kind=torch.tensor([[KINDS.index(kind)]]),
    )


@given(st.floats(-2, 35), st.floats(-3, 3), st.sampled_from(["car", "pedestrian"]))
def test_candidates_are_driven_by_small_steps(speed: float, heading: float, kind: str) -> None:
    scene = in_open_space(one(speed, heading, kind))
    found = scene.goal_candidates[0, 0].view(7, 20, 2).double()
    limit, time = (1.0 if kind == "pedestrian" else 3.0), 4.0
    speed = max(speed, 0.0)  # an agent that rolls backwards stops
    assert scene.reference_speed.item() == pytest.approx(speed)
    far = speed * time + limit * time * time / 2
    brake = min(speed / 4.0, time)
    near = max(0.0, min(speed * brake - 2.0 * brake * brake, far - 10.0))
    largest = min(limit / speed**2 if speed > 1e-3 else math.inf, math.pi / far)
    for number, share in enumerate((1.0, 4 / 9, 1 / 9, 0.0, -1 / 9, -4 / 9, -1.0)):  # from left to right
        for place in (0, 7, 19):
            length = near + (far - near) * place / 19
            x, y, angle, step = 3.0, -2.0, heading, length / 2000
            for _ in range(2000):
                middle = angle + 0.5 * step * share * largest
                x, y, angle = x + step * math.cos(middle), y + step * math.sin(middle), angle + step * share * largest
            assert math.dist((x, y), found[number, place].tolist()) < 2e-3 * (1 + far / 50)


def test_the_map_is_empty_and_nothing_else_changes() -> None:
    before = walkers()
    after = in_open_space(before)
    assert not after.lane_mask.any()
    assert not after.reference_mask.any()
    assert torch.equal(after.goal_mask.any(-1), before.agent_mask)
    assert torch.equal(
        after.reference_speed.where(before.agent_mask, 0.0),
        before.current[..., 3].clamp_min(0.0).where(before.agent_mask, 0.0),
    )
    added = {
        "lanes",
        "lane_mask",
        "goal_candidates",
        "goal_mask",
        "goal_reference",
        "references",
        "reference_mask",
        "reference_speed",
    }
    for field in dataclasses.fields(Scene):
        if field.name not in added:
            assert getattr(after, field.name) is getattr(before, field.name), field.name
    assert after.finite.all()
    road = DrawnData("highway", scenes=2).open("test")[torch.arange(2)]
    assert in_open_space(road) is road


def test_padding_of_absent_agents_is_not_read() -> None:
    scene = walkers()
    assert not scene.agent_mask.all()
    padded = dataclasses.replace(scene, history=scene.history.masked_fill(~scene.agent_mask[..., None, None], math.nan))
    for name in ("goal_candidates", "reference_speed"):
        assert torch.equal(getattr(in_open_space(padded), name), getattr(in_open_space(scene), name))


def test_candidates_do_not_depend_on_the_future() -> None:
    scene = walkers()
    other = dataclasses.replace(scene, future=scene.future + 5.0)
    assert torch.equal(in_open_space(scene).goal_candidates, in_open_space(other).goal_candidates)
    with pytest.raises(ValueError, match=r"scene\.future"):
        in_open_space(dataclasses.replace(scene, future=None, future_mask=None))


def road_model(row: str):
    settings = read(Settings, compose("train", [f"experiment=highway/{row}", "data=drawn", "budget=smoke"]))
    model = build_model(settings, DrawnData("highway"))
    for parameter in model.parameters():  # no weight is zero at the start, so that everything has an effect
        torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def at_the_roads_clock(scene: Scene) -> Scene:
    """The same scenes, read as if their steps were 0.2 s, with 20 future steps."""
    future = scene.future.repeat_interleave(2, 2)[:, :, :20]
    mask = scene.future_mask.repeat_interleave(2, 2)[:, :, :20]
    return dataclasses.replace(scene, dt=0.2, future=future, future_mask=mask)


@pytest.mark.parametrize("backbone", ["v_lstm", "vibes", "hivt_m"])
def test_backbones_read_an_empty_map_as_no_map(backbone: str) -> None:
    model, scene = road_model(backbone), in_open_space(at_the_roads_clock(walkers()))
    features = model.backbone(scene)
    assert features.isfinite().all()
    noise = dataclasses.replace(
        scene,
        lanes=torch.full((len(scene.lanes), 9, 4, 4), 77.0),
        lane_mask=torch.zeros(len(scene.lanes), 9, 4, dtype=torch.bool),
    )
    torch.testing.assert_close(model.backbone(noise), features, rtol=0, atol=1e-6)
    lanes, model.backbone.lanes = model.backbone.lanes, None  # a backbone without a map has no lane encoder
    attention = getattr(model.backbone.interaction, "to_lanes", None)
    if attention is not None:
        model.backbone.interaction.to_lanes = None
    torch.testing.assert_close(model.backbone(scene), features, rtol=0, atol=1e-6)
    assert lanes is not None


@pytest.mark.parametrize("row", ["v_lstm", "vibes_sc", "v_lstm_epo", "hivt_m_epo"])
def test_rows_of_roads_forecast_in_open_space(row: str) -> None:
    model, scene = road_model(row), in_open_space(at_the_roads_clock(walkers()))
    forecast = model.predict(scene)
    assert forecast.states.isfinite().all()
    if forecast.parameters is not None:
        assert not forecast.own_energy["lane"].any(), "a line that does not exist costs nothing"
        assert forecast.own_energy["goal"].any()
        seen = model.examine(scene, forecast)
        assert seen.equilibrium.energy.isfinite().all()
        moved = dataclasses.replace(scene, references=scene.references + 31.0)
        torch.testing.assert_close(model.predict(moved).states, forecast.states, rtol=0, atol=1e-5)


def test_a_data_set_keeps_its_order_and_provenance() -> None:
    whole = DrawnData("pedestrians", scenes=5).open("test")
    opened = OpenSpace(whole)
    epochs: list[int] = []
    whole.set_epoch = epochs.append
    opened.set_epoch(3)
    assert epochs == [3]
    assert len(opened) == 5
    assert opened[torch.tensor([3, 1])].id.tolist() == [3, 1]
    assert opened.provenance([2]) == whole.provenance([2])
