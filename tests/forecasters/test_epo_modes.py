"""Modes of EPO and their probabilities, and combinations that its constructor refuses."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from games import highway_scene, random_scene
from suites import highway_model, model

from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters import build_forecaster
from epo_lightning.forecasters.epo import EPO
from epo_lightning.game.convex_energy import ConvexEnergy
from epo_lightning.metrics.functional.displacement import min_sade_of_likely
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

SECTIONS = ("forecaster", "dynamics", "energy", "solver", "backward", "objective")


def row(name: str, modes: int, **changes: Any) -> dict[str, Any]:
    composed = compose("train", [f"experiment=table1/{name}"])
    found = {kind: {**composed[kind], **changes.get(kind, {})} for kind in SECTIONS}
    found["forecaster"]["modes"] = modes
    return found


def tgl(modes: int, within: float = 20.0) -> EPO:
    torch.manual_seed(1)
    made = build_forecaster(highway_model(**row("highway_tgl", modes, energy={"within": within})))
    assert isinstance(made, EPO)
    return made


def earlier(rows: list[Any]) -> list[bool]:
    return [one in rows[:number] for number, one in enumerate(rows)]


@pytest.mark.parametrize("agents", [1, 2, 4])
def test_probabilities_of_modes_are_products_of_orders_and_goals(agents):
    scene = highway_scene(6, agents)
    scene.agent_mask[0, 0] = agents == 1  # one agent is absent, another one has no candidate
    scene.goal_mask[1, 0] = False
    forecaster = tgl(5).eval()  # while training, orders are the observed ones
    forecast = forecaster(scene)
    assert isinstance(forecaster.energy, ConvexEnergy)
    matter = forecaster.energy.pair_order.matters(scene, 8)
    order, goals = forecast.parameters.order, forecast.parameters.goals
    assert (forecast.order_logits[~matter] == 0).all()
    assert (order.mT[~matter] == 1).all()
    repeats = 0
    for number in range(6):
        likely, seen = [], []
        for mode in range(5):
            chance = 1.0
            for pair in matter[number].nonzero()[:, 0]:
                chance *= (order[number, mode, pair] * forecast.order_logits[number, pair]).sigmoid().item()
            for agent in range(agents):
                candidates = scene.goal_mask[number, agent].nonzero()[:, 0]
                if scene.agent_mask[number, agent] and len(candidates):
                    way = scene.goal_candidates[number, agent] - goals[number, mode, agent]
                    chosen = candidates[way[candidates].square().sum(-1).argmin()]
                    chance *= forecast.goal_probabilities[number, agent, chosen].item()
            likely.append(chance)
            seen.append((order[number, mode].tolist(), goals[number, mode].tolist()))
        expected = torch.tensor(likely).masked_fill(torch.tensor(earlier(seen)), 0.0)
        torch.testing.assert_close(forecast.probabilities[number], expected / expected.sum(), rtol=1e-4, atol=1e-6)
        repeats += sum(earlier(seen))
    assert repeats or agents > 1


def test_probabilities_of_modes_have_no_gradient_to_goals():
    forecaster = tgl(3)
    forecaster(highway_scene(4)).probabilities.square().sum().backward()
    assert any(p.grad is not None and (p.grad != 0).any() for p in forecaster.orders.parameters())
    assert all(p.grad is None for p in forecaster.goals.parameters())


def test_no_mode_is_spent_on_the_order_of_agents_that_are_never_near():
    near, far = tgl(4), tgl(4, within=1e-3)
    scene = highway_scene(4)
    assert (near(scene).parameters.order < 0).any()
    assert (far(scene).parameters.order == 1).all()
    terms = far.losses(scene, far(scene))
    assert terms["probability"][1] == 0


def candidates(count: int, modes: int, objective: str = "conditional") -> EPO:
    torch.manual_seed(1)
    parts = row("rpi_jfp", modes, solver={"candidates": count})
    parts["objective"] = compose("train", ["experiment=table1/rpi_jfp", f"objective={objective}"])["objective"]
    made = build_forecaster(model(**parts, horizon=8))
    assert isinstance(made, EPO)
    return made


def scored(scene: Scene, forecast: JointForecast) -> torch.Tensor:
    return min_sade_of_likely(forecast.states, forecast.probabilities, scene.future, scene.future_mask)


@pytest.mark.parametrize("objective", ["conditional", "imitation"])
def test_repeated_joint_choices_have_zero_probability(objective):
    scene = random_scene(4, 2, history=5, horizon=8)
    scene.agent_mask[0, 1] = False
    forecaster = candidates(2, 7, objective).train()
    forecast = forecaster(scene)
    for number, count in enumerate((2, 4, 4, 4)):
        rows = forecast.solution.assignment[number].tolist()
        assert earlier(rows) == [False] * count + [True] * (7 - count)
        assert (forecast.probabilities[number, count:] == 0).all()
        energy = forecast.solution.energy[number, :count]
        torch.testing.assert_close(forecast.probabilities[number, :count], (-energy).softmax(0))
    likely = scored(scene, forecast)
    assert (likely[:, 4:] == likely[:, 3:4]).all()
    loss = sum(weight * value for weight, value in forecaster.losses(scene, forecast).values())
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad.isfinite().all() for p in forecaster.parameters() if p.grad is not None)


def test_goals_are_learned_with_candidates():
    torch.manual_seed(1)
    parts = row("highway_jfp", 2, solver={"candidates": 3})
    parts["energy"] = compose("train", ["experiment=table1/highway_epo"])["energy"]  # one with goals
    forecaster = build_forecaster(highway_model(**parts)).train()
    scene = highway_scene(4)
    weight, value = forecaster.losses(scene, forecaster(scene))["goal"]
    assert weight > 0
    value.backward()
    assert any(p.grad is not None and (p.grad != 0).any() for p in forecaster.goals.parameters())


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("rpi_jfp", {"modes": 0}, r"forecaster\.modes must be 1 or more"),
    ("rpi_tgl", {"modes": -1}, r"forecaster\.modes must be 1 or more"),
    ("rpi_tgl", {"initial": "motions"}, "motions are those of a unicycle"),
    ("rpi_tgl", {"own_start": {"acc": 0.2}}, r"own_start\.acc has no effect: this energy fixes the weight of acc"),
    (
        "rpi_dsdnet",
        {"motions": {"acceleration": 1.0}},
        r"forecaster\.motions must name acceleration .* not acceleration$",
    ),
    ("rpi_dsdnet", {"motions": None}, r"forecaster\.motions must name acceleration .* not nothing$"),
    (
        "rpi_dsdnet",
        {"motions": {"acceleration": 1.0, "curvature": 1.0, "jerk": 1.0}},
        r"forecaster\.motions must name acceleration .* and curvature .* not acceleration, curvature, jerk$",
    ),
    *(
        (name, {"pair_start": wrong, **changes}, r"forecaster\.pair_start must be a number, positive, and finite, not")
        for name, changes in (("rpi_epo", {"one_game": True}), ("rpi_epo", {"pair_weights": "shared"}))
        for wrong in (0.0, -3.0, float("nan"))
    ),
    *(
        ("rpi_epo", {"control_scale": wrong}, "control_scale must be a number, positive")
        for wrong in (0.0, -1.0, float("inf"))
    ),
]


@pytest.mark.parametrize(("name", "wrong", "message"), REFUSED)
def test_invalid_combinations_are_refused(name, wrong, message):
    parts = row(name, 2)
    parts["forecaster"] |= wrong
    with pytest.raises(ConfigError, match=message):
        build_forecaster(model(**parts))


@pytest.mark.parametrize("start", [0.0, -3.0])
def test_pair_weights_to_which_the_output_is_added_may_start_anywhere(start):
    parts = row("rpi_epo", 2)
    parts["forecaster"] |= {"pair_start": start}
    assert build_forecaster(model(**parts)).pair_weights.start == start
