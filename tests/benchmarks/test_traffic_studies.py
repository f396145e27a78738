"""Studies of games of traffic and pedestrians at their smallest sizes: refinements, responses, gates and constraints."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from programs import TINY, refused

from benchmarks import decentralised, forecast_speed, hard_constraints, many_agents, refinement
from epo_lightning.experiment import train
from epo_lightning.experiment.config.compose import compose
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene


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


def test_refinements_name_what_is_no_run(tmp_path):
    assert str(tmp_path) in refused(refinement.main, tmp_path)


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
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
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
    with pytest.raises(ConfigError, match="no scene whose constraints can be met"):
        hard_constraints.report(dataclasses.replace(scene, size=8 * size))
