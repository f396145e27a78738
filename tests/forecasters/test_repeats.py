"""Modes that repeat an earlier one, against slow versions; and forecasts of games with fewer equilibria than modes."""

from __future__ import annotations

import dataclasses
import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given
from test_game_horizon import SOLVER, built, scenes
from torch import Tensor, nn

from epo_lightning.forecast import DISTINCT, Solution, same_motion
from epo_lightning.forecasters import epo
from epo_lightning.forecasters.repeats import earliest_same, repeats_joined, smallest_of_same, with_repeats_added
from epo_lightning.metrics.functional import brier_min_sade


def motions(offsets: list[float], agents: int = 2) -> Tensor:
    """One scene [1, M, N, K=3, 4], whose modes differ in the last position of the last agent, by multiples of DISTINCT."""
    states = torch.zeros(1, len(offsets), agents, 3, 4, dtype=torch.double)
    states[0, :, -1, -1, 1] = DISTINCT * torch.tensor(offsets, dtype=torch.double)
    return states


def everyone(agents: int = 2) -> Tensor:
    return torch.ones(1, agents, dtype=torch.bool)


@pytest.mark.parametrize(
    ("offsets", "earliest"),
    [
        ([0.0], [0]),
        ([0.0, 0.5], [0, 0]),
        ([0.0, 1.5], [0, 1]),
        ([3.0, 0.0, 2.5, 0.1], [0, 1, 0, 1]),
        ([0.0, 0.9, 1.8, 2.7, 3.6], [0, 0, 0, 0, 0]),  # a chain
        ([0.0, 1.2, 0.6], [0, 0, 0]),  # a chain whose middle is the last mode
        ([0.0, math.nan, math.nan, 0.1], [0, 1, 2, 0]),
    ],
)
def test_a_mode_repeats_the_earliest_one_with_the_same_motion(offsets: list[float], earliest: list[int]) -> None:
    assert earliest_same(motions(offsets), everyone()).tolist() == [earliest]


@given(st.lists(st.sampled_from([*(0.6 * step for step in range(12)), math.nan]), min_size=1, max_size=9))
def test_modes_of_a_chain_are_one_outcome_in_any_order(offsets: list[float]) -> None:
    """A slow version joins the sets of two equal modes until none is left."""
    outcomes = [{mode} for mode in range(len(offsets))]
    for one, first in enumerate(offsets):
        for other, second in enumerate(offsets):
            if abs(first - second) < 1.0:
                joined = outcomes[one] | outcomes[other]
                for mode in joined:
                    outcomes[mode] = joined
    assert earliest_same(motions(offsets), everyone()).tolist() == [[min(outcome) for outcome in outcomes]]


def test_headings_and_speeds_do_not_make_motions_different() -> None:
    states = motions([0.0, 0.0])
    states[0, 1, ..., 2:] = 7.0
    assert same_motion(states).all()


def test_agents_that_do_not_exist_do_not_make_motions_different() -> None:
    states, mask = motions([0.0, 5.0]), everyone()
    assert earliest_same(states, mask).tolist() == [[0, 1]]
    mask[0, 1] = False
    assert earliest_same(states, mask).tolist() == [[0, 0]]
    states[0, 1, 1] = math.nan
    assert earliest_same(states, mask).tolist() == [[0, 0]]


@st.composite
def repeated(draw: st.DrawFn) -> tuple[list[float], list[int]]:
    """Logits of modes, and for every mode the earliest one that it repeats."""
    count = draw(st.integers(1, 5))
    earliest: list[int] = []
    for mode in range(count):
        earliest.append(draw(st.sampled_from([*sorted({*earliest}), mode])))
    return draw(st.lists(st.floats(-30, 30), min_size=count, max_size=count)), earliest


@given(repeated())
def test_probabilities_of_repetitions_are_summed(case: tuple[list[float], list[int]]) -> None:
    logits, earliest = case
    decoded = torch.tensor([logits], dtype=torch.double, requires_grad=True)
    found = with_repeats_added(decoded, torch.tensor([earliest])).softmax(1)
    before = torch.tensor(logits, dtype=torch.double).softmax(0).tolist()
    expected = [
        sum(p for p, first in zip(before, earliest, strict=True) if first == mode) for mode in range(len(logits))
    ]
    assert found[0].tolist() == pytest.approx(expected, abs=1e-12)
    for mode in {*earliest}:
        (gradient,) = torch.autograd.grad(found[0, mode], decoded, retain_graph=True)
        inside = torch.tensor([first == mode for first in earliest])
        # The derivative of a sum of softmax values p by logit l_k is p_k ([k in the sum] - sum).
        softmax = torch.tensor(before, dtype=torch.double)
        torch.testing.assert_close(gradient[0], softmax * (inside.double() - expected[mode]), atol=1e-12, rtol=1e-9)


@pytest.mark.filterwarnings("ignore:Anomaly Detection")
def test_derivatives_of_repetitions_are_no_nan_on_the_way_either() -> None:
    """With ``debug=nan``, PyTorch raises an error at the first one, also at those that are left out later."""
    decoded = torch.randn(1, 3, requires_grad=True)
    with torch.autograd.detect_anomaly():
        with_repeats_added(decoded, torch.tensor([[0, 0, 2]])).softmax(1)[0, 0].backward()
    assert decoded.grad is not None


def test_logits_without_repetitions_are_unchanged() -> None:
    logits = torch.randn(4, 3)
    assert torch.equal(with_repeats_added(logits, torch.arange(3).expand(4, 3)), logits)


def test_a_game_with_one_equilibrium_has_one_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two agents far from each other: both initial strategies lead to the same equilibrium, which gets all probability."""
    scene = scenes()
    history, goals = scene.history.clone(), scene.goal_candidates.clone()
    history[:, 1, :, 1] += 1000.0
    goals[:, 1, :, 1] += 1000.0
    scene = dataclasses.replace(scene, history=history, goal_candidates=goals)
    forecaster = built(calibration=None, solver={**SOLVER, "steps": 40, "newton_steps": 5})
    forecast = forecaster.predict(scene)
    assert forecast.solution is not None
    assert forecast.probabilities.tolist() == [[1.0, 0.0]] * 3
    assert torch.equal(forecast.states[:, 0], forecast.states[:, 1])
    assert forecast.controls is not None
    assert torch.equal(forecast.controls[:, 0], forecast.controls[:, 1])
    assert torch.equal(forecast.controls, forecast.solution.controls[..., : forecast.controls.shape[3], :])
    # The solver itself ends at two slightly different strategies; the forecast has those with the smallest gradient.
    with monkeypatch.context() as patch:
        patch.setattr(epo, "repeats_joined", lambda solution, logits, horizon, mask: (solution, logits))
        apart = forecaster.predict(scene).solution
    assert apart is not None
    assert not torch.equal(apart.states[:, 0], apart.states[:, 1])
    norm = apart.gradient_norm
    assert torch.equal(forecast.solution.gradient_norm, norm.amin(1, keepdim=True).expand_as(norm))
    # The repetition is as close to any future as the mode that it repeats, so scores take the probability of the first.
    future = forecast.states[:, 1]
    score = brier_min_sade(
        forecast.states, forecast.probabilities, future, torch.ones(future.shape[:3], dtype=torch.bool)
    )
    assert score.tolist() == [0.0] * 3


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.0, 0.6, 1.2, 5.0, 5.5]), st.sampled_from([0.0, 1e-9, 2.5, 1e30, math.inf, math.nan])
        ),
        min_size=1,
        max_size=6,
    )
)
def test_the_strategies_of_an_outcome_are_those_with_the_smallest_gradient(modes: list[tuple[float, float]]) -> None:
    offsets, norms = zip(*modes, strict=True)
    earliest = earliest_same(motions([*offsets]), everyone())
    found = smallest_of_same(torch.tensor([norms]), earliest)[0].tolist()
    for mode, chosen in enumerate(found):
        same = [other for other in range(len(modes)) if earliest[0, other] == earliest[0, mode]]
        assert chosen in same
        finite = [norms[other] for other in same if math.isfinite(norms[other])]
        if finite:
            assert torch.tensor(norms[chosen]) == torch.tensor(min(finite))
        else:
            assert chosen == same[0]


def test_a_program_takes_any_number_of_scenes() -> None:
    class Joined(nn.Module):
        def forward(
            self, states: Tensor, controls: Tensor, norm: Tensor, logits: Tensor, mask: Tensor
        ) -> tuple[Tensor, ...]:
            unknown, status = torch.zeros_like(norm), torch.zeros_like(norm, dtype=torch.long)
            solution = Solution(controls, states, unknown, unknown, norm, status)
            found, joined = repeats_joined(solution, logits, 3, mask)
            return found.states, found.controls, found.gradient_norm, joined

    def given(scenes: int) -> tuple[Tensor, ...]:
        states = torch.randn(scenes, 3, 2, 4, 4)
        states[:, 2, :, :3] = states[:, 0, :, :3]  # the same in the three steps of the forecast
        controls, mask = torch.randn(scenes, 3, 2, 4, 2), torch.ones(scenes, 2, dtype=torch.bool)
        return states, controls, torch.rand(scenes, 3), torch.randn(scenes, 3), mask

    scenes = torch.export.Dim("scenes", min=1)
    program = torch.export.export(Joined(), given(3), dynamic_shapes=tuple({0: scenes} for _ in range(5))).module()
    for count in (1, 7):
        arguments = given(count)
        found = program(*arguments)
        for one, wanted in zip(found, Joined()(*arguments), strict=True):
            assert torch.equal(one, wanted)
        states, controls, norm, _ = found
        assert torch.equal(states[:, 0], states[:, 2])
        assert torch.equal(norm[:, 0], torch.minimum(arguments[2][:, 0], arguments[2][:, 2]))
        first = arguments[2][:, 0] <= arguments[2][:, 2]
        assert torch.equal(controls[first, 2], arguments[1][first, 0])
        assert torch.equal(controls[~first, 0], arguments[1][~first, 2])
