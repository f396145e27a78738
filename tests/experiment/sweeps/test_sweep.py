"""Sweeps: every run is trained exactly once, despite interruptions, and failures are reported."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import yaml
from experiment import tiny
from experiment.conftest import TINY, Epo
from experiment.sweeps.rpi_sweep import SRC, the_sweep

from epo_lightning.experiment.sweeps import sweeping
from epo_lightning.experiment.sweeps.sweep import Job, Sweep
from epo_lightning.experiment.sweeps.watch import result
from epo_lightning.files import read_json
from epo_lightning.run_folder import RunFolder, discover

SWEEP = ("sweep", "rpi_main", *TINY, "seed=0,1", "score=test")


ROWS = ("const_vel", "v_lstm", "v_lstm_sc", "v_lstm_epo")


def marks(sweep: Sweep) -> dict[str, tuple[float, float]]:
    """When each run's last checkpoint and scores were written."""
    return {
        str(job.run.path): (
            job.run.checkpoint("last").stat().st_mtime_ns,
            job.run.metrics_file().stat().st_mtime_ns,
        )
        for job in sweep.jobs
    }


def test_a_sweep_trains_and_scores_every_run_once(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo(*SWEEP) == 0
    sweep = the_sweep()
    assert len(sweep.jobs) == 8
    assert {sweep.state(job) for job in sweep.jobs} == {"done"}
    assert {job.run.path.parent.name for job in sweep.jobs} == set(ROWS)
    assert all(job.identity == job.run.record["identity"] for job in sweep.jobs)
    out = capsys.readouterr().out
    assert "8 runs: 8 done" in out
    assert "[8/8]" in out
    before = marks(sweep)
    assert epo(*SWEEP) == 0
    assert marks(sweep) == before, "a finished run was run again"
    # What is missing, and only that, is done.
    first, second = sweep.jobs[2].run, sweep.jobs[3].run
    first.metrics_file().unlink()
    second.update(status="training")
    second.metrics_file().unlink()
    assert [sweep.state(sweep.jobs[i]) for i in (2, 3)] == ["trained, not scored", "interrupted"]
    capsys.readouterr()
    assert epo("sweep", "status", "rpi_main") == 0
    shown = capsys.readouterr().out
    assert "6 done, 1 interrupted, 1 trained, not scored" in shown
    assert "lacks test" in shown
    assert f"it also scores what is trained; a single run: epo evaluate run={first.path}\n" in shown
    assert epo(*SWEEP) == 0
    assert {sweep.state(job) for job in sweep.jobs} == {"done"}
    assert {path for path, mark in marks(sweep).items() if mark != before[path]} == {str(first.path), str(second.path)}


def test_runs_that_an_edited_sweep_has_no_longer_are_counted(
    epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "conf" / "sweeps" / "mine.yaml"
    file.parent.mkdir(parents=True)
    words = ("sweep", "mine", f"--config-dir={tmp_path / 'conf'}", "data=tiny", "budget=untrained")

    def said(seeds: str) -> str:
        text = f"# @package _global_\nhydra: {{sweeper: {{params: {{experiment: rpi/v_lstm, seed: '{seeds}'}}}}}}\n"
        file.write_text(text)
        os.utime(file, (len(seeds), len(seeds)))  # files are read again when their time has changed
        capsys.readouterr()
        assert epo(*words) == 0
        return capsys.readouterr().out

    assert "no longer" not in said("0,1,2")
    assert (
        said("1").count(
            "2 runs of earlier starts are no longer part of this sweep, because files that it reads have changed"
        )
        == 2
    )
    assert epo("sweep", "status", "mine") == 0
    out = capsys.readouterr().out
    assert re.search(r"2 runs of .*; the folder stays: \S+/runs/rpi/v_lstm/untrained-s0-\w+\n", out)
    assert "1 run of an earlier start is no longer part" in said("1,0")
    assert "no longer" not in said("0,1,2,3")


def test_a_failed_run_is_reported_and_does_not_stop_the_others(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    words = (*SWEEP, "optimizer.lr=1e25")
    assert epo(*words) == 1
    sweep = the_sweep()
    states = [sweep.state(job) for job in sweep.jobs]
    assert states.count("failed") == 6
    assert states.count("done") == 2, "constant velocity learns nothing, so nothing can go wrong"
    captured = capsys.readouterr()
    assert captured.out.count("FAILED") == 6
    assert "without a single finite validation score" in captured.out
    assert "Traceback" not in captured.out + captured.err
    failures = sorted((sweep.folder / "failures").iterdir())
    assert len(failures) == 6
    assert "Traceback" in failures[0].read_text()
    assert all(job.run.record["status"] == "failed" for job in sweep.jobs if sweep.state(job) == "failed")


@pytest.mark.slow
def test_a_run_that_fails_again_is_reported_again(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    words = (*SWEEP, "optimizer.lr=1e25")
    assert epo(*words) == 1
    capsys.readouterr()
    assert epo(*words) == 1
    news = re.findall(r"^\[(\d)/8\] .*, seed \d: (\w+)", capsys.readouterr().out, re.MULTILINE)
    # Two runs of constant velocity are done already.
    assert news == [(str(number), "FAILED") for number in range(3, 9)]


def test_a_sweep_stops_at_a_failure_if_asked_to(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo(*SWEEP, "optimizer.lr=1e25", "--stop-on-failure") == 1
    assert "2 done, 1 failed, 5 waiting" in capsys.readouterr().out


def test_a_second_start_of_a_running_sweep_is_refused(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("sweep", "rpi_main", *TINY, "seed=0", "score=test", "experiment=rpi/v_lstm") == 0
    with the_sweep().lock():
        assert epo("sweep", "rpi_main", *TINY, "seed=0", "score=test", "experiment=rpi/v_lstm") == 2
    message = capsys.readouterr().err
    assert "runs already (process" in message
    assert "epo sweep status" in message


def test_two_processes_do_not_train_the_same_run(epo: Epo, refused: Callable[..., str]) -> None:
    words = ("train", "experiment=rpi/v_lstm", *TINY, "run_dir=run")
    assert epo(*words) == 0
    run = RunFolder(Path("run"))
    run.update(status="training")
    assert run.state == "interrupted"
    with run.lock():
        assert run.state == "running"
        assert "another process" in refused("train", "resume=run")
    assert run.state == "interrupted"


def test_a_run_killed_before_its_start_is_started_again(epo: Epo) -> None:
    words = ("sweep", "rpi_main", *TINY, "seed=0", "score=test", "experiment=rpi/v_lstm")
    assert epo(*words) == 0
    (job,) = the_sweep().jobs
    for path in sorted(job.run.path.rglob("*"), reverse=True):
        if path.name != "config.yaml":
            path.rmdir() if path.is_dir() else path.unlink()
    (job.run.path / ".run.json-abc").touch()
    assert the_sweep().state(job) == "waiting"
    assert epo(*words) == 0
    assert the_sweep().state(job) == "done"


def test_one_damaged_run_does_not_hide_the_others(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/v_lstm,rpi/const_vel") == 0
    the_sweep().jobs[0].run.record_file.write_text("{")
    capsys.readouterr()
    assert epo("sweep", "status", "rpi_main") == 0
    out = capsys.readouterr().out
    assert "1 done, 1 failed" in out
    assert "is not JSON" in " ".join(out.split())


@pytest.mark.parametrize("place", ["a,b x(1)=it's", "[z]{k}über", "#5", "~t", 'q"q a:b'])
def test_folders_may_have_any_name(epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    (tmp_path / place).mkdir()
    monkeypatch.chdir(tmp_path / place)
    assert epo("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/const_vel") == 0
    assert list((tmp_path / place).glob("runs/rpi/const_vel/*/run.json"))


def test_times_with_other_thread_counts_are_measured_again(epo: Epo) -> None:
    words = ("sweep", "rpi_main", "data=drawn", "budget=untrained", "seed=0", "experiment=rpi/v_lstm", "score=time")
    for threads in (1, 2, 1, 2):
        assert epo(*words, f"trainer.threads={threads}") == 0
        (job,) = the_sweep().jobs
        assert json.loads(job.run.metrics_file("time").read_text())["threads"] == threads
    for name, threads in (("cpu-1", 1), ("cpu-1-2", 1), ("cpu-2", 2)):
        assert json.loads((job.run.path / f"runtime-{name}.json").read_text())["threads"] == threads, "nothing is lost"


def test_a_run_is_done_when_all_measurements_exist(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("sweep", "rpi_main", "data=drawn", "data.scenes=32", "budget=untrained", "seed=0", "experiment=rpi/v_lstm")
    assert epo(*words, "score=test") == 0
    (job,) = the_sweep().jobs
    folder, scores = job.run.path, job.run.metrics_file().stat().st_mtime_ns
    assert epo(*words, "score=[time,test]") == 0
    sweep = Sweep.find("rpi_main", (*words[2:], "score=[time,test]"), "runs")
    (job,) = sweep.jobs
    assert job.measures == ("test", "time")
    assert job.run.path == folder, "what is measured makes it another run"
    assert sweep.state(job) == "done"
    assert job.run.metrics_file().stat().st_mtime_ns == scores, "it was scored again"
    capsys.readouterr()
    for which in job.measures:
        job.run.metrics_file(which).rename(folder / "aside")
        assert sweep.state(job) == "trained, not scored"
        (folder / "aside").rename(job.run.metrics_file(which))
    scores = r"val/minSADE \d+\.\d{4}, test/minSADE \d+\.\d{4}"
    assert re.fullmatch(scores + r", \d+ s of training, \d+\.\d ms per forecast", result(job))
    assert epo(*words, "score=[time,test]", "trainer.threads=2") == 0
    assert (folder / "runtime-cpu-1.json").is_file(), "another time that was measured as well"


@pytest.mark.parametrize(
    ("launcher", "word", "message"),
    [
        ("slurm", "hydra.launcher.time=3", "unknown key 'hydra.launcher.time' in hydra.launcher: did you mean"),
        (
            "local",
            "hydra.launcher.n_job=2",
            "unknown key 'hydra.launcher.n_job' in hydra.launcher: did you mean 'n_jobs'",
        ),
    ],
)
def test_an_unknown_key_of_a_launcher_is_named(
    refused: Callable[..., str], launcher: str, word: str, message: str
) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{'submitit' if launcher == 'slurm' else 'joblib'}_launcher")
    assert message in refused("sweep", "rpi_main", *TINY, f"hydra/launcher={launcher}", word)


def test_runs_that_go_on_without_their_launcher_are_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a cluster one job is lost, and another one goes on until the third look; a third one has not begun."""
    lost, on, late = (cast(Job, SimpleNamespace(overrides=[name])) for name in ("lost", "on", "late"))
    looks, launched = Counter[str](), []

    class Watched:
        def state(self, job: Job) -> str:
            name = job.overrides[0]
            looks[name] += 1
            return {"lost": "interrupted", "on": "running" if looks["on"] < 3 else "done", "late": "waiting"}[name]

    def launch(name: str, words: object, jobs: list[list[str]], *_: object) -> None:
        launched.append([job[0] for job in jobs])
        if len(launched) == 1:
            raise RuntimeError("one job has no result")

    monkeypatch.setattr(sweeping.compose, "launch", launch)
    monkeypatch.setattr(sweeping, "PAUSE", 0.0)
    sweeping._launch(cast(Sweep, Watched()), [lost, on, late], [], print, [])
    assert launched == [["lost", "on", "late"], ["lost", "late"]]
    said = capsys.readouterr().out
    assert "the launcher broke down (RuntimeError: one job has no result)\nwaiting for 1 runs that go on\n" in said
    assert "2 runs are left" in said


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("hydra_plugins.hydra_optuna_sweeper") is None, reason="the extra `search` is not installed"
)
def test_a_search_goes_on_when_a_run_fails(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("sweep", "rpi_search", *TINY, "hydra.sweeper.n_trials=2")
    assert epo(*words, "optimizer.lr=1e30") == 1
    said = capsys.readouterr()
    assert "2 runs: 2 failed" in said.out
    assert "the search ended early" in said.out, "no run gave a result"
    assert "Traceback" not in said.out + said.err


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("hydra_plugins.hydra_optuna_sweeper") is None, reason="the extra `search` is not installed"
)
def test_a_search_continues_after_a_stop(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("sweep", "rpi_search", *TINY, "hydra.sweeper.sampler.n_startup_trials=1")
    assert epo(*words, "hydra.sweeper.n_trials=2") == 0
    sweep = the_sweep()
    before = {str(job.run.path) for job in sweep.jobs}
    assert len(before) == 2
    interrupted = sweep.jobs[0].run
    interrupted.update(status="training")
    assert epo(*words, "hydra.sweeper.n_trials=3") == 0
    assert interrupted.finished
    assert len(sweep.jobs) == 3
    assert before < {str(job.run.path) for job in sweep.jobs}
    found = yaml.safe_load((sweep.folder / "optimization_results.yaml").read_text())
    scores = [job.run.record["best"]["val/minSADE"] for job in sweep.jobs]
    assert found["best_value"] == pytest.approx(min(scores)), "the sweeper looks for the lowest score"
    capsys.readouterr()
    assert epo(*words, "hydra.sweeper.n_trials=3") == 0
    assert "3 runs: 3 done" in capsys.readouterr().out
    assert len(sweep.jobs) == 3


@pytest.mark.slow
@pytest.mark.parametrize("launcher", [(), ("hydra/launcher=local", "hydra.launcher.n_jobs=2")])
@pytest.mark.parametrize(("how", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_a_stopped_sweep_prints_a_note_and_leaves_no_process(
    tmp_path: Path, launcher: tuple[str, ...], how: signal.Signals, status: int
) -> None:
    environment = {**os.environ, "PYTHONPATH": str(SRC)}
    words = ["data=drawn", "budget=smoke", "trainer.max_epochs=2000", "trainer.limit_train_batches=1", "seed=0,1"]
    words += ["experiment=rpi/v_lstm_sc", "callbacks.progress=none", *launcher]
    program = [sys.executable, "-m", "epo_lightning.cli", "sweep", "rpi_main", *words]
    process = subprocess.Popen(program, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("runs/rpi/*/*/checkpoints/last.ckpt")) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(how)
    _, said = process.communicate(timeout=60)  # returns when all processes that hold the pipe have ended
    if not (launcher and how == signal.SIGTERM):  # joblib's parent has no handler of SIGTERM
        assert process.returncode == status
    if how == signal.SIGINT:
        assert "epo: interrupted; no incomplete file was left; the same command continues" in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_a_sweep_killed_ten_times_ends_with_the_same_table(tmp_path: Path) -> None:
    """Kill -9 of all its processes at random moments; no written row of a log is lost, and no finished run is run again."""
    environment = {**os.environ, "PYTHONPATH": str(SRC)}
    program = [sys.executable, str(Path(tiny.__file__).resolve())]
    words = [*program, "sweep", "rpi_main", *TINY, "seed=0,1", "trainer.max_epochs=12", "score=test"]

    began = time.monotonic()
    subprocess.run([*words, "runs=whole"], cwd=tmp_path, env=environment, check=True)
    lasted = time.monotonic() - began

    rng = random.Random(0)
    finished: dict[Path, int] = {}
    interrupted = 0
    for _ in range(10):
        process = subprocess.Popen([*words, "runs=parts"], cwd=tmp_path, env=environment, start_new_session=True)
        while not (record := list((tmp_path / "parts").glob("sweeps/*/sweep.json"))) or (
            read_json(record[0])["process"] != process.pid
        ):
            time.sleep(0.05)
        time.sleep(rng.uniform(0.0, 0.15) * lasted)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for path in (tmp_path / "parts").glob("rpi/*/*/metrics.json"):
            finished.setdefault(path, path.stat().st_mtime_ns)
        interrupted += any(run.state == "interrupted" for run in discover(tmp_path / "parts"))
    subprocess.run([*words, "runs=parts"], cwd=tmp_path, env=environment, check=True)
    assert interrupted, "no kill hit a run that had begun"
    assert finished, "no kill came late enough to find a finished run"
    assert all(path.stat().st_mtime_ns == mark for path, mark in finished.items()), "a finished run ran again"

    whole = [path.relative_to(tmp_path / "whole") for path in (tmp_path / "whole").glob("rpi/*/*/metrics.json")]
    assert len(whole) == 8
    for name in (file for run in whole for file in (run, run.parent / "logs" / "metrics.csv")):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    tables = []
    for runs in ("whole", "parts"):
        subprocess.run([*program, "report", "rpi_main", f"runs={runs}"], cwd=tmp_path, env=environment, check=True)
        (table,) = (tmp_path / runs).glob("sweeps/*/report/results.csv")
        tables.append(table.read_text())
    assert tables[0] == tables[1]
