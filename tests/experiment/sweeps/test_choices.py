"""Choices: the winners of a search are trained by another sweep, from the file that the report of the search writes."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from experiment import tiny
from experiment.conftest import TINY, Epo
from omegaconf import DictConfig
from report.run_folders import make_run, scores
from report.test_selection import search

from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.experiment.sweeps import sweeping
from epo_lightning.experiment.sweeps.sweep import Sweep
from epo_lightning.registry import ConfigError
from epo_lightning.report.choices import read_choices
from epo_lightning.report.write import Report, write_report

MAIN = ("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/const_vel,rpi/v_lstm", "score=val")


def written(out: Path, runs: Path) -> Path:
    write_report(Report.of_folder(runs), out)
    return out / "choices.yaml"


def test_the_report_of_a_search_writes_its_winners_and_what_they_were_chosen_from(tmp_path: Path) -> None:
    search(tmp_path / "runs", {(0.001, 64): [0.4, 0.4], (0.0005, 64): [0.2, 0.3], (0.01, 64): [0.1]})
    file = written(tmp_path / "out", tmp_path / "runs")
    assert read_choices(str(file)).overrides == {"rpi/v_lstm": ("optimizer.lr=0.0005",)}
    folders = [str(tmp_path / "runs" / f"V-LSTM-0.0005-64-{seed}") for seed in (0, 1)]
    entry = yaml.safe_load(file.read_text())["rpi/v_lstm"]
    assert entry["runs"] == folders
    assert {folder: entry["compared"][folder] for folder in folders} == dict(zip(folders, (0.2, 0.3), strict=True))
    assert len(entry["compared"]) == 4  # the setting that lacks a seed was not compared
    assert (entry["split"], entry["metric"], entry["data_digest"]) == ("val", "minSADE", "abc")
    assert f"#   epo report runs={tmp_path}/runs" in file.read_text()


def test_an_experiment_that_was_searched_twice_and_a_report_without_a_search_give_no_choice(tmp_path: Path) -> None:
    for data in ("one", "two"):
        for lr in (0.1, 0.2):
            make_run(
                tmp_path / "runs" / f"{data}-{lr}", "V-LSTM", "marginal", scores(lr), data=data, split="val",
                experiment="rpi/v_lstm", settings={"optimizer.lr": lr},
            )  # fmt: skip
    assert not written(tmp_path / "out", tmp_path / "runs").exists()
    make_run(tmp_path / "plain" / "run", "V-LSTM", "marginal", scores(0.3), split="val")
    assert not written(tmp_path / "out", tmp_path / "plain").exists()


def test_a_sweep_starts_its_rows_with_the_choices(
    epo: Epo, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    content = {
        "rpi/v_lstm": {
            "overrides": ["optimizer.lr=0.002", "backbone=vibes", "backbone.width=16", "+forecaster.annealing=0.5"],
            "runs": ["runs/a"],
        },
        "rpi/v_lstm_sc": {"overrides": ["optimizer.lr=0.003"]},
    }
    Path("choices.yaml").write_text(yaml.safe_dump(content))
    started: dict[str, tuple[float, int, str, float]] = {}
    monkeypatch.setattr(RPIData, "setup", lambda self, stage: None)  # nothing is trained here

    def task(config: DictConfig) -> None:
        annealing = config.forecaster.get("annealing", 0.0)
        started[config.title] = config.optimizer.lr, config.backbone.width, config.backbone.name, annealing

    words = [*MAIN[2:], "choices=choices.yaml"]
    assert not sweeping.run("rpi_main", words, [str(tiny.CONF)], task, False), "no run was trained"
    out = capsys.readouterr().out
    assert "choices=choices.yaml: rpi/v_lstm: optimizer.lr=0.002 backbone=vibes backbone.width=16" in out
    assert "choices=choices.yaml: rpi/v_lstm_sc: not in this sweep" in out
    assert started.pop("V-LSTM") == (0.002, 16, "vibes", 0.5)
    (other,) = started.values()  # it is started without choices
    assert other[2:] == ("v_lstm", 0.0)
    assert other[:2] != (0.002, 16)
    sweep = Sweep.find("rpi_main", words, "runs")
    assert sweep.record["choices"] == content
    assert sweep.label != "rpi_main"
    chosen, plain = sorted(sweep.jobs, key=lambda job: "optimizer.lr=0.002" not in job.overrides)
    assert chosen.run.path.parent.name == "v_lstm"
    assert not any("optimizer" in word for word in plain.overrides)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rpi/v_lstn: {overrides: [optimizer.lr=0.1]}", "unknown experiment 'rpi/v_lstn': did you mean .*rpi/v_lstm"),
        ("rpi/v_lstm: {overrides: [optimizer.learning=0.1]}", "choices=c.yaml, rpi/v_lstm: .*learning"),
        ("rpi/v_lstm_sc: {overrides: [optimizer.lr=0.1]}", "no experiment of this sweep, only rpi/v_lstm_sc"),
        ("rpi/v_lstm: {overrides: [optimizer.schedule=cosine]}", "optimizer.schedule of rpi/v_lstm is set by"),
        ("rpi/v_lstm: {overrides: [++optimizer.schedule=cosine]}", "optimizer.schedule of rpi/v_lstm is set by"),
    ],
)
def test_choices_that_do_not_fit_are_refused(epo: Epo, refused: Callable[..., str], text: str, message: str) -> None:
    Path("c.yaml").write_text(text)
    found = refused(*MAIN, "optimizer.schedule=constant", "choices=c.yaml")
    assert re.search(message, found), found
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rpi/v_lstm: {overrides: [seed=4]}", "'seed=4', expected a setting of a section"),
        ("rpi/v_lstm: {overrides: [~optimizer.lr=4]}", "expected a setting of a section"),
        ("rpi/v_lstm: {overrides: [data=exid]}", "expected a setting of a section"),
        ("rpi/v_lstm: {overrides: [optimizer.clip=1, ++optimizer.clip=2]}", r"v_lstm sets optimizer\.clip twice"),
        ("rpi/v_lstm: {lr: 4}", "rpi/v_lstm has no list `overrides`"),
        (
            "rpi/v_lstm: {overrides: [optimizer.lr=0.1]}\nrpi/v_lstm: {overrides: [optimizer.lr=0.2]}",
            r"choices=.*c\.yaml has the entry rpi/v_lstm twice, .*: leave one of them out",
        ),
        ("rpi/v_lstm: {overrides: [optimizer.lr=0.1], overrides: [goal=all]}", "has the entry overrides twice"),
        (
            "rpi/v_lstm: {overrides: [optimizer.lr=0.1, goal=all, optimizer.lr=0.2]}",
            r"c\.yaml: rpi/v_lstm sets optimizer\.lr twice, by optimizer\.lr=0\.1 and by optimizer\.lr=0\.2: leave one",
        ),
        ("[", "is not YAML"),
        ("", "has no choices"),
        (None, "cannot read choices=.*: No such file"),
    ],
)
def test_a_damaged_or_foreign_file_is_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_choices(str(tmp_path / "c.yaml"))
