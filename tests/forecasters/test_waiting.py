"""Training steps on a device: forward pass, losses and backward pass, in which the host never waits for the device."""

from __future__ import annotations

import pytest
import torch
from backends import HostMustNotWait
from torch import Tensor
from torch.utils._pytree import tree_leaves

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecasters import Forecaster
from epo_lightning.scene import Scene
from epo_lightning.schema import read

PLAIN = (
    "rpi/v_lstm_relaxed",
    "rpi/v_lstm_sc",
    "rpi/v_lstm_sc_relaxed",
    "highway/v_lstm",
    "highway/vibes",
    "highway/hivt_m",
)
GAMES = ("rpi/v_lstm_epo", "rpi/v_lstm_epo_relaxed", "highway/v_lstm_epo", "highway/vibes_epo", "highway/hivt_m_epo")


class HostMustNotCopy(HostMustNotWait):
    """Fails also on operations with tensors of two devices, one of which would be copied."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        found = super().__torch_dispatch__(function, types, args, kwargs)
        tensors = [leaf for leaf in tree_leaves((args, kwargs, found)) if isinstance(leaf, Tensor)]
        # A number that is a tensor of the host becomes an argument of the kernel, except where it is copied itself.
        copy = function._schema.name in ("aten::_to_copy", "aten::copy_")
        devices = {tensor.device.type for tensor in tensors if copy or tensor.dim()}
        assert len(devices) <= 1, f"{function} copies between devices"
        return found


def prepared(experiment: str, backend: str) -> tuple[Forecaster, Scene]:
    """A forecaster in training mode, and a batch for it."""
    kind = "rpi" if experiment.startswith("rpi") else "highway"
    words = ["data=drawn", f"data.like={kind}", "data.scenes=32", "data.batch_size=4", f"solver.backend={backend}"]
    settings = read(Settings, compose("train", [f"experiment={experiment}", *words]))
    data = assembly.build_data(settings.data)
    forecaster = assembly.build_model(settings, data).train()
    assert isinstance(forecaster, Forecaster)
    data.setup("fit")
    return forecaster, next(iter(data.train_dataloader()))


@pytest.mark.parametrize("experiment", [*PLAIN, *GAMES])
def test_no_value_is_looked_at_and_nothing_is_copied_on_another_device(experiment):
    """The device is ``meta``, where tensors have no values at all."""
    forecaster, scene = prepared(experiment, "pytorch")
    forecaster, scene = forecaster.to("meta"), scene.to("meta")
    for schedule in forecaster.schedules:
        schedule.held = torch.zeros((), device="meta")  # as for a CUDA graph
    with HostMustNotCopy():
        forecaster.weighted_losses(scene)[0].backward()
    assert any(parameter.grad is not None for parameter in forecaster.parameters())


@pytest.mark.parametrize("backend", ["pytorch", "warp"])
@pytest.mark.parametrize("experiment", GAMES)
def test_the_paths_without_waiting_give_the_same_losses_and_gradients(experiment, backend, monkeypatch):
    if backend == "warp":
        pytest.importorskip("warp")
    forecaster, scene = prepared(experiment, backend)
    state = {name: value.clone() for name, value in forecaster.state_dict().items()}
    expected, _ = forecaster.weighted_losses(scene)
    expected.backward()
    gradients = {name: each.grad for name, each in forecaster.named_parameters() if each.grad is not None}
    statistics = {name: value.clone() for name, value in forecaster.state_dict().items() if "running" in name}
    forecaster.load_state_dict(state)
    forecaster.zero_grad()
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)  # values are then not readable on a CPU either
    with HostMustNotWait():
        total, _ = forecaster.weighted_losses(scene)
        total.backward()
    torch.testing.assert_close(total, expected, rtol=1e-4, atol=1e-5)
    for name, gradient in gradients.items():
        found = forecaster.get_parameter(name).grad
        scale = gradient.abs().max().clamp_min(1e-3)
        torch.testing.assert_close(found / scale, gradient / scale, rtol=0, atol=1e-2, msg=name)
    after = forecaster.state_dict()
    for name, value in statistics.items():
        torch.testing.assert_close(after[name], value, msg=name)
