"""Benchmarks of computing time at their smallest sizes, and their errors: one line for a foreseeable mistake."""

from __future__ import annotations

import functools
import json
import re

import pytest
import torch
from experiment.replays import Again
from programs import refused
from rich.console import Console

from benchmarks import dashboards, devices, epo_layer, explore, forecast_time, scaling, training_step

SMALL = ["--B", "2", "--M", "1", "--K", "4", "--S", "1", "--repeats", "1"]


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
def test_answers_of_the_page_are_timed(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))  # no data set: the scenes that ship with the run are taken
    explore.main(["times", "rpi/v_lstm_epo", "--edits", "2"])
    assert re.search(r"solver +median +[\d.]+ ms.*\nall +median +[\d.]+ ms", capsys.readouterr().out)
