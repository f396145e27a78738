"""``epo report`` of a sweep: its own runs with its measurements, and the states of runs that are left out."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from report.methods import of_methods
from report.page_runs import timed
from report.run_folders import make_run, scores
from report.test_transfer import on

from epo_lightning.experiment.config.settings import ReportSettings
from epo_lightning.experiment.report import of_sweep, preface, report
from epo_lightning.experiment.sweeps.sweep import Sweep
from epo_lightning.experiment.sweeps.watch import result, status
from epo_lightning.files import write_file, write_json
from epo_lightning.registry import ConfigError
from epo_lightning.report.runs import collect
from epo_lightning.run_folder import RunFolder


def begin(runs: Path, name: str, folders: dict[str, str | None], score: str | list[str] = "test") -> Sweep:
    """The record of a sweep over these folders; of a score of its own where one is given."""
    jobs = [
        {
            "overrides": [f"seed={seed}"],
            "folder": folder,
            "identity": f"{seed:016x}",
            "title": "V-LSTM",
            "seed": seed,
            "score": own or score,
        }
        for seed, (folder, own) in enumerate(folders.items())
    ]
    folder = runs / "sweeps" / name
    write_json(folder / "sweep.json", {"name": name, "command": f"epo sweep {name}", "overrides": [], "jobs": jobs})
    return Sweep(folder)


def finish(run: RunFolder) -> RunFolder:
    run.update(status="finished")
    return run


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


def test_the_status_of_a_sweep_says_how_to_continue(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    finish(make_run(runs / "a", "V-LSTM", "marginal", scores(0.3)))
    hint = "give the same command again to continue"
    for folder, shown in (("c", True), ("d", True), ("a", False)):  # interrupted, waiting, done
        if folder == "c":
            make_run(runs / "c", "V-LSTM", "marginal", None)
        status(begin(runs, "rpi_main", dict.fromkeys(("a", folder))))
        assert (hint in capsys.readouterr().out) == shown, folder
    with RunFolder(runs / "c").lock():
        status(begin(runs, "rpi_main", dict.fromkeys(("c", "d"))))
    assert hint not in capsys.readouterr().out, "the sweep runs"


def test_runs_of_earlier_starts_that_were_removed_are_not_counted(runs: Path) -> None:
    sweep = begin(runs, "rpi_main", {})
    write_json(sweep.folder / "sweep.json", {**sweep.record, "former": ["gone", "there"]})
    (runs / "there").mkdir()
    assert [run.path for run in sweep.former] == [runs / "there"]


def test_a_trained_run_is_running_while_it_is_scored(runs: Path) -> None:
    run = finish(make_run(runs / "a", "V-LSTM", "marginal", None))
    sweep = begin(runs, "rpi_main", {"a": None})
    (job,) = sweep.jobs
    with run.lock():
        assert sweep.state(job) == "running"
    assert sweep.state(job) == "trained, not scored"


def test_a_sweep_reports_its_runs_and_the_states_of_the_others(runs: Path) -> None:
    finish(make_run(runs / "a", "V-LSTM", "marginal", scores(0.3), seed=0))
    finish(make_run(runs / "b", "V-LSTM", "marginal", scores(0.5), seed=1))
    finish(make_run(runs / "elsewhere", "Not of the sweep", "marginal", scores(0.1)))
    make_run(runs / "c", "V-LSTM", "marginal", None, seed=2)
    sweep = begin(runs, "rpi_main", dict.fromkeys(("a", "b", "c", "d", "e")))
    write_file(sweep.folder / "failures" / "e.txt", "ValueError: it broke\n\ntraceback\n")
    subject = of_sweep(sweep)
    assert (subject.title, subject.command) == ("rpi_main", "epo report rpi_main")
    assert [run.path.name for run in subject.evaluated] == ["a", "b"]
    assert subject.left_out == (
        ("runs/c", "interrupted"),
        ("runs/d", "waiting"),
        ("runs/e", "failed: ValueError: it broke"),
    )
    out = report(ReportSettings(sweep="rpi_main"))
    assert out.resolve() == sweep.folder / "report"
    written = (out / "results.md").read_text()
    assert "0.400 ± 0.141" in written
    assert "Not of the sweep" not in written
    assert "**Budget: reduced.**" in written
    assert r"\textbf{Budget: reduced, " in (out / "results.tex").read_text()
    assert "- `runs/e`: failed: ValueError: it broke" in written
    page = (out / "index.html").read_text()
    assert "3 runs left out" in page
    assert "<code>epo sweep rpi_main</code>" in page
    assert "`epo sweep rpi_main`" in written


def test_scores_on_another_split_are_left_out(runs: Path) -> None:
    for split in ("test", "val"):
        finish(make_run(runs / "a", "V-LSTM", "marginal", scores(0.3), split=split))
    finish(make_run(runs / "b", "V-LSTM", "marginal", scores(0.3), seed=1, split="test"))
    subject = of_sweep(begin(runs, "grid", {"a": None, "b": None}, score="val"))
    assert [(run.path.name, run.split) for run in subject.evaluated] == [("a", "val")]
    assert [folder for folder, _ in subject.left_out] == ["runs/b"]


def test_a_sweep_that_measures_time_is_reported(runs: Path) -> None:
    finish(timed(runs, 2, 1, 4, 0.001))
    finish(timed(runs, 4, 1, 4, 0.02))
    sweep = begin(runs, "runtime", {"N2-S1-M4": None, "N4-S1-M4": None}, score="time")
    assert [result(job) for job in sweep.jobs] == ["1.0 ms per forecast", "19.6 ms per forecast"], "the median"
    out = report(ReportSettings(sweep="runtime", out="out"))
    assert out == Path("out")
    assert (out / "figures" / "runtime.png").is_file()
    assert not (out / "results.csv").exists()
    assert "Budget:" not in (out / "results.md").read_text()  # a time does not depend on it


def test_a_sweep_that_measures_scores_and_time_is_reported(runs: Path) -> None:
    for run in of_methods(runs):
        finish(run)
    not_asked_for = {"data_digest": "abc", "split": "val", "metrics": scores(0.9)}
    write_json(runs / "EPO-s0" / "metrics-val.json", not_asked_for)
    folders = [f"{title}-s{seed}" for title in ("JFP", "EPO", "Laplace") for seed in (0, 1)]
    sweep = begin(runs, "table1", dict.fromkeys(folders), score=["test", "time"])
    (runs / "Laplace-s1" / "runtime.json").unlink()
    assert [sweep.state(job) for job in sweep.jobs] == ["done"] * 5 + ["trained, not scored"]
    subject = of_sweep(sweep)
    assert {run.split for run in subject.evaluated} == {"test"}
    assert subject.left_out == (), "the run that lacks its time has scores"
    written = (report(ReportSettings(sweep="table1")) / "results.md").read_text()
    titles = [line for line in written.splitlines() if line.startswith("## ")]
    assert titles == [
        "## rpi, test split",
        "## rpi, test split: accuracy of the k most likely modes",
        "## rpi, test split: equilibrium",
        "## Cost: rpi",
        "## How this was made",
    ]
    assert [line.split(" | ")[0] for line in written.splitlines() if line.endswith(" ms |")] == [
        "| JFP",
        "| EPO",
        "| Laplace",
    ]


@pytest.mark.parametrize(
    ("budget", "data", "words", "said"),
    [
        ("paper", "rpi", "trainer.threads=4 data.root=/data seed=1 optimizer.lr=0.1", []),
        (
            "paper",
            "rpi",
            "+data.batch_size=16 trainer.threads=4",
            ["Budget: paper.", "Changed by hand: `+data.batch_size=16`."],
        ),
        (
            "reduced",
            "rpi",
            "trainer.max_steps=9",
            ["Budget: reduced.", "`trainer.max_steps=9`", "do not reproduce its table"],
        ),
        ("reduced", "dut", "", ["Budget: reduced."]),
    ],
)
def test_a_report_says_first_what_differs_from_the_papers_settings(
    tmp_path: Path, budget: str, data: str, words: str, said: list[str]
) -> None:
    command = f"epo train experiment=x {words}"
    make_run(tmp_path, "V-LSTM", "marginal", scores(0.3), budget=budget, data=data, command=command)
    text = preface(collect(tmp_path))
    assert bool(text) == bool(said)
    assert all(part in text for part in said)
    assert ("do not reproduce" in text) == (data == "rpi" and bool(said))
    assert "threads" not in text


def test_a_run_that_was_scored_on_other_data_alone_is_reported(runs: Path) -> None:
    elsewhere = finish(make_run(runs / "a", "V-LSTM", "marginal", None))
    on(elsewhere, "b", 4.0)
    subject = of_sweep(begin(runs, "rpi_main", {"a": None}))
    assert [run.path.name for run in subject.runs] == ["a"]
    assert (subject.evaluated, subject.left_out) == ((), ())


def test_a_run_that_goes_on_after_a_failure_is_left_out_without_its_old_error(runs: Path) -> None:
    finish(make_run(runs / "a", "V-LSTM", "marginal", scores(0.3)))
    again = make_run(runs / "b", "V-LSTM", "marginal", None, seed=1)
    sweep = begin(runs, "rpi_main", {"a": None, "b": None})
    sweep.fail(again, "ValueError: it broke")
    assert of_sweep(sweep).left_out == (("runs/b", "failed: ValueError: it broke"),)
    with again.lock():
        assert of_sweep(sweep).left_out == (("runs/b", "running"),)


def test_sweeps_that_cannot_be_reported_are_refused(runs: Path) -> None:
    make_run(runs / "a", "V-LSTM", "marginal", None)
    begin(runs, "rpi_main", {"a": None})
    with pytest.raises(
        ConfigError, match=r"the only run of the sweep rpi_main is not evaluated: .*epo evaluate runs=runs "
    ):
        report(ReportSettings(sweep="rpi_main"))
    with pytest.raises(ConfigError, match="rpi_main"):
        report(ReportSettings(sweep="rpi_mian"))
    with pytest.raises(
        ConfigError, match=r"no sweep runs/a has .*; `epo report runs=runs/a` reports on runs in a folder"
    ):
        report(ReportSettings(sweep="runs/a"))
    assert json.loads((runs / "sweeps/rpi_main/sweep.json").read_text())["name"] == "rpi_main"
    assert not (runs / "sweeps" / "rpi_main" / "report").exists()
