"""Declared features: equal to the same function without a declaration, and bad declarations are refused."""

from __future__ import annotations

import inspect

import pytest
import torch
from energy_cases import replaced, stacked
from games import leaves_of, normal_equations, random_game, random_scene

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import (
    OWN_FEATURES,
    Source,
    own_feature,
    pair_feature,
)
from epo_lightning.registry import ConfigError


def wave(value):
    return torch.sin(2.0 * value) + 0.3 * value.square()


def gap(distance, reach):
    return torch.exp(0.5 * (reach - distance))


def register_twins():
    """Pairs of equal features, with and without a declaration of their structure; the reach is 2 m for all."""
    for source, channel in (
        (Source.CONTROL, 0),
        (Source.CONTROL, 1),
        (Source.RATE, 0),
        (Source.RATE, 1),
        (Source.SPEED, 0),
    ):
        name = f"{source.value}{channel}"
        declared = own_feature(name, source, channel)(lambda z: wave(z))

        @own_feature(f"{name}_undeclared")
        def undeclared(states, controls, source=source, channel=channel, declared=declared):
            read = {
                Source.CONTROL: controls[..., channel],
                Source.RATE: controls[..., channel].diff(dim=-1) / 0.1,
                Source.SPEED: states[..., 3],
            }
            return declared(read[source])

    pair_feature("gap", Source.DISTANCE)(gap)

    @pair_feature("gap_undeclared")
    def gap_undeclared(first, second):
        return gap((first[..., :2] - second[..., :2]).norm(dim=-1), 2.0)

    return [name for name in OWN_FEATURES if name[-1] in "01" and not name.endswith("undeclared")]


@pytest.mark.parametrize("stride", [1, 3])
def test_a_declared_feature_equals_the_same_function_undeclared(registry, stride):
    own = register_twins()
    scene = random_scene(2, 3, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, own=tuple(own), horizon=6)
    weights, pair_weights = parameters.own_weights, {"gap": parameters.pair_weights["proximity"]}
    results = []
    for suffix in ("", "_undeclared"):
        energy = FeatureEnergy([name + suffix for name in own], ["gap" + suffix], pair_stride=stride)
        twin = leaves_of(
            replaced(
                parameters,
                own_weights={name + suffix: weight for name, weight in weights.items()},
                pair_weights={name + suffix: weight for name, weight in pair_weights.items()},
            )
        )
        residuals = stacked(energy, scene, twin, twin.initial_controls)
        gradient, matrix = normal_equations(energy, scene, twin, twin.initial_controls)
        directions = torch.ones(2, *twin.initial_controls.shape, dtype=torch.float64)
        directions[1, ..., 0] = -0.5
        values, (one, other) = energy.linearisation(scene, twin, twin.initial_controls, directions)
        (one * (values + other)).sum().backward()
        by = [*twin.own_weights.values(), *twin.pair_weights.values(), twin.initial_controls]
        results.append([residuals, gradient, matrix, *(tensor.grad for tensor in by)])
    for declared, undeclared in zip(*results, strict=True):
        torch.testing.assert_close(declared, undeclared, rtol=0, atol=1e-12 * declared.abs().max().item())


@pytest.mark.parametrize("count", [2, 13])
def test_functions_of_steps_have_the_changes_of_functions_of_trajectories(registry, count):
    """Along few directions each is differentiated; along many the changes follow from the derivatives of single steps."""

    def gap(first, second):
        return (first[..., :2] - second[..., :2]).square().sum(-1) + (first[..., 2] - second[..., 2]).cos()

    for name, source in (("mine", Source.STEP), ("theirs", Source.TRAJECTORY)):
        own_feature(name, source)(lambda states, controls: states[..., 3] * controls[..., 1] + states[..., 2].sin())
        pair_feature(f"{name} too", source)(gap)
    scene = random_scene(3, 3, history=2, dtype=torch.float64)
    scene.agent_mask[1, 1] = False
    scene = replaced(scene, game_steps=torch.tensor([6, 4, 1]))
    game = random_game(scene, horizon=6)
    weight, pair = game.own_weights["acc"], game.pair_weights["proximity"]
    directions = torch.randn(count, *game.initial_controls.shape, dtype=torch.float64)
    found = []
    for name in ("mine", "theirs"):
        game = replaced(game, own_weights={name: weight}, pair_weights={f"{name} too": pair})
        found.append(
            FeatureEnergy([name], [f"{name} too"]).linearisation(scene, game, game.initial_controls, directions)
        )
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)


def test_bad_declarations_are_refused(registry):
    with pytest.raises(ConfigError, match="built-in"):
        own_feature("acc")
    with pytest.raises(ConfigError, match="built-in"):
        pair_feature("proximity")
    with pytest.raises(ConfigError, match="not as POSITION"):
        own_feature("mine", Source.POSITION)
    with pytest.raises(ConfigError, match="not as SPEED"):
        pair_feature("ours", Source.SPEED)


def test_features_of_agents_and_of_pairs_have_different_names(registry):
    own_feature("mine", Source.SPEED)(lambda speed: speed)
    pair_feature("mine", Source.DISTANCE)(lambda distance, reach: (reach - distance).exp())
    with pytest.raises(
        ConfigError, match=r"energy\.own and energy\.pair both have a feature called 'mine': rename one"
    ):
        FeatureEnergy(["acc", "mine"], ["mine"])


@pytest.mark.parametrize(("register", "kind"), [(own_feature, "own"), (pair_feature, "pair")])
def test_a_decorator_without_a_name_is_refused(register, kind):
    with pytest.raises(
        ConfigError, match=rf'^@{kind}_feature needs a name, .*@{kind}_feature\("wave"\) above the function$'
    ):
        inspect.unwrap(register)(wave)  # without the type checker of the tests
