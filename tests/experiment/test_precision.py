"""Precisions that a run may have."""

from __future__ import annotations

import pytest

from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.registry import ConfigError


@pytest.mark.parametrize("precision", ["16-mixed", "bf16-mixed", "bf16-true", "32 true"])
def test_unsupported_precisions_are_refused_before_the_run(precision: str) -> None:
    with pytest.raises(ConfigError, match=r"trainer\.precision must be one of 32-true, 64-true, not .* digits"):
        TrainerSettings(precision=precision)


@pytest.mark.parametrize("precision", ["32-true", "64-true"])
def test_single_and_double_precision_are_accepted(precision: str) -> None:
    assert TrainerSettings(precision=precision).precision == precision
