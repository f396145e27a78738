"""Smoke tests of the benchmarks at their smallest sizes, and their errors: one line for a foreseeable mistake."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from experiment.replays import Again
from rich.console import Console

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import (
    commits,
    dashboards,
    decentralised,
    devices,
    distance_by_weight,
    epo_layer,
    explore,
    extraction,
    feedback_games,
    figures,
    forecast_speed,
    forecast_time,
    generation,
    hard_constraints,
    label_noise,
    many_agents,
    passing_sides,
    placements,
    reading,
    refinement,
    repeat,
    scaling,
    shared_errors,
    training_step,
    true_game,
)
from benchmarks.rpi_runs import Forecasts
from epo_lightning import cli
from epo_lightning.data.recorded.formats.argoverse2 import argoverse2
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.experiment import train
from epo_lightning.experiment.config.compose import compose
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, write_json
from epo_lightning.scene import Scene

FIXTURE = ROOT / "tests" / "fixtures" / "exid_sim"
SMALL = ["--B", "2", "--M", "1", "--K", "4", "--S", "1", "--repeats", "1"]


def refused(main, *words: object) -> str:
    """The one line with which a benchmark ends."""
    with pytest.raises(SystemExit) as found:
        main([str(word) for word in words])
    message = str(found.value)
    assert found.value.code not in (0, None)
    assert "\n" not in message
    return message


def test_epo_layer_compares_the_implementations(tmp_path, capsys):
    epo_layer.main([*SMALL, "--settings", "rpi", "--implementations", "pytorch", "--json", str(tmp_path / "lines")])
    shown = capsys.readouterr().out
    assert "rpi: B=2, M=1, N=2, K=4, S=1" in shown
    assert "through the public API, pytorch" in shown
    (line,) = map(json.loads, (tmp_path / "lines").read_text().splitlines())
    assert line["implementation"] == "pytorch"
    assert line["forward_ms"] > 0
    assert line["forward_backward_ms"] > 0


@pytest.mark.slow
def test_epo_layer_reports_times_over_sizes(tmp_path, capsys, monkeypatch):
    axes = [(title, setting, axis, (2, 3)) for title, setting, axis, _ in scaling.AXES]
    monkeypatch.setattr(scaling, "AXES", axes)
    plot = tmp_path / "scaling.png"
    implementations = ["--implementations", "pytorch", "reference"]
    epo_layer.main([*SMALL, "--N", "2", "--scaling", "--plot", str(plot), *implementations])
    shown = capsys.readouterr().out
    assert all(f"{title}: {axis} = 3: pytorch" in shown for title, _, axis, _ in axes)
    assert plot.stat().st_size > 1000


def test_batches_on_a_device_are_timed(tmp_path, capsys, monkeypatch):
    """On the CPU, with the backends that it has; on a GPU, the host backend and CUDA graphs come in addition."""
    monkeypatch.setattr(devices, "implementations", lambda device: ("peer", "pytorch", "compiled"))
    monkeypatch.setattr(devices, "lane_changes", functools.partial(devices.lane_changes, batch=4, most=10))
    sizes = {"M": 1, "K": 4, "S": 1}
    devices.run(torch.device("cpu"), ["rpi"], [2, 4], 1, tmp_path / "lines", Console(width=200), **sizes)
    shown = capsys.readouterr().out
    assert "lane change, T=20, B=4, compiled: " in shown
    lines = [json.loads(line) for line in (tmp_path / "lines").read_text().splitlines()]
    ours = [(line["implementation"], line["B"]) for line in lines if line["implementation"] != "peer"]
    assert ours == [("pytorch", 2), ("compiled", 2), ("pytorch", 4), ("compiled", 4)]
    assert all(line["games_per_s"] > 0 and line["millijoules"] is None for line in lines)
    monkeypatch.setattr(devices, "disagreement", lambda name, game: float("nan"))
    with pytest.raises(SystemExit, match=r"nothing was measured: .* differs from the reference by nan"):
        devices.run(torch.device("cpu"), ["rpi"], [2], 1, None, Console(), **sizes)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
@pytest.mark.parametrize("main", [epo_layer.main, training_step.main])
def test_a_missing_gpu_is_one_line(main):
    assert refused(main, "--device", "cuda").startswith("--device cuda: PyTorch sees no GPU on this machine")


def test_epo_layer_refuses_invalid_sizes(capsys):
    assert refused(epo_layer.main, *SMALL, "--K", 1).startswith("K = 1: a game takes B, M, N and S of at least 1")
    refused(epo_layer.main, "--repeats", 0)
    assert "'0' is not a whole number, 1 or more" in capsys.readouterr().err


def test_a_training_step_is_timed_by_stage(capsys, tmp_path):
    training_step.main(["--repeats", "1", f"data.root={tmp_path}"])
    shown = capsys.readouterr().out
    assert "random scenes" in shown
    assert all(stage in shown for stage in training_step.STAGES)
    last = next(line for line in shown.splitlines() if "layer, forward" in line)
    assert float(last.split("│")[-2].split()[0]) > 0, "the last forecaster has the layer"
    assert "the layer's share of a step" in shown


def test_whole_training_steps_are_compared_without_and_with_a_graph(tmp_path, monkeypatch):
    """With a stand-in for the graph, on the CPU."""
    words = [f"data.root={tmp_path}", "data.batch_size=4"]
    monkeypatch.setattr(training_step.step_graph, "Recorder", Again)
    lines = list(training_step.whole_steps([*words, "solver.backend=pytorch"], torch.device("cpu"), 1))
    assert [line.startswith("a whole step of V-LSTM") for line in lines] == [True, True, True, False]
    assert all(line.endswith(" ms from a CUDA graph") for line in lines[:3])
    assert "a step of +EPO takes" in lines[3]
    lines = list(training_step.whole_steps([*words, "solver.adaptive=true"], torch.device("cpu"), 1))
    assert len(lines) == 3
    assert (
        "from a CUDA graph: trainer.graph=true with solver.name=levenberg_marquardt and solver.backend=auto" in lines[2]
    )


def test_other_rows_are_timed_and_need_data(tmp_path):
    assert "epo generate" in refused(training_step.main, "--rows", "v_lstm_epo_feedback", f"data.root={tmp_path}")
    assert "v_lstm_epo_feetback" in refused(training_step.main, "--rows", "v_lstm,v_lstm_epo_feetback")


def test_forecasts_of_shipped_forecasters_are_timed(capsys):
    forecast_time.main(["rpi/v_lstm_sc", "rpi/v_lstm_epo", "--rounds", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["rpi/v_lstm_sc", "rpi/v_lstm_epo"]
    for line in lines:
        one, most, batch = (float(number) for number in re.findall(r"([\d.]+) ms", line))
        assert 0 < one <= most
        assert batch > 0
    assert "rpi/v_lstm_epo_game_refined" in refused(forecast_time.main, "rpi/v_lstm")


def test_a_training_step_refuses_what_epo_train_refuses():
    assert "solver.backend" in refused(training_step.main, "solver.backend=cuda")


@pytest.mark.slow
def test_dashboards_are_compared(capsys):
    dashboards.main(["--loggers", "csv", "--data", "data=drawn", "data.scenes=32", "--epochs", "1", "--repeats", "1"])
    shown = capsys.readouterr().out
    assert "rpi/v_lstm_epo, 1 epochs, median of 1" in shown
    assert "(+0.0%)" in shown


def test_dashboards_name_missing_data(tmp_path):
    assert "epo generate" in refused(dashboards.main, "--data", "data=rpi", f"data.root={tmp_path}")


@pytest.mark.slow
def test_extraction_is_timed(capsys):
    extraction.main([str(FIXTURE), "--recordings", "1", "--batches", "2"])
    shown = capsys.readouterr().out
    for stage in ("reading", "extraction", "loading"):
        (number,) = [line.split()[1] for line in shown.splitlines() if line.startswith(stage)][:1]
        assert float(number.replace(",", "")) > 0


@pytest.mark.slow
def test_answers_of_the_page_are_timed(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))  # no data set: the scenes that ship with the run are taken
    explore.main(["times", "rpi/v_lstm_epo", "--edits", "2"])
    assert re.search(r"solver +median +[\d.]+ ms.*\nall +median +[\d.]+ ms", capsys.readouterr().out)


@pytest.mark.slow
def test_true_games_are_measured(capsys, tmp_path):
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null"]
    assert "epo generate" in refused(true_game.main, *small)
    generate = RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2)
    generate.generate(workers=1, progress=False)
    true_game.main(["--records", "2", *small])
    lines = capsys.readouterr().out.splitlines()[-9:]
    assert lines[6].startswith("alternative modes missed by more than 1 mm with the true w: 0 of ")
    assert [line.split(" w")[0] for line in lines[:6]] == ["1", "0.85", "1.15", "0.5", "2", "0"]
    assert float(lines[0].split("executed ")[1].split()[0]) < 1e-5
    assert "fewer than 4000" in refused(true_game.main, "--records", 4000, *small)
    assert "data=rpi" in refused(true_game.main, "data=drawn")


@pytest.mark.slow
def test_feedback_games_are_measured(capsys, tmp_path):
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "data.solver=feedback"]
    generate = RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, solver="feedback", recipe=2)
    generate.generate(workers=1, progress=False)
    feedback_games.main(["--records", "2", *small])
    text = capsys.readouterr().out
    assert re.findall(r"^\S+ times", text, re.MULTILINE) == ["1 times", "0.3 times"]
    games = {
        title: float(number) for title, number in re.findall(r"^(\S.*?) +solved .* (\S+) LQ games", text, re.MULTILINE)
    }
    assert games["in PyTorch"] <= games["without acceleration"]
    times = [float(number) for number in re.findall(r"^.*iteration.* solved 2 of 2 +(\S+) ms", text, re.MULTILINE)]
    assert len(times) == 3
    errors = [float(error) for error in re.findall(r"relative error (\S+),", text)]
    assert len(errors) == 8
    assert errors[3] < 0.01 < errors[0]
    assert "data=rpi" in refused(feedback_games.main, "data=drawn")


@pytest.mark.slow
def test_the_noise_of_recorded_futures_is_measured(capsys):
    label_noise.main(["--games", "3"])
    rows = dict(re.findall(r"^\| (\w+) \| \d+ \| (.+) \|$", capsys.readouterr().out, re.MULTILINE))
    means = {solver: [float(mean) for mean in re.findall(r"(\S+) \(", cells)] for solver, cells in rows.items()}
    single = {solver: re.findall(r"(\d+) of (\d+)", cells) for solver, cells in rows.items()}
    assert all(len(distances) == 3 for distances in means.values())
    assert all(int(alone) <= int(found) for ((alone, found),) in single.values())
    assert list(means) == ["potential", "feedback", "feedback_converged"]
    assert max(means["potential"]) < 1e-4
    assert max(means["feedback_converged"]) < 0.01 < min(means["feedback"])


def test_a_side_is_taught_if_another_mode_is_closest_to_it():
    """Two records: in the first, mode 0 is closest to both futures; in the second, mode 1 is closest to the alternative."""
    still = torch.zeros(2, 2, 2, 3, 2)  # [B, M, N, K, 2]
    forecast = still + torch.tensor([[0.1, 0.9], [0.0, 1.0]])[:, :, None, None, None] * torch.tensor([0.0, 1.0])
    futures = still + torch.tensor([[0.0, 0.4], [0.0, 1.2]])[:, :, None, None, None] * torch.tensor([0.0, 1.0])
    found = passing_sides.served(forecast, futures, torch.tensor([True, False]))
    assert dataclasses.astuple(found["left"]) == pytest.approx((1, 1.0, 0.1, 0.3, 0.9))
    assert dataclasses.astuple(found["right"]) == pytest.approx((1, 0.0, 0.0, 0.2, 1.0))
    assert set(passing_sides.served(forecast, futures, torch.tensor([False, False]))) == {"right"}


def test_the_side_of_a_future_is_the_turn_of_the_line_of_sight():
    angles = torch.linspace(0.0, 4.0, 30)  # more than half a turn
    around = torch.stack((angles.cos(), angles.sin()), -1)
    centre = torch.tensor([5.0, 3.0]).expand(30, 2)
    pairs = torch.stack((torch.stack((centre, centre + around)), torch.stack((centre, centre + around.flip(0)))))
    assert passing_sides.turns_left(pairs).tolist() == [True, False]


def test_errors_are_split_by_placement_and_side():
    """One agent and step, three placements: errors are 1, 2 and 4 m on the executed side, ten times as much on the other."""
    at = torch.tensor([1.0, 2.0, 4.0, 100.0])
    futures = torch.stack((at, 10.0 * at), 1)[:, :, None, None, None] * torch.tensor([1.0, 0.0])
    modes = torch.stack((torch.zeros(4), torch.full((4,), 1e6)), 1)[:, :, None, None, None] * torch.ones(2)
    found = Forecasts(
        modes=modes,
        futures=futures,
        both=torch.tensor([True, True, True, False]),
        start=torch.zeros(4, 1, 2),
        weight=torch.ones(4),
        placement=torch.tensor([0, 1, 2, 1]),
        placements=3,
    )
    assert placements.errors(found) == {"executed": [1.0, 4.0, 51.0], "alternative": [10.0, 40.0, 20.0]}


def test_errors_of_runs_are_shared_where_they_point_the_same_way():
    """Two records and one agent: the closest mode misses by (1, 0) and (0, 2), or in other directions."""
    off = torch.tensor([[1.0, 0.0], [0.0, 2.0]])[:, None, None, None]
    far = torch.full_like(off, 1e3)
    found = [
        Forecasts(
            modes=torch.cat((far, error), 1),
            futures=torch.zeros(2, 2, 1, 1, 2),
            both=torch.tensor([True, False]),
            start=torch.zeros(2, 1, 2),
            weight=torch.ones(2),
            placement=torch.zeros(2, dtype=torch.long),
            placements=1,
        )
        for error in (off, -3 * off, off.flip(0), off * torch.tensor([1.0, 0.0]))
    ]
    executed, alternative = ([of_run.missed(side)[of_run.having(side)] for of_run in found] for side in (0, 1))
    assert executed[0].tolist() == [[[1.0, 0.0]], [[0.0, 2.0]]]
    assert [len(error) for error in alternative] == [1, 1, 1, 1]
    expected = [1.0, -1.0, 0.0, 1 / math.sqrt(5)]
    assert shared_errors.correlations(executed)[0].tolist() == pytest.approx(expected)


def test_sides_that_a_run_serves_are_counted(capsys, tmp_path):
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "callbacks.progress=none"]
    data = RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2)
    data.generate(workers=1, progress=False)
    run = train.train(compose("train", ["experiment=rpi/v_lstm_sc", *small, "budget=smoke", f"runs={tmp_path}"])).path
    capsys.readouterr()
    passing_sides.main([str(run)])
    rows = [line.removeprefix(str(run)).split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert sum(int(row[1]) for row in rows) == int((data.records("test")["modes"] == 2).sum())
    assert all(float(row[3]) > 0 and float(row[4]) > 0 for row in rows)
    distance_by_weight.main([str(run)])
    true, forecast = (line.removeprefix(str(run)).split() for line in capsys.readouterr().out.splitlines()[1:])
    assert (true[0], forecast[0]) == ("true", "forecast")
    assert float(true[2]) > 0.5, "discs do not touch"
    placements.main([str(run), "--split", "train"])
    executed, alternative = (line.removeprefix(str(run)).split() for line in capsys.readouterr().out.splitlines()[1:])
    assert (executed[0], alternative[0]) == ("executed", "alternative")
    assert float(executed[1]) > 0
    assert executed[2:] == ["nan", "nan"], "there is one placement"
    shared_errors.main([str(run), str(run)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [f"run 0: {run}", f"run 1: {run}"]
    assert [line.split()[3:] for line in lines if line.startswith("  run")] == 4 * [["1.00", "1.00"]]
    assert "no run folder" in refused(passing_sides.main, tmp_path / "nowhere")
    record = run / "run.json"
    record.write_text(record.read_text().replace('"finished"', '"training"'))
    assert "is not finished" in refused(passing_sides.main, run)
    drawn = ["data.targets=sampled", "budget=smoke", f"runs={tmp_path}"]
    sampled = train.train(compose("train", ["experiment=rpi/v_lstm_sc", *small, *drawn])).path
    assert "data.targets=sampled" in refused(passing_sides.main, sampled)
    other = train.train(compose("train", ["experiment=highway/v_lstm_sc", *TINY, f"runs={tmp_path}"])).path
    assert "only RPI has known equilibria" in refused(passing_sides.main, other)
    assert "only RPI has known equilibria" in refused(distance_by_weight.main, other)


_TOLD = """
import dataclasses
import sys
import epo_lightning
from benchmarks import hidden_weight
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.registry import ConfigError, build
from epo_lightning.scene import SPEED

words = sys.argv[1:]
root = next(word for word in words if word.startswith("data.root=")).removeprefix("data.root=")
told, plain = (kind(root=root, games=3, placements=1, sizes=None, recipe=2) for kind in (hidden_weight.ToldRPIData, RPIData))
assert told.digest != plain.digest
for split in ("train", "test"):
    scenes, weights = told.open(split), told.records(split)["weight"].float()
    assert (scenes.history[:, :, 0, SPEED] == ((weights - 55.0) / 45.0)[:, None]).all()  # w is between 10 and 100
    assert (scenes.history[..., :3] == plain.open(split).history[..., :3]).all()
    assert (scenes.history[:, :, 1:] == plain.open(split).history[:, :, 1:]).all()
hidden_weight.main(words)
run = next(word for word in words if word.startswith("run_dir=")).removeprefix("run_dir=")
forecaster = epo_lightning.load(f"{run}/checkpoints/best.ckpt")
scene = told.open("test")[:1]
other = scene.history.clone()
other[:, :, 0, SPEED] += 1.0
scenes = [dataclasses.replace(scene, history=history) for history in (scene.history, other)]
read = [forecaster.backbone(one) for one in scenes]
assert (read[0] != read[1]).any(-1).all()
for name in ("v_lstm", "vibes", "hivt_m"):  # no backbone reads speeds
    backbone = build("backbone", {"name": name}).eval()
    assert (backbone(scenes[0]) == backbone(scenes[1])).all()
for row in ("rpi/v_lstm_sc backbone=vibes", "rpi/v_lstm_epo_game", "highway/v_lstm_sc"):
    try:
        hidden_weight.main(f"experiment={row}".split())
    except SystemExit as error:
        assert "backbone=v_lstm and without calibration" in str(error)
    else:
        raise AssertionError(row)
try:
    hidden_weight.ToldRPIData(root=root, games=3, placements=1, sizes=None, recipe=2, games_share=0.5).open("train")
except ConfigError as error:
    assert "games_share" in str(error)
else:
    raise AssertionError("a share of the games")
"""


def test_a_network_is_told_the_weight_of_the_game(tmp_path):
    """In a process of its own, because the program registers a data set and a backbone."""
    RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2).generate(workers=1, progress=False)
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "callbacks.progress=none"]
    words = ["experiment=rpi/v_lstm_sc", *small, "budget=smoke", "score=test", f"run_dir={tmp_path / 'run'}"]
    found = subprocess.run([sys.executable, "-c", _TOLD, *words], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["metrics"]


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
    assert "not repeated: no RPI data at nowhere" in capsys.readouterr().out


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


def test_smallest_distances_are_ranked_against_the_weight():
    """Agents on parallel lines that are w metres apart, but for one pair that keeps less than its w."""
    weight = torch.tensor([1.0, 2.0, 3.0, 4.0])
    along = torch.linspace(0.0, 1.0, 5)
    apart = torch.tensor([1.0, 2.0, 1.5, 4.0])
    lines = torch.stack((along.expand(4, 5), torch.zeros(4, 5)), -1)
    positions = torch.stack((lines, lines + torch.stack((torch.zeros(4), apart), -1)[:, None]), 1)
    distance = distance_by_weight.smallest(positions)
    torch.testing.assert_close(distance, apart)
    found = distance_by_weight.by_weight(distance, weight)
    assert dataclasses.astuple(found) == pytest.approx((0.8, 1.0, 4.0))
    assert math.isnan(distance_by_weight.by_weight(distance, torch.ones(4)).correlation), "one weight has no rank"


@pytest.mark.slow
def test_modes_of_records_are_drawn_with_their_energies(capsys, tmp_path):
    data = RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2)
    data.generate(workers=1, progress=False)
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "budget=smoke"]
    run = train.train(compose("train", ["experiment=rpi/v_lstm_epo", *small, f"runs={tmp_path}"])).path
    modes = data.records("test")["modes"]
    two, one = ((modes == count).nonzero()[0].item() for count in (2, 1))
    capsys.readouterr()
    figures.main(["modes", str(tmp_path / "modes.png"), str(run), "--records", str(two)])
    assert (tmp_path / "modes.png").stat().st_size > 10_000
    first, second = capsys.readouterr().out.splitlines()
    assert re.fullmatch(rf".*, record {two}: E of the modes \d+, \d+ before, \d+, \d+ after the steps", first)
    assert second.endswith(f"true {data.records('test')['weight'][two]:.1f}")
    assert f"record {one} " in refused(figures.main, "modes", tmp_path / "modes.png", run, "--records", one)


TINY = (
    "data=drawn",
    "data.scenes=32",
    "data.batch_size=4",
    "data.like=highway",
    "budget=smoke",
    "callbacks.progress=none",
)
"""Overrides of a training of seconds on scenes that are drawn at random."""


@pytest.mark.slow
def test_refinements_of_runs_are_scored_and_timed(capsys, tmp_path):
    run = train.train(compose("train", ["experiment=highway/v_lstm", *TINY, f"runs={tmp_path}"]))
    refinement.main(
        [str(run.path), "--weights", "accref=1", "turnrref=20", "circles=10", "headway=1", "--margins", "headway=0"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[3] for line in lines[1:-1] if " all " in line] == ["given", "tracked", "refined"]
    assert lines[-1].startswith("CPU ms per scene of 4 agents and 5 modes: ")
    assert "'circles' is not name=number" in refused(refinement.main, run.path, "--weights", "circles")


@pytest.mark.slow
def test_best_responses_come_close_to_the_central_solution(capsys, tmp_path):
    run = train.train(compose("train", ["experiment=highway/v_lstm_epo_equilibrium", *TINY, f"runs={tmp_path}"]))
    decentralised.main([str(run.path)])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in rows] == ["central", *["in_turn"] * 6, *["at_once"] * 6]
    near = [float(row[2].removesuffix("%")) for row in rows[1:]]
    assert near[5] >= near[0]
    assert near[11] >= near[6]
    marginal = train.train(compose("train", ["experiment=highway/v_lstm", *TINY, f"runs={tmp_path}"]))
    assert "infers no game of features" in refused(decentralised.main, marginal.path)


@pytest.mark.slow
def test_forecasts_of_traffic_are_made_faster_and_slower(capsys, tmp_path):
    pytest.importorskip("libsumo", reason="the extra `sim` is not installed")
    forecast_speed.main(["highway_sim/hivt_m_epo", "--traffic", "free", "--episodes", "1", "--watched", "1"])
    rows = [line.split("  ")[0] for line in capsys.readouterr().out.splitlines()]
    assert [rows.count(name) for name in ("HiVT-M + EPO", "keeping their speed")] == [3, 3]
    assert "keeping their speed, +0.85 m/s²" in rows
    assert "HiVT-M + EPO, -0.85 m/s²" in rows
    other = train.train(compose("train", ["experiment=highway/v_lstm", *TINY, f"runs={tmp_path}"]))
    assert "takes runs of recorded traffic" in refused(forecast_speed.main, other.path)


def test_gates_are_compared_and_missing_data_is_one_line(capsys, tmp_path):
    many_agents.main(["data=drawn", "--agents", "3", "4", "--scenes", "2", "--repeats", "1", "--ahead", "0"])
    lines = capsys.readouterr().out.splitlines()
    assert [line[:5] for line in lines if line.startswith("N =")] == ["N = 3", "N = 4"]
    everyone = [line.split()[1:] for line in lines if line.startswith("all")]
    assert [row[0] for row in everyone] == ["2", "3"]  # pairs per agent
    assert [row[5:8] for row in everyone] == [["1", "0", "0"]] * 2  # no difference to itself
    assert str(tmp_path) in refused(many_agents.main, "data=ucy", f"data.folder={tmp_path}")


def test_hard_constraints_are_kept_and_soft_ones_are_not(capsys):
    current = torch.tensor([[[-2.0, 0.1, 0.0, 1.0], [2.0, -0.1, torch.pi, 1.0]]], dtype=torch.float64)
    size = torch.full((1, 2, 2), 0.5, dtype=torch.float64)
    scene = Scene(current[:, :, None], dt=0.4, size=size, future=current[:, :, None].expand(-1, -1, 8, -1))
    hard_constraints.report(scene)
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[0] for row in rows[-5:]] == ["soft,"] * 4 + ["hard"]
    assert float(rows[-5][3]) > 0.01 > 0.001 >= float(rows[-1][2])
    with pytest.raises(SystemExit, match="no scene whose constraints can be met"):
        hard_constraints.report(dataclasses.replace(scene, size=8 * size))


def test_refinements_name_what_is_no_run(tmp_path):
    assert str(tmp_path) in refused(refinement.main, tmp_path)


def test_figures_are_drawn_and_wrong_runs_are_one_line(tmp_path):
    figures.main(["levels", str(tmp_path / "levels.png")])
    assert (tmp_path / "levels.png").stat().st_size > 10_000
    assert str(tmp_path) in refused(figures.main, "weights", tmp_path / "weights.png", tmp_path)
    for words in (["weights"], ["modes"], ["modes", "rpi/v_lstm_epo"], ["weights", "rpi/v_lstm_epo", "--records", "1"]):
        with pytest.raises(SystemExit):
            figures.main([words[0], str(tmp_path / "figure.png"), *words[1:]])


@pytest.mark.parametrize("format_", ["commonroad", "ucy", "exid"])
def test_extraction_of_a_folder_of_another_format_is_one_line(format_, tmp_path):
    folder = FIXTURE if format_ != "exid" else tmp_path
    message = refused(extraction.main, folder, "--format", format_)
    assert str(folder) in message
    assert f"--format is {format_}" in message


def test_extraction_of_a_format_that_does_not_exist_names_the_nearest():
    assert "did you mean 'exid'" in refused(extraction.main, FIXTURE, "--format", "exdi")


def test_made_scenarios_have_scenes(tmp_path):
    size = generation.make(tmp_path, 0, 11)
    sources = argoverse2(tmp_path)
    assert [source.group for source in sources] == ["train"] * 9 + ["val"] * 2
    assert size == sum(file.stat().st_size for file in tmp_path.rglob("*.*"))
    windows = WindowConfig(
        **{"dt": 0.1, "history": 50, "horizon": 60, "least_agents": 2, "lane_change": False, "off_lane": "agent"}
    )
    for source in sources[:3]:
        scenes, counts = extract(source.read(), windows)
        assert scenes is not None
        assert counts["windows"] > 0


@pytest.mark.slow
def test_generation_and_reading_are_measured(tmp_path, capsys):
    generation.main(["--recordings", "50", "--folder", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "a million of these recordings" in shown
    (made,) = (tmp_path / "cache-all").glob("argoverse2-*")
    reading.main([str(made), "--gigabytes", "0.01", "--seconds", "0.1", "--folder", str(tmp_path / "repeated")])
    assert capsys.readouterr().out.count("scenes/s") == 8
