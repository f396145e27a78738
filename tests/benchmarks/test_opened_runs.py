"""Runs that benchmarks open: only finished ones are measured, on the data that they were trained on."""

from __future__ import annotations

import pytest
from programs import TINY, refused

from benchmarks import (
    along_across,
    chosen_goals,
    decentralised,
    distance_by_weight,
    figures,
    passing_sides,
    placements,
    refinement,
    shared_errors,
    turning,
)
from epo_lightning.data import drawn
from epo_lightning.experiment import train
from epo_lightning.experiment.config.compose import compose
from epo_lightning.run_folder import RunFolder

OF_RUNS = (
    along_across,
    chosen_goals,
    decentralised,
    distance_by_weight,
    passing_sides,
    placements,
    refinement,
    shared_errors,
    turning,
)
"""Benchmarks whose words are run folders."""


@pytest.mark.parametrize("words", [(benchmark.main,) for benchmark in OF_RUNS] + [(figures.main, "weights", "w.png")])
def test_an_unfinished_run_is_refused(words, tmp_path):
    run = RunFolder(tmp_path / "run")
    run.begin({"seed": 0}, {})
    advice = f"{run.path} is not finished: continue it with `epo train resume={run.path}`"
    assert refused(*words, run.path) == f"{words[0].__module__}: {advice}"


def test_data_that_has_changed_is_refused(tmp_path, monkeypatch):
    run = train.train(compose("train", ["experiment=highway/v_lstm_epo_equilibrium", *TINY, f"runs={tmp_path}"]))
    monkeypatch.setattr(drawn, "VERSION", drawn.VERSION + 1)
    for main in (refinement.main, decentralised.main):
        assert f"the data of {run.path} has changed since the run began" in refused(main, run.path)
