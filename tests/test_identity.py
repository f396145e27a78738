"""The identity of a run changes exactly with the settings that affect its result."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from epo_lightning.experiment.config.compose import compose
from epo_lightning.identity import differences, essence, identity, row_identity

CONFIG = compose("train", ["experiment=rpi/v_lstm_epo"])


def changed(key: str, value: Any) -> dict[str, Any]:
    config = copy.deepcopy(CONFIG)
    *sections, last = key.split(".")
    section = config
    for name in sections:
        section = section[name]
    section[last] = value
    return config


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("solver.steps", 4), ("optimizer.lr", 0.1), ("trainer.max_epochs", 3), ("energy.own", ["goal"])),
        *(("data.batch_size", 16), ("goal", "all"), ("objective.weights.goal", 7.0), ("callbacks.patience", 2)),
        *(("dynamics.integrator", "heun"), ("backward.name", "implicit"), ("backbone.width", 3), ("energy.pair", [])),
    ],
)
def test_settings_that_affect_the_result_change_the_identity(key: str, value: Any) -> None:
    other = changed(key, value)
    assert identity(other, "d") != identity(CONFIG, "d")
    assert row_identity(other, "d") != row_identity(CONFIG, "d")
    assert [found for found, _, _ in differences(CONFIG, other)] == [key]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(
            ("title", "x"),
            ("runs", "elsewhere"),
            ("run_dir", "here"),
            ("logger", {"wandb": {}}),
            ("existing", "continue"),
        ),
        *(("trainer.threads", 8), ("trainer.devices", 2), ("trainer.accelerator", "gpu"), ("data.root", "/cache")),
        *(("callbacks.progress", "bar"), ("budget", {"name": "other"}), ("experiment", "rpi/other")),
        *(("trainer.share", 2), ("trainer.graph", True), ("trainer.profiler", True)),
        *(("callbacks.refresh", 1), ("data.folder", "/recordings")),
    ],
)
def test_names_paths_and_hardware_do_not_change_the_identity(key: str, value: Any) -> None:
    other = changed(key, value)
    assert identity(other, "d") == identity(CONFIG, "d")
    assert differences(CONFIG, other) == []


def test_equal_numbers_have_equal_identities_except_batch_limits() -> None:
    for key, one, other in (("optimizer.clip", 1, 1.0), ("solver.damping", 10, 10.0), ("forecaster.own_start", 1, 1.0)):
        assert identity(changed(key, one), "d") == identity(changed(key, other), "d")
        assert differences(changed(key, one), changed(key, other)) == []
    for key in ("trainer.limit_train_batches", "trainer.limit_val_batches"):
        assert identity(changed(key, 1), "d") != identity(changed(key, 1.0), "d")
        assert [found for found, _, _ in differences(changed(key, 1), changed(key, 1.0))] == [key]
    assert differences(changed("solver.adaptive", True), changed("solver.adaptive", 1))


def test_rows_are_runs_without_their_seed() -> None:
    other = changed("seed", 5)
    assert identity(other, "d") != identity(CONFIG, "d")
    assert row_identity(other, "d") == row_identity(CONFIG, "d")


def test_a_setting_that_runs_did_not_have_yet_leaves_their_identity() -> None:
    before = copy.deepcopy(CONFIG)
    del before["data"]["recipe"]
    assert identity(before, "d") == identity(changed("data.recipe", 1), "d") != identity(CONFIG, "d")
    assert differences(before, changed("data.recipe", 1)) == []
    before = copy.deepcopy(CONFIG)
    del before["optimizer"]["shared_factor"]
    assert identity(before, "d") == identity(CONFIG, "d") != identity(changed("optimizer.shared_factor", 10), "d")


def test_calibrations_from_one_start_are_those_of_runs_without_the_setting() -> None:
    now = compose("train", ["experiment=rpi/v_lstm_epo_game", "forecaster.calibration.starts=[0.0]"])
    before = copy.deepcopy(now)
    del before["forecaster"]["calibration"]["starts"]
    assert identity(before, "d") == identity(now, "d")
    now["forecaster"]["calibration"]["starts"] = [0.0, 1.0]
    assert identity(before, "d") != identity(now, "d")


def test_a_setting_that_is_gone_leaves_the_identity_of_runs_that_have_it_off() -> None:
    now = compose("train", ["experiment=rpi/v_lstm_epo_game"])
    before = copy.deepcopy(now)
    before["forecaster"]["calibration"]["training"] = False
    assert identity(before, "d") == identity(now, "d")
    before["forecaster"]["calibration"]["training"] = True
    assert identity(before, "d") != identity(now, "d")


def test_data_enters_the_identity_by_its_digest() -> None:
    assert identity(CONFIG, "one") != identity(CONFIG, "other")
    assert len(identity(CONFIG, "one")) == 16


def test_the_order_of_keys_does_not_matter() -> None:
    shuffled = dict(reversed(CONFIG.items()))
    assert identity(shuffled, "d") == identity(CONFIG, "d")
    assert essence(shuffled) == essence(CONFIG)
