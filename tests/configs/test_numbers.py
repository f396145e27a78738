"""Every number of a configuration that cannot work is refused in one sentence: NaN, infinite, negative, huge."""

from __future__ import annotations

from typing import Any

import pytest

from epo_lightning.arguments import parse
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import EvaluateSettings, GenerateSettings, PredictSettings, Settings
from epo_lightning.forecasters import SUPPLIED
from epo_lightning.registry import ConfigError
from epo_lightning.schema import check_part, read

CONFIG = compose("train", ["experiment=rpi/v_lstm_epo", "logger=[csv,tensorboard]", "data=drawn", "data.like=rpi"])
NAN, INF = float("nan"), float("inf")
REFUSED = {
    "seed": (-1, 2**32, 1.5, NAN),
    "trainer.max_epochs": (1.5, NAN),
    "trainer.max_steps": (-5, 1.5),
    "trainer.threads": (0, -1, 100_000, 1.5),
    "trainer.devices": (0, -1, 100_000),
    "trainer.share": (0, -1),
    "trainer.validate_every": (0, -1),
    "trainer.validate_steps": (0, -1),
    "trainer.limit_train_batches": (0, -1, 1.5, NAN, INF, -INF),
    "trainer.limit_val_batches": (0, -1, 1.5, NAN, INF),
    "trainer.overfit_batches": (-1,),
    "callbacks.patience": (0, -1, NAN),
    "callbacks.min_delta": (-1.0, NAN, INF),
    "callbacks.refresh": (0, -1),
    "logger.csv.flush": (0, -1),
    "logger.tensorboard.pictures": (-1,),
    "logger.tensorboard.patience": (-1.0, NAN, INF),
    "data.batch_size": (0, 1, -1),
    "data.scenes": (0, -1),
    "optimizer.lr": (0.0, -1.0, NAN, INF),
    "optimizer.clip": (0.0, -1.0, NAN),
    "solver.steps": (-1, 1.5, NAN),
    "forecaster.modes": (0, -1, 1.5),
    "forecaster.control_scale": (0.0, -1.0, NAN, INF),
    "forecaster.own_start": (0.0, -1.0, NAN, INF),
    "forecaster.pair_start": (NAN, INF, -INF),
    "energy.pair_stride": (0, -1, 1.5, 41),  # the horizon has 40 steps
    "objective.weights.imitation": (-1.0, NAN, INF),
}
CASES = [(key, value) for key, values in REFUSED.items() for value in values]


def changed(key: str, value: Any) -> dict[str, Any]:
    """The configuration with one other value."""
    head, _, rest = key.partition(".")
    config = dict(CONFIG)
    if not rest:
        return {**config, head: value}

    def within(section: Any, keys: list[str]) -> Any:
        return {**section, keys[0]: within(section[keys[0]], keys[1:])} if keys else value

    return {**config, head: within(config[head], rest.split("."))}


def test_the_default_configuration_is_accepted() -> None:
    _, model = assembly.check_buildable(read(Settings, CONFIG))
    assert assembly.parameters(model) > 0


@pytest.mark.parametrize(("key", "value"), CASES, ids=lambda case: str(case))
def test_invalid_numbers_are_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError) as error:
        assembly.check_buildable(read(Settings, changed(key, value)))
    assert key.rpartition(".")[2] in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", SUPPLIED)
def test_no_number_of_a_part_may_be_nan(kind: str) -> None:
    section = CONFIG[kind]
    for key, value in section.items():
        if isinstance(value, float):
            with pytest.raises(ConfigError, match=rf"{kind}\.{key} must be a number.*, not nan"):
                check_part(kind, {**section, key: NAN}, SUPPLIED[kind])


@pytest.mark.parametrize(
    ("schema", "values"),
    [
        *((GenerateSettings, {"data": {}, "workers": workers}) for workers in (0, -1, 100_000, NAN)),
        *((EvaluateSettings, {"run": "run", "batch_size": size}) for size in (0, -1, 1.5)),
        *((PredictSettings, {"run": "run", "scenes": scenes}) for scenes in (0, -1, NAN)),
        *((PredictSettings, {"run": "run", key: -1}) for key in ("figures", "animate")),
    ],
)
def test_invalid_numbers_of_other_verbs_are_refused(schema: type, values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"{list(values)[-1]} must be"):
        read(schema, values)


@pytest.mark.parametrize("monitor", ["val/foo", "foo", "", "val/minSADE/executed"])
def test_an_unknown_score_cannot_be_monitored(monitor: str) -> None:
    with pytest.raises(ConfigError, match=r"unknown callbacks\.monitor .*known: .*val/minSADE"):
        assembly.check_buildable(read(Settings, changed("callbacks.monitor", monitor)))


def test_scores_of_subsets_can_be_monitored() -> None:
    data, _ = assembly.check_buildable(read(Settings, changed("callbacks.monitor", "val/executed/minADE")))
    assert "executed" in data.task.subsets


@pytest.mark.parametrize("words", ["seed=1 seed=2", "seed=1 +seed=1", "data=rpi data=exid", "a.b=1 c=2 ++a.b=3"])
def test_a_key_may_be_set_only_once(words: str) -> None:
    with pytest.raises(ConfigError, match=r"is set twice, by .* and by .*: leave one of them out"):
        parse(["train", *words.split()])
    assert parse(["train", "seed=1", "seeds=1", "~seed", "data.seed=1"]).overrides == [
        "seed=1",
        "seeds=1",
        "~seed",
        "data.seed=1",
    ]


def test_an_empty_mapping_that_changes_nothing_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"objective\.weights=\{\} would change nothing: .*~objective\.weights\.<name>"
    ):
        parse(["train", "experiment=rpi/v_lstm_epo", "objective.weights={}"])
