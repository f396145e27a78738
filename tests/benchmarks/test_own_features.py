"""Test of the benchmark of features of the user."""

from __future__ import annotations

import re

import pytest

from benchmarks import own_features
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES


def test_every_declaration_is_timed(capsys: pytest.CaptureFixture[str]) -> None:
    known = {*OWN_FEATURES, *PAIR_FEATURES}
    try:
        own_features.main(["--rounds", "1", "--rows", "rpi/v_lstm_epo"])
    finally:
        for features in (OWN_FEATURES, PAIR_FEATURES):
            for name in features.keys() - known:
                del features[name]
    head, _, row = capsys.readouterr().out.splitlines()
    named = ["own, SPEED", "own, STEP", "own, TRAJECTORY", "pair, DISTANCE", "pair, STEP", "pair, TRAJECTORY"]
    assert re.findall(r"\+ (\w+, \w+)", head) == named
    times = [float(number) for number in re.findall(r"\d+\.\d", row)]
    assert len(times) == 7
    assert min(times) > 0
