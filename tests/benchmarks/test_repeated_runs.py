"""Runs that are trained again, from the file of their results or with the code of their commit."""

from __future__ import annotations

import math

import pytest
from programs import ROOT

from benchmarks import commits, repeat
from epo_lightning import cli
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.experiment import train
from epo_lightning.experiment.config.compose import compose
from epo_lightning.files import write_json
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder


@pytest.mark.slow
def test_a_run_of_a_results_file_is_trained_again(capsys, tmp_path):
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "callbacks.progress=none"]
    RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2).generate(workers=1, progress=False)
    for row in ("v_lstm", "v_lstm_epo"):
        words = [f"experiment=rpi/{row}", *small, "budget=smoke", "score=test", f"runs={tmp_path / 'runs'}"]
        train.train(compose("train", words))
    file = tmp_path / "small.json"
    cli.main(["report", f"runs={tmp_path / 'runs'}", f"save={file}", f"out={tmp_path / 'report'}"])
    capsys.readouterr()
    repeat.main([str(file), f"data.root={tmp_path}", "--out", str(tmp_path / "again")])
    row = capsys.readouterr().out.splitlines()[-1]
    assert row.startswith("| small | V-LSTM + EPO, seed 0 | ")
    assert row.endswith(" | 0 |")
    saved, again = repeat.chosen(repeat.trained_runs(str(file))), RunFolder(tmp_path / "again" / "small")
    saved.scores["metrics.json"]["metrics"]["minSFDE"] += 0.25
    assert repeat.distance(saved, again)[0] == pytest.approx(0.25)
    repeat.main([str(file), "data.root=nowhere", "--out", str(tmp_path / "third")])
    assert "not repeated: no rpi data at nowhere" in capsys.readouterr().out


def test_numbers_of_two_logs_are_compared():
    before = [
        {"epoch": "0", "step": "5", "train/loss": "1.5"},
        {"epoch": "0", "step": "5", "val/minSADE": "nan", "a": "1"},
    ]
    now = [
        {"epoch": "1", "step": "5", "train/loss": "1.25"},
        {"epoch": "0", "step": "5", "val/minSADE": "nan", "b": "1"},
    ]
    assert commits.distance(before, now) == (0.25, 2)
    assert repeat.difference(math.inf, math.inf) == 0.0
    now[1]["val/minSADE"] = "1.0"
    assert commits.distance(before, now) == (math.inf, 2), "a number in place of none is a difference"
    with pytest.raises(ConfigError, match="same steps"):
        commits.distance(before, now[:1])
    with pytest.raises(ConfigError, match="no number in common"):
        commits.distance([{"step": "5", "a": "1"}], [{"step": "5", "b": "1"}])


def test_one_run_of_every_commit_is_chosen():
    runs = repeat.trained_runs(str(ROOT / "results/highway_sim_pair.json"))
    found = commits.one_of_every_commit(runs)
    assert len({run.record["git_commit"] for run in found}) == len(found) == 2
    assert all(run.settings["forecaster"]["name"] == "epo" for run in found)
    assert all(commits.settings_since(run) == [] for run in found)
    on_rpi = repeat.trained_runs(str(ROOT / "results/rpi_equilibrium.json"))
    assert all(commits.settings_since(run) == ["data.recipe=1"] for run in on_rpi)
    with pytest.raises(ConfigError, match="no run was trained"):
        repeat.trained_runs(str(ROOT / "results/runtime.json"))


@pytest.mark.slow
def test_the_code_of_a_commit_trains_like_the_code_at_hand(capsys, tmp_path):
    RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2).generate(workers=1, progress=False)
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "budget=smoke"]
    cli.main(["train", "experiment=rpi/v_lstm_epo", *small, "score=test", f"run_dir={tmp_path / 'run'}"])
    run, file = RunFolder(tmp_path / "run"), tmp_path / "small.json"
    if run.record["git_commit"] is None:
        pytest.skip("not a checkout")
    words = [str(file), f"data.root={tmp_path}", "--steps", "2", "--out", str(tmp_path / "commits")]
    commit = run.record["git_commit"].rstrip("+")

    def compare(commit: str, *overrides: str) -> str:
        write_json(run.record_file, {**run.record, "git_commit": commit})
        cli.main(["report", f"runs={run.path}", f"save={file}", f"out={tmp_path / 'report'}"])
        capsys.readouterr()
        commits.main([*words, *overrides])
        return capsys.readouterr().out.splitlines()[-1]

    assert compare(commit).endswith(" | 0 |")
    assert "has solver.steps=3, the saved run 2" in compare(commit, "solver.steps=3")
    assert "not compared: its code is not known" in compare(f"{commit}+")
