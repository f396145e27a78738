"""Test of the benchmark of features of the user."""

from __future__ import annotations

import re

import pytest

from benchmarks import own_features
from epo_lightning.game.features import OWN_FEATURES


def test_every_declaration_is_timed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    known = {*OWN_FEATURES}
    monkeypatch.setattr(own_features, "ROWS", ("rpi/v_lstm_epo",))
    try:
        own_features.main(["--rounds", "1"])
    finally:
        for name in {*OWN_FEATURES} - known:
            del OWN_FEATURES[name]
    head, _, row = capsys.readouterr().out.splitlines()
    assert re.findall(r"`Source\.(\w+)`", head) == ["SPEED", "STEP", "TRAJECTORY"]
    times = [float(number) for number in re.findall(r"\d+\.\d", row)]
    assert len(times) == 4
    assert min(times) > 0
