"""The inferred game: types that users give by mistake."""

from __future__ import annotations

import re
from typing import Any

import jaxtyping
import pytest
import torch
from games import random_game, random_scene

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt


@pytest.fixture(autouse=True)
def as_users_run_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the tests' own checks of annotations, which would come first."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (
            "initial_controls",
            torch.zeros(1, 1, 2, 3, 2).numpy(),
            "initial_controls is a ndarray; it takes a tensor",
        ),
        ("initial_controls", None, "parameters.initial_controls is a NoneType"),
        ("goals", [[[[0.0, 0.0]]]], "parameters.goals is a list; it takes a tensor: convert it with torch.as_tensor"),
        ("own_weights", {"acc": 1.0}, "parameters.own_weights['acc'] is a float"),
        ("own_weights", {"acc": torch.ones(1, 1, 2).numpy()}, "parameters.own_weights['acc'] is a ndarray"),
        (
            "pair_weights",
            torch.ones(1, 1, 1),
            "parameters.pair_weights is a Tensor; it takes a tensor for each feature",
        ),
        ("margins", {"clearance": 0.5}, "parameters.margins['clearance'] is a float"),
    ],
)
def test_values_that_are_no_tensors_are_named(field: str, value: Any, message: str) -> None:
    right = {"own_weights": {}, "pair_weights": {}, "initial_controls": torch.zeros(1, 1, 2, 3, 2)}
    assert GameParameters(**right).goals is None
    with pytest.raises(TypeError, match=re.escape(message)):
        GameParameters(**{**right, field: value})


def test_learned_weights_in_a_dictionary_of_parameters_are_taken() -> None:
    weights = torch.nn.ParameterDict({"acc": torch.ones(1, 2, 2), "turnr": torch.ones(1, 2, 2)})
    scene = random_scene(1, 2, horizon=3)
    game = GameParameters(weights, {}, torch.randn(1, 2, 2, 3, 2))  # type: ignore[arg-type]
    solution = LevenbergMarquardt()(FeatureEnergy(["acc", "turnr"], pair=[]), scene, game)
    solution.controls.square().sum().backward()
    assert all((weight.grad != 0).all() for weight in weights.values())
    assert game.to(torch.float64).own_weights["acc"].dtype == torch.float64


def test_a_solver_names_arguments_in_another_order() -> None:
    scene, energy = random_scene(1, 2), FeatureEnergy(["acc"])
    game, solve = random_game(scene, own=("acc",)), LevenbergMarquardt()
    assert solve(energy, scene, game).controls.shape[:3] == (1, 2, 2)
    for wrong, named in (((scene, energy, game), "Scene, FeatureEnergy, GameParameters"), ((energy, {}, game), "dict")):
        with pytest.raises(TypeError, match=f"an energy, a Scene and GameParameters, in this order, not .*{named}"):
            solve(*wrong)


def test_games_without_pairs_differ_in_their_pair_weights_alone():
    game = random_game(random_scene(2, 3))
    alone = game.without_pairs()
    assert {name: weight.any().item() for name, weight in alone.pair_weights.items()} == {"proximity": False}
    assert game.pair_weights["proximity"].all()
    assert all(torch.equal(alone.own_weights[name], weight) for name, weight in game.own_weights.items())
    assert alone.initial_controls is game.initial_controls
