"""Conditional density estimation over candidates, against likelihoods summed up by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import pytest
import torch
import yaml
from games import random_scene
from torch import Tensor

from epo_lightning import registry
from epo_lightning.forecast import JointForecast, Solution, Tables
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.objectives.conditional import Conditional
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.discrete import assignments

NAN, INF = float("nan"), float("inf")
WEIGHTS = {"density": 1.0, "marginal": 0.5, "regression": 0.25, "goal": 2.0}
ENERGY = FeatureEnergy(["acc"], [])
SCENES, AGENTS, COUNT, STEPS = 3, 3, 4, 5


def scene_of(agents: int = AGENTS) -> Scene:
    return random_scene(SCENES, agents, horizon=STEPS, dtype=torch.float64)


def tables_of(scene: Scene, unary: Tensor, pair: Tensor, states: Tensor) -> Tables:
    """Solution tables of a minimiser; scenes with nan have no density."""
    unary, pair = assignments.settle(unary, pair, scene.agent_mask)
    sound = ~unary.isnan().flatten(1).any(1)
    marginals, total = assignments.partition(torch.where(sound[:, None, None], unary, 0.0), pair, scene.agent_mask)
    marginals, total = torch.where(sound[:, None, None], marginals, NAN), torch.where(sound, total, NAN)
    return Tables(states, unary, pair, marginals, total)


def drawn(scene: Scene, count: int = COUNT) -> tuple[Tensor, Tensor, Tensor]:
    scenes, agents = scene.agent_mask.shape
    unary = torch.randn(scenes, agents, count, dtype=torch.float64)
    pair = 2.0 * torch.rand(scenes, agents * (agents - 1) // 2, count, count, dtype=torch.float64)
    return unary, pair, torch.randn(scenes, count, agents, STEPS, 4, dtype=torch.float64)


def forecast_of(tables: Tables | None) -> JointForecast:
    scenes = SCENES if tables is None else len(tables.unary)
    none, solution = torch.zeros(scenes, 1, dtype=torch.float64), None
    if tables is not None:
        controls = torch.zeros(*tables.states[:, :1].shape[:-1], 2, dtype=torch.float64)
        solution = Solution(controls, tables.states[:, :1], none, none, none, none.long(), tables=tables)
    return JointForecast(torch.zeros(scenes, 1, AGENTS, STEPS, 4), none, solution=solution)


def losses_of(scene: Scene, tables: Tables, density: str = "joint") -> dict[str, Tensor]:
    terms = Conditional(WEIGHTS, density)(scene, forecast_of(tables), ENERGY)
    assert {name: weight for name, (weight, _) in terms.items()} == {
        name: WEIGHTS[name] for name in WEIGHTS if name != "goal"
    }
    return {name: value for name, (_, value) in terms.items()}


def nearest(scene: Scene, states: Tensor, number: int, agent: int) -> tuple[int, float]:
    """The candidate whose mean distance to what was observed is smallest, and that distance."""
    assert scene.future is not None
    assert scene.future_mask is not None
    ways = []
    for candidate in range(states.shape[1]):
        steps = [k for k in range(STEPS) if scene.future_mask[number, agent, k]]
        way = [math.dist(states[number, candidate, agent, k, :2], scene.future[number, agent, k, :2]) for k in steps]
        ways.append(sum(way) / len(way))
    return min(range(len(ways)), key=ways.__getitem__), min(ways)


def partly_observed() -> Scene:
    """Scenes with an absent, an unobserved and a partly observed agent; in the last scene no agent is observed."""
    scene = scene_of()
    present, observed = scene.agent_mask.clone(), scene.future_mask.clone()
    present[0, 1] = observed[0, 1] = False
    observed[1, 0] = observed[1, 1, 3:] = observed[2] = False
    future = torch.where((observed & present[..., None])[..., None], scene.future, NAN)
    return dataclasses.replace(scene, agent_mask=present, future_mask=observed, future=future)


def test_losses_equal_hand_computed_values():
    scene = partly_observed()
    unary, pair, states = drawn(scene)
    unary[0, 1] = NAN
    pair[0, [0, 2]] = NAN
    tables = tables_of(scene, unary, pair, states)
    joint, marginal = losses_of(scene, tables), losses_of(scene, tables, "marginal")
    density = alone = each = regression = 0.0
    for number in range(2):
        seen = [i for i in range(AGENTS) if scene.future_mask[number, i].any() and scene.agent_mask[number, i]]
        closest = {agent: nearest(scene, states, number, agent) for agent in seen}
        weight: dict[tuple[int, ...], float] = {}
        for choice in itertools.product(range(COUNT), repeat=AGENTS):
            energy = sum(unary[number, i, choice[i]].item() for i in range(AGENTS) if scene.agent_mask[number, i])
            for p, (i, j) in enumerate(itertools.combinations(range(AGENTS), 2)):
                if scene.agent_mask[number, [i, j]].all():
                    energy += pair[number, p, choice[i], choice[j]].item()
            if scene.agent_mask[number, 1] or choice[1] == 0:
                weight[choice] = math.exp(-energy)
        total = sum(weight.values())
        agree = sum(value for choice, value in weight.items() if all(choice[i] == closest[i][0] for i in seen))
        density -= math.log(agree / total)
        for i in seen:
            chance = sum(value for choice, value in weight.items() if choice[i] == closest[i][0]) / total
            each -= math.log(chance) / len(seen)
            own = unary[number, i].neg().exp()
            alone -= math.log(own[closest[i][0]] / own.sum()) / len(seen)
            regression += closest[i][1] / len(seen)
    assert joint["density"].item() == pytest.approx(density / SCENES)
    assert marginal["density"].item() == pytest.approx(each / SCENES)
    assert joint["marginal"].item() == marginal["marginal"].item() == pytest.approx(alone / SCENES)
    assert joint["regression"].item() == pytest.approx(regression / SCENES)


@pytest.mark.parametrize("density", ["joint", "marginal"])
def test_derivatives_by_finite_differences(density):
    scene = partly_observed()
    given = [table.requires_grad_() for table in drawn(scene, 2)]

    def total(*tables: Tensor) -> Tensor:
        terms = losses_of(scene, tables_of(scene, *tables), density)
        return sum(WEIGHTS[name] * value for name, value in terms.items())

    assert torch.autograd.gradcheck(total, given, fast_mode=True)


def test_the_gradient_is_the_difference_from_the_expectation():
    """d(-log p(k*))/d unary = [k*_i = k] - p(k_i)."""
    scene = scene_of()
    unary, pair, states = drawn(scene)
    tables = tables_of(scene, unary.requires_grad_(), pair, states)
    losses_of(scene, tables)["density"].backward()
    for number, agent in itertools.product(range(SCENES), range(AGENTS)):
        expected = -tables.log_marginals[number, agent].detach().exp()
        expected[nearest(scene, states, number, agent)[0]] += 1.0
        torch.testing.assert_close(unary.grad[number, agent], expected / SCENES)


def test_the_closest_candidates_of_many_agents_are_taken_beyond_enumeration():
    scene = scene_of(8)
    unary, pair, states = drawn(scene)
    pair = 0.0 * pair  # independent: messages are exact
    value = losses_of(scene, tables_of(scene, unary, pair, states))["density"]
    expected = 0.0
    for number, agent in itertools.product(range(SCENES), range(8)):
        expected -= (-unary[number, agent]).log_softmax(0)[nearest(scene, states, number, agent)[0]].item()
    assert value.item() == pytest.approx(expected / SCENES)


@pytest.mark.parametrize("density", ["joint", "marginal"])
def test_candidates_that_the_energy_forbids_are_no_targets(density):
    scene = scene_of()
    unary, pair, states = drawn(scene)
    states[:, 2] = scene.future  # would be the closest of all
    unary[..., 2] = INF
    forbidden = losses_of(scene, tables_of(scene, unary, pair, states), density)
    left = [0, 1, 3]
    without = tables_of(scene, unary[..., left], pair[..., left, :][..., left], states[:, left])
    torch.testing.assert_close(forbidden, losses_of(scene, without, density))


@pytest.mark.parametrize("density", ["joint", "marginal"])
@pytest.mark.parametrize("broken", ["closest do not go together", "no number"])
def test_impossible_scenes_have_a_finite_loss_and_no_gradient(density, broken):
    scene = scene_of()
    unary, pair, states = drawn(scene)
    if broken == "no number":
        unary[0, 0, 0] = NAN
    else:
        first, second = (nearest(scene, states, 0, agent)[0] for agent in (0, 1))
        pair[0, 0, first, second] = INF
    unary, pair, states = unary.requires_grad_(), pair.requires_grad_(), states.requires_grad_()
    tables = tables_of(scene, unary, pair, states)
    terms = losses_of(scene, tables, density)
    others = losses_of(scene[1:], tables[1:], density)
    if broken == "no number" or density == "joint":
        worst = -math.log(torch.finfo(torch.float64).tiny)
        torch.testing.assert_close(terms["density"], (worst + 2 * others["density"]) / 3)
    assert all(value.isfinite() for value in terms.values())
    terms["density"].backward()
    assert all(table.grad is None or table.grad.isfinite().all() for table in (unary, pair, states))
    if broken == "no number" or density == "joint":
        assert (unary.grad[0] == 0).all()
    assert (unary.grad[1:] != 0).all()


def test_probabilities_are_at_most_one_for_every_solver():
    """Hard pair energies, for which Bethe's log Z is below the true one, and agents of whom nothing was observed."""
    scene = partly_observed()
    unary, pair, states = drawn(scene)
    below = 0
    for _ in range(20):
        unary, pair = torch.randn_like(unary), 30.0 * torch.rand_like(pair).round()
        unary, pair = assignments.settle(unary, pair, scene.agent_mask)
        exact = assignments.partition(unary, pair, scene.agent_mask)
        messages = assignments.sum_product(unary, pair, scene.agent_mask)
        loss, approximate = (
            losses_of(scene, Tables(states, unary, pair, *found))["density"].item() for found in (exact, messages)
        )
        assert loss >= -1e-12
        assert approximate == pytest.approx(loss, abs=1e-12)
        below += int((messages[1] < exact[1] - 0.1).any())
    assert below, "no table was hard enough"


def test_decoded_goals_are_trained():
    scene = scene_of()
    scene = dataclasses.replace(scene, goal_candidates=torch.randn(SCENES, AGENTS, 3, 2).double(), goal_mask=None)
    logits = torch.zeros(SCENES, AGENTS, 3, dtype=torch.float64, requires_grad=True)
    forecast = forecast_of(tables_of(scene, *drawn(scene)))
    terms = Conditional(WEIGHTS)(scene, dataclasses.replace(forecast, goal_probabilities=logits.softmax(-1)), ENERGY)
    weight, value = terms["goal"]
    assert weight == WEIGHTS["goal"]
    assert value.item() == pytest.approx(math.log(3))
    value.backward()
    assert (logits.grad != 0).all()


@pytest.mark.parametrize("wrong", ["much", None, True, -0.1, INF, NAN])
def test_unknown_weights_are_named(wrong):
    with pytest.raises(ConfigError, match=r"objective\.weights\.marginal must be a number, 0 or more, not"):
        Conditional({**WEIGHTS, "marginal": wrong})


def test_unlikely_closest_candidates_have_a_gradient():
    scene = scene_of()
    unary, pair, states = drawn(scene)
    for number, agent in itertools.product(range(SCENES), range(AGENTS)):
        unary[number, agent, nearest(scene, states, number, agent)[0]] = 2e3  # exp(-2000) is zero in any precision
    unary.requires_grad_()
    terms = losses_of(scene, tables_of(scene, unary, pair, states), "marginal")
    assert terms["density"] > 1e3
    terms["density"].backward()
    assert (unary.grad.amax(-1) > 0.1 / SCENES).all()


def test_learned_candidates_are_trained_towards_the_observation():
    scene = scene_of()
    unary, pair, states = drawn(scene)
    states.requires_grad_()
    losses_of(scene, tables_of(scene, unary, pair, states))["regression"].backward()
    moved = states.grad.abs().sum((-1, -2)) > 0
    for number, agent in itertools.product(range(SCENES), range(AGENTS)):
        hot = torch.arange(COUNT) == nearest(scene, states.detach(), number, agent)[0]
        assert torch.equal(moved[number, :, agent], hot)


def test_missing_inputs_are_named():
    scene = scene_of()
    objective = Conditional(WEIGHTS)
    with pytest.raises(ValueError, match="a density over candidates needs"):
        objective(scene, forecast_of(None), ENERGY)
    with pytest.raises(ValueError, match=r"scene\.future"):
        future_less = dataclasses.replace(scene, future=None, future_mask=None)
        objective(future_less, forecast_of(tables_of(scene, *drawn(scene))), ENERGY)
    with pytest.raises(ConfigError, match="did you mean 'marginal'"):
        Conditional(WEIGHTS, "marginals")
    with pytest.raises(ValueError, match="weights must name"):
        Conditional({"density": 1.0})


def test_the_configuration_file_states_the_defaults():
    page = yaml.safe_load((Path(__file__).parents[2] / "conf" / "objective" / "conditional.yaml").read_text())
    built, default = registry.build("objective", page), Conditional(page["weights"])
    assert isinstance(built, Conditional)
    assert set(page) == {"name", "weights", "density"}
    assert vars(built) == vars(default)
