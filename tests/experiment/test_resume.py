"""Runs that were stopped at an awkward moment, or moved, or went to another machine: they end as if nothing had been."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from experiment.conftest import TINY, Epo

from epo_lightning.experiment import train as training
from epo_lightning.experiment.callbacks import RandomStates
from epo_lightning.run_folder import RunFolder

WORSENING = ("train", "experiment=rpi/v_lstm_sc", *TINY, "optimizer.lr=0.05", "trainer.max_epochs=4", "score=test")
"""A step so large that the validation gets worse: the best epoch is not the last one."""


def same(one: str, two: str) -> bool:
    """Whether two runs have the same weights, scores and logs."""
    for which in ("best", "last"):
        a, b = (
            torch.load(RunFolder(Path(run)).checkpoint(which), weights_only=True)["state_dict"] for run in (one, two)
        )
        if not all(torch.equal(a[key], b[key]) for key in a):
            return False
    files = ("metrics.json", "logs/metrics.csv")
    records = [RunFolder(Path(run)).record for run in (one, two)]
    keys = ("status", "epochs", "steps", "best")
    return all((Path(one) / file).read_bytes() == (Path(two) / file).read_bytes() for file in files) and all(
        records[0][key] == records[1][key] for key in keys
    )


def stop_before_epoch(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power failure as the epoch begins."""
    original, starts = RandomStates.on_train_epoch_start, []

    def stop(self: RandomStates, trainer: object, module: object) -> None:
        starts.append(1)
        if len(starts) == number:
            raise RuntimeError("power failure")
        original(self, trainer, module)

    monkeypatch.setattr(RandomStates, "on_train_epoch_start", stop)


def begin_and_stop(epo: Epo, run: str, number: int, *words: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        stop_before_epoch(number, patch)
        with pytest.raises(RuntimeError, match="power failure"):
            epo(*WORSENING, f"run_dir={run}", *words)


def test_a_run_that_was_moved_keeps_its_best_epoch(epo: Epo) -> None:
    assert epo(*WORSENING, "run_dir=whole") == 0
    best = torch.load("whole/checkpoints/best.ckpt", weights_only=True)["epoch"]
    assert best < 2, "the validation has to get worse where the other run goes on"
    begin_and_stop(epo, "parts", 3)
    (Path.cwd() / "elsewhere").mkdir()
    shutil.move("parts", "elsewhere/moved")
    assert epo("train", "resume=elsewhere/moved") == 0
    assert same("whole", "elsewhere/moved")
    assert not Path("parts").exists()


def test_a_run_that_had_stopped_early_makes_no_further_step(epo: Epo) -> None:
    words = (*WORSENING, "callbacks.patience=1", "trainer.max_epochs=9")
    assert epo(*words, "run_dir=whole") == 0
    assert RunFolder(Path("whole")).record["epochs"] < 9

    def fail(*_: object) -> float:
        raise RuntimeError("power failure")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_best_score", fail)
        with pytest.raises(RuntimeError, match="power failure"):
            epo(*words, "run_dir=parts")
    assert epo("train", "resume=parts") == 0
    assert same("whole", "parts")
