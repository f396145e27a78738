"""Resuming of runs that were stopped at any moment, moved, or taken to another machine: equal results."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy
import pytest
import torch
from experiment.conftest import TINY, Epo
from lightning.pytorch import Trainer

from epo_lightning.experiment import train as training
from epo_lightning.experiment.callbacks import LastCheckpoint, RandomStates
from epo_lightning.experiment.csv_log import CSVLog
from epo_lightning.files import read_json
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder

WORSENING = ("train", "experiment=rpi/v_lstm_sc", *TINY, "optimizer.lr=0.05", "trainer.max_epochs=4", "score=test")
"""A step so large that the validation gets worse: the best epoch is not the last one."""


def without(key: str) -> tuple[str, ...]:
    """The command line without a key, which may be set only once."""
    return tuple(word for word in WORSENING if not word.startswith(f"{key}="))


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
    """A power failure as the epoch begins, when the one before it is stored."""
    original, starts = LastCheckpoint.on_train_epoch_start, []

    def stop(self: LastCheckpoint, trainer: Trainer, module: Forecaster) -> None:
        starts.append(1)
        original(self, trainer, module)
        if len(starts) == number:
            raise RuntimeError("power failure")

    monkeypatch.setattr(LastCheckpoint, "on_train_epoch_start", stop)


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


@pytest.mark.parametrize("logged", [False, True])
def test_a_run_that_is_stopped_at_the_end_of_an_epoch_logs_every_epoch_once(epo: Epo, logged: bool) -> None:
    assert epo(*WORSENING, "run_dir=whole") == 0
    log = CSVLog.log_metrics

    def stop(self: CSVLog, metrics: Mapping[str, float], step: int | None = None) -> None:
        ends = metrics["epoch"] == 1 and "train/loss" in metrics
        assert not ends or Path("parts/checkpoints/ended.ckpt").is_file(), (
            "the epoch is stored before its row is logged"
        )
        if logged or not ends:
            log(self, metrics, step)
        if ends:
            raise RuntimeError("power failure")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CSVLog, "log_metrics", stop)
        with pytest.raises(RuntimeError, match="power failure"):
            epo(*WORSENING, "run_dir=parts")
    assert torch.load("parts/checkpoints/last.ckpt", weights_only=True)["epoch"] == 0
    assert epo("train", "resume=parts") == 0
    assert same("whole", "parts")
    assert sorted(path.name for path in Path("parts/checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


def test_an_epoch_that_was_stored_before_its_row_was_logged_does_not_count(tmp_path: Path) -> None:
    last, ended = tmp_path / "last.ckpt", tmp_path / "ended.ckpt"
    last.write_text("the epoch before")
    ended.write_text("stopped before its row")
    kept, trainer = LastCheckpoint(tmp_path), cast(Trainer, SimpleNamespace(is_global_zero=True))
    module = cast(Forecaster, None)
    kept.on_fit_start(trainer, module)
    kept.on_train_epoch_start(trainer, module)
    assert last.read_text() == "the epoch before"
    ended.write_text("with its row")
    kept.on_train_end(trainer, module)
    assert last.read_text() == "with its row"


def test_a_run_of_an_earlier_version_continues_and_keeps_its_checkpoint_until_the_next_row_is_logged(
    epo: Epo, recwarn: pytest.WarningsRecorder
) -> None:
    begin_and_stop(epo, "begun", 2)
    file = Path("begun/checkpoints/last.ckpt")
    content = torch.load(file, weights_only=True)
    states = content["callbacks"]
    (state,) = (entry for key, entry in states.items() if "Checkpoint{'monitor': None" in key)
    for key in [key for key, entry in states.items() if entry is state]:
        states["ModelCheckpoint" + key[key.index("{") :]] = states.pop(key)
    state["best_model_path"] = str(file.resolve())
    torch.save(content, file)
    Path("linked").symlink_to("begun")

    def stop(self: CSVLog, metrics: Mapping[str, float], step: int | None = None) -> None:
        if "train/loss" in metrics:
            raise RuntimeError("power failure")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CSVLog, "log_metrics", stop)
        with pytest.raises(RuntimeError, match="power failure"):
            epo("train", "resume=linked")
    assert torch.load(file, weights_only=True)["epoch"] == 0
    assert not [entry for entry in recwarn if "callbacks used to create the checkpoint" in str(entry.message)]


def test_a_run_that_had_stopped_early_makes_no_further_step(epo: Epo) -> None:
    words = (*without("trainer.max_epochs"), "callbacks.patience=1", "trainer.max_epochs=9")
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


def test_a_continued_run_draws_the_random_numbers_of_an_uninterrupted_one(epo: Epo) -> None:
    """EBIOC draws noise in every step."""
    words = ("train", "experiment=table1/rpi_ebioc", "data=drawn", "budget=smoke", "trainer.max_epochs=3", "score=test")
    assert epo(*words, "run_dir=whole") == 0
    with pytest.MonkeyPatch.context() as patch:
        stop_before_epoch(3, patch)
        with pytest.raises(RuntimeError, match="power failure"):
            epo(*words, "run_dir=stopped")
    assert epo("train", "resume=stopped") == 0
    assert same("whole", "stopped")


def test_the_random_states_of_all_libraries_are_restored_before_the_batches_of_the_epoch_are_drawn(
    tmp_path: Path,
) -> None:
    def drawn() -> tuple[float, ...]:
        return torch.rand(1).item(), numpy.random.normal(), random.random()  # noqa: NPY002 - the global generator

    class Batches:
        def __iter__(self) -> Iterator[float]:
            self.first = drawn()
            return iter(())

    drawn()  # NumPy draws normal numbers two at a time and has kept the second one
    torch.save(RandomStates().state_dict(), tmp_path / "states")
    expected = [drawn(), drawn()]
    continued, batches = RandomStates(), Batches()
    continued.load_state_dict(torch.load(tmp_path / "states", weights_only=True))
    trainer: Any = SimpleNamespace(fit_loop=SimpleNamespace(_data_fetcher=batches))
    continued.on_train_epoch_start(trainer, trainer)
    assert [batches.first, drawn()] == expected
    continued.on_train_epoch_start(trainer, trainer)
    assert drawn() not in expected, "only the first epoch of a continued run begins with these states"


@pytest.mark.parametrize("between", [2, 3, 5, 8])
def test_a_run_that_validates_after_a_number_of_steps_goes_on_with_the_next_epoch(epo: Epo, between: int) -> None:
    """Epochs of four steps: validations are at their ends, or not, or at some of them."""
    words = (
        "trainer.max_epochs=null",
        "trainer.max_steps=18",
        f"trainer.validate_steps={between}",
    )
    kept = without("trainer.max_epochs")
    words = (*kept, *words, "trainer.limit_train_batches=4")
    assert epo(*words, "run_dir=whole") == 0
    with pytest.MonkeyPatch.context() as patch:
        stop_before_epoch(3, patch)
        with pytest.raises(RuntimeError, match="power failure"):
            epo(*words, "run_dir=parts")
    assert epo("train", "resume=parts") == 0
    assert same("whole", "parts")


@pytest.mark.parametrize(("during", "words"), [("test_step", ()), ("validation_step", ("budget=untrained",))])
def test_a_run_that_is_terminated_while_it_is_measured_ends(
    epo: Epo,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    during: str,
    words: tuple[str, ...],
) -> None:
    original = getattr(Forecaster, during)

    def terminate(self: Forecaster, *batch: object) -> object:
        os.kill(os.getpid(), signal.SIGTERM)
        return original(self, *batch)

    kept = without("budget") if words else WORSENING
    words = (*kept, *words, "trainer.limit_val_batches=1", "run_dir=parts", "existing=continue")
    before = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        patch.setattr(Forecaster, during, terminate)
        assert epo(*words) == 143
    run = RunFolder(Path("parts"))
    assert capsys.readouterr().err.endswith("epo: terminated; continue with `epo train resume=parts`\n")
    assert signal.getsignal(signal.SIGTERM) == before
    assert not run.metrics_file().exists()
    assert not run.locked
    assert epo("train", "resume=parts") == 0
    assert run.metrics_file().exists()
    assert epo("train", "resume=parts") == 2, "nothing is left to do"


def test_a_run_terminated_outside_lightning_loops_ends_at_once(
    epo: Epo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original = training._best_score

    def terminate(*arguments: object) -> float:
        os.kill(os.getpid(), signal.SIGTERM)
        return original(*arguments)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(training, "_best_score", terminate)
        assert epo(*WORSENING, "run_dir=parts") == 143
    assert RunFolder(Path("parts")).state == "interrupted"
    assert capsys.readouterr().err.endswith("epo: terminated; continue with `epo train resume=parts`\n")


def give_to(run: str, accelerator: str) -> None:
    """Change the record as if the run had begun on another machine."""
    file = RunFolder(Path(run)).config_file
    file.write_text(file.read_text().replace("accelerator: cpu", f"accelerator: {accelerator}"))
    assert RunFolder(Path(run)).config()["trainer"]["accelerator"] == accelerator


def test_a_run_that_began_on_a_gpu_is_finished_and_scored_on_a_cpu(epo: Epo) -> None:
    assert epo(*WORSENING, "run_dir=whole") == 0
    begin_and_stop(epo, "parts", 3)
    give_to("parts", "gpu")
    assert epo(*WORSENING, "run_dir=parts", "existing=continue") == 0
    assert same("whole", "parts")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_named(epo: Epo, refused: Callable[..., str]) -> None:
    assert epo(*WORSENING, "run_dir=run") == 0
    give_to("run", "gpu")
    RunFolder(Path("run")).metrics_file().unlink()
    assert "trainer.accelerator=gpu" in refused("evaluate", "run=run")
    said = refused(*WORSENING, "trainer.accelerator=gpu", "run_dir=other")
    assert "trainer.accelerator=gpu needs a CUDA device, and PyTorch sees none here" in said
    assert not Path("other").exists(), "nothing is left that would have to be continued"


def test_garbage_in_a_run_folder_is_named(tmp_path: Path) -> None:
    garbage = b"\xff\xfe\x00garbage"
    (tmp_path / "config.yaml").write_bytes(garbage)
    (tmp_path / "run.json").write_bytes(garbage)
    with pytest.raises(ConfigError, match=r"config\.yaml is not YAML"):
        RunFolder(tmp_path).config()
    with pytest.raises(ConfigError, match=r"run\.json is not JSON"):
        read_json(tmp_path / "run.json")


@contextmanager
def files_of_at_most(count: int) -> Iterator[None]:
    """A disk on which larger files find no place."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_named_and_the_run_can_continue_later(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo(*WORSENING, "run_dir=whole") == 0
    capsys.readouterr()
    with files_of_at_most(200_000):
        assert epo(*WORSENING, "run_dir=parts") == 1
    assert "epo: File too large" in capsys.readouterr().err
    run = RunFolder(Path("parts"))
    assert run.state == "failed"
    assert "File too large" in run.record["error"]
    assert not list(run.checkpoints.iterdir())
    assert epo("train", "resume=parts") == 0
    assert run.record["error"] is None
    assert same("whole", "parts")
