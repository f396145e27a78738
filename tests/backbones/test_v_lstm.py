"""V-LSTM, with and without the goal as an input."""

from suites import BackboneSuite


class TestVLSTM(BackboneSuite):
    config = {"name": "v_lstm"}


class TestVLSTMWithGoal(BackboneSuite):
    config = {"name": "v_lstm", "goal_input": True}
