"""A registered metric from the training to the report."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from experiment.conftest import Epo
from torch import Tensor

from epo_lightning import registry
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.scene import Scene


def top_speed(forecast: JointForecast, scene: Scene) -> Tensor:
    """The largest speed in any mode."""
    return forecast.states[..., 3].flatten(1).amax(1)


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Registers metrics by name in the place of all others, until the end of the test."""
    return lambda **metrics: monkeypatch.setattr(registry, "_PARTS", {**registry._PARTS, "metric": metrics})


def table_of(report: Path) -> str:
    """The table of further metrics in a report."""
    return (report / "results.md").read_text().partition("further metrics\n\n")[2].partition("\n\n")[0]


def test_older_runs_get_the_metric_when_they_are_evaluated_again(
    epo: Epo, tmp_path: Path, own: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("data=drawn", "budget=smoke", "callbacks.progress=none", "score=test", "seed=0")
    assert epo("train", "experiment=rpi/const_vel", *words) == 0
    own(**{"top speed": top_speed})
    assert epo("train", "experiment=rpi/v_lstm_sc", *words, "callbacks.monitor=val/own/top speed") == 0
    assert epo("report", "runs=runs", "out=before") == 0
    before = table_of(tmp_path / "before")
    assert "| V-LSTM + SC |" in before
    assert "| Constant velocity |" not in before
    capsys.readouterr()
    assert epo("evaluate", "runs=runs") == 0
    assert capsys.readouterr().out.count(", own/top speed ") == 2
    assert epo("report", "runs=runs", "out=after") == 0
    after = table_of(tmp_path / "after")
    assert "| top speed |" in after
    assert "| Constant velocity |" in after
    assert "own and" not in (tmp_path / "after" / "results.md").read_text(), "no subset of scenes has this name"


def test_metrics_that_some_runs_lack_and_corrected_ones_do_not_prevent_a_report(
    epo: Epo, tmp_path: Path, own: Callable[..., None]
) -> None:
    """A metric has no value for the scenes of one seed, has another name later, or another formula."""

    def stored(seed: int) -> dict[str, float]:
        found = json.loads((tmp_path / "runs" / f"s{seed}" / "metrics.json").read_text())["metrics"]
        return {name: value for name, value in found.items() if name.startswith("own/")}

    words = ("experiment=rpi/v_lstm_sc", "data=drawn", "budget=smoke", "callbacks.progress=none", "score=test")
    for seed in (0, 1):
        own(**({"speed": top_speed} if seed else {"other": top_speed}))
        assert epo("train", *words, f"seed={seed}", f"run_dir=runs/s{seed}") == 0
    assert epo("report", "runs=runs", "out=first") == 0
    own(speed=lambda forecast, scene: 2 * top_speed(forecast, scene))
    before = stored(1)["own/speed"]
    assert epo("evaluate", "runs=runs") == 0
    assert stored(0).keys() == {"own/other", "own/speed"}
    assert stored(1) == {"own/speed": pytest.approx(2 * before)}
    assert not list(tmp_path.rglob("scores-*.json"))
    assert epo("report", "runs=runs", "out=second") == 0
    mean = (stored(0)["own/speed"] + stored(1)["own/speed"]) / 2
    assert f"{mean:.3f}" in table_of(tmp_path / "second")


def test_a_metric_that_fails_is_found_before_the_first_step(
    epo: Epo,
    tmp_path: Path,
    own: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(forecast: JointForecast, scene: Scene) -> Tensor:
        return forecast.speeds  # type: ignore[attr-defined,no-any-return]

    own(broken=broken)
    steps: list[int] = []
    monkeypatch.setattr(Forecaster, "training_step", lambda self, scene, index: steps.append(index))
    assert epo("train", "experiment=rpi/v_lstm_sc", "data=drawn", "budget=smoke", "callbacks.progress=none") == 2
    assert "the metric 'broken' fails at" in capsys.readouterr().err
    assert not steps


def test_a_monitored_score_may_be_missing_in_the_first_validated_batch(
    epo: Epo, tmp_path: Path, own: Callable[..., None]
) -> None:
    """Two batches are validated after training; the score has values in the second one only."""
    calls: list[int] = []

    def late(forecast: JointForecast, scene: Scene) -> Tensor:
        calls.append(len(scene.history))
        speed = top_speed(forecast, scene)
        return speed if len(calls) > 2 else speed * float("nan")

    own(late=late)
    words = (
        "experiment=rpi/v_lstm_sc",
        "data=drawn",
        "budget=smoke",
        "callbacks.progress=none",
        "trainer.max_epochs=1",
    )
    assert epo("train", *words, "callbacks.monitor=val/own/late", "run_dir=runs/late") == 0
    assert len(calls) > 2
    assert json.loads((tmp_path / "runs" / "late" / "run.json").read_text())["best"]["val/own/late"] > 0


def test_a_monitored_metric_without_a_value_decides_nothing_also_after_a_stop(
    epo: Epo,
    tmp_path: Path,
    own: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The metric has values in the first validation only; a run that is stopped after it ends as one that is not."""

    def early(forecast: JointForecast, scene: Scene) -> Tensor:
        speed = top_speed(forecast, scene)
        return speed if epoch[0] == 0 else speed * float("nan")

    def begin(self: Forecaster) -> None:
        epoch[0] = self.current_epoch
        if epoch[0] == stop:
            raise RuntimeError("power failure")
        original(self)

    epoch, original = [0], Forecaster.on_train_epoch_start
    own(early=early)
    monkeypatch.setattr(Forecaster, "on_train_epoch_start", begin)
    words = (
        "experiment=rpi/v_lstm_sc",
        "data=drawn",
        "budget=smoke",
        "callbacks.progress=lines",
        "trainer.max_epochs=3",
    )
    monitor = "callbacks.monitor=val/own/early"
    stop = -1
    with pytest.warns(UserWarning, match="val/own/early has no value in a validation"):
        assert epo("train", *words, monitor, "run_dir=runs/whole") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "epoch" in line]
    assert ["val/own/early nan" in line for line in lines] == [False, True, True]
    stop, epoch[0] = 1, 0
    with pytest.raises(RuntimeError, match="power failure"):
        epo("train", *words, monitor, "run_dir=runs/parts")
    stop = -1
    with pytest.warns(UserWarning, match="val/own/early has no value in a validation"):
        assert epo("train", "resume=runs/parts") == 0
    records = [json.loads((tmp_path / "runs" / name / "run.json").read_text()) for name in ("whole", "parts")]
    assert records[0]["best"] == records[1]["best"]


def test_a_metric_that_has_no_value_any_more_loses_its_earlier_one(
    epo: Epo, tmp_path: Path, own: Callable[..., None]
) -> None:
    own(speed=top_speed, gone=top_speed)
    words = ("experiment=rpi/const_vel", "data=drawn", "budget=smoke", "callbacks.progress=none", "score=test")
    assert epo("train", *words, "run_dir=runs/one") == 0
    own(speed=lambda forecast, scene: top_speed(forecast, scene) * float("nan"))
    assert epo("evaluate", "run=runs/one") == 0
    found = json.loads((tmp_path / "runs" / "one" / "metrics.json").read_text())["metrics"]
    assert {name for name in found if "own/" in name} == {"own/gone", "executed/own/gone", "alternative/own/gone"}


def test_a_monitored_metric_without_any_value_is_named(
    epo: Epo, own: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    own(never=lambda forecast, scene: top_speed(forecast, scene) * float("nan"))
    words = ("experiment=rpi/v_lstm_sc", "data=drawn", "budget=smoke", "callbacks.progress=none")
    with pytest.warns(UserWarning, match="has no value in a validation"):
        assert epo("train", *words, "callbacks.monitor=val/own/never", "run_dir=runs/never") == 2
    assert "no validation has a value of callbacks.monitor=val/own/never" in capsys.readouterr().err
