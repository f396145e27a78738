"""Drawn scenes: fields, shapes and types of the real data, and reproducible random values."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch

from epo_lightning.data.drawn import DrawnData
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.metrics.functional.overlap import overlapping_pairs
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS, Scene

FIXTURE = Path(__file__).parents[1] / "fixtures" / "exid_sim"
REAL = {
    "rpi": ("data=rpi", "data.games=3", "data.placements=1"),
    "highway": ("data=exid", f"data.folder={FIXTURE}"),
    "pedestrians": ("data=ucy",),
}


def real(like: str, root: Path):
    return assembly.build_data(compose("generate", [*REAL[like], f"data.root={root}"])["data"])


def drawn(like: str, split: str = "train", **options) -> Scene:
    dataset = DrawnData(like, **options).open(split)
    return dataset[torch.arange(len(dataset))]


@pytest.mark.parametrize("like", REAL)
def test_tasks_are_the_real_ones(like, tmp_path):
    pretended, genuine = DrawnData(like), real(like, tmp_path)
    assert (pretended.task, pretended.num_agents) == (genuine.task, genuine.num_agents)
    if like != "rpi":
        assert pretended.preset.history == genuine.windows.history


@pytest.mark.parametrize("like", ["rpi", "highway"])
def test_fields_shapes_and_types_are_the_real_ones(like, tmp_path):
    module = real(like, tmp_path)
    module.generate(workers=1, progress=False)
    genuine, pretended = module.open("train")[torch.arange(2)], drawn(like)
    for name, expected in vars(genuine).items():
        found = getattr(pretended, name)
        if isinstance(expected, torch.Tensor):
            assert (found.shape[1:], found.dtype) == (expected.shape[1:], expected.dtype), name
        else:
            assert found == expected, name


@pytest.mark.parametrize("like", REAL)
@pytest.mark.parametrize("agents", [None, 1, 12])
def test_drawn_scenes_have_plausible_values(like, agents):
    scene = drawn(like, agents=agents, scenes=64)
    assert len(scene.history) == 64
    assert scene.history.shape[1] == (agents or DrawnData(like).preset.agents)
    assert scene.finite.all()
    assert scene.agent_mask.any(1).all()
    states = torch.cat((scene.history, scene.future), 2)[scene.agent_mask]
    moved = states[:, 1:, :2] - states[:, :-1, :2]
    assert (moved.norm(dim=-1) / scene.dt - states[:, 1:, 3]).abs().max() < 0.1
    turned = torch.atan2(moved[..., 1], moved[..., 0]) - states[:, 1:, 2]
    assert turned.cos().min() > 0.99
    low, high = {"highway": (18.0, 37.0)}.get(like, (0.6, 1.6))
    assert states[..., 3].min() > low
    assert states[..., 3].max() < high


def test_vehicles_rarely_begin_within_each_other_and_some_change_lane():
    scene = drawn("highway", agents=12, scenes=64)
    within = overlapping_pairs(scene.current[:, :, None], scene.size, scene.agent_mask, "box")
    assert within.float().mean() < 0.005
    drift = (scene.future[..., -1, 1] - scene.history[..., 0, 1]).abs()
    assert 0.1 < (drift > 3.0).float().mean() < 0.9
    last = scene.future[:, :, None, -1, :2]
    assert (scene.goal_candidates - last).norm(dim=-1).amin(-1).median() < 5.0


def test_goals_and_lines_of_drawn_vehicles_lie_on_three_lanes_and_as_far_as_they_brake_or_accelerate():
    scene = drawn("highway", agents=12, scenes=16)
    now = scene.current.double()
    x, pace = now[..., 0, None], (now[..., 3] * now[..., 2].cos())[..., None]
    goals, lines = scene.goal_candidates.double().unflatten(2, (3, 20)), scene.references.double()
    for points, first, last in ((goals, 4 * pace - 32.0, 4 * pace + 24.0), (lines, -5.0 + 0 * pace, 4 * pace + 34.0)):
        for place, far in ((0, first), (-1, last)):
            torch.testing.assert_close(points[..., place, 0] - x, far.expand(-1, -1, 3), rtol=0, atol=1e-3)
        assert (points[..., 1].diff(dim=2) == -3.5).all(), "from left to right, one lane apart"
        own = points[:, :, 1, :, 1]
        assert set(own.flatten().tolist()) == {0.0, 3.5, 7.0, 10.5}
        assert (own[..., 0] - now[..., 1]).abs().max() <= 3.5
    torch.testing.assert_close(scene.reference_speed.double(), pace[..., 0] + 2.0, rtol=0, atol=1e-4)


def test_drawn_lanes_are_a_road_of_four_lanes_and_trucks_are_long():
    scene = drawn("highway", scenes=4)
    for lanes in scene.lanes:
        assert ((lanes[..., 2:] - lanes[..., :2]) == torch.tensor([6.0, 0.0])).all(), "along x"
        pieces = sorted(zip(lanes[:, 0, 1].tolist(), lanes[:, 0, 0].tolist(), lanes[:, -1, 2].tolist(), strict=True))
        assert [y for y, *_ in pieces] == [0.0] * 8 + [3.5] * 8 + [7.0] * 8 + [10.5] * 8
        assert all(one[2] == other[1] for one, other in itertools.pairwise(pieces) if one[0] == other[0])
    assert torch.equal(scene.size[..., 0] > 10.0, scene.kind == KINDS.index("truck"))


def test_numbers_of_scenes_and_agents_are_those_that_were_asked_for():
    """A record of RPI is two scenes."""
    for count, scenes in ((1, 2), (5, 6), (6, 6)):
        assert len(DrawnData("rpi", scenes=count).open("train")) == scenes
        assert len(DrawnData("pedestrians", scenes=count).open("train")) == count
    there = drawn("pedestrians", agents=6, scenes=64).agent_mask.sum(1)
    assert set(there.tolist()) == {2, 3, 4, 5, 6}


def test_scenes_depend_on_the_seed_and_the_split():
    one, again, other, later = (
        drawn("highway", split, seed=seed).history
        for split, seed in (("train", 3), ("train", 3), ("train", 4), ("test", 3))
    )
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert not torch.equal(one, later)
    assert not torch.equal(other, drawn("highway", "val", seed=3).history), "seeds do not share their splits"
    assert drawn("highway", "train").subset is None
    assert drawn("highway", "test").subset is not None
    options = ({}, {"seed": 1}, {"scenes": 8}, {"agents": 3}, {"like": "rpi"})
    assert len({DrawnData(**each).digest for each in options}) == len(options)
    assert DrawnData(batch_size=8).digest == DrawnData().digest == DrawnData(agents=4).digest


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"like": "highways"}, "did you mean 'highway'"),
        ({"agents": 0}, "data.agents must be between 1 and 64"),
        ({"scenes": 0}, "data.scenes must be 1 or more"),
    ],
)
def test_invalid_settings_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        DrawnData(**options)


def test_there_is_nothing_to_generate():
    with pytest.raises(ConfigError, match="nothing to generate"):
        DrawnData().generate()
