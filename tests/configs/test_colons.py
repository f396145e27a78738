"""Keys of YAML files that lack a colon, and keys with blanks that do not."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from epo_lightning.experiment.config.sources import _check_colons
from epo_lightning.registry import ConfigError


def refusal(file: Path, text: str) -> str | None:
    """The message about a file with this text; None if it is allowed."""
    file.write_text(text)
    try:
        _check_colons(file, OmegaConf.load(file))
    except ConfigError as error:
        return str(error)
    return None


@pytest.mark.parametrize(
    "text", ["a: {MY VAR: null}", "a: {'b c': }", "a: {b c: {d: 1}}", "a: {b c: ''}", "a: {b: }", ""]
)
def test_keys_with_blanks_are_allowed_if_they_have_a_value_or_quotation_marks(tmp_path: Path, text: str) -> None:
    assert refusal(tmp_path / "own.yaml", text) is None


@pytest.mark.parametrize("text", ["a: {steps 3}", "steps 3:", "a: {b c: {steps 3}}", "a:\n  b: 1\n  steps 3:"])
def test_a_key_without_its_colon_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "own.yaml"
    assert refusal(file, text) == f"in {file}, `steps 3` lacks a colon: write `steps: 3`"
