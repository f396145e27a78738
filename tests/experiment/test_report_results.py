"""Results files: the report that is written from one is the report of the run folders, byte for byte."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from experiment.test_sweep_report import begin, finish
from report.page_runs import rows_with_seeds, timed, write_log
from report.run_folders import make_run, scores
from report.test_transfer import three_runs

from epo_lightning.experiment.config.settings import ReportSettings
from epo_lightning.experiment.report import NOT_DRAWN, report
from epo_lightning.experiment.report_scenes import _best_of_titles
from epo_lightning.files import write_json
from epo_lightning.identity import digest_of
from epo_lightning.registry import ConfigError
from epo_lightning.report.results import save_results
from epo_lightning.report.runs import collect
from epo_lightning.report.tables import build_tables, distinct
from epo_lightning.report.write import Report
from epo_lightning.run_folder import RunFolder

FILES = {
    *("results.md", "results.csv", "results.tex", "index.html", "comparisons.csv"),
    *("figures/learning_curves.png", "figures/runtime_modes.png"),
}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def every_section(runs: Path) -> None:
    """Rows with seeds and logs, runtimes, and a run without scores; two logs and one time are damaged."""
    rows_with_seeds(runs)
    timed(runs / "times", 4, 2, 1, 0.002)
    timed(runs / "times", 4, 2, 8, 0.003)
    make_run(runs / "waiting", "Not evaluated", "marginal", None)
    logless = make_run(runs / "logless", "Without a log", "marginal", scores(0.7))
    write_log(logless, [])
    unvalidated = make_run(runs / "unvalidated", "Without a validation", "marginal", scores(0.8))
    write_log(unvalidated, []).write_text("epoch,step,train/loss\n0,99,0.5\n")
    damaged = make_run(runs / "times" / "damaged", "Damaged", "marginal", None)
    damaged.metrics_file("time").write_text("{}")


def saved(runs: Path = Path("runs"), **settings: object) -> Path:
    """A results file of run folders, which are deleted afterwards."""
    report(ReportSettings(runs=str(runs), out="one", save="results/all.json", scenes=False, **settings))  # type: ignore[arg-type]
    shutil.rmtree(runs)
    return Path("results/all.json")


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def rebuilt(file: Path) -> dict[str, bytes]:
    """The files of the report that is written from a results file, in another folder than the first one."""
    return files(report(ReportSettings(results=str(file), out="elsewhere/two")))


def test_a_report_is_rebuilt_from_its_results_file() -> None:
    every_section(Path("runs"))
    file = saved()
    one, two = files(Path("one")), rebuilt(file)
    assert one.keys() >= FILES
    assert {name for name in one if one[name] != two.get(name)} == set()
    assert two.keys() == one.keys()
    written = two["results.md"].decode()
    assert NOT_DRAWN in written
    assert "- `runs/waiting`: interrupted" in written
    assert "times/damaged/runtime.json is not what" in written
    assert "logless/logs/metrics.csv is missing or has no row" in two["index.html"].decode()
    assert "unvalidated/logs/metrics.csv has no finite val/minSADE" in two["index.html"].decode()


def test_a_timed_run_with_a_damaged_record_is_noted() -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.3))
    timed(Path("runs/times"), 4, 2, 1, 0.002).update(versions=5)
    report(ReportSettings(runs="runs", out="one", scenes=False))
    assert "run.json is damaged: its entry versions must be texts by name" in Path("one/results.md").read_text()


def test_a_report_without_runs_is_not_saved() -> None:
    with pytest.raises(ConfigError, match=r"all\.json is not written: the report empty has no run"):
        save_results(Report("empty", "epo report empty", (), ()), "all.json")
    assert not Path("all.json").exists()


def test_reports_of_two_files_lie_in_folders_with_their_names_and_have_them_as_titles() -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.315))
    file = saved()
    shutil.copy(file, "results/other.json")
    assert Path("one/results.md").read_text().startswith("# Results: all\n")
    for name in ("all", "other"):
        assert report(ReportSettings(results=f"results/{name}.json")) == Path("report") / name
    for name in ("all", "other"):
        assert Path(f"report/{name}/results.md").read_text().startswith(f"# Results: {name}\n")
        assert f"<title>{name}" in Path(f"report/{name}/index.html").read_text()


def test_reports_of_two_folders_do_not_replace_each_other(tmp_path: Path) -> None:
    for folder, title in (("runs/rpi", "V-LSTM"), ("mine/one", "first"), ("mine/two", "second")):
        make_run(Path(folder) / "a", title, "marginal", scores(0.3))
    made = {
        "runs": "report",
        "./runs/": "report",
        "runs/rpi/a": "report/rpi/a",
        "mine/one": "report/one",
        "mine/two/": "report/two",
        str(tmp_path / "mine"): "report/mine",
    }
    for runs, folder in made.items():
        assert report(ReportSettings(runs=runs, scenes=False)) == Path(folder)
    assert "first" in Path("report/one/results.md").read_text()
    assert "second" in Path("report/two/results.md").read_text()
    assert report(ReportSettings(runs="mine/one", out="chosen", scenes=False)) == Path("chosen")


def test_scores_on_other_data_are_rebuilt() -> None:
    three_runs(Path("runs"))
    file = saved()
    one = files(Path("one"))
    assert "transfer.csv" in one
    assert rebuilt(file) == one


def test_a_sweep_is_rebuilt_with_the_splits_that_it_measures() -> None:
    for split, value in (("test", 0.3), ("val", 0.9)):
        finish(make_run(Path("runs/a"), "V-LSTM", "marginal", scores(value), split=split))
    begin(Path("runs"), "rpi_main", dict.fromkeys(("a", "b")))
    file = saved(sweep="rpi_main")
    two = rebuilt(file)
    assert two == files(Path("one"))
    written = two["results.md"].decode()
    assert "test split" in written
    assert "val split" not in written
    assert "`epo sweep rpi_main`" in written


def test_every_number_has_its_command_commit_seed_and_data_and_no_folder_of_the_machine(tmp_path: Path) -> None:
    run = make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.3), seed=4, settings={"data.root": str(tmp_path)})
    run.update(host="a-machine", seconds=2.0, steps=10)
    content = json.loads(saved().read_text())
    (entry,) = content["runs"]
    assert entry["record"] == {
        "command": "epo train experiment=None seed=4",
        "git_commit": "0123456789abcdef",
        "data_digest": "abc",
        "parameters": 1234,
        "steps": 10,
        "seconds": 2.0,
        "status": "training",
    }
    assert entry["config"]["seed"] == 4
    assert entry["scores"]["metrics.json"] == {"data_digest": "abc", "split": "test", "metrics": scores(0.3)}
    assert str(tmp_path) not in json.dumps(content)


def test_a_secret_that_an_older_version_recorded_is_in_no_results_file_and_no_table() -> None:
    run = make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.3))
    command = "epo train logger.mlflow.uri=https://me:pa55word@host/mlflow"
    write_json(run.record_file, {**run.record, "command": command})
    file = saved()
    assert "https://me:***@host/mlflow" in file.read_text()
    assert "https://me:***@host/mlflow" in Path("one/results.md").read_text()
    written = {**files(Path("one")), **rebuilt(file), "file": file.read_bytes()}
    assert [name for name, content in written.items() if b"pa55word" in content] == []


def test_of_the_rows_of_a_title_the_best_one_on_the_first_data_is_drawn() -> None:
    for lr, value, data in ((0.05, math.nan, "a"), (0.1, 0.3, "a"), (0.2, 0.2, "a"), (0.4, 0.1, "b")):
        settings = {"optimizer.lr": lr}
        make_run(Path("runs") / str(lr), "V-LSTM", "marginal", scores(value), data=data, digest=data, settings=settings)
    make_run(Path("runs/sc"), "SC", "scene_consistent", scores(0.9), data="a", digest="a")
    make_run(Path("runs/nan"), "Diverged", "scene_consistent", scores(math.nan), data="a", digest="a")
    drawn = _best_of_titles(distinct(build_tables(collect("runs"))))
    found = {row.title: row.cells["minSADE"].mean for row in drawn}
    assert found == pytest.approx({"V-LSTM": 0.2, "SC": 0.9, "Diverged": math.nan}, nan_ok=True)


def edited(text: str) -> str:
    return text.replace("0.315", "0.314")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edited, r"all\.json is damaged: .* write it again with `epo report runs=runs save=.*all\.json`"),
        (lambda text: text[:-200], r"all\.json is not JSON .*; epo report <sweep> save=<file> writes such a file"),
        (lambda text: '{"metrics": {}}', r"all\.json is no results file: it has no entry format"),
        (lambda text: text.replace('"version": 1', '"version": 2'), "of version 2, this program reads version 1"),
        (lambda text: "[1]", r"all\.json holds no JSON object"),
    ],
)
def test_a_damaged_or_foreign_file_is_refused(change: Callable[[str], str], message: str) -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.315))
    file = saved()
    text = file.read_text()
    file.write_text(change(text))
    assert file.read_text() != text
    with pytest.raises(ConfigError, match=message):
        report(ReportSettings(results=str(file), out="two"))
    assert not Path("two").exists()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            "title",
            None,
            r"all\.json is damaged: its entry title must be a text, not None; take the committed file again",
        ),
        ("left_out", [["runs/a"]], r"its entry left_out must be a list of pairs of texts, not \[\['runs/a'\]\]"),
        ("runs", {"a": 1}, r"its entry runs must be a list of objects"),
        ("runs.0.folder", 3, r"all\.json, entry 0 of runs, is damaged: its entry folder must be a text, not 3"),
        ("runs.0.reported", ..., r"entry 0 of runs, is damaged: it lacks the entry reported, a list of texts"),
        ("runs.0.scores", {"metrics.json": []}, r"its entry scores must be objects by name"),
        ("runs.0.log", [[1, "0.5"]], r"its entry log must be a list of lists of a step and perhaps a score, as texts"),
        ("runs.0.log", [["", "0.5"]], r"its entry log must be a list of lists of a step"),
        ("runs.0.log", [["1", "0.5", "2"]], r"its entry log must be a list of lists of a step"),
        ("runs", [], r"all\.json is damaged: its entry runs is empty, .*; take the committed file again"),
        ("runs.0.scores", {}, r"entry 0 of runs, is damaged: its entry scores has neither scores nor the time"),
        ("runs.0.reported", ["tset"], r"its entry reported has the split 'tset', and the run has scores on test; take"),
        ("version", "1", r"all\.json is a results file of version '1', this program reads version 1"),
        *(
            (
                f"runs.0.config.{section}",
                5,
                rf"0 of runs, config is damaged: its entry {section} must be an object.*, not 5",
            )
            for section in ("energy", "solver", "backward", "objective", "data", "forecaster", "trainer", "budget")
        ),
        (
            "runs.0.config.backbone",
            {"name": 5},
            r"its entry backbone must be an object with a text `name`, .*not {'name': 5}",
        ),
        (
            "runs.0.config.objective",
            {"relaxation": "x"},
            r"its entry objective\.relaxation must be a finite number, not 'x'",
        ),
        ("runs.0.config.solver", {"steps": [2]}, r"its entry solver\.steps must be a whole number, or null, not \[2\]"),
        ("runs.0.config.seed", "one", r"its entry seed must be a whole number, not 'one'; take"),
        (
            "runs.0.record.versions",
            5,
            r"0 of runs, record is damaged: its entry versions must be texts by name, or null, not 5",
        ),
        ("runs.0.record.git_commit", 5, r"its entry git_commit must be a text, or null, not 5"),
        ("runs.0.record.steps", "many", r"its entry steps must be a whole number, or null, not 'many'"),
        ("runs.0.record.seconds", "x", r"its entry seconds must be a finite number, or null, not 'x'"),
        ("runs.0.record.seconds", math.nan, r"its entry seconds must be a finite number, or null, not nan"),
        ("runs.0.record.status", [], r"its entry status must be a text, not \[\]"),
        (
            "runs.0.config.backbone",
            ...,
            r"entry 0 of runs, is damaged: .*has no entry backbone\.name: .* Take the committed",
        ),
    ],
)
def test_a_damaged_entry_with_a_fitting_digest_is_named(path: str, value: object, message: str) -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.315))
    file = saved()
    content = json.loads(file.read_text())
    del content["digest"]
    place: Any = content
    *way, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    for key in way:
        place = place[key]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    file.write_text(json.dumps({**content, "digest": digest_of(content)}))
    with pytest.raises(ConfigError, match=message):
        report(ReportSettings(results=str(file), out="two"))
    assert not Path("two").exists()


def test_a_missing_file_and_two_sources_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"cannot read none\.json.*save=<file> writes such a file"):
        report(ReportSettings(results="none.json"))
    with pytest.raises(ConfigError, match=r"results=a\.json and the sweep rpi_main name different runs"):
        report(ReportSettings(results="a.json", sweep="rpi_main"))


def test_a_damaged_run_is_not_saved() -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.3))
    RunFolder(Path("runs/a")).metrics_file("time").write_text("{")
    with pytest.raises(ConfigError, match=r"runtime\.json is not JSON"):
        report(ReportSettings(out="one", save="all.json", scenes=False))
    assert not Path("all.json").exists()
