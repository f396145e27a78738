"""Places on GPUs, which are files: no GPU is needed."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
from lightning.pytorch.accelerators import CPUAccelerator

from epo_lightning.experiment.assembly import build_trainer
from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.experiment.gpus import accelerator, place, placed
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder


def test_empty_gpus_are_taken_before_shared_ones(tmp_path: Path) -> None:
    with ExitStack() as stack:
        taken = [stack.enter_context(place(["a", "b"], 2, tmp_path)) for _ in range(4)]
    assert taken == [0, 1, 0, 1]
    with place(["a", "b"], 2, tmp_path) as number:
        assert number == 0, "places are given back"


def test_a_run_waits_for_a_free_gpu(tmp_path: Path) -> None:
    got = threading.Event()

    def wait() -> None:
        with place(["a"], 1, tmp_path):
            got.set()

    waiting = threading.Thread(target=wait)
    with place(["a"], 1, tmp_path):
        waiting.start()
        assert not got.wait(1.0)
    assert got.wait(5.0)
    waiting.join()


def test_a_user_without_a_name_takes_a_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container may run under a number that its /etc/passwd does not have."""

    def nameless() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    monkeypatch.setattr("getpass.getuser", nameless)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with place(["a"], 1) as number:
        assert number == 0
    assert list(tmp_path.glob("epo-gpus-*/a-0.lock"))


def test_runs_on_cpu_take_no_gpu() -> None:
    settings = TrainerSettings(accelerator="cpu", devices=3)
    with placed(settings) as devices:
        assert devices == 3


def test_a_run_on_several_gpus_takes_no_single_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> int:
        raise AssertionError("one of these GPUs is chosen")

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", fail)
    with placed(TrainerSettings(accelerator="gpu", devices=2)) as devices:
        assert devices == 2


@pytest.mark.parametrize("cuda", [False, True])
def test_gpus_are_those_of_cuda(cuda: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lightning would also take Apple's, which cannot sum scores in float64."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: cuda)
    monkeypatch.setattr("lightning.pytorch.accelerators.mps.MPSAccelerator.is_available", lambda: True)
    assert accelerator(TrainerSettings(accelerator="cpu")) == "cpu"
    auto = TrainerSettings(accelerator="auto")
    if cuda:
        assert accelerator(TrainerSettings(accelerator="gpu")) == accelerator(auto) == "cuda"
        return
    assert isinstance(build_trainer(auto, RunFolder(tmp_path), []).accelerator, CPUAccelerator)
    with pytest.raises(ConfigError, match=r"trainer\.accelerator=gpu needs a CUDA device"):
        accelerator(TrainerSettings(accelerator="gpu"))
    with pytest.raises(ConfigError, match=r"trainer\.graph=true needs a CUDA device"):
        accelerator(TrainerSettings(accelerator="auto", graph=True))
