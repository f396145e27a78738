"""Studies of RPI's games and of runs on them, at their smallest sizes."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import subprocess
import sys

import pytest
import torch
from programs import ROOT, TINY, refused

from benchmarks import (
    distance_by_weight,
    feedback_games,
    figures,
    label_noise,
    passing_sides,
    placements,
    refinement,
    shared_errors,
    true_game,
)
from benchmarks.rpi_runs import Forecasts, drawn
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.experiment import train
from epo_lightning.experiment.config.compose import compose


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


def test_records_are_drawn_with_their_executed_futures():
    modes = torch.tensor([2, 1, 2, 2, 1])
    records = {"history": torch.zeros(5, 2, 19, 4), "goals": torch.zeros(5, 2, 2), "goal_headings": torch.zeros(5, 2)}
    records |= {"states": torch.zeros(5, 2, 2, 40, 4), "game_steps": torch.full((5,), 40), "modes": modes}
    scenes = RPIDataset(records)
    assert scenes.executed.tolist() == [0, 2, 3, 5, 7]
    few, every = drawn(scenes, 3), drawn(scenes, 9)
    assert sorted(every.tolist()) == [0, 2, 3, 5, 7]
    assert few.tolist() == every[:3].tolist()


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
    scenes = [refinement.forecasts(str(run), share, "test")[1] for share in (None, 0.5)]
    both, half = (sum(len(scene.history) for scene, *_ in of_share) for of_share in scenes)
    assert half == round(both / 2)
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


@pytest.mark.slow
def test_a_network_is_told_the_weight_of_the_game(tmp_path):
    """In a process of its own, because the program registers a data set and a backbone."""
    RPIData(root=str(tmp_path), games=3, placements=1, sizes=None, recipe=2).generate(workers=1, progress=False)
    small = [f"data.root={tmp_path}", "data.games=3", "data.placements=1", "data.sizes=null", "callbacks.progress=none"]
    words = ["experiment=rpi/v_lstm_sc", *small, "budget=smoke", "score=test", f"run_dir={tmp_path / 'run'}"]
    found = subprocess.run([sys.executable, "-c", _TOLD, *words], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["metrics"]


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


def test_figures_are_drawn_and_wrong_runs_are_one_line(tmp_path):
    figures.main(["levels", str(tmp_path / "levels.png")])
    assert (tmp_path / "levels.png").stat().st_size > 10_000
    assert str(tmp_path) in refused(figures.main, "weights", tmp_path / "weights.png", tmp_path)
    for words in (["weights"], ["modes"], ["modes", "rpi/v_lstm_epo"], ["weights", "rpi/v_lstm_epo", "--records", "1"]):
        with pytest.raises(SystemExit):
            figures.main([words[0], str(tmp_path / "figure.png"), *words[1:]])
