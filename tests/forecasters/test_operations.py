"""The number of operations of a training step, which is the time that it takes on a GPU: each one is a launch or more."""

from __future__ import annotations

import pytest
import torch
from test_waiting import prepared
from torch.utils._python_dispatch import TorchDispatchMode

from epo_lightning.decoders.batch_norm import MaskedBatchNorm, installed

MEMORY = ("empty", "new_empty", "detach", "_unsafe_view")


class Counted(TorchDispatchMode):
    """Counts the operations of PyTorch that compute something."""

    count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.removeprefix("aten::")
        views = [each.alias_info is not None and not each.alias_info.is_write for each in function._schema.returns]
        self.count += not (any(views) or name.startswith(MEMORY))
        return function(*args, **(kwargs or {}))


@pytest.mark.skipif(not installed(), reason="NVIDIA Warp is not installed: pip install 'epo_lightning[gpu]'")
@pytest.mark.parametrize(("kind", "most"), [("rpi", 35), ("highway", 185)])
def test_inferring_a_game_takes_few_more_operations_than_decoding_controls(kind, most, monkeypatch):
    """The layer and the normalisation of present rows are kernels of their own, and not counted."""
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)  # the paths of a GPU, without values
    monkeypatch.setattr(MaskedBatchNorm, "_without_waiting", MaskedBatchNorm._fused)
    counts = []
    for row in ("v_lstm_sc", "v_lstm_epo"):
        forecaster, scene = prepared(f"{kind}/{row}", "warp")
        forecaster.weighted_losses(scene)[0].backward()  # constants are made in the first step
        forecaster.zero_grad()
        with Counted() as counted:
            forecaster.weighted_losses(scene)[0].backward()
        counts.append(counted.count)
    assert counts[1] - counts[0] <= most, counts
