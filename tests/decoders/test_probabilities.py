"""Probabilities of modes: what the logits depend on, and whether the two sides of passing can be told apart."""

from __future__ import annotations

import math

import pytest
import torch
from games import highway_scene, reordered
from hypothesis import given, settings
from hypothesis import strategies as st
from suites import LOSS_WEIGHTS, highway_model, model
from torch import Tensor

from epo_lightning import losses
from epo_lightning.decoders.probabilities import PROBABILITIES, PairwiseProbabilities, SceneProbabilities
from epo_lightning.forecasters import build_forecaster
from epo_lightning.registry import ConfigError

WIDTH, STEPS = 6, 5


def decoder(kind: str = "pairwise", modes: int = 2, **options: float) -> SceneProbabilities | PairwiseProbabilities:
    torch.manual_seed(0)
    return PROBABILITIES[kind](WIDTH, modes, STEPS, **options).double().eval()


def drawn(seed: int, scenes: int = 3, modes: int = 2, agents: int = 4) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features, positions, current states and mask of random scenes; every scene has one agent at least."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    mask = normal(scenes, agents) < 0.5
    mask[:, 0] = True
    return normal(scenes, agents, WIDTH), normal(scenes, modes, agents, STEPS, 2), normal(scenes, agents, 4), mask


def passing(start: Tensor, side: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Positions [B, M, 2, K, 2] and current states [B, 2, 4] of two agents that meet head-on and both evade to one side.

    Args:
        start: distance [m] of each agent from the middle, [B].
        side: how far [m] both agents evade to their own left, [B, M].
        angle: direction [rad] of the first agent, [B].
    """
    start, side, angle = start.double(), side.double(), angle.double()
    forward = torch.linspace(0.4, 2.0, STEPS, dtype=torch.float64) * start[:, None]
    left = torch.sin(torch.linspace(0.0, math.pi, STEPS, dtype=torch.float64)) * side[..., None]
    first = torch.stack(((forward - start[:, None])[:, None].expand_as(left), left), -1)
    local = torch.stack((first, -first), 2)  # turned by half a turn
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack((torch.stack((cos, sin), -1), torch.stack((-sin, cos), -1)), -2)
    current = torch.zeros(len(start), 2, 4, dtype=torch.float64)
    current[:, 0, 0], current[:, 1, 0] = -start, start
    current[..., :2] = current[..., :2] @ turn
    current[:, 0, 2], current[:, 1, 2] = angle, angle + math.pi
    return torch.einsum("bmnkx,bxy->bmnky", local, turn), current


@pytest.mark.parametrize("kind", PROBABILITIES)
def test_only_pairwise_probabilities_tell_passing_left_from_passing_right(kind: str) -> None:
    positions, current = passing(torch.full((2,), 3.0), torch.tensor([[0.5, -0.5], [-0.5, 0.5]]), torch.zeros(2))
    z, everyone = torch.ones(2, 2, WIDTH).double(), torch.ones(2, 2, dtype=torch.bool)
    left_right, right_left = decoder(kind)(z, positions, current, everyone)
    if kind == "linear":
        torch.testing.assert_close(left_right, right_left)
    else:
        torch.testing.assert_close(left_right, right_left.flip(0))
        assert (left_right[0] - left_right[1]).abs() > 1e-3


@pytest.mark.parametrize("kind", PROBABILITIES)
def test_training_learns_the_side_on_which_agents_pass(kind: str) -> None:
    """One mode of every scene passes on the left and one on the right, in either order; the future is on the left."""
    torch.manual_seed(0)
    learner = decoder(kind).train()
    optimizer = torch.optim.Adam(learner.parameters(), 5e-3)

    def batch() -> tuple[Tensor, Tensor]:
        sign = torch.where(torch.rand(64) < 0.5, 1.0, -1.0)
        side = (0.2 + torch.rand(64, 1)) * torch.stack((sign, -sign), 1)
        positions, current = passing(2.0 + torch.rand(64), side, 2 * math.pi * torch.rand(64))
        z, everyone = torch.zeros(64, 2, WIDTH).double(), torch.ones(64, 2, dtype=torch.bool)
        return learner(z, positions, current, everyone), (sign < 0).long()

    for _ in range(60):
        logits, left = batch()
        loss = torch.nn.functional.cross_entropy(logits, left)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    learner.eval()
    logits, left = batch()
    correct = (logits.argmax(1) == left).double().mean().item()
    if kind == "linear":
        assert torch.nn.functional.cross_entropy(logits, left) > 0.6, "both orders of the modes look the same"
    else:
        assert correct > 0.95


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 3), st.integers(1, 4), st.permutations(range(4)))
def test_the_order_of_agents_and_padding_change_nothing(seed, modes, agents, order) -> None:
    order = [agent for agent in order if agent < agents]
    z, positions, current, mask = drawn(seed, modes=modes, agents=agents)
    for kind in PROBABILITIES:
        made = decoder(kind, modes)
        logits = made(z, positions, current, mask)
        assert logits.shape == (3, modes)
        other = made(z[:, order], positions[:, :, order], current[:, order], mask[:, order])
        torch.testing.assert_close(other, logits)
        for filling in (0.0, 1e6, math.nan):
            there = mask[..., None]
            padded = (
                torch.cat((z.where(there, filling), torch.full_like(z, filling)), 1),
                torch.cat(
                    (positions.where(there[:, None, ..., None], filling), torch.full_like(positions, filling)), 2
                ),
                torch.cat((current.where(there, filling), torch.full_like(current, filling)), 1),
                torch.cat((mask, torch.zeros_like(mask)), 1),
            )
            torch.testing.assert_close(made(*padded), logits)


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.floats(-4.0, 4.0), st.permutations(range(3)))
def test_pairwise_logits_follow_the_modes_and_ignore_the_frame(seed, angle, order) -> None:
    z, positions, current, mask = drawn(seed, modes=3)
    made = decoder(modes=3)
    logits = made(z, positions, current, mask)
    torch.testing.assert_close(made(z, positions[:, order], current, mask), logits[:, order])
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    there = torch.tensor([30.0, -7.0]).double()
    moved = torch.cat((current[..., :2] @ turn + there, current[..., 2:3] + angle, current[..., 3:]), -1)
    torch.testing.assert_close(made(z, positions @ turn + there, moved, mask), logits)


def test_pairwise_probabilities_know_which_agent_does_what() -> None:
    """Exchanging the futures of two agents with different features is another mode; so is another agent's future alone."""
    z, positions, current, mask = drawn(1, agents=2)
    mask[:], current[:] = True, current[:, :1]
    logits = decoder()(z, positions, current, mask)
    assert ((decoder()(z, positions.flip(2), current, mask) - logits).abs() > 1e-4).all()
    other = positions.clone()
    other[:, 0, 1] += 0.5
    assert ((decoder()(z, other, current, mask) - logits)[:, 0].abs() > 1e-4).all()


def test_pairwise_probabilities_see_where_the_others_are() -> None:
    """Moving an agent and all of its futures leaves its displacements as they are, but not its place among the others."""
    z, positions, current, mask = drawn(1, agents=3)
    mask[:] = True
    logits = {kind: decoder(kind)(z, positions, current, mask) for kind in PROBABILITIES}
    step = torch.tensor([1.0, 0.0]).double()
    positions[:, :, 2] += step
    current[:, 2, :2] += step
    torch.testing.assert_close(decoder("linear")(z, positions, current, mask), logits["linear"])
    assert ((decoder()(z, positions, current, mask) - logits["pairwise"]).abs() > 1e-5).all()


@pytest.mark.parametrize("name", ["scene_consistent", "epo"])
def test_highway_forecasts_with_pairwise_probabilities_are_equivariant_to_the_order_of_agents(name: str) -> None:
    torch.manual_seed(1)
    config = {"name": name, "modes": 3, "probabilities": "pairwise"}
    config |= {"symmetric_pairs": True} if name == "epo" else {"loss_weights": LOSS_WEIGHTS}
    forecaster = build_forecaster(highway_model(config))
    scene, order = highway_scene(3), [2, 0, 3, 1]
    scene.agent_mask[0, 3] = False
    assert isinstance(forecaster.probabilities, PairwiseProbabilities)
    forecast, other = (forecaster.predict(each) for each in (scene, reordered(scene, order)))
    torch.testing.assert_close(other.probabilities, forecast.probabilities, rtol=0, atol=1e-5)
    assert (forecast.probabilities - 1 / 3).abs().max() > 1e-4


def test_pairwise_logits_scale_with_the_unit_of_positions() -> None:
    z, positions, current, mask = drawn(2)
    far = torch.cat((50.0 * current[..., :2], current[..., 2:]), -1)
    torch.testing.assert_close(
        decoder(scale=50.0)(z, 50.0 * positions, far, mask), decoder()(z, positions, current, mask)
    )


@pytest.mark.parametrize("kind", PROBABILITIES)
def test_no_gradient_flows_to_the_futures_and_all_parameters_have_one(kind: str) -> None:
    z, positions, current, mask = drawn(3)
    positions.requires_grad_()
    made = decoder(kind).train()
    losses.scene_probability(
        made(z, positions, current, mask).log_softmax(1), torch.tensor([0, 1, 0]), mask[..., None]
    ).backward()
    assert positions.grad is None
    for name, parameter in made.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.abs().sum() > 0, name


def test_unknown_and_useless_choices_are_refused() -> None:
    baseline = {"name": "scene_consistent", "modes": 2, "loss_weights": LOSS_WEIGHTS}
    for forecaster in (baseline, {"name": "epo", "modes": 2}):
        with pytest.raises(ConfigError, match="did you mean 'pairwise'"):
            build_forecaster(model({**forecaster, "probabilities": "pairwse"}))
    chosen = {"solver": {"name": "enumeration", "candidates": 4}, "backward": {"name": "unrolled"}}
    objective = {"name": "conditional", "weights": {"density": 1.0, "marginal": 0.1, "regression": 0.1}}
    with pytest.raises(ConfigError, match=r"probabilities=pairwise has no effect .* energies of choices"):
        build_forecaster(model({"name": "epo", "modes": 2, "probabilities": "pairwise"}, **chosen, objective=objective))
    for made in (model(baseline), highway_model({"name": "epo", "modes": 3})):
        assert isinstance(build_forecaster(made).probabilities, SceneProbabilities), "the paper's is the default"
