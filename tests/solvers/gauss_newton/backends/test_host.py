"""The host backend on a device of which only the copies are made up: its tensors have no address that a kernel can read."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from backends import STATE_PAIRS, BackendSuite, gradients
from games import ALL, BOUNDS, leaves_of, random_game, random_scene
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_map

from epo_lightning.forecast import Status
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import SPEED, TURN_RATE
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.gauss_newton.backends import assisted, choice, compiled, host, pytorch
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

if isinstance(interface.find(), str):
    pytest.skip("the compiled layer is missing", allow_module_level=True)


class Remote(torch.Tensor):
    """A tensor of another device: it has no address for the host, and no operation mixes it with tensors of the CPU."""

    @staticmethod
    def __new__(cls, values):
        return torch.Tensor._make_wrapper_subclass(
            cls, values.shape, strides=values.stride(), dtype=values.dtype, device="meta"
        )

    def __init__(self, values):
        self.values_there = values

    def data_ptr(self):
        raise AssertionError("the kernel must not get an address on the device")

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        def values(value):
            if isinstance(value, torch.Tensor) and not isinstance(value, Remote):
                assert value.dim() == 0, f"{function} mixes tensors of two devices"
            return value.values_there if isinstance(value, Remote) else value

        kwargs = {**(kwargs or {})}
        if kwargs.get("device") is not None:
            kwargs["device"] = "cpu"
        found = function(*tree_map(values, args), **tree_map(values, kwargs))
        return tree_map(lambda value: Remote(value) if isinstance(value, torch.Tensor) else value, found)


class Counted:
    """Copies of the device of :class:`Remote` tensors, which remember what they copied."""

    def __init__(self):
        self.copied = []

    def to_host(self, buffer):
        self.copied.append(("to host", buffer.numel()))
        return buffer.values_there.clone()

    def to_device(self, tensors):
        assert not any(isinstance(tensor, Remote) for tensor in tensors)
        packed = torch.cat(host._parts(tensors))
        self.copied.append(("to device", packed.numel()))
        return Remote(packed)


class Factories(TorchFunctionMode):
    """Tensors that PyTorch makes on the device of another one: ``torch.arange(2, device=tensor.device)``, or of a number."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.where and isinstance(args[1], Remote) and not isinstance(args[2], Remote):
            return function(*args[:2], args[1].new_full((), args[2]))
        if str(kwargs.get("device")) != "meta":
            return function(*args, **kwargs)
        return Remote(function(*args, **{**kwargs, "device": "cpu"}))


def remote(batch):
    return batch.map(lambda tensor: Remote(tensor.detach()).requires_grad_(tensor.requires_grad))


def values(tensor):
    return tensor.values_there if isinstance(tensor, Remote) else tensor


@pytest.fixture(autouse=True)
def copies(monkeypatch):
    """The copies, and nothing of CUDA."""
    found = Counted()
    monkeypatch.setattr(host, "copies_of", lambda device: found if device.type == "meta" else None)
    return found


class _Onto(torch.autograd.Function):
    """Bridge of the suite, whose tensors are on the CPU, to the device."""

    @staticmethod
    def forward(ctx, tensor):
        return Remote(tensor.detach().clone(memory_format=torch.preserve_format))

    @staticmethod
    def backward(ctx, gradient):
        return values(gradient)


class _Back(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        if not tensor.is_floating_point():
            ctx.mark_non_differentiable(tensor)
        return values(tensor).clone()

    @staticmethod
    def backward(ctx, gradient):
        return None if gradient is None else Remote(gradient)


class TestHosted(BackendSuite):
    @staticmethod
    def solve(energy, scene, parameters, steps, step_size, damping, keep_iterates=False):
        there, game = scene.map(_Onto.apply), parameters.map(_Onto.apply)
        found = host.solve(energy, there, game, steps, step_size, Remote(damping), keep_iterates)
        assert all(isinstance(tensor, Remote) for tensor in (found.controls, found.energy, found.status))
        return found.map(_Back.apply)


@pytest.mark.parametrize("pair", [("proximity",), *STATE_PAIRS])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_are_those_of_the_compiled_layer_bit_for_bit(pair, dtype, copies):
    """One copy each way for the forward pass and one each way for the backward pass."""
    scene = random_scene(5, 3, history=4, size=1.5, dtype=dtype, lanes=2)
    scene = dataclasses.replace(scene, game_steps=torch.tensor([7, 3, 5, 7, 1]))
    energy, game = FeatureEnergy(ALL, pair, BOUNDS), random_game(scene, pair=pair)
    damping = torch.full((5, 2), 10.0, dtype=dtype)
    ours, theirs = leaves_of(game), leaves_of(game)
    there = remote(ours)
    solution = host.solve(energy, remote(scene), there, 2, 0.3, Remote(damping), keep_iterates=True)
    expected = compiled.solve(energy, scene, theirs, 2, 0.3, damping, keep_iterates=True)
    assert [way for way, _ in copies.copied] == ["to host", "to device"]
    for name in ("controls", "states", "initial_energy", "energy", "gradient_norm", "status"):
        assert torch.equal(values(getattr(solution, name)), getattr(expected, name)), name
    assert all(torch.equal(values(a), b) for a, b in zip(solution.iterates, expected.iterates, strict=True))
    copies.copied.clear()
    weigh = torch.randn_like(expected.states)
    ((solution.states * Remote(weigh)).sum() + solution.iterates[1].square().sum()).backward()
    ((expected.states * weigh).sum() + expected.iterates[1].square().sum()).backward()
    assert [way for way, _ in copies.copied] == ["to host", "to device"]
    exact, found = gradients(theirs), gradients(there)
    assert all(torch.equal(values(found[name]), exact[name]) for name in exact)


def test_only_what_the_kernel_reads_is_copied(copies):
    scene = random_scene(4, 2, history=19, lanes=5)
    energy, game = FeatureEnergy(["acc", "goal"]), random_game(scene, 2, 7)
    with torch.no_grad():
        host.solve(energy, remote(scene), remote(game), 1, 0.3, Remote(torch.ones(4, 2)))
    agents, floats = 4 * 2, 4
    read = floats * agents * (4 + 2) + 2 * agents  # current states, sizes, two masks
    read += floats * (2 * agents * (2 + 2 + 7 * 2) + 2 * 4 + 2 * 4)  # weights, goals, controls; pairs, damping
    assert copies.copied[0] == ("to host", read)


def test_adaptive_and_implicit_solutions_are_those_of_the_compiled_layer(copies):
    scene, energy = random_scene(3, 2, history=2, size=1.0), FeatureEnergy(["goal", "acc", "turnr"])
    game = random_game(scene, 2, 6, spread=0.1)
    minimise = LevenbergMarquardt(20, 1.0, 1.0, adaptive=True, newton_steps=5)
    assert choice.choose("auto", energy, remote(scene), remote(game)) is host
    assert minimise.on_host
    assert not dataclasses.replace(minimise, backend="pytorch").on_host
    with torch.no_grad(), Factories():
        found, expected = minimise(energy, remote(scene), remote(game)), minimise(energy, scene, game)
    assert torch.equal(values(found.controls), expected.controls)
    assert [way for way, _ in copies.copied] == ["to host", "to device"] * 2, (
        "Gauss-Newton steps, and then Newton steps"
    )
    ours, theirs = leaves_of(game), leaves_of(game)
    there = remote(ours)
    with Factories():
        Implicit()(minimise, energy, remote(scene), there).controls.square().sum().backward()
    Implicit()(minimise, energy, scene, theirs).controls.square().sum().backward()
    found_by, by = gradients(there), gradients(theirs)
    assert any((gradient != 0).any() for gradient in by.values())
    assert all(torch.equal(values(found_by[name]), by[name]) for name in by)


@pytest.fixture
def own_features():
    """An own and a pair feature of the user, and a game with them."""

    @own_feature("drift", Source.STEP)
    def drift(states, controls):
        return states[..., SPEED] * controls[..., TURN_RATE]

    @pair_feature("room", Source.STEP, needs="size", margin=True)
    def room(one, other, size, other_size, margin):
        away = (one[..., :2] - other[..., :2]).square().sum(-1)
        return ((size + other_size).sum(-1) + margin - away).relu()

    scene = random_scene(4, 3, history=3, size=1.5, lanes=2)
    scene.agent_mask[1, 1] = False
    energy = FeatureEnergy(["goal", "acc", "turnr", "lane", "drift"], ["proximity", "room"])
    game = random_game(scene, 2, 7, pair=("proximity",), spread=0.1)
    own = {name: game.own_weights["acc"].clone() for name in energy.own}
    pair = {name: game.pair_weights["proximity"].clone() for name in energy.pair}
    margins = {"room": torch.full_like(pair["room"], 0.5)}
    yield energy, scene, dataclasses.replace(game, own_weights=own, pair_weights=pair, margins=margins)
    del OWN_FEATURES["drift"], PAIR_FEATURES["room"]


def test_features_of_the_user_are_evaluated_on_the_host(own_features, copies):
    energy, scene, game = own_features
    ours, theirs, damping = leaves_of(game), leaves_of(game), torch.full((4, 2), 5.0)
    there = remote(ours)
    found = host.solve(energy, remote(scene), there, 2, 0.3, Remote(damping), keep_iterates=True)
    expected = assisted.solve(energy, scene, theirs, 2, 0.3, damping, keep_iterates=True)
    assert [way for way, _ in copies.copied] == ["to host", "to device"]
    for name in ("controls", "states", "initial_energy", "energy", "gradient_norm", "status"):
        assert torch.equal(values(getattr(found, name)), getattr(expected, name)), name
    (found.states.square().sum() + found.iterates[1].sum()).backward()
    (expected.states.square().sum() + expected.iterates[1].sum()).backward()
    exact = gradients(theirs)
    assert all(exact[name].any() for name in ("drift", "room", "margin of room"))
    found_by = gradients(there)
    assert all(torch.equal(values(found_by[name]), exact[name]) for name in exact)


def test_minima_with_features_of_the_user_are_found_and_differentiated_on_the_host(own_features, copies):
    energy, scene, game = own_features
    ours, theirs = leaves_of(game), leaves_of(game)
    there = remote(ours)
    minimise = LevenbergMarquardt(10, 1.0, 1.0, adaptive=True, newton_steps=10)
    with Factories():
        found = Implicit()(minimise, energy, remote(scene), there)
        found.controls.square().sum().backward()
    assert [way for way, _ in copies.copied] == ["to host", "to device"] * 4, "two descents, minima, gradients"
    expected = Implicit()(minimise, energy, scene, theirs)
    expected.controls.square().sum().backward()
    assert torch.equal(values(found.controls), expected.controls)
    exact, found_by = gradients(theirs), gradients(there)
    assert exact["drift"].any()
    assert all(torch.equal(values(found_by[name]), exact[name]) for name in exact)


def test_fixed_steps_with_features_of_the_user_stay_on_the_device(own_features):
    """A CUDA graph can contain them there."""
    energy, scene, game = own_features
    choice.say_once.cache_clear()
    with pytest.warns(UserWarning, match="the fused layer does not know the feature 'drift'"):
        assert choice.choose("auto", energy, remote(scene), remote(game), fixed=True) is pytorch
    assert choice.choose("auto", energy, remote(scene), remote(game)) is host
    assert choice.choose("host", energy, remote(scene), remote(game), fixed=True) is host


def test_the_host_backend_is_for_games_on_a_device_that_the_kernel_knows():
    scene, energy = random_scene(2, 2, history=2), FeatureEnergy(["goal", "acc"])
    game = random_game(scene)
    assert choice.choose("host", energy, scene, game) is compiled, "a run of a GPU is scored on a machine without one"
    with pytest.raises(ValueError, match="backend is 'compiled', but the compiled layer runs on CPUs"):
        choice.choose("compiled", energy, remote(scene), remote(game))
    heun = FeatureEnergy(["goal", "acc"], dynamics=Unicycle("heun"))
    with pytest.raises(ValueError, match="backend is 'host', but the compiled layer integrates by euler, not heun"):
        choice.choose("host", heun, remote(scene), remote(game))
    choice.say_once.cache_clear()
    with pytest.warns(UserWarning, match="integrates by euler, not heun"):
        chosen = choice.choose("auto", heun, remote(scene), remote(game))
    assert chosen is pytorch


def test_devices_without_copies_are_named(monkeypatch):
    monkeypatch.undo()
    scene, energy = random_scene(2, 2, history=2).to("meta"), FeatureEnergy(["goal", "acc"])
    reason = host.obstacle(energy, scene, random_game(random_scene(2, 2, history=2)).to("meta"))
    assert reason == "the game is copied from CUDA devices, and these tensors are on meta"


def test_a_missing_copy_would_be_noticed():
    """The stand-in for a device can fail: the kernel cannot read its tensors, and its operations do not mix devices."""
    scene, energy = random_scene(2, 2, history=2), FeatureEnergy(["goal", "acc"])
    game, damping = random_game(scene), torch.ones(2, 2)
    with pytest.raises(AssertionError, match="address on the device"):
        compiled.solve(energy, scene, remote(game), 1, 0.3, damping)
    with pytest.raises(AssertionError, match="mixes tensors of two devices"):
        remote(game).initial_controls + game.initial_controls


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_gets_the_results_of_the_cpu(monkeypatch):
    monkeypatch.undo()
    scene, energy = random_scene(5, 3, history=2, size=1.5), FeatureEnergy(ALL, bounds=BOUNDS)
    theirs = leaves_of(random_game(scene))
    ours = leaves_of(theirs.to("cuda"))
    there, here = LevenbergMarquardt(backend="host"), LevenbergMarquardt(backend="compiled")
    found, expected = there(energy, scene.to("cuda"), ours), here(energy, scene, theirs)
    assert found.controls.device.type == "cuda"
    assert torch.equal(found.controls.cpu(), expected.controls)
    found.states.square().sum().backward()
    expected.states.square().sum().backward()
    exact = gradients(theirs)
    assert all(torch.allclose(gradient.cpu(), exact[name]) for name, gradient in gradients(ours).items())
    assert (found.status == Status.COMPLETED).all()
