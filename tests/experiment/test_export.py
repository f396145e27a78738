"""Exported programs give the forecasts of their forecasters, in a process without this package."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.decoders import goals
from epo_lightning.experiment.config.settings import ExportSettings
from epo_lightning.experiment.export import check_exportable, export, inputs_of
from epo_lightning.forecasters.constant_velocity import ConstantVelocity
from epo_lightning.host import readable
from epo_lightning.registry import ConfigError

STRANGER = """
import json, sys, torch
about = {"about.json": ""}
program = torch.export.load(sys.argv[1], extra_files=about).module()
with torch.no_grad():
    found = program(torch.load(sys.argv[2]))
assert not any(name.startswith("epo_lightning") for name in sys.modules)
torch.save(found, sys.argv[3])
print(about["about.json"])
"""


@pytest.mark.parametrize(
    "name",
    [
        "rpi/v_lstm_sc",
        pytest.param("rpi/v_lstm_epo", marks=pytest.mark.slow),
        pytest.param("highway_sim/hivt_m_epo", marks=pytest.mark.slow),
    ],
)
def test_a_program_gives_the_forecasts_of_its_forecaster_elsewhere(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))  # no data set: the scenes that ship with the run are the example
    file, difference = export(ExportSettings(run=name, out=str(tmp_path / "it.pt2")))
    assert difference <= 1e-5
    forecaster, scenes = epo_lightning.load(name), pretrained.examples(name)
    for count in (1, 7):  # other batches than the example's
        some = scenes[slice(count)]
        torch.save(inputs_of(forecaster, some), tmp_path / "given.pt")
        words = [sys.executable, "-I", "-c", STRANGER, *(str(tmp_path / f) for f in ("it.pt2", "given.pt", "found.pt"))]
        printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
        found, wanted = torch.load(tmp_path / "found.pt"), forecaster.predict(some)
        torch.testing.assert_close(found["states"], wanted.states, atol=1e-5, rtol=0)
        torch.testing.assert_close(found["probabilities"], wanted.probabilities, atol=1e-5, rtol=0)
    about = json.loads(printed)
    assert about["dt"] == scenes.dt
    assert about["inputs"]["history"]["shape"] == ["B", *scenes.history.shape[1:]]
    assert about["outputs"]["states"]["dtype"] == "float32"
    with pytest.raises(ConfigError, match="it.pt2 exists: nothing is overwritten"):
        export(ExportSettings(run=name, out=str(file)))


def test_solvers_that_stop_at_convergence_are_refused() -> None:
    forecaster = epo_lightning.load("rpi/v_lstm_epo")
    check_exportable(forecaster, "two steps")
    forecaster.solver = replace(forecaster.solver, adaptive=True)
    with pytest.raises(
        ConfigError, match=r"solved cannot be exported: its solver \(LevenbergMarquardt\) takes as many steps"
    ):
        check_exportable(forecaster, "solved")


def test_values_are_not_readable_on_other_devices_and_while_a_program_is_exported() -> None:
    assert readable(torch.zeros(1))
    assert not readable(torch.zeros(1, device="meta"))

    class Asked(torch.nn.Module):
        def forward(self, given: torch.Tensor) -> torch.Tensor:
            return given + (1.0 if readable(given) else 2.0)

    program = torch.export.export(Asked(), (torch.zeros(2),))
    assert program.module()(torch.zeros(2)).tolist() == [2.0, 2.0]


def test_logits_of_all_goal_candidates_are_those_of_the_existing_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "highway_sim/hivt_m_epo"
    forecaster, scene = epo_lightning.load(name).eval(), pretrained.examples(name)
    with torch.no_grad():
        z = forecaster.backbone(scene)
        compact = forecaster.goals.logits(z, scene)
        monkeypatch.setattr(goals, "readable", lambda tensor: False)
        torch.testing.assert_close(forecaster.goals.logits(z, scene), compact, atol=1e-5, rtol=0)


def test_forecasters_without_a_game_can_be_exported() -> None:
    check_exportable(ConstantVelocity.__new__(ConstantVelocity), "constant velocity")
