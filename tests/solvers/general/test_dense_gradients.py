"""Implicit derivatives by dense Hessians, against differences, and warnings of solutions that are no minima."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch
from convex_games import convex_energy, convex_game, widen_convex
from dense_games import FEATURES, Learned, feature_game, learned_game
from games import leaves_of, pad

from epo_lightning.forecast import Status
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.gauss_newton import implicit
from epo_lightning.solvers.general import descent
from epo_lightning.solvers.general.dense import attach, with_zeros
from epo_lightning.solvers.general.newton import Newton

NEWTON = Newton(100, 1e-13)


def solved(energy, scene, game, exact=True):
    """Controls at the minimum, with the gradient of ``dense.attach``."""
    with torch.no_grad():
        solution = NEWTON(energy, scene, game)
    assert solution.gradient_norm.max() < 1e-9
    controls, status = attach(energy, scene, game, solution.controls, exact)
    assert torch.equal(controls.detach(), solution.controls)
    assert (status == Status.COMPLETED).all()
    return controls


def differences(energy, scene, game, replace, tensor, cotangent, step=1e-5):
    """d <cotangent, argmin> / d tensor by central differences along random directions, and these directions."""
    shifts = torch.randn(3, *tensor.shape, dtype=tensor.dtype)
    found = []
    for shift in shifts:
        ends = [NEWTON(energy, scene, replace(tensor + sign * step * shift)).controls for sign in (1, -1)]
        found.append(((ends[0] - ends[1]) * cotangent).sum() / (2 * step))
    return torch.stack(found), shifts


CASES = {"convex": (convex_energy, convex_game), "features": (lambda: FEATURES, feature_game)}


BY = ("own_weights", "pair_weights", "goals")


def relative(analytic, numeric):
    return ((analytic - numeric).norm() / numeric.norm()).item()


@pytest.mark.parametrize("by", BY)
@pytest.mark.parametrize("case", CASES)
def test_implicit_gradients_equal_central_differences_of_the_argmin(case, by):
    make, play = CASES[case]
    energy, (scene, game) = make(), play()
    game = dataclasses.replace(game, initial_controls=NEWTON(energy, scene, game).controls)
    name = {"own_weights": "goal", "pair_weights": energy.pair[0], "goals": None}[by]
    tensor = getattr(game, by) if name is None else getattr(game, by)[name]

    def replace(values):
        return dataclasses.replace(game, **{by: values if name is None else {**getattr(game, by), name: values}})

    cotangent = torch.randn_like(game.initial_controls)
    leaf = tensor.clone().requires_grad_()
    (slope,) = torch.autograd.grad((solved(energy, scene, replace(leaf)) * cotangent).sum(), leaf)
    numeric, shifts = differences(energy, scene, game, replace, tensor, cotangent)
    assert relative((slope * shifts).flatten(1).sum(1), numeric) < 1e-6
    approximate = solved(energy, scene, replace(leaf), exact=False)
    (slope,) = torch.autograd.grad((approximate * cotangent).sum(), leaf)
    error = relative((slope * shifts).flatten(1).sum(1), numeric)
    assert (error < 1e-6) == (case == "convex")


def test_implicit_gradients_reach_networks():
    scene, game = learned_game()
    energy = Learned()
    cotangent = torch.randn_like(game.initial_controls)
    context = game.context.clone().requires_grad_()
    controls = solved(energy, scene, dataclasses.replace(game, context=context))
    leaves = [context, energy.net.weight, energy.touch.weight]
    slopes = torch.autograd.grad((controls * cotangent).sum(), leaves)
    numeric, shifts = differences(
        energy, scene, game, lambda z: dataclasses.replace(game, context=z), game.context, cotangent
    )
    assert relative((slopes[0] * shifts).flatten(1).sum(1), numeric) < 1e-6
    for weight, slope in zip(leaves[1:], slopes[1:], strict=True):
        kept = weight.detach().clone()

        def changed(values, weight=weight):
            weight.data.copy_(values)
            return game

        numeric, shifts = differences(energy, scene, game, changed, kept, cotangent)
        weight.data.copy_(kept)
        assert relative((slope * shifts).flatten(1).sum(1), numeric) < 1e-6


@pytest.mark.parametrize("exact", [True, False])
def test_gradients_are_those_of_the_structured_layer(exact):
    scene, game = feature_game()
    controls = NEWTON(FEATURES, scene, game).controls
    cotangent = torch.randn_like(controls)
    found = []
    for function in (attach, implicit.attach):
        leaves = leaves_of(game)
        (function(FEATURES, scene, leaves, controls, exact)[0] * cotangent).sum().backward()
        found.append(
            [*(w.grad for w in leaves.own_weights.values()), leaves.pair_weights["proximity"].grad, leaves.goals.grad]
        )
        assert leaves.initial_controls.grad is None or (leaves.initial_controls.grad == 0).all()
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-10)


def test_a_common_scale_of_all_weights_has_no_gradient():
    scene, game = feature_game()
    leaves = leaves_of(game)
    (solved(FEATURES, scene, leaves) * torch.randn_like(game.initial_controls)).sum().backward()
    weights = [*leaves.own_weights.values(), leaves.pair_weights["proximity"]]
    along = sum((weight * weight.grad).sum(-1) for weight in weights)
    length = sum((weight * weight.grad).abs().sum(-1) for weight in weights)
    assert (along.abs() < 1e-9 * length).all()
    # In the convex game one weight is held, so that the scale of the others is learned.
    scene, game = convex_game()
    leaves = leaves_of(game)
    (solved(convex_energy(), scene, leaves) * torch.randn_like(game.initial_controls)).sum().backward()
    weights = [leaves.own_weights[name] for name in convex_energy().weighted[0]] + [leaves.pair_weights["order"]]
    along = sum((weight * weight.grad).sum(-1) for weight in weights)
    length = sum((weight * weight.grad).abs().sum(-1) for weight in weights)
    assert (along.abs() > 1e-4 * length).all()


def test_points_that_are_no_minimum_have_zero_gradients():
    scene, game = feature_game(scenes=3)
    game = dataclasses.replace(game, initial_controls=NEWTON(FEATURES, scene, game).controls)
    controls = game.initial_controls.clone()
    broken = game.own_weights["vel"].clone()
    broken[0, 0] = torch.nan
    # Held together by nothing but a hinge, which pushes agents apart: a saddle.
    loose = {name: weight.clone() for name, weight in game.own_weights.items()}
    for weight in loose.values():
        weight[1, 1] = 0.0
    controls[1, 1] = 0.0
    game = dataclasses.replace(game, own_weights={**loose, "vel": torch.where(broken.isnan(), broken, loose["vel"])})
    leaves = leaves_of(game)
    found, status = attach(FEATURES, scene, leaves, controls, True)
    expected = torch.zeros(3, 2, dtype=torch.long)
    expected[0, 0] = expected[1, 1] = Status.STOPPED
    assert torch.equal(status, expected)
    assert torch.equal(found.detach(), controls)
    found.square().sum().backward()
    for slope in (
        *(w.grad for w in leaves.own_weights.values()),
        leaves.pair_weights["proximity"].grad,
        leaves.goals.grad,
    ):
        assert slope.isfinite().all()
        assert (slope[expected == Status.STOPPED] == 0).all()
        assert (slope[expected == Status.COMPLETED] != 0).any()


def test_a_nan_scene_gives_networks_no_gradient():
    scene, game = learned_game()
    energy = Learned()

    def slopes(scene, game):
        controls = NEWTON(energy, scene, game).controls
        found, status = attach(energy, scene, game, controls, True)
        parameters = [*energy.net.parameters(), *energy.touch.parameters()]
        return status, torch.autograd.grad(found.square().sum(), parameters)

    _, expected = slopes(scene[1], game[1])
    history = scene.history.clone()
    history[0] = torch.nan
    context = game.context.clone()
    context[0] = torch.nan
    status, found = slopes(dataclasses.replace(scene, history=history), dataclasses.replace(game, context=context))
    assert (status[0] == Status.STOPPED).all()
    assert (status[1] == Status.COMPLETED).all()
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_games_that_are_left_out_hold_zeros():
    scene, game = learned_game()
    kept = torch.tensor([[True, False], [False, False]])
    found_scene, found = with_zeros(scene, game, kept)
    assert torch.equal(found_scene.agent_mask, scene.agent_mask & torch.tensor([[True], [False]]))
    assert torch.equal(found.context[0], game.context[0]), "modes share it, and one of them is kept"
    assert (found.context[1] == 0).all()
    for name in ("initial_controls", "goals"):
        one, other = getattr(found, name), getattr(game, name)
        assert torch.equal(one[kept], other[kept])
        assert (one[~kept] == 0).all()


def test_padding_and_batches_do_not_change_gradients():
    scene, game = convex_game(scenes=3)
    energy, teach = convex_energy(), Implicit()

    def slopes(scene, game, agents=3):
        leaves = leaves_of(game)
        solution = teach(NEWTON, energy, scene, leaves)
        solution.states[:, :, :agents, :, :2].square().sum().backward()
        return leaves.own_weights["lateral"].grad, leaves.goals.grad

    together = slopes(scene, game)
    alone = slopes(scene[1], game[1])
    padded = slopes(pad(scene, 1), widen_convex(game, 1))
    for whole, one, wide in zip(together, alone, padded, strict=True):
        torch.testing.assert_close(whole[1:2], one, rtol=1e-11, atol=1e-12)
        torch.testing.assert_close(wide[:, :, :3], whole, rtol=1e-11, atol=1e-12)
        assert (wide[:, :, 3:] == 0).all()


@pytest.mark.parametrize("kind", ["features", "convex", "gauss_newton"])
def test_unconverged_solutions_are_warned_of_once(kind, monkeypatch):
    energy, (scene, game) = (convex_energy(), convex_game()) if kind == "convex" else (FEATURES, feature_game())
    teach = Implicit("gauss_newton" if kind == "gauss_newton" else "exact")
    monkeypatch.setattr(descent, "_warned", False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        teach(NEWTON, energy, scene, leaves_of(game))
        with torch.no_grad():
            teach(Newton(steps=0), energy, scene, game)  # nothing is differentiated
    far = leaves_of(game)
    with pytest.warns(UserWarning, match=r"backward=implicit: \d+ % of the solutions .* no minima .*solver.steps"):
        teach(Newton(steps=0), energy, scene, far)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        teach(Newton(steps=0), energy, scene, far)


@pytest.mark.parametrize(
    ("shares", "told"), [((2e-3, 2e-3, 5e-4), "67 %"), ((2e-3, 5e-4, 5e-4), None), ((0.0, 0.0, 0.0), None)]
)
def test_a_warning_needs_most_of_a_batch_to_be_unconverged(shares, told, monkeypatch):
    monkeypatch.setattr(descent, "_warned", False)
    left = torch.tensor(shares, dtype=torch.float64)[:, None]
    value = torch.ones_like(left)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        descent.warn_if_far(value, left, left.isfinite())
    assert [told in str(warning.message) for warning in caught] == ([True] if told else [])
