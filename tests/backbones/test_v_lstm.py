"""V-LSTM, with and without the goal as an input."""

import pytest
from games import random_scene
from suites import BackboneSuite

from epo_lightning.registry import build


class TestVLSTM(BackboneSuite):
    config = {"name": "v_lstm"}


class TestVLSTMWithGoal(BackboneSuite):
    config = {"name": "v_lstm", "goal_input": True}


def test_a_single_state_is_refused():
    with pytest.raises(ValueError, match="H = 1 state"):
        build("backbone", {"name": "v_lstm"})(random_scene(1, 2, history=1))
