"""Features whose functions cannot work are refused when an energy is built."""

from __future__ import annotations

import re

import pytest
import torch

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.registry import ConfigError
from epo_lightning.scene import SPEED


@pytest.fixture(autouse=True)
def _registered_features_stay():
    own, pair = dict(OWN_FEATURES), dict(PAIR_FEATURES)
    yield
    for table, before in ((OWN_FEATURES, own), (PAIR_FEATURES, pair)):
        table.clear()
        table.update(before)


def slowed(states, controls):
    controls[..., 0] -= 1.0
    return controls[..., 0]


def slowed_speed(speed):
    speed -= 1.2
    return speed.relu()


OF_TRAJECTORIES = {
    "in place": (slowed, "changes its arguments in place"),
    "no residuals": (
        lambda states, controls: controls[..., 0].square().sum(-1),
        r"returns the shape \[4, 3\] for arguments of the shapes .*\[\.\., R\]",
    ),
    "one for each control": (lambda states, controls: controls, r"returns the shape \[4, 3, 40, 2\]"),
    "no batch": (lambda states, controls: states[0, 0], r"returns the shape \[40, 4\]"),
    "comparison": (lambda states, controls: (controls[..., 0] > 0.1).float(), "has a derivative of zero everywhere"),
    "detached": (lambda states, controls: controls[..., 0].detach(), "has a derivative of zero everywhere"),
    "of all agents": (
        lambda states, controls: controls[..., 0] - controls[..., 0].mean(1, keepdim=True),
        "is not a func",
    ),
    "rounded": (lambda states, controls: controls[..., 0].round(), "has a derivative of zero everywhere"),
    "whole": (lambda states, controls: controls[..., 0].long(), "returns a tensor of torch.int64"),
    "two": (lambda states, controls: (states[..., 0], controls[..., 0]), "returns a tuple"),
    "one argument": (
        lambda states: states[..., 0],
        r"fails on trial arguments: TypeError.*takes states \[\.\., K, 4\] and",
    ),
}
OF_SIGNALS = {
    "in place": (slowed_speed, "changes its arguments in place"),
    "differences": (lambda speed: speed.diff(dim=-1), r"returns the shape \[4, 3, 39\].*\[\.\., K\]"),
    "sums": (lambda speed: speed.cumsum(-1), "is not elementwise"),
    "fluctuation": (lambda speed: speed - speed.mean(-1, keepdim=True), "is not elementwise"),
    "share": (lambda speed: speed.softmax(-1), "is not elementwise"),
    "of all agents": (lambda speed: speed - speed.mean(-2, keepdim=True), "is not elementwise"),
    "two arguments": (lambda states, controls: states[..., 0], "fails on trial arguments: TypeError.*takes one signal"),
}
OF_PAIRS = {
    "one": (
        lambda first: first[..., 0],
        r"fails on trial arguments: TypeError: .*takes the states \[\.\., K, 4\] of two",
    ),
    "far": (lambda first, second: first[..., 999, :2] - second[..., 999, :2], "fails on trial arguments: IndexError"),
    "number": (lambda first, second: 1.0, "returns a float"),
}


def refused(kind, name, words):
    """The energy names the feature and this file, and says what is wrong."""
    given = {"own": ([name], []), "pair": (["acc"], [name])}[kind]
    with pytest.raises(ConfigError, match=rf"^{kind} feature '{re.escape(name)}' \(.*test_trials.py:\d+\) {words}"):
        FeatureEnergy(*given)


@pytest.mark.parametrize("name", OF_TRAJECTORIES)
def test_functions_of_trajectories(name):
    function, words = OF_TRAJECTORIES[name]
    own_feature(name)(function)
    refused("own", name, words)


@pytest.mark.parametrize("name", OF_SIGNALS)
@pytest.mark.parametrize("source", [Source.SPEED, Source.CONTROL, Source.RATE])
def test_functions_of_signals(name, source):
    function, words = OF_SIGNALS[name]
    own_feature(name, source)(function)
    refused("own", name, words)


@pytest.mark.parametrize(
    ("name", "function", "words"),
    [
        ("jerky", lambda states, controls: controls[..., 0].cumsum(-1), "is not a function of single steps alone"),
        (
            "shape",
            lambda states, controls: controls[..., 1:, 0],
            r"returns the shape \[4, 3, 39\].*per step, \[\.\., K\]",
        ),
        ("both", lambda states, controls: controls, r"returns the shape \[4, 3, 40, 2\]"),
    ],
)
def test_functions_of_steps(name, function, words):
    own_feature(name, Source.STEP)(function)
    refused("own", name, words)


def test_functions_of_the_steps_of_pairs():
    pair_feature("held", Source.STEP)(lambda first, second: (first - second)[..., :1, 0].expand(first.shape[:-1]))
    refused("pair", "held", "is not a function of single steps alone")


@pytest.mark.parametrize("name", OF_PAIRS)
def test_functions_of_pairs(name):
    function, words = OF_PAIRS[name]
    pair_feature(name)(function)
    refused("pair", name, words)


def test_a_function_of_the_distance():
    pair_feature("gaps", Source.DISTANCE)(lambda distance, reach: (reach - distance).relu().diff(dim=-1))
    refused("pair", "gaps", r"returns the shape \[4, 3, 39\]")


def test_functions_that_work_are_accepted():
    """Also hinges without any effect on the trial trajectories, and functions that are not finite there."""
    own_feature("never")(lambda states, controls: (controls[..., 0] - 1e6).relu())
    own_feature("last")(lambda states, controls: states[..., -1:, SPEED])
    own_feature("root", Source.SPEED)(lambda speed: speed.sqrt())
    network = torch.nn.Linear(4, 3)
    own_feature("learned")(lambda states, controls: network(states).flatten(-2))
    own_feature("fading", Source.SPEED)(lambda speed: 0.9 ** torch.arange(speed.shape[-1]) * (speed - 3.0).relu())
    own_feature("empty")(lambda states, controls: states[..., 40:, SPEED])
    own_feature("random", Source.SPEED)(lambda speed: speed + torch.randn_like(speed))
    own_feature("limit", Source.CONTROL)(lambda control: (control - 2.0).relu())
    pair_feature("soft", Source.DISTANCE, margin=True)(lambda distance, reach: torch.exp(reach - distance))
    before = torch.get_rng_state()
    own = ["never", "last", "root", "learned", "fading", "empty", "random", "limit"]
    with torch.inference_mode():
        FeatureEnergy(own, ["soft", "proximity"])
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    "function",
    [
        lambda states, controls: torch.linspace(0.0, 1.0, 20) * controls[..., 0],
        lambda states, controls: controls[..., 0] * torch.ones(1, device="meta"),
        lambda states, controls: torch.as_tensor(controls[..., 0].numpy()),
    ],
)
def test_functions_that_may_work_elsewhere_have_a_warning_with_their_place(function):
    """They are made for another number of steps or device."""
    own_feature("elsewhere")(function)
    with pytest.warns(
        UserWarning, match=r"\(.*test_trials.py:\d+\) fails on trial arguments: RuntimeError.*This does not"
    ):
        FeatureEnergy(["elsewhere"])


def test_the_symmetry_of_functions_that_fail_is_not_known():
    network = torch.nn.Linear(8, 3)
    pair_feature("learned pair")(lambda first, second: network(torch.cat((first, second), -1)).flatten(-2))
    with pytest.warns(
        UserWarning, match=r"whether the pair feature 'learned pair' .* is symmetric could not be tried: Runt"
    ):
        FeatureEnergy([], ["learned pair"])


def test_built_in_features_have_no_flaw():
    assert all(feature.flaw is None for feature in (*OWN_FEATURES.values(), *PAIR_FEATURES.values()))


def test_features_in_the_other_list_and_new_ones_are_explained():
    for own, pair, words in (
        (["proximity"], [], r"'proximity' in energy\.own: the pair features have it, so it belongs in energy\.pair"),
        (["acc"], ["acc"], r"'acc' in energy\.pair: the own features have it, so it belongs in energy\.own"),
    ):
        with pytest.raises(ConfigError, match=words):
            FeatureEnergy(own, pair)
    with pytest.raises(
        ConfigError, match=r'A new one has @own_feature\("zigzag"\) above its function, in a file of epo_l'
    ):
        FeatureEnergy(["zigzag"])
    with pytest.raises(ConfigError, match="did you mean 'goal'"):
        FeatureEnergy(["goals"])


def test_two_features_of_one_name_are_named_with_their_places():
    """A cell of a notebook may run again, with another function of the same module."""

    def elsewhere(speed):
        return speed

    elsewhere.__module__ = "elsewhere"
    for register in (own_feature, pair_feature):
        register("mine")(lambda first, second: first[..., 0])
        register("mine")(lambda first, second: second[..., 0])
        with pytest.raises(
            ConfigError, match=r"features are called 'mine', in .*test_trials.py:\d+ and .*:\d+: rename"
        ):
            register("mine")(elsewhere)


@pytest.mark.parametrize(
    "function",
    [
        lambda states, controls: controls[..., 0] * states[..., SPEED].detach(),
        lambda states, controls: controls[..., 0] / float(controls.detach().abs().max()) + controls.detach()[..., 1],
    ],
)
def test_features_with_a_detached_part_have_a_warning(function) -> None:
    own_feature("partly")(function)
    with pytest.warns(
        UserWarning, match=r"test_trials\.py:\d+.* has another derivative than its values, at \d+% of the"
    ):
        FeatureEnergy(own=["partly"], pair=[])


def test_features_with_kinks_and_steps_have_no_warning(recwarn: pytest.WarningsRecorder) -> None:
    own_feature("kinks")(lambda states, controls: (controls[..., 0].abs() - 3.0).relu() + controls[..., 1].round())
    FeatureEnergy(own=["kinks"], pair=[])
    for name, feature in {**OWN_FEATURES, **PAIR_FEATURES}.items():
        assert feature.flaw is None, name
    assert not [warning for warning in recwarn if "derivative" in str(warning.message)]
