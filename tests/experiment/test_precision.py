"""Precisions that a run may have."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from experiment.conftest import TINY, Epo
from games import random_scene
from safetensors.torch import load_file

import epo_lightning
from epo_lightning.drive.planners import ForecastPlanner
from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder


@pytest.mark.parametrize("precision", ["16-mixed", "bf16-mixed", "bf16-true", "32 true"])
def test_unsupported_precisions_are_refused_before_the_run(precision: str) -> None:
    with pytest.raises(ConfigError, match=r"trainer\.precision must be one of 32-true, 64-true, not .* digits"):
        TrainerSettings(precision=precision)


@pytest.mark.parametrize("precision", ["32-true", "64-true"])
def test_single_and_double_precision_are_accepted(precision: str) -> None:
    assert TrainerSettings(precision=precision).precision == precision


def test_weights_in_double_precision_are_loaded_as_they_are(epo: Epo) -> None:
    words = ("experiment=rpi/v_lstm_epo", *TINY, "trainer.precision=64-true", "run_dir=run", "score=test")
    assert epo("train", *words) == 0
    run = RunFolder(Path("run"))
    saved = torch.load(run.checkpoint("best"), weights_only=True)["state_dict"]
    forecaster = epo_lightning.load(run.checkpoint("best"))
    for name, weight in forecaster.state_dict().items():
        assert torch.equal(weight, saved[name])
    assert epo("predict", "run=run", "out=forecasts", "scenes=2") == 0
    assert load_file("forecasts/forecasts.safetensors")["states"].dtype == torch.double
    assert ForecastPlanner(forecaster)(random_scene(2), None).states.dtype == torch.double
