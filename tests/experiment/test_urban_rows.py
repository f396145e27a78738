"""Urban rows: those on highways, on scenes with several ways through a junction."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from data.recorded.crossings import turning_traffic
from omegaconf import OmegaConf

import epo_lightning
from benchmarks.along_across import main as along_and_across
from benchmarks.chosen_goals import COLUMNS as GOAL_COLUMNS
from benchmarks.chosen_goals import main as goal_scores
from benchmarks.goals import main as goals
from benchmarks.turning import main as turning_scores
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.experiment import train
from epo_lightning.experiment.assembly import build_data
from epo_lightning.experiment.config.compose import compose, jobs, tree
from epo_lightning.experiment.evaluate import evaluate
from epo_lightning.experiment.predict import predict
from epo_lightning.experiment.verbs import check_settings
from epo_lightning.files import read_json
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.identity import differences
from epo_lightning.registry import register
from epo_lightning.scene import Scene

ROWS = sorted(file.stem for file in (tree() / "conf" / "experiment" / "urban").glob("*.yaml"))


@register("format", "turning")
def turning(folder: Path) -> list[RecordingSource]:
    """Files ``<seed>.turning`` of traffic that turns."""
    return [
        RecordingSource(
            file.stem, file.stem, (file,), lambda file=file: turning_traffic(int(file.stem), name=file.stem)
        )
        for file in folder.glob("*.turning")
    ]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Words that choose an extracted data set of turning traffic."""
    folder = tmp_path_factory.mktemp("turning")
    for seed in range(5):
        (folder / f"{seed}.turning").touch()
    words = ["data=lankershim", "data.format=turning", f"data.folder={folder}", f"data.root={folder / 'cache'}"]
    words += ["data.windows.smoothing=null", "data.windows.every=2"]
    build_data(compose("generate", words)["data"]).generate(workers=1, progress=False)
    return words


def content(row: str) -> dict[str, Any]:
    """The file of a row without its choice of task and data."""
    found = OmegaConf.to_container(OmegaConf.load(tree() / "conf" / "experiment" / f"{row}.yaml"))
    assert isinstance(found, dict)
    chosen = {"override /task", "override /data"}
    kept = [entry for entry in found["defaults"] if isinstance(entry, str) or not chosen & entry.keys()]
    found["defaults"] = [entry.replace("/urban/", "/highway/") if isinstance(entry, str) else entry for entry in kept]
    found.pop("task", None)  # of rows without a network, which choose no group of it
    return found


def test_the_rows_are_those_of_the_highway_on_other_data() -> None:
    backbones = ("v_lstm", "vibes", "hivt_m")
    suffixes = ("", "_sc", "_epo", "_epo_no_pair")
    of_backbones = {f"{backbone}{suffix}" for backbone in backbones for suffix in suffixes}
    assert of_backbones | {"const_vel", "v_lstm_epo_no_goal"} == set(ROWS)
    for row in ROWS:
        assert content(f"urban/{row}") == content(f"highway/{row}")
    row = "vibes_epo_no_pair"
    urban, highway = (compose("train", [f"experiment={kind}/{row}", "data=exid"]) for kind in ("urban", "highway"))
    assert differences(urban, highway) == []
    assert compose("train", ["experiment=urban/v_lstm_epo"])["data"]["dataset"] == "lankershim"


def test_maps_with_junctions_have_lines_along_all_successors() -> None:
    windows = {}
    for file in (tree() / "conf" / "data").glob("*.yaml"):
        section = compose("generate", [f"data={file.stem}"])["data"]
        if section.get("map"):
            windows[file.stem] = section["windows"].get("lines"), section["windows"]["lanes"]
    urban = dict.fromkeys(("argoverse2", "ind", "interaction", "lankershim", "round", "unid", "waymo"), (8, None))
    highways = dict.fromkeys(("exid", "highd", "us101"), (None, 32))
    assert windows == {**urban, **highways}


def test_the_sweep_has_every_row_and_a_twin_without_pair_terms_of_every_game() -> None:
    runs = jobs("train", ["sweeps=urban_main"])
    assert len(runs) == 3 * len(ROWS)
    configs = {config["experiment"]: config for config in (compose("train", job) for job in runs if "seed=0" in job)}
    assert configs.keys() == {f"urban/{row}" for row in ROWS}
    for game in (name for name in configs if name.endswith("_epo")):
        assert differences(configs[game], configs[f"{game}_no_pair"]) == [("energy.pair", ["proximity"], [])]


@pytest.mark.parametrize("row", ["v_lstm_sc", "v_lstm_epo", "vibes"])
def test_rows_train_on_several_ways_through_a_junction(row: str, data: list[str], tmp_path: Path) -> None:
    words = [f"experiment=urban/{row}", "budget=smoke", "callbacks.progress=none", f"runs={tmp_path}"]
    run = train.train(compose("train", [*words, *data, "data.batch_size=4"]))
    evaluate({"run": str(run.path), "batch_size": 16})
    metrics = read_json(run.metrics_file())["metrics"]
    assert all(math.isfinite(value) for value in metrics.values())
    if row == "v_lstm_epo":
        out = tmp_path / "seen"
        predict(
            check_settings("predict", compose("predict", [f"run={run.path}", f"out={out}", "figures=1", "scenes=3"]))
        )
        assert list((out / "figures").glob("scene_*.png"))


def untrained(row: str, data: list[str], folder: Path) -> tuple[str, Scene, Forecaster]:
    """The folder of an untrained run, all test scenes of its data as one batch, and its forecaster."""
    words = [f"experiment=urban/{row}", "budget=untrained", "callbacks.progress=none", f"runs={folder}", *data]
    run = train.train(compose("train", words))
    scenes = build_data(compose("train", words)["data"]).open("test")
    return str(run.path), scenes[torch.arange(len(scenes))], epo_lightning.load(run.checkpoint("best"))


def test_scores_of_turning_agents_are_those_of_a_loop(
    data: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, scene, forecaster = untrained("v_lstm_sc", data, tmp_path)
    turning_scores([run])
    shown = [line.split()[-6:] for line in capsys.readouterr().out.splitlines()[1:]]
    forecast = forecaster.predict(scene)
    errors = (forecast.states[..., :2] - scene.future[:, None, ..., :2]).norm(dim=-1)  # [B, M, N, K]
    for name, turns in (("turning", True), ("others", False)):
        count, each, joint = 0, [], []
        for b in range(len(scene.history)):
            turned = [
                abs(float(scene.future[b, i, -1, 2] - scene.history[b, i, -1, 2])) > math.pi / 6 for i in range(4)
            ]
            members = [i for i in range(4) if scene.agent_mask[b, i] and turned[i] == turns]
            if members:
                count += len(members)
                each.append(float(np.mean([errors[b, :, i].mean(-1).min() for i in members])))
                joint.append(float(errors[b][:, members].mean((1, 2)).min()))
        (line,) = [line for line in shown if line[0] == name]
        assert int(line[1]) == count > 0
        assert float(line[2]) == pytest.approx(np.mean(each), abs=6e-4)
        assert float(line[4]) == pytest.approx(np.mean(joint), abs=6e-4)


def test_lanes_of_scenes_reach_as_far_as_agents_get(data: list[str]) -> None:
    module = build_data(compose("generate", data)["data"])
    scenes = module.open("train")
    batch = scenes[torch.arange(len(scenes))]
    points = torch.where(batch.lane_mask[..., None], batch.lanes, torch.inf).unflatten(-1, (2, 2)).flatten(1, 3)
    ends = batch.future[:, :, -1, :2]
    nearest = (points[:, None] - ends[:, :, None]).norm(dim=-1).amin(-1)
    assert nearest[batch.agent_mask].max() < 5.0
    assert module.report()["train"].get("moving agents that end over 10 m from all lanes given", 0.0) == 0.0


def test_goals_of_turning_agents_are_measured_by_a_command(data: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    shares = {}
    for lines in ("8", "null"):
        goals([*data, f"data.windows.lines={lines}", "workers=1"])
        shown = capsys.readouterr().out.splitlines()
        turning = next(line.split() for line in shown if line.startswith("turning"))
        shares[lines] = np.array(turning[1:4], dtype=float)
    assert shares["8"][0] == shares["null"][0] > 20, "the same agents"
    assert shares["8"][1] < 1.5
    assert shares["8"][2] < 3.0
    assert shares["null"][2] > shares["8"][2] + 1.0, "three lines follow the straightest successor"


def test_errors_along_and_across_are_those_of_a_loop(
    data: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, scene, forecaster = untrained("v_lstm_sc", data, tmp_path)
    along_and_across([run])
    shown = capsys.readouterr().out.splitlines()[1].split()[:4]
    states = forecaster.predict(scene).states
    found = []
    for b in range(len(scene.history)):
        agents = [i for i in range(scene.agent_mask.shape[1]) if scene.agent_mask[b, i]]
        distance = (states[b, ..., :2] - scene.future[b, None, ..., :2]).norm(dim=-1)  # [M, N, K]
        mode = int(distance[:, agents].mean((1, 2)).argmin())
        of_agents = []
        for i in agents:
            x, y = (states[b, mode, i, -1, :2] - scene.future[b, i, -1, :2]).tolist()
            angle = math.atan2(y, x) - float(scene.future[b, i, -1, 2])
            ahead, aside = math.hypot(x, y) * math.cos(angle), math.hypot(x, y) * math.sin(angle)
            of_agents.append((abs(ahead), abs(aside), ahead))
        found.append(np.mean(of_agents, axis=0))
    assert int(shown[0]) == len(scene.history)
    assert [float(value) for value in shown[1:]] == pytest.approx(list(np.mean(found, axis=0)), abs=2e-3)


def test_scores_of_chosen_goals_are_those_of_a_loop(
    data: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, scene, forecaster = untrained("v_lstm_epo", data, tmp_path)
    goal_scores([run])
    printed = capsys.readouterr().out.splitlines()[1].split()[1 : 1 + len(GOAL_COLUMNS)]
    shown = dict(zip(GOAL_COLUMNS, map(float, printed), strict=True))
    forecast = forecaster.predict(scene)
    end = scene.future[..., -1, :2]

    def closest(states: torch.Tensor) -> float:
        agents = scene.agent_mask
        distance = (states[..., :2] - scene.future[:, None, ..., :2]).norm(dim=-1).mean(-1)  # [B, M, N]
        return float(np.mean([float(distance[b][:, agents[b]].mean(1).min()) for b in range(len(scene.history))]))

    def solved(weight: float, goals: torch.Tensor, reference: torch.Tensor) -> float:
        own = dict(forecast.parameters.own_weights)
        own.update({name: weight * own[name] for name in ("goal", "lane")})
        changed = dataclasses.replace(forecast.parameters, own_weights=own, goals=goals, reference=reference)
        return closest(forecaster.solve(scene, changed).states)

    true, lanes = end[:, None].expand(forecast.parameters.goals.shape).contiguous(), forecast.parameters.reference
    nearest_lanes = lanes.clone()
    for b, i in (scene.agent_mask & scene.goal_mask.any(-1)).nonzero().tolist():
        exist = scene.goal_mask[b, i].nonzero()[:, 0]
        ways = (scene.goal_candidates[b, i, exist] - end[b, i]).norm(dim=-1)
        nearest_lanes[b, :, i] = scene.goal_reference[b, i, exist[ways.argmin()]]
    assert shown["SADE"] == pytest.approx(closest(forecast.states), abs=2e-3)
    assert shown["initial"] == pytest.approx(closest(forecast.initial_states), abs=2e-3)
    assert shown["no goals"] == pytest.approx(solved(0.0, true + 40.0, lanes * 0), abs=2e-3), "they mean nothing"
    assert shown["true goals"] == pytest.approx(solved(1.0, true, nearest_lanes), abs=2e-3)
    assert len({round(shown[name], 2) for name in ("SADE", "initial", "no goals", "true goals")}) > 2
    losses, counts, ways = [], [], []
    for b in range(len(scene.history)):
        for i in scene.agent_mask[b].nonzero()[:, 0].tolist():
            exist = scene.goal_mask[b, i].nonzero()[:, 0]
            logits = forecast.goal_logits[b, i, exist].double()
            nearest = int((scene.goal_candidates[b, i, exist] - end[b, i]).norm(dim=-1).argmin())
            losses.append((b, float(logits.logsumexp(0) - logits[nearest])))
            counts.append((b, math.log(len(exist))))
            ways += (forecast.parameters.goals[b, :, i] - end[b, i]).norm(dim=-1).tolist()
    for name, values in (("entropy", losses), ("uniform", counts)):
        of_scenes = [np.mean([value for at, value in values if at == b]) for b in range(len(scene.history))]
        assert shown[name] == pytest.approx(np.mean(of_scenes), abs=2e-3)
    assert shown["goal [m]"] == pytest.approx(np.mean(ways), abs=2e-3)
    with pytest.raises(SystemExit, match="does not choose goals"):
        goal_scores([untrained("v_lstm_sc", data, tmp_path)[0]])
