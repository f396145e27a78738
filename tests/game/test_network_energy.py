"""The base of network energies: tables, absent agents, and named features as further terms."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from games import BOUNDS, pad, random_game, random_scene, reordered, widen

from epo_lightning.experiment.config.compose import compose
from epo_lightning.game.collision_energy import CollisionEnergy
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, own_feature, pair_feature
from epo_lightning.game.neural_energy import NeuralEnergy
from epo_lightning.registry import ConfigError, build

WIDTH, HORIZON = 6, 5
KINDS = {
    "neural": lambda **features: NeuralEnergy(Unicycle(), WIDTH, HORIZON, 2.0, hidden=8, **features),
    "disc": lambda **features: CollisionEnergy(Unicycle(), WIDTH, HORIZON, 2.0, "disc", hidden=8, **features),
    "box": lambda **features: CollisionEnergy(Unicycle(), WIDTH, HORIZON, 2.0, "box", hidden=8, **features),
}
FEATURES = {"own": ["goal", "lane", "acc", "velb"], "pair": ["proximity", "circles"], "bounds": BOUNDS}
each = pytest.mark.parametrize("kind", KINDS)


def crowd(scenes=2, agents=3, modes=2, own=()):
    """Agents as large as they are far apart, so that some collide and others do not, and a game for them."""
    scene = random_scene(scenes, agents, history=2, size=1.0, dtype=torch.float64)
    scene.size[..., 1] *= 0.5
    scene = dataclasses.replace(scene, dt=0.5)
    game = random_game(scene, modes, HORIZON, own=tuple(own), spread=2.0)
    pair_weights = {name: game.pair_weights["proximity"] * factor for factor, name in enumerate(PAIR_FEATURES, 1)}
    context = torch.randn(scenes, agents, WIDTH, dtype=torch.float64)
    return scene, dataclasses.replace(game, context=context, pair_weights=pair_weights)


def one_game(game, candidates):
    """The first mode's game, and controls for a number of candidates."""
    first = game.map(lambda tensor: tensor if tensor.dim() == 3 and tensor.shape[-1] == WIDTH else tensor[:, :1])
    scenes, _, agents = game.initial_controls.shape[:3]
    return first, 2.0 * torch.randn(scenes, candidates, agents, HORIZON, 2, dtype=torch.float64)


@each
@pytest.mark.parametrize("features", [{}, FEATURES], ids=["alone", "with features"])
@pytest.mark.parametrize("agents", [1, 3])
def test_tables_equal_those_of_the_default_implementation(kind, features, agents):
    energy = KINDS[kind](**features).double()
    scene, game = crowd(agents=agents, own=features.get("own", ()))
    first, candidates = one_game(game, 4)
    scene.agent_mask[0, -1] = False
    scene.history[0, -1] = candidates[0, :, -1] = first.context[0, -1] = torch.nan
    unary, pair = energy.tables(scene, first, candidates)
    expected, expected_pair = Energy.tables(energy, scene, first, candidates)
    torch.testing.assert_close(unary, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(pair, expected_pair, rtol=0, atol=1e-12)
    assert unary.isfinite().all()
    assert unary[1].std() > 0
    assert agents == 1 or pair.std() > 0


@each
def test_tables_hold_the_terms_of_every_joint_choice(kind):
    energy = KINDS[kind](**FEATURES).double()
    scene, game = crowd(own=FEATURES["own"])
    first, candidates = one_game(game, 3)
    unary, pair = energy.tables(scene, first, candidates)
    for choice in ((0, 1, 2), (2, 0, 0), (1, 1, 0)):
        joint = torch.stack([candidates[:, k, i] for i, k in enumerate(choice)], 1)[:, None]
        total = sum(unary[:, i, k] for i, k in enumerate(choice))
        members = ((0, 1), (0, 2), (1, 2))
        total = total + sum(pair[:, p, choice[i], choice[j]] for p, (i, j) in enumerate(members))
        torch.testing.assert_close(energy(scene, first, joint)[:, 0], total, rtol=0, atol=1e-12)


@each
def test_large_tables_are_made_in_parts(kind, monkeypatch):
    energy = KINDS[kind]().double()
    first, candidates = one_game((made := crowd())[1], 5)
    whole = energy.tables(made[0], first, candidates)
    monkeypatch.setattr("epo_lightning.game.neural_energy._TABLE_ENTRIES", 60)
    monkeypatch.setattr("epo_lightning.game.collision_energy._AT_ONCE", 7)
    for one, other in zip(whole, energy.tables(made[0], first, candidates), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-13)


@each
def test_absent_agents_do_not_change_the_energy(kind):
    energy = KINDS[kind](**FEATURES).double()
    scene, game = crowd(own=FEATURES["own"])
    nothing = torch.full((2, 2, WIDTH), torch.nan, dtype=torch.float64)
    padded, wide = pad(scene), dataclasses.replace(widen(game), context=torch.cat((game.context, nothing), 1))
    results = []
    for s, g in ((scene, game), (padded, wide)):
        controls, context = g.initial_controls.clone().requires_grad_(), g.context.clone().requires_grad_()
        value = energy(s, dataclasses.replace(g, context=context), controls)
        energy.zero_grad()
        value.sum().backward()
        learned = [parameter.grad for parameter in energy.parameters() if parameter.grad is not None]
        assert learned
        results.append([value, controls.grad[:, :, :3], context.grad[:, :3], *learned])
        assert all((tensor.grad[..., 3:, :] == 0).all() for tensor in (context,))
        assert (controls.grad[:, :, 3:] == 0).all()
    for alone, together in zip(*results, strict=True):
        torch.testing.assert_close(together, alone, rtol=0, atol=1e-12)


@each
def test_another_order_of_agents_reorders_the_terms(kind):
    energy = KINDS[kind]().double()
    scene, game = crowd()
    order, pairs = [2, 0, 1], [1, 2, 0]  # the pairs (2, 0), (2, 1), (0, 1) of the first numbering
    other = dataclasses.replace(game, context=game.context[:, order])
    terms = energy.terms(scene, game, game.initial_controls)
    moved = energy.terms(reordered(scene, order), other, game.initial_controls[:, :, order])
    torch.testing.assert_close(moved[energy.term], terms[energy.term][..., order], rtol=0, atol=1e-12)
    torch.testing.assert_close(moved[energy.pair_term], terms[energy.pair_term][..., pairs], rtol=0, atol=1e-12)
    assert terms[energy.pair_term].std() > 0


@each
def test_the_energy_is_invariant_to_the_frame(kind):
    energy = KINDS[kind]().double()
    scene, game = crowd()
    angle = torch.tensor(0.7, dtype=torch.float64)
    turn = torch.stack((angle.cos(), -angle.sin(), angle.sin(), angle.cos())).view(2, 2)
    history = scene.history.clone()
    history[..., :2] = history[..., :2] @ turn.T + torch.tensor([5.0, -3.0], dtype=torch.float64)
    history[..., 2] += angle
    elsewhere = dataclasses.replace(scene, history=history)
    here = energy(scene, game, game.initial_controls)
    torch.testing.assert_close(energy(elsewhere, game, game.initial_controls), here, rtol=0, atol=1e-12)


@each
def test_features_are_added_to_the_networks(kind):
    scene, game = crowd(own=FEATURES["own"])
    both, plain = KINDS[kind](**FEATURES, pair_stride=2).double(), KINDS[kind]().double()
    plain.load_state_dict(both.state_dict())
    features = FeatureEnergy(**FEATURES, pair_stride=2)
    terms = both.terms(scene, game, game.initial_controls)
    parts = {
        **features.terms(scene, game, game.initial_controls),
        **plain.terms(scene, game, game.initial_controls),
    }
    assert set(terms) == set(parts) == {*both.own, *both.pair}
    for name, part in parts.items():
        torch.testing.assert_close(terms[name], part, rtol=0, atol=0)
    for method in ("__call__", "objectives"):
        whole, one, other = (
            getattr(energy, method)(scene, game, game.initial_controls) for energy in (both, features, plain)
        )
        torch.testing.assert_close(whole, one + other, rtol=0, atol=1e-12)
    assert both.weighted == (("goal", "lane", "acc", "velb"), ("proximity", "circles"))
    assert plain.weighted == ((), ())
    assert both.needs == {"goals", "reference"} | plain.needs
    assert both.goal_terms == {"goal", "lane"}
    assert plain.goal_terms == set()


def test_the_energy_is_an_exact_potential_of_the_agents_costs():
    scene, game = crowd(own=FEATURES["own"])
    energy = KINDS["neural"](**FEATURES).double()
    controls = game.initial_controls.clone().requires_grad_()
    (of_potential,) = torch.autograd.grad(energy(scene, game, controls).sum(), controls)
    objectives = energy.objectives(scene, game, controls)
    for agent in range(3):
        (of_agent,) = torch.autograd.grad(objectives[..., agent].sum(), controls, retain_graph=True)
        torch.testing.assert_close(of_agent[:, :, agent], of_potential[:, :, agent], rtol=0, atol=1e-12)
    assert of_potential.abs().max() > 0


@each
def test_a_registered_feature_works_in_every_energy(kind):
    try:

        @own_feature("sideways")
        def sideways(states, controls):
            return states[..., 3] * controls[..., 1]

        @pair_feature("like_minded")
        def like_minded(first, second):
            return first[..., 3] - second[..., 3]

        energy = KINDS[kind](own=["sideways"], pair=["like_minded"]).double()
        scene, game = crowd(own=["sideways"])
        terms = energy.terms(scene, game, game.initial_controls)
    finally:
        OWN_FEATURES.pop("sideways", None)
        PAIR_FEATURES.pop("like_minded", None)
    states = energy.dynamics.rollout(scene.current[:, None], game.initial_controls, scene.dt)
    squared = (states[..., 3] * game.initial_controls[..., 1]).square().sum(-1)
    torch.testing.assert_close(terms["sideways"], 0.5 * game.own_weights["sideways"].square() * squared)
    speed = (states[:, :, 0, :, 3] - states[:, :, 1, :, 3]).square().sum(-1)
    torch.testing.assert_close(
        terms["like_minded"][..., 0], 0.5 * game.pair_weights["like_minded"][..., 0] ** 2 * speed
    )


def test_a_feature_must_not_be_called_like_a_term():
    try:
        own_feature("neural")(lambda states, controls: controls[..., 0])
        with pytest.raises(ConfigError, match="the feature 'neural' has the name of this energy's network term"):
            KINDS["neural"](own=["neural"])
    finally:
        OWN_FEATURES.pop("neural", None)


@each
def test_tensors_of_wrong_shape_are_named(kind):
    scene, game = crowd(own=["acc"])
    energy = KINDS[kind](own=["acc"]).double()
    controls = game.initial_controls
    with pytest.raises(ValueError, match=r"parameters\.context \[2, 3, 6\], which is None"):
        energy(scene, dataclasses.replace(game, context=None), controls)
    with pytest.raises(ValueError, match=r"parameters\.context has shape \[2, 3, 5\]"):
        energy(scene, dataclasses.replace(game, context=game.context[..., 1:]), controls)
    with pytest.raises(ValueError, match=r"span K = 4 steps; this energy's networks take 5"):
        energy(scene, game, controls[..., 1:, :])
    with pytest.raises(ValueError, match="own_weights lacks the feature 'acc'"):
        energy(scene, dataclasses.replace(game, own_weights={}), controls)
    with pytest.raises(ConfigError, match="unknown own feature 'cca'"):
        KINDS[kind](own=["cca"])


@pytest.mark.parametrize(
    ("experiment", "name"),
    [
        ("rpi/v_lstm_epo", "neural"),
        ("rpi/v_lstm_epo", "collision"),
        ("rpi/v_lstm_epo", "augmented_rpi"),
        ("exid/v_lstm_epo", "augmented_exid"),
    ],
)
def test_configured_energies_can_be_built(experiment, name):
    config = compose("train", [f"experiment={experiment}", f"energy={name}"])["energy"]
    supplied = {"dynamics": Unicycle(), "width": 128, "horizon": 20, "scale": 1.0}
    energy = build("energy", config, **supplied, **({"shape": "box"} if name == "collision" else {}))
    plain = compose("train", [f"experiment={experiment}", f"energy={name.removeprefix('augmented_')}"])["energy"]
    assert energy.weighted == (tuple(plain["own"]), tuple(plain["pair"]))
    assert sum(parameter.numel() for parameter in energy.parameters()) > 1000
