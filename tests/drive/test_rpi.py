"""The robot-pedestrian game as a world: the same episodes for all planners, and pedestrians that play or ignore."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch

import epo_lightning
from epo_lightning.data.rpi.game import main_game
from epo_lightning.data.rpi.subgames import HISTORY
from epo_lightning.drive.episodes import play
from epo_lightning.drive.measures import measure
from epo_lightning.drive.planners import ForecastPlanner, GamePlanner, Planner, ResponsePlanner
from epo_lightning.drive.rpi import RPIWorld
from epo_lightning.drive.world import SEEDS
from epo_lightning.registry import ConfigError
from epo_lightning.scene import SPEED


@pytest.fixture(scope="module", params=["plays", "ignores"])
def world(request: pytest.FixtureRequest) -> RPIWorld:
    return RPIWorld(3, seed=1, pedestrian=request.param)


def moved(world: RPIWorld, control: tuple[float, float], steps: int) -> torch.Tensor:
    """States of the pedestrian while the robot's controls are constant."""
    own = copy.deepcopy(world)
    for _ in range(steps):
        own.advance(torch.tensor(control).expand(3, 2))
    return own.observe().current[:, 1]


def test_a_seed_names_the_episodes(world: RPIWorld) -> None:
    again, other = (RPIWorld(2, seed, world.pedestrian).observe() for seed in (1, 2))
    torch.testing.assert_close(again.history, world.observe().history[:2], rtol=0, atol=0)
    assert not torch.allclose(again.history, other.history)


def test_games_are_solved_when_their_episodes_are_begun() -> None:
    world = RPIWorld(500, seed=1)
    assert world.together == 50
    assert len(world.games) == 50


def test_a_scene_shows_the_past_alone(world: RPIWorld) -> None:
    scene = world.observe()
    assert scene.future is None
    assert scene.history.shape == (3, 2, HISTORY + 1, 4)
    assert bool((scene.history[:, :, 0, SPEED] == 0).all()), "an episode is planned as soon as a history is complete"
    assert scene.game_steps is not None
    assert scene.game_steps.tolist() == [82] * 3


def test_only_a_pedestrian_who_plays_answers_the_robot(world: RPIWorld) -> None:
    straight, turned = moved(world, (0.0, 0.0), 12), moved(world, (0.5, 0.8), 12)
    assert torch.equal(straight, turned) == (world.pedestrian == "ignores")


def test_the_true_game_against_itself_stays_on_the_begun_mode() -> None:
    world = RPIWorld(3, seed=1, pedestrian="plays")
    planned = torch.tensor(world._x.copy())[:, HISTORY:]
    episodes = play(world, GamePlanner(world.energy, world.game), range(len(world)))
    assert episodes.found.all()
    reached = episodes.outcome.states.transpose(1, 2).flatten(2)
    assert float((reached - planned)[..., [0, 1, 4, 5]].abs().max()) < 0.02


def test_the_cost_is_that_of_the_true_game() -> None:
    world = RPIWorld(2, seed=1, pedestrian="plays")
    episodes = play(world, GamePlanner(world.energy, world.game), range(len(world)))
    weight, c = world.weight, world.constants
    robot = episodes.outcome.states[:, 0, 1:]
    own = 5 * episodes.controls.square().sum((1, 2)) + 15 * robot[..., SPEED].square().sum(1)
    own += 50 * (episodes.controls[..., 1].abs() - c.turn_limit).clamp_min(0).square().sum(1)
    goal = torch.tensor([3.0, 0.0, 0.0], dtype=torch.double)
    own += 150 * (robot[:, -1, :3] - goal).square().sum(-1)
    distance = (episodes.outcome.states[:, 0, 1:, :2] - episodes.outcome.states[:, 1, 1:, :2]).norm(dim=-1)
    pair = weight * (c.radius - distance).clamp_min(0).square().sum(1)
    torch.testing.assert_close(episodes.outcome.measures["cost"], own + pair, rtol=1e-6, atol=1e-6)


def test_the_last_step_has_a_game(world: RPIWorld) -> None:
    own = copy.deepcopy(world)
    own.now = own.constants.steps - 1
    plan = GamePlanner(own.energy, own.game)(own.observe(), None)
    assert bool(plan.found.all())
    assert plan.controls.shape[1] == 2


def test_an_episode_is_the_same_alone_and_again(world: RPIWorld) -> None:
    own = copy.deepcopy(world)
    planner = GamePlanner(own.energy, own.game)
    together = play(own, planner, range(3)).outcome
    for _ in range(2):
        alone = play(own, planner, [1]).outcome
        torch.testing.assert_close(alone.states[0], together.states[1], rtol=0, atol=1e-9)
        torch.testing.assert_close(alone.measures["cost"][0], together.measures["cost"][1])


@pytest.mark.parametrize("way", ["forecast", "response"])
def test_measures_do_not_depend_on_how_many_episodes_are_driven_together(
    way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    forecaster = epo_lightning.load("rpi/v_lstm_epo")

    def measured(together: int) -> dict[str, torch.Tensor]:
        monkeypatch.setattr("epo_lightning.drive.rpi.TOGETHER", together)
        world = RPIWorld(3, seed=1)
        assert world.together == together
        planner: Planner = ForecastPlanner(forecaster)
        if way == "response":
            planner = ResponsePlanner(world.energy, world.game, forecaster, world.search, world.agents)
        chunks = [range(3)[first : first + together] for first in range(0, 3, together)]
        parts = [measure(play(world, planner, chunk), world) for chunk in chunks]
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    whole, halves = measured(3), measured(2)
    for name, values in whole.items():
        torch.testing.assert_close(halves[name], values, rtol=1e-5, atol=1e-5)


# Measured before worlds got their common interface, on 5 episodes of seed 3, with the same machine to the last bit.
BEFORE = {
    ("plays", "response"): (0.915660703036, 5.451256734232, 0.035029468046, 0.021959829788, 461.055879660077),
    ("plays", "joint"): (0.938162635823, 5.461879681964, 0.042340519704, 0.022562294376, 462.682336658897),
    ("ignores", "response"): (0.883031428854, 5.487721369232, 0.086123166514, 0.058542791081, 516.910300639821),
    ("ignores", "joint"): (0.771684432329, 5.482042030341, 0.088898522468, 0.056379343374, 540.859930620363),
}


@pytest.mark.parametrize("pedestrian", ["plays", "ignores"])
def test_results_are_those_of_before(pedestrian: str) -> None:
    world = RPIWorld(5, seed=3, pedestrian=pedestrian)
    # The angles of these episodes were drawn by the first recipe.
    world._games = [main_game(SEEDS + 3, episode, 0, 1, world.constants, recipe=1) for episode in range(5)]
    world._begun.clear()
    world.reset(range(world.together))
    planners: dict[str, Planner] = {
        "response": ResponsePlanner(world.energy, world.game),
        "joint": GamePlanner(world.energy, world.game),
    }
    for name, planner in planners.items():
        found = measure(play(world, planner, range(5)), world)
        values = [float(found[key].mean()) for key in ("distance", "progress", "jerk", "lateral", "cost")]
        assert values == pytest.approx(BEFORE[pedestrian, name], rel=1e-6)


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="did you mean 'plays'"):
        RPIWorld(1, pedestrian="play")
    with pytest.raises(ConfigError, match="episodes must be a whole number, 1 or more, not 0"):
        RPIWorld(0)


def test_a_world_is_not_changed_by_its_scenes(world: RPIWorld) -> None:
    scene = world.observe()
    scene.history.zero_()
    assert dataclasses.replace(world.observe()).history.abs().sum() > 0


def test_a_pedestrian_who_ignores_the_robot_makes_the_inferred_pair_term_small(world: RPIWorld) -> None:
    game = epo_lightning.load("rpi/v_lstm_epo_game_refined").predict(world.observe()).parameters
    # Scale: the weight of accelerations is the square root of `effort` in the true game.
    unit = world.constants.effort / game.own_weights["acc"][:, 0, 0].square()
    inferred = game.pair_weights["clearance"][:, 0, 0].square() / 2 * unit
    share = float((inferred / world.weight).median())
    assert share < 0.2 if world.pedestrian == "ignores" else 0.8 < share < 1.25
