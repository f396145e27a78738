"""Edits of a game: every change of the page is compared with the same change made by hand."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.explore.edit import Edit
from epo_lightning.explore.session import Session
from epo_lightning.metrics.forecast import equilibrium_values
from epo_lightning.registry import ConfigError

RUN, SCENE = "rpi/v_lstm_epo", 3


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(epo_lightning.load(RUN), pretrained.examples(RUN), "rpi", ("executed", "alternative"))


def states(answer: dict[str, Any], mode: int = 0) -> torch.Tensor:
    return torch.tensor([answer["modes"][mode]["states"][agent] for agent in answer["present"]])


def close(found: torch.Tensor, wanted: torch.Tensor) -> None:
    torch.testing.assert_close(found, wanted, atol=2e-4, rtol=0)  # the page's numbers are rounded


def test_an_unchanged_game_is_the_forecast(session: Session) -> None:
    forecast = session.forecaster.predict(session.scenes[SCENE])
    answer = session.solve(Edit(scene=SCENE, mode=1))
    assert forecast.initial_states is not None
    assert forecast.own_energy is not None
    for mode in range(2):
        close(states(answer, mode), forecast.states[0, mode])
        close(torch.tensor(answer["modes"][mode]["start"][0]), forecast.initial_states[0, mode, 0, :, :2])
        assert answer["modes"][mode]["probability"] == pytest.approx(float(forecast.probabilities[0, mode]))
    assert answer["energy"] == pytest.approx(float(forecast.solution.energy[0, 1]), rel=1e-6)  # type: ignore[union-attr]
    for name, energy in forecast.own_energy.items():
        close(torch.tensor(answer["own_energy"][name]), energy[0, 1])
    parts = [*answer["own_energy"].values(), *answer["pair_energy"].values()]
    assert sum(map(sum, parts)) == pytest.approx(answer["energy"], abs=1e-2)


def test_a_factor_multiplies_the_weights_of_all_agents(session: Session) -> None:
    scene = session.scenes[SCENE]
    game = session.forecaster.predict(scene).parameters
    assert game is not None
    changed = dataclasses.replace(game, own_weights={**game.own_weights, "goal": 1.5 * game.own_weights["goal"]})
    wanted = session.forecaster.solve(scene, changed)
    answer = session.solve(Edit(scene=SCENE, factors={"goal": 1.5}))
    close(states(answer), wanted.states[0, 0])
    close(torch.tensor(answer["own_weights"]["goal"]), changed.own_weights["goal"][0, answer["mode"]])


def test_without_pair_terms_or_without_the_other_agent_an_agent_plans_alike(session: Session) -> None:
    alone = session.solve(Edit(scene=SCENE, pair_terms=False))
    assert all(value == 0 for values in alone["pair_energy"].values() for value in values)
    for absent in (0, 1):
        answer = session.solve(Edit(scene=SCENE, absent=[absent]))
        assert answer["present"] == [1 - absent]
        close(states(answer)[0], states(alone)[1 - absent])


def test_agents_follow_a_goal_that_was_moved(session: Session) -> None:
    before = session.solve(Edit(scene=SCENE))
    x, y = before["modes"][0]["goals"][0]
    after = session.solve(Edit(scene=SCENE, goals={"0": [x, y + 3.0]}))
    assert after["modes"][0]["goals"][0] == [pytest.approx(x, abs=1e-4), pytest.approx(y + 3.0, abs=1e-4)]
    assert after["modes"][0]["goals"][1] == before["modes"][0]["goals"][1]
    assert after["modes"][1]["goals"][0] == after["modes"][0]["goals"][0], "a goal is the same in all modes"
    moved = states(after)[0, -1] - states(before)[0, -1]
    assert moved[1] > 0.05
    assert session.solve(Edit(scene=SCENE)) | {"milliseconds": 0} == before | {"milliseconds": 0}, "nothing is kept"


def test_a_moved_agent_came_there_at_constant_velocity_and_the_network_is_asked_again(session: Session) -> None:
    scene = session.scenes[SCENE]
    edit = Edit(scene=SCENE, states={"1": [1.0, -2.0, math.pi / 2, 0.8]})
    moved = edit.moved(scene)
    assert torch.equal(moved.history[:, 0], scene.history[:, 0])
    torch.testing.assert_close(moved.history[0, 1, -1], torch.tensor([1.0, -2.0, math.pi / 2, 0.8]))
    steps = moved.history[0, 1, :, :2].diff(dim=0)
    torch.testing.assert_close(steps, torch.tensor([0.0, 0.08]).expand_as(steps), atol=1e-5, rtol=0)
    close(states(session.solve(edit)), session.forecaster.predict(moved).states[0, 0])


def test_the_description_has_what_is_drawn(session: Session) -> None:
    scene = session.scenes[SCENE]
    found = session.describe(SCENE)
    assert (found["index"], found["count"], found["dt"]) == (SCENE, len(session.scenes.history), scene.dt)
    assert found["subset"] in ("executed", "alternative")
    assert found["pairs"] == [[0, 1]]
    assert found["weighted"] == [list(names) for names in session.forecaster.energy.weighted]
    assert scene.future is not None
    for agent in (0, 1):
        close(torch.tensor(found["agents"][agent]["history"]), scene.history[0, agent, :, :2])
        close(torch.tensor(found["agents"][agent]["future"]), scene.future[0, agent, :, :2])


def test_steps_that_were_not_observed_are_not_drawn_and_those_of_a_moved_agent_are() -> None:
    scenes = pretrained.examples(RUN)
    mask = scenes.history_mask.clone()
    mask[SCENE, 1, :3] = False
    gappy = Session(epo_lightning.load(RUN), dataclasses.replace(scenes, history_mask=mask))
    drawn = gappy.describe(SCENE)["agents"][1]["history"]
    close(torch.tensor(drawn), scenes.history[SCENE, 1, 3:, :2])
    moved = Edit(states={"1": [1.0, -2.0, 0.0, 0.8]}).moved(gappy.scenes[SCENE])
    assert moved.history_mask.all()
    assert not gappy.scenes.history_mask[SCENE, 1, :3].any(), "the scene itself stays as it is"


def test_lanes_goals_and_the_nash_gap_are_those_of_the_scene_and_the_mode() -> None:
    """On a road, where every mode has goals of its own."""
    run = "highway_sim/hivt_m_epo"
    forecaster, scenes = epo_lightning.load(run), pretrained.examples(run)[:2]
    assert scenes.lanes is not None
    assert scenes.lane_mask is not None
    mask = scenes.lane_mask.clone()
    mask[1, 3] = False
    roads = Session(forecaster, dataclasses.replace(scenes, lane_mask=mask))
    vectors = torch.cat([scenes.lanes[1, lane] for lane in range(mask.shape[1]) if lane != 3])
    close(torch.tensor(roads.describe(1)["lanes"]), vectors)
    forecast = forecaster.predict(roads.scenes[1])
    assert forecast.parameters is not None
    assert forecast.parameters.goals is not None
    for mode in (1, 3):
        answer = roads.solve(Edit(scene=1, mode=mode))
        for each in range(5):
            goals = torch.tensor([answer["modes"][each]["goals"][agent] for agent in range(4)])
            close(goals, forecast.parameters.goals[0, each])
        alone = torch.eye(5)[mode, None]
        report = forecaster.examine(roads.scenes[1], dataclasses.replace(forecast, probabilities=alone))
        assert answer["nash_gap"] == pytest.approx(float(equilibrium_values(report)["nash_gap_relative"]), rel=1e-4)


edits = st.builds(
    Edit,
    scene=st.integers(0, 15),
    mode=st.sampled_from([None, 0, 1]),
    factors=st.dictionaries(st.sampled_from(["goal", "vel", "acc", "jerk", "proximity"]), st.floats(0, 32)),
    goals=st.dictionaries(st.sampled_from(["0", "1"]), st.tuples(*[st.floats(-20, 20)] * 2)),
    states=st.dictionaries(
        st.sampled_from(["0", "1"]), st.tuples(*[st.floats(-10, 10)] * 2, st.floats(-7, 7), st.floats(0, 3))
    ),
    absent=st.sampled_from([(), (0,), (1,)]),
    pair_terms=st.booleans(),
)


@settings(max_examples=6, deadline=None)
@given(edits)
def test_every_edit_gives_finite_numbers(session: Session, edit: Edit) -> None:
    answer = session.solve(edit)
    assert states(answer).isfinite().all()
    assert math.isfinite(answer["energy"])
    assert answer["nash_gap"] is None or answer["nash_gap"] >= 0
    assert session.solve(edit) | {"milliseconds": 0} == answer | {"milliseconds": 0}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"scene": 16}, "scene must be a number from 0 to 15, not 16"),
        ({"mode": 2}, "mode must be a number from 0 to 1, not 2"),
        ({"factors": {"gaol": 1.0}}, "no feature 'gaol': did you mean 'goal'"),
        ({"factors": {"goal": -1.0}}, "factors.goal must be a number from 0 to 1000, not -1.0"),
        ({"goals": {"0": [1.0]}}, r"goals.0 must be \[x, y\] in m, at most 10000 in size"),
        ({"goals": {"first": [1.0, 2.0]}}, "goals.first must have the number of an agent"),
        ({"goals": {"7": [1.0, 2.0]}}, r"goals: the scene has the agents \[0, 1\], not 7"),
        ({"states": {"0": [0.0, 0.0, 0.0, math.inf]}}, r"states.0 must be \[x, y, heading, speed\]"),
        ({"absent": [0, 1]}, "at least one agent has to stay"),
    ],
)
def test_edits_that_do_not_fit_are_refused(session: Session, words: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        session.solve(Edit(**words))


def test_a_forecaster_without_a_game_is_refused() -> None:
    with pytest.raises(ConfigError, match="infers no game"):
        Session(torch.nn.Linear(1, 1), pretrained.examples(RUN))


def test_an_angle_and_a_turn_more_are_the_same_heading() -> None:
    run = "rpi/v_lstm_epo_game_refined"  # its agents want a heading at their goals
    session = Session(epo_lightning.load(run), pretrained.examples(run))
    x, y, heading, speed = session.scenes[SCENE].history[0, 1, -1].tolist()
    answers = [
        session.solve(Edit(scene=SCENE, states={"1": [x, y, heading + turn, speed]}))
        for turn in (0.0, math.tau, -math.tau)
    ]
    for answer in answers[1:]:
        close(states(answer)[..., :2], states(answers[0])[..., :2])
        assert answer["energy"] == pytest.approx(answers[0]["energy"], rel=1e-3)
