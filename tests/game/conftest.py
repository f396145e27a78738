"""Fixtures of tests of games."""

from __future__ import annotations

import pytest

from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES


@pytest.fixture
def registry():
    """Features registered in a test are gone after it."""
    own, pair = dict(OWN_FEATURES), dict(PAIR_FEATURES)
    yield
    for known, before in ((OWN_FEATURES, own), (PAIR_FEATURES, pair)):
        for name in set(known) - set(before):
            del known[name]
