"""What a sweep does again: runs that broke down, times of another device, and the choices of a search."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from experiment.conftest import TINY, Epo

from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.experiment.sweeps import sweeping
from epo_lightning.experiment.sweeps.sweep import Job, Sweep
from epo_lightning.files import write_json
from epo_lightning.run_folder import RunFolder


class Watched:
    """A sweep whose runs have these states for ever."""

    def __init__(self, states: dict[str, str]) -> None:
        self.jobs = [cast(Job, SimpleNamespace(overrides=[name], run=name)) for name in states]
        self.states, self.given_up = states, list[object]()

    def state(self, job: Job) -> str:
        return self.states[job.overrides[0]]

    def fail(self, run: object, message: str) -> None:
        assert message == sweeping.KILLED
        self.given_up.append(run)


def test_runs_whose_process_dies_in_every_attempt_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that have failed say why themselves, and those that have not begun can begin later."""
    states = {"a": "interrupted", "b": "trained, not scored", "c": "failed", "d": "waiting", "e": "done"}
    sweep, launched = Watched(states), []

    def launch(name: str, words: object, jobs: list[list[str]], *_: object) -> None:
        launched.append("".join(job[0] for job in jobs))
        raise RuntimeError("out of memory")

    monkeypatch.setattr(sweeping.compose, "launch", launch)
    sweeping._launch(cast(Sweep, sweep), sweep.jobs, [], print, [])
    assert launched == ["abcde", "abd", "abd"]
    assert sweep.given_up == ["a", "b"]


@pytest.mark.parametrize(("trials", "more"), [(5, ["hydra.sweeper.n_trials=3"]), (2, None), (1, None), (None, [])])
def test_a_search_that_continues_chooses_the_runs_that_it_lacks(
    trials: int | None, more: list[str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep, given = Watched({"a": "done", "b": "interrupted"}), list[list[str]]()
    launched: list[list[list[str]]] = []
    monkeypatch.setattr(sweeping.compose, "launch", lambda name, words, jobs, *_: launched.append(jobs))
    monkeypatch.setattr(sweeping.compose, "trials", lambda *_: trials)
    monkeypatch.setattr(sweeping.compose, "multirun", lambda name, words, *_: given.append(words))
    assert sweeping._search(cast(Sweep, sweep), ["data=drawn"], print, [])
    assert launched == [[["b"]]], "runs that were chosen before are finished first"
    assert given == ([] if more is None else [["data=drawn", *more]])


def test_a_search_that_ended_early_is_not_done(
    epo: Epo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def end(*_: object) -> None:
        raise RuntimeError("no run gave a result")

    monkeypatch.setattr(sweeping, "_listed", lambda *_: [])
    monkeypatch.setattr(sweeping.compose, "trials", lambda *_: 4)
    monkeypatch.setattr(sweeping.compose, "multirun", end)
    assert epo("sweep", "rpi_main", *TINY) == 1
    said = capsys.readouterr().out
    assert "the search ended early (RuntimeError: no run gave a result)" in said
    assert "next: epo report" not in said
    assert not list(Path("runs").glob("rpi"))


@pytest.mark.parametrize(
    ("device", "accelerator", "kept"),
    [
        ("cpu", "auto", True),
        ("cpu", "cpu", True),
        ("cpu", "gpu", False),
        ("cuda", "auto", True),
        ("cuda", "gpu", True),
        ("cuda", "cpu", False),
    ],
)
def test_times_of_another_device_are_measured_again(device: str, accelerator: str, kept: bool, tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    write_json(run.metrics_file("time"), {"device": device, "threads": 1})
    sweeping._set_aside(run, TrainerSettings(accelerator=accelerator, threads=1))
    aside = tmp_path / f"runtime-{'cpu' if device == 'cpu' else 'gpu'}-1.json"
    assert (run.metrics_file("time").is_file(), aside.is_file()) == (kept, not kept)


def test_words_of_the_data_are_no_words_of_runs_and_drawn_scenes_are_not_made(
    epo: Epo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[tuple[str, bool, int]] = []
    monkeypatch.setattr(
        sweeping, "make_data", lambda settings: made.append((settings.data["name"], settings.strict, settings.workers))
    )
    words = ("strict=false", "workers=3", "progress=false", "seed=0", "experiment=rpi/const_vel,rpi/v_lstm")
    assert epo("sweep", "generate", "rpi_main", *words, "data=rpi") == 0
    assert made == [("rpi", False, 3)], "once, although two rows have it"
    assert epo("sweep", "generate", "rpi_main", *words, "data=drawn") == 0
    assert len(made) == 1
    assert "draws its scenes in memory: there is nothing to make" in capsys.readouterr().out
