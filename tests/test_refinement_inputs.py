"""What `refine()` refuses or warns of, and scenes that it takes: without others, and in coordinates of a map."""

from __future__ import annotations

import dataclasses
import math
import warnings

import pytest
import torch
from crossing_cars import K, alone, crossing
from torch.testing import assert_close

from epo_lightning import FeatureEnergy, Scene, Unicycle, refine
from epo_lightning.refinement import ENERGY, WEIGHTS
from epo_lightning.registry import ConfigError


def refused(error: type[Exception], message: str, **changes) -> None:
    scene, states = crossing()
    arguments = {"states": states, "probabilities": torch.ones(1, 1), "scene": scene, **changes}
    with pytest.raises(error, match=message):
        refine(**arguments)


GOALS = FeatureEnergy(own=("accref", "turnrref", "goal"), pair=())


FORGETS = FeatureEnergy(own=("acc", "turnr"), pair=("circles",))


MARGIN = FeatureEnergy(own=("accref",), pair=("lateral",))


HEUN = dataclasses.replace(ENERGY, dynamics=Unicycle("heun"))


BROKEN = torch.zeros(1, 1, 2, K, 4)
BROKEN[0, 0, 1, 3, 0] = math.nan


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"states": [1.0]}, TypeError, "states is a list"),
        ({"states": torch.zeros(1, 1, 2, K, 4, dtype=torch.long)}, TypeError, r"states is of type torch\.int64"),
        ({"states": torch.zeros(1, 2, K, 4)}, ValueError, r"\[1, 2, 20, 4\]; this scene takes \[1, M, 2, K, 2 or 4\]"),
        ({"states": torch.zeros(1, 1, 3, K, 4)}, ValueError, r"\[1, 1, 3, 20, 4\]"),
        ({"states": torch.zeros(1, 1, 2, K, 3)}, ValueError, "2 or 4"),
        ({"states": torch.zeros(1, 1, 2, 1, 4)}, ValueError, r"K = 1 step\(s\)"),
        ({"states": torch.zeros(1, 0, 2, K, 4), "probabilities": torch.ones(1, 0)}, ValueError, r"M = 0 mode"),
        ({"states": BROKEN}, ValueError, r"states\[0, 0, 1, 3\] is \[nan"),
        (
            {"probabilities": torch.ones(1, 2)},
            ValueError,
            r"probabilities has shape \[1, 2\]; these states take \[1, 1\]",
        ),
        ({"probabilities": torch.full((1, 1), 0.7)}, ValueError, r"probabilities\[0\] is \[0\.6.*sum to 1"),
        ({"probabilities": torch.full((1, 1), math.nan)}, ValueError, r"probabilities\[0\] is \[nan\]"),
        (
            {"energy": dataclasses.replace(ENERGY), "weights": {"accref": 1.0}},
            ValueError,
            "lacks the feature 'turnrref'",
        ),
        (
            {"energy": dataclasses.replace(ENERGY)},
            ValueError,
            "needs weights=, a number for each of accref, turnrref, circ",
        ),
        ({"weights": {**WEIGHTS, "circle": 1.0}}, ValueError, r"unknown feature weights\['circle'\].*'circles'"),
        ({"weights": {**WEIGHTS, "circles": math.inf}}, ValueError, r"weights\['circles'\] must be a finite number"),
        ({"weights": {**WEIGHTS, "circles": torch.ones(3)}}, ValueError, r"shape \[3\].*\[1, 1, 1\]"),
        ({"energy": GOALS, "weights": {}}, ConfigError, "knows no goals"),
        ({"energy": FORGETS, "weights": {}}, ConfigError, "add accref and turnrref"),
        (
            {"energy": MARGIN, "weights": {"accref": 1.0, "lateral": 1.0}},
            ValueError,
            "margins lacks the feature 'lateral'",
        ),
        ({"margins": {"circles": 0.1}}, ValueError, r"unknown feature margins\['circles'\]"),
        ({"inverse_temperature": -1.0}, ConfigError, "inverse_temperature must be a number, 0 or more"),
        ({"inverse_temperature": 1e39}, ValueError, "inverse_temperature must be at most"),
        ({"weights": {**WEIGHTS, "accref": 1e20}}, ValueError, r"weights\['accref'\] must be at most"),
        ({"weights": {**WEIGHTS, "accref": torch.tensor(-1e20)}}, ValueError, r"weights\['accref'\] must be at most"),
        ({"weights": [1, 2, 3]}, TypeError, "weights is a list"),
        ({"scene": None}, TypeError, "scene is a NoneType"),
        ({"states": torch.zeros(1, 1, 2, K, 4, dtype=torch.half)}, TypeError, r"states is of type torch\.float16"),
        ({"inverse_temperature": math.inf}, ConfigError, "inverse_temperature must be a number, 0 or more, and finite"),
        ({"inverse_temperature": torch.tensor([1.0])}, ValueError, "inverse_temperature must be one finite number"),
        ({"weights": {"accref": torch.tensor(math.nan), "turnrref": 1.0, "circles": 1.0}}, ValueError, "not finite"),
        ({"inverse_temperature": torch.tensor(True)}, ValueError, "inverse_temperature must be one finite number"),
        ({"inverse_temperature": torch.tensor(1j)}, ValueError, "inverse_temperature must be one finite number"),
        ({"inverse_temperature": 10**400}, ValueError, "inverse_temperature must be at most"),
        ({"weights": {**WEIGHTS, "accref": 10**400}}, ValueError, r"weights\['accref'\] must be at most"),
        (
            {"weights": {**WEIGHTS, "accref": torch.tensor(1j)}},
            ValueError,
            r"weights\['accref'\] is of type .*complex64",
        ),
        ({"energy": None}, TypeError, "energy is a NoneType; it takes an instance of epo_lightning.game.energy.Energy"),
        ({"solver": None}, TypeError, "solver is a NoneType"),
        ({"backward": "implicit"}, TypeError, "backward is a str"),
        ({"noise": -0.1}, ValueError, "noise must be a number, 0 or more"),
        ({"energy": HEUN, "weights": WEIGHTS}, ConfigError, "integrator=euler"),
    ],
)
def test_what_cannot_be_refined_is_refused_by_name(changes, error, message):
    refused(error, message, **changes)


def test_sizes_are_needed_where_bodies_interact():
    scene, states = crossing()
    refused(ValueError, "size", scene=dataclasses.replace(scene, size=None), states=states)


@pytest.mark.parametrize("absent", [0, 1])
def test_agents_without_others_need_no_sizes(absent: int):
    scene, states = crossing()
    given = states[:, :, : 1 + absent]
    refined = refine(given, torch.ones(1, 1), alone(scene, absent))
    assert_close(refined.states[:, :, 0], states[:, :, 0], rtol=0, atol=1e-3)
    assert (refined.states == refine(given, torch.ones(1, 1), alone(scene, absent, sized=True)).states).all()


def test_agents_without_others_need_sizes_where_their_own_features_do():
    scene, states = crossing()
    steers = FeatureEnergy(own=("accref", "turnrref", "steer"), pair=("circles",))
    refused(
        ValueError,
        r"scene\.size.*None",
        states=states[:, :, :1],
        scene=alone(scene),
        energy=steers,
        weights={**WEIGHTS, "steer": 1.0},
    )


def test_futures_in_other_coordinates_lead_to_a_warning():
    scene, states = crossing()
    with pytest.warns(UserWarning, match=r"states\[0, 0, 0\] begins 14\d\.\d m from .* in the same coordinates"):
        refine(states[..., :2] + 100.0, torch.ones(1, 1), scene)


def test_one_weight_of_the_default_energy_can_be_changed():
    scene, states = crossing()
    whole = refine(states, torch.ones(1, 1), scene, weights={**WEIGHTS, "circles": 20.0})
    torch.testing.assert_close(
        refine(states, torch.ones(1, 1), scene, weights={"circles": 20.0}).states, whole.states, rtol=0, atol=0
    )
    assert not torch.equal(whole.states, refine(states, torch.ones(1, 1), scene).states)


def crossing_at(offset: float = 0.0, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, Scene]:
    """Positions of the futures of two cars whose paths cross, and their scene; far from the origin by an offset."""
    scene, states = crossing(dtype)
    history = scene.history.clone()
    history[..., :2] += offset
    return states[..., :2] + offset, dataclasses.replace(scene, history=history)


def test_scenes_in_coordinates_of_a_map_are_refined_as_near_the_origin() -> None:
    near, far = (
        refine(given, torch.ones(1, 1).double(), scene)
        for given, scene in (crossing_at(dtype=torch.double), crossing_at(5.4e6, torch.double))
    )
    torch.testing.assert_close(far.states[..., :2] - 5.4e6, near.states[..., :2], rtol=0, atol=1e-6)
    torch.testing.assert_close(far.initial_states[..., :2] - 5.4e6, near.initial_states[..., :2], rtol=0, atol=1e-6)
    states, scene = crossing_at(5.4e6)
    with pytest.warns(
        UserWarning, match=r"up to 5400000 m from the origin, where single precision has a resolution of 0\.6"
    ):
        refine(states, torch.ones(1, 1), scene)


@pytest.mark.parametrize(("entry", "factor"), [(2, 0.0), (2, 2.0), (3, 3.6), (3, 0.0)])
def test_futures_that_contradict_the_present_states_are_warned_of(entry: int, factor: float) -> None:
    states, scene = crossing_at()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refine(states, torch.ones(1, 1), scene)
    history = scene.history.clone()
    history[..., entry] *= factor
    with pytest.warns(UserWarning, match=r"of the given futures of agents do not continue .* states\[0, 0, [01]\]"):
        refine(states, torch.ones(1, 1), dataclasses.replace(scene, history=history))


def test_absent_agents_may_have_any_numbers() -> None:
    states, scene = crossing_at()
    for value in (math.nan, math.inf):
        history, padded = scene.history.clone(), states.clone()
        history[:, 1], padded[:, :, 1] = value, value
        alone = dataclasses.replace(scene, history=history, agent_mask=torch.tensor([[True, False]]))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert refine(padded, torch.ones(1, 1), alone).states[:, :, 0].isfinite().all()


@pytest.mark.parametrize("channel", range(4))
def test_a_present_state_with_one_number_that_is_not_finite_is_refused(channel: int) -> None:
    states, scene = crossing_at()
    history = scene.history.clone()
    history[0, 1, -1, channel] = math.nan
    with pytest.raises(ValueError, match=r"scene\.history\[0, 1, -1\] is not finite: mark the agent as absent"):
        refine(states, torch.ones(1, 1), dataclasses.replace(scene, history=history))


def test_negative_weights_and_names_of_derivatives_are_refused() -> None:
    states, scene = crossing_at()
    with pytest.raises(ValueError, match=r"weights\['circles'\] must be 0 or more, not -20"):
        refine(states, torch.ones(1, 1), scene, weights={"circles": -20.0})
    with pytest.raises(TypeError, match=r"backward is a str; it takes an instance of .*Implicit\(\), Unrolled\(\)"):
        refine(states, torch.ones(1, 1), scene, backward="unrolled")
