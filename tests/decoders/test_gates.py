"""Gates in front of the game of an EPO forecaster."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import highway_scene, random_scene
from suites import HighwaySuite, highway_model, model

from epo_lightning.decoders.gates import AttentionGate, NearestGate, RadiusGate
from epo_lightning.decoders.weights import Margins, PairWeights, SharedPairWeights
from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecasters import build_forecaster
from epo_lightning.forecasters.epo_settings import check_gate
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.neighbours import closest_approach, group_sizes
from epo_lightning.registry import ConfigError, build

EPO = {"name": "epo", "modes": 3, "own_start": {"vel": 0.05}, "symmetric_pairs": True}
GATES = (
    {"name": "radius", "radius": 5.0, "group": 3},
    {"name": "nearest", "neighbours": 1},
    {"name": "attention", "neighbours": 2, "size": 8},
)


class TestAttention(HighwaySuite):
    """Independence of batch, padding and poisoned scenes, with the most learned gate and limited groups."""

    config = {**EPO, "gate": {**GATES[2], "group": 3}}


def forecaster(config, **changes):
    torch.manual_seed(1)
    return build_forecaster(highway_model(config, **changes)).eval()


@pytest.mark.parametrize("gate", GATES, ids=lambda gate: gate["name"])
def test_pairs_that_are_left_out_have_no_weight_and_others_keep_theirs(gate):
    scene = highway_scene(6, 5)
    plain, gated = forecaster(EPO), forecaster({**EPO, "gate": gate})
    gated.load_state_dict(plain.state_dict(), strict=False)
    every, chosen = plain.predict(scene).parameters.pair_weights, gated.predict(scene).parameters.pair_weights
    mask, factor = gated.gate(gated.backbone(scene), scene)
    assert 0 < mask.sum() < mask.numel()
    for name, weight in chosen.items():
        expected = every[name] * mask[:, None] * (1.0 if factor is None else factor[:, None])
        torch.testing.assert_close(weight, expected)


def test_a_gate_that_leaves_out_no_pair_changes_nothing():
    scene = highway_scene(4, 5)
    plain = forecaster(EPO)
    for gate in ({"name": "radius", "radius": 1e6}, {"name": "nearest", "neighbours": 4}):
        gated = forecaster({**EPO, "gate": gate})
        torch.testing.assert_close(gated.predict(scene).states, plain.predict(scene).states)


def test_forecasts_without_a_gate_have_the_weights_of_earlier_versions():
    """A gate is built after all other networks, so their initial weights do not depend on it."""
    plain, gated = forecaster(EPO), forecaster({**EPO, "gate": GATES[2]})
    known = gated.state_dict()
    assert all(torch.equal(value, known[name]) for name, value in plain.state_dict().items())
    assert plain.gate is None


def test_nothing_is_computed_for_pairs_that_are_left_out():
    rows = []
    decoder = PairWeights(8, 2, ("proximity",), symmetric=True)
    decoder.mlp.register_forward_hook(lambda _, given, __: rows.append(given[0].shape[:-1].numel()))
    chosen = torch.rand(3, 15) < 0.3
    z = torch.randn(3, 6, 8)
    gated, every = decoder(z, chosen)["proximity"], decoder(z)["proximity"]
    assert rows == [int(chosen.sum())] * 2 + [45] * 2
    torch.testing.assert_close(gated, torch.where(chosen[:, None], every, 0.0))
    assert decoder(z, torch.zeros_like(chosen))["proximity"].shape == every.shape


def test_shared_weights_and_margins_follow_the_choice():
    chosen, z = torch.tensor([[True, False, True]]), torch.randn(1, 3, 8)
    shared = SharedPairWeights(2, ("proximity",), 3.0)
    assert shared(z, chosen)["proximity"].tolist() == [[[3.0, 0.0, 3.0]] * 2]
    margins = Margins(8, 2, ("clearance",), 2.0, 0.5)
    torch.testing.assert_close(margins(z, chosen)["clearance"][..., chosen[0]], margins(z)["clearance"][..., chosen[0]])
    assert ((margins(z, chosen)["clearance"] >= 0) & (margins(z, chosen)["clearance"] <= 2.0)).all()


def test_an_untrained_attention_gate_is_nearly_that_of_the_nearest_and_learns():
    scene, z = highway_scene(5, 6), torch.randn(5, 6, 16)
    torch.manual_seed(0)
    attention = AttentionGate(2, 4, ahead=1.6, width=16, scale=20.0)
    chosen, factor = attention(z, scene)
    assert (chosen == NearestGate(2, ahead=1.6)(z, scene).chosen).float().mean() > 0.95
    torch.testing.assert_close(factor, torch.ones_like(factor), rtol=0, atol=0.05)
    (factor * chosen * torch.randn_like(factor)).sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in attention.parameters())


def test_features_of_absent_agents_have_no_meaning():
    """Whatever they are: choice and factors are the same, and pairs of absent agents keep the factor of one."""
    scene, z = highway_scene(4, 5), torch.randn(4, 5, 16)
    scene = dataclasses.replace(scene, agent_mask=scene.agent_mask & (torch.arange(5) != 2))
    attention = AttentionGate(2, 4, ahead=1.6, width=16, scale=20.0)
    with torch.no_grad():
        attention.key.weight.mul_(100.0)
    found = [attention(z.masked_fill(~scene.agent_mask[..., None], value), scene) for value in (0.0, 1e3, math.nan)]
    for chosen, factor in found:
        assert torch.equal(chosen, found[0].chosen)
        assert torch.equal(factor, found[0].factor)
    absent = ~(scene.agent_mask[:, :, None] & scene.agent_mask[:, None])[:, *torch.triu_indices(5, 5, 1)]
    assert absent.any()
    assert not found[0].chosen[absent].any()
    assert (found[0].factor[absent] == 1.0).all()
    assert (found[0].factor[~absent] != 1.0).all()


def test_the_score_decides_the_choice():
    """Agent 0 pays attention to agent 3 alone, however far it is."""
    scene, z = highway_scene(1, 4), torch.eye(4)[None]
    attention = AttentionGate(1, 4, width=4, scale=1.0)
    with torch.no_grad():
        attention.query.weight.copy_(1e3 * torch.eye(4))
        attention.key.weight.zero_()
        attention.key.weight[0, 3] = attention.key.weight[3, 0] = 1e3
    chosen, factor = attention(z, scene)
    assert chosen[0, 2]  # pair 0-3
    assert factor[0, 2].item() == pytest.approx(2.0)


def test_groups_of_a_gate_are_limited():
    scene, z = highway_scene(8, 7), torch.randn(8, 7, 16)
    for gate in (RadiusGate(50.0, 3, 1.6), NearestGate(4, 3, 1.6), AttentionGate(4, 8, 3, 1.6, 16)):
        assert max(max(row) for row in group_sizes(gate(z, scene).chosen, 7)) == 3
    limited = RadiusGate(50.0, 3, 1.6)(z, scene).chosen
    assert limited.sum() < (closest_approach(scene, 1.6) <= 50.0).sum()


@pytest.mark.parametrize(
    ("gate", "message"),
    [
        ({"name": "radios"}, "did you mean 'radius'"),
        ({"name": "radius", "radius": -1.0}, "gate.radius"),
        ({"name": "nearest", "neighbours": 0}, "gate.neighbours"),
        ({"name": "nearest", "count": 2}, "unknown key gate.count"),
        ({"name": "nearest", "group": 1}, "gate.group"),
        ({"name": "attention", "size": 0}, "gate.size"),
        ({"name": "nearest", "ahead": 1.0}, "unknown key gate.ahead"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(gate, message):
    with pytest.raises(ConfigError, match=message):
        forecaster({**EPO, "gate": gate})


@pytest.mark.parametrize("name", ["radius", "nearest", "attention"])
def test_the_configuration_chooses_a_gate_which_is_part_of_the_forecaster(name):
    config = compose("train", ["experiment=ucy/v_lstm_epo", f"gate={name}", "forecaster.gate.group=8"])
    assert config["forecaster"]["gate"]["name"] == name
    assert config["forecaster"]["gate"]["group"] == 8
    assert "gate" not in compose("train", ["experiment=ucy/v_lstm_epo"])["forecaster"]


def test_settings_of_a_gate_are_those_of_the_forecaster():
    with pytest.raises(
        ConfigError, match=r"with gate=<one of attention, nearest, radius> it is forecaster\.gate\.group"
    ):
        compose("train", ["experiment=ucy/v_lstm_epo", "gate=nearest", "gate.group=8"])


def test_settings_of_a_gate_without_a_gate_are_refused():
    with pytest.raises(
        ConfigError,
        match=r"forecaster\.gate\.group is a setting of a gate.*add gate=<one of attention, nearest, radius>",
    ):
        compose("train", ["experiment=ucy/v_lstm_epo", "forecaster.gate.group=8"])
    config = compose("train", ["experiment=ucy/v_lstm_epo", "+forecaster.gate.group=8"])
    with pytest.raises(ConfigError, match=r"forecaster\.gate\.group has no effect without a gate: choose one"):
        forecaster({**EPO, "gate": config["forecaster"]["gate"]})


def test_energies_without_pairs_that_can_be_left_out_are_refused():
    with pytest.raises(ConfigError, match=r"energy\.pair is empty"):
        forecaster({**EPO, "gate": GATES[1]}, energy={"name": "features", "own": ["vel", "acc"], "pair": []})
    with pytest.raises(ConfigError, match="named features"):
        given = {"dynamics": Unicycle(), "width": 8, "horizon": 8, "scale": 1.0, "shape": "disc"}
        check_gate(GATES[1], build("energy", {"name": "collision"}, **given))


def test_the_solver_meets_the_same_game_with_either_backend():
    scene = random_scene(4, 5, size=2.0)
    epo = build_forecaster(model({"name": "epo", "modes": 2, "gate": {"name": "nearest", "neighbours": 1}})).eval()
    found = epo.predict(scene)
    epo.solver = dataclasses.replace(epo.solver, backend="pytorch")
    torch.testing.assert_close(epo.predict(scene).states, found.states, rtol=0, atol=1e-3)


@pytest.mark.parametrize("scale", [0, -1.0, math.nan, math.inf])
def test_the_scale_of_attention_must_be_a_positive_number(scale: float):
    with pytest.raises(ConfigError, match=r"gate\.scale must be a number, positive"):
        AttentionGate(scale=scale)
