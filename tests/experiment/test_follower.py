"""What a follower takes over from its leader: the seed, the checkpoint, and all that decides how the training goes on."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.distributed as dist
from experiment import tiny
from experiment.conftest import TINY
from lightning.pytorch.callbacks import Checkpoint

from epo_lightning.experiment import assembly, callbacks, follower
from epo_lightning.experiment.config import compose
from epo_lightning.experiment.distributed import Place
from epo_lightning.run_folder import RunFolder


def test_a_follower_trains_as_its_leader_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """The leader alone writes and prints; a follower that decided otherwise would train another run."""
    words = ["experiment=rpi/v_lstm_sc", *TINY, "callbacks.patience=3", "run_dir=run", "seed=7"]
    config = compose.compose("train", words, [str(tiny.CONF)])
    task = {"run": "run", "config": config, "last": "run/checkpoints/last.ckpt"}
    monkeypatch.setattr(follower, "_find", lambda *_: SimpleNamespace(get=lambda key: json.dumps(task)))
    seen: dict[str, Any] = {}

    def trainer(settings: Any, run: RunFolder, deciding: list[Any], devices: Any, strategy: Any) -> SimpleNamespace:
        seen.update(run=run.path, kinds=[type(one) for one in deciding], devices=devices, place=strategy.place)
        return SimpleNamespace(
            fit=lambda model, data, **words: seen.update(model=model, order=data.order_seed, **words)
        )

    monkeypatch.setattr(assembly, "build_trainer", trainer)
    torch.manual_seed(1)
    follower.follow(Place(1, 2, 1234))
    assert seen["ckpt_path"] == "run/checkpoints/last.ckpt"
    assert (seen["run"], seen["order"], seen["devices"], seen["place"]) == (Path("run"), 7, 1, Place(1, 2, 1234))
    decide = {callbacks.NextEpoch, callbacks.RandomStates, callbacks.EarlyStopping, callbacks.ModelCheckpoint}
    assert {*seen["kinds"]} == decide | {callbacks.LastCheckpoint}
    assert sum(issubclass(kind, Checkpoint) for kind in seen["kinds"]) == 2
    first = {name: value.clone() for name, value in seen["model"].state_dict().items()}
    drawn = torch.rand(3)
    torch.manual_seed(2)
    follower.follow(Place(1, 2, 1234))
    assert all(torch.equal(value, seen["model"].state_dict()[name]) for name, value in first.items())
    assert torch.equal(torch.rand(3), drawn)


def test_a_follower_of_a_finished_run_waits_for_no_leader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task of Slurm that starts again after the run has ended: its leader trains nothing and opens no store."""

    searched = []

    def no_store(*_: object, **__: object) -> None:
        searched.append(True)
        raise dist.DistNetworkError("refused")

    monkeypatch.setattr(follower, "PATIENCE", 0.0)
    monkeypatch.setattr(follower.dist, "TCPStore", no_store)
    run = RunFolder(tmp_path)
    run.path.mkdir(exist_ok=True)
    run.record_file.write_text(json.dumps({"status": "finished"}))
    follower.follow(Place(1, 2, 1234), run)
    assert searched == [True], "the store is searched once, and then the record of the run is read"
