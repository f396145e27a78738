"""The order of a training's scenes, its validations, its early stop, and how its best checkpoint is scored."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from experiment import tiny
from experiment.conftest import TINY, Epo

from epo_lightning.experiment import assembly, callbacks, evaluate
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_checkpoint
from epo_lightning.files import read_json
from epo_lightning.forecasters.checkpoint import read_checkpoint
from epo_lightning.forecasters.step_means import StepMeans
from epo_lightning.metrics.forecast import EQUILIBRIUM_METRICS
from epo_lightning.run_folder import RunFolder, read_log
from epo_lightning.schema import read

WORDS = ("train", "experiment=rpi/v_lstm_sc", *TINY, "trainer.max_epochs=4")
"""Four epochs of four steps."""


def validated(run: str) -> list[int]:
    """The optimisation steps after which a run was validated, counted from zero."""
    rows = read_log(RunFolder(Path(run)).logs / "metrics.csv")
    return [int(row["step"]) for row in rows if row.get("val/minSADE")]


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("trainer.validate_every=1", [3, 7, 11, 15]),
        ("trainer.validate_every=2", [7, 15]),
        ("trainer.validate_steps=3", [2, 5, 8, 11, 14]),
    ],
)
def test_a_training_is_validated_as_often_as_configured(epo: Epo, setting: str, expected: list[int]) -> None:
    assert epo(*WORDS, setting, "run_dir=run") == 0
    assert validated("run") == expected


@pytest.mark.parametrize(("given", "epochs"), [("0", 0), ("3", 3), ("null", -1)])
def test_zero_epochs_are_none_and_no_number_is_no_limit(given: str, epochs: int, tmp_path: Path) -> None:
    words = ["experiment=rpi/v_lstm_sc", "data=drawn", f"trainer.max_epochs={given}", "trainer.max_steps=9"]
    settings = read(Settings, compose("train", words))
    assert assembly.build_trainer(settings.trainer, RunFolder(tmp_path), []).max_epochs == epochs


@pytest.mark.parametrize(("least", "epochs"), [(0.0, 4), (100.0, 3)])
def test_an_improvement_below_min_delta_is_none(epo: Epo, least: float, epochs: int) -> None:
    words = ("optimizer.lr=0.0001", "callbacks.patience=2", f"callbacks.min_delta={least}")
    assert epo(*WORDS, *words, "run_dir=run") == 0
    rows = read_log(RunFolder(Path("run")).logs / "metrics.csv")
    scores = [float(row["val/minSADE"]) for row in rows if row.get("val/minSADE")]
    assert RunFolder(Path("run")).record["epochs"] == len(scores) == epochs


def test_a_run_is_scored_by_its_best_checkpoint(epo: Epo) -> None:
    worsening = ("optimizer.lr=0.05", "trainer.limit_val_batches=1.0", "score=val")
    assert epo(*WORDS, *worsening, "run_dir=run") == 0
    run = RunFolder(Path("run"))
    scores = [float(row["val/minSADE"]) for row in read_log(run.logs / "metrics.csv") if row.get("val/minSADE")]
    assert scores[-1] > 1.01 * min(scores), "the last epoch is not the best one"
    assert run.record["best"] == {"val/minSADE": pytest.approx(min(scores))}
    scored = read_json(run.metrics_file("val"))
    assert scored["checkpoint"] == "best"
    assert scored["metrics"]["minSADE"] == pytest.approx(min(scores), rel=1e-5)


def test_the_best_checkpoint_has_the_weights_of_its_validation_also_within_an_epoch(epo: Epo) -> None:
    words = ("optimizer.lr=0.05", "trainer.limit_val_batches=1.0", "trainer.validate_steps=3")
    assert epo(*WORDS, *words, "run_dir=run") == 0
    run = RunFolder(Path("run"))
    rows = read_log(run.logs / "metrics.csv")
    scores = {int(row["step"]) + 1: float(row["val/minSADE"]) for row in rows if row.get("val/minSADE")}
    best = min(scores, key=lambda step: scores[step])
    assert best % 4, "the best validation is that of the end of an epoch"
    assert read_checkpoint(run.checkpoint("best"))["global_step"] == best


def test_an_evaluation_draws_from_the_seed_of_the_run_whatever_was_drawn_before(
    epo: Epo, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A forecaster may draw its forecasts; its scores must not depend on the runs that are scored before it."""
    assert epo("train", "experiment=rpi/const_vel", *TINY, "seed=3", "run_dir=run") == 0
    drawn: list[float] = []

    def opened(*words: Any) -> Any:
        forecaster = open_checkpoint(*words)
        forecaster.register_forward_pre_hook(lambda *_: drawn.append(torch.rand(1).item()))
        return forecaster

    monkeypatch.setattr(evaluate, "open_checkpoint", opened)
    for before in (1, 2):
        torch.manual_seed(before)
        assert epo("evaluate", "run=run", "batch_size=16") == 0
    assert len(drawn) == 2 * 4, "four batches each"
    assert drawn[:4] == drawn[4:]
    torch.manual_seed(3)
    assert drawn[0] == torch.rand(1).item()


def test_true_costs_are_those_of_the_games_that_are_scored(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(evaluate, "RPIData", tiny.Tiny)
    monkeypatch.setattr(tiny.Tiny, "records", lambda _, split: {"weight": split}, raising=False)
    monkeypatch.setattr(evaluate, "TruthTest", asked.append)
    assert epo("train", "experiment=rpi/const_vel", *TINY, "run_dir=run") == 0
    for split in ("val", "test"):
        assert epo("evaluate", "run=run", f"split={split}") == 0
    assert asked == ["val", "test"]


def test_the_equilibrium_of_games_is_measured_in_tests_and_not_in_validations(epo: Epo) -> None:
    assert epo("train", "experiment=rpi/v_lstm_epo", *TINY, "score=test", "run_dir=run") == 0
    run = RunFolder(Path("run"))
    assert set(EQUILIBRIUM_METRICS) < read_json(run.metrics_file())["metrics"].keys()
    logged = {name for row in read_log(run.logs / "metrics.csv") for name in row}
    assert "val/minSADE" in logged
    assert not {f"val/{name}" for name in EQUILIBRIUM_METRICS} & logged


def test_runs_of_different_seeds_see_the_same_scenes_in_different_orders() -> None:
    orders = []
    for seed in (0, 0, 1):
        words = ["experiment=rpi/v_lstm_sc", "data=drawn", "data.scenes=64", "budget=smoke", f"seed={seed}"]
        data, _ = assembly.build(read(Settings, compose("train", words)))
        data.setup("fit")
        orders.append([number for scene in data.train_dataloader() for number in scene.id.tolist()])
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == sorted(orders[2])


def test_progress_lines_of_a_resumed_run_know_its_best_score(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = callbacks.ModelCheckpoint(tmp_path, monitor="val/minSADE")
    kept.best_model_score = torch.tensor(0.1)
    trainer: Any = SimpleNamespace(
        sanity_checking=False,
        checkpoint_callbacks=[kept],
        callback_metrics={"val/minSADE": torch.tensor(0.3)},
        current_epoch=4,
        max_epochs=9,
        global_step=50,
    )
    model: Any = SimpleNamespace(step_means=StepMeans())
    model.step_means.add({"train/loss": torch.tensor(1.0)}, 32)
    lines = callbacks.EpochLines("a run", "val/minSADE")
    for hook in (lines.on_train_start, lines.on_validation_end, lines.on_train_epoch_end):
        hook(trainer, model)
    assert "epoch 5/9, step 50, loss 1.0000, val/minSADE 0.3000 (best 0.1000)" in capsys.readouterr().out


def test_a_line_names_the_step_of_its_validation_if_the_epoch_goes_on_after_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    trainer: Any = SimpleNamespace(
        sanity_checking=False,
        checkpoint_callbacks=[],
        callback_metrics={"val/minSADE": torch.tensor(0.3)},
        current_epoch=1,
        max_epochs=-1,
        global_step=200,
    )
    model: Any = SimpleNamespace(step_means=StepMeans())
    model.step_means.add({"train/loss": torch.tensor(1.0)}, 32)
    lines = callbacks.EpochLines("a run", "val/minSADE")
    lines.on_train_start(trainer, model)
    lines.on_validation_end(trainer, model)
    trainer.global_step = 380
    lines.on_train_epoch_end(trainer, model)
    assert "epoch 2, step 380, loss 1.0000, val/minSADE 0.3000 (at step 200, best 0.3000)" in capsys.readouterr().out
    lines.on_train_epoch_end(trainer, model)
    assert capsys.readouterr().out == ""


def test_a_long_scoring_says_how_far_it_is(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 10.0, 40.0, 50.0, 80.0])
    monkeypatch.setattr(callbacks.time, "monotonic", lambda: next(clock))
    lines = callbacks.ScoringLines(scenes=50)
    batch: Any = SimpleNamespace(history=range(10))
    for number in range(4):
        lines.on_test_batch_end(None, None, None, batch, number)  # type: ignore[arg-type]
    assert capsys.readouterr().out.splitlines() == [
        "20 of 50 scenes scored, about 60 s left",
        "40 of 50 scenes scored, about 20 s left",
    ]


def test_a_check_of_a_configuration_draws_no_random_numbers() -> None:
    settings = read(Settings, compose("train", ["experiment=rpi/v_lstm_sc", "data=drawn", "data.like=rpi"]))
    before = torch.get_rng_state()
    assembly.check_buildable(settings)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_progress_of_a_continued_run_says_from_which_step_it_went_on(tmp_path: Path) -> None:
    trainer: Any = SimpleNamespace(global_step=40, estimated_stepping_batches=100.0, max_steps=-1)
    run, often, seldom = RunFolder(tmp_path), callbacks.Progress(RunFolder(tmp_path), every=0.0), math.inf
    often.on_train_batch_end(trainer)
    assert not run.progress, "the training has not begun"
    often.on_train_start(trainer, trainer)
    trainer.global_step = 41
    often.on_train_batch_end(trainer)
    assert {key: run.progress[key] for key in ("step", "from_step", "steps")} == {
        "step": 41,
        "from_step": 40,
        "steps": 100,
    }
    rarely = callbacks.Progress(run, every=seldom)
    trainer.estimated_stepping_batches = math.inf
    rarely.on_train_start(trainer, trainer)
    assert (run.progress["from_step"], run.progress["steps"]) == (41, None)
    trainer.global_step = 42
    rarely.on_train_batch_end(trainer)
    rarely.on_validation_batch_end(trainer)
    assert run.progress["step"] == 41, "the file is written every few seconds"


def test_a_training_that_is_shorter_than_the_steps_between_validations_is_validated_at_its_end(epo: Epo) -> None:
    assert epo(*WORDS, "trainer.max_steps=3", "trainer.validate_steps=200", "run_dir=run") == 0
    assert validated("run") == [2]


def test_a_training_that_ends_before_its_first_validation_says_so(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo(*WORDS, "trainer.max_steps=2", "trainer.validate_every=4", "run_dir=run") == 2
    assert "ended after 2 steps, before its first validation" in capsys.readouterr().err
