"""Training steps inside Lightning: the loss, gradient clipping, relaxation and annealing, scores of an epoch."""

from __future__ import annotations

import dataclasses
from typing import Any

import lightning
import pytest
import torch
from games import random_scene
from suites import IMITATION, LOSS_WEIGHTS, model
from torch.utils.data import DataLoader

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecasters import Forecaster, build_forecaster
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.scene import Scene
from epo_lightning.schedules import Annealing, Relaxation
from epo_lightning.schema import read

BATCHES, EPOCHS = 2, 2
RELAXED = {"relaxation": 0.5, "relaxation_steps": 3}
BASELINE = {"modes": 2, "loss_weights": LOSS_WEIGHTS, **RELAXED}
LEARNED = {
    "marginal": {"forecaster": {"name": "marginal", **BASELINE}},
    "scene_consistent": {"forecaster": {"name": "scene_consistent", **BASELINE}},
    "epo": {"forecaster": {"name": "epo", "modes": 2}, "objective": {**IMITATION, **RELAXED}},
}


def build(name: str, **changes: Any) -> Forecaster:
    torch.manual_seed(1)
    return build_forecaster(model(**{**LEARNED[name], **changes}))


def fit(forecaster: Forecaster, epochs: int = EPOCHS, **options: Any) -> list[Scene]:
    """Train for some epochs of two batches each; returns the validation batches."""
    training, validation = ([random_scene(4, 2) for _ in range(BATCHES)] for _ in range(2))
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **options,
    )
    trainer.fit(forecaster, *(DataLoader(scenes, batch_size=None) for scenes in (training, validation)))
    return validation


class Recorder(lightning.Callback):
    """The logged values after every step, the norm of the gradient, and the validation scores of every epoch."""

    def __init__(self) -> None:
        self.norms: list[float] = []
        self.scores: list[dict[str, float]] = []

    def on_train_batch_end(self, trainer: lightning.Trainer, module: Forecaster, *_: Any) -> None:
        gradients = [p.grad.flatten() for p in module.parameters() if p.grad is not None]
        self.norms.append(float(torch.cat(gradients).norm()))

    def on_validation_end(self, trainer: lightning.Trainer, module: Forecaster) -> None:
        metrics = trainer.callback_metrics
        self.scores.append({name: float(value) for name, value in metrics.items() if name.startswith("val/")})


@pytest.mark.parametrize("name", LEARNED)
def test_the_logged_loss_is_the_weighted_sum_of_its_terms(name: str) -> None:
    forecaster = build(name)
    scene = random_scene(4, 2)
    torch.manual_seed(0)
    total = forecaster.training_step(scene, 0)
    logged = forecaster.step_means.means()
    terms = {key.removeprefix("train/"): value for key, value in logged.items() if key != "train/loss"}
    weights = LOSS_WEIGHTS if name != "epo" else IMITATION["weights"]
    expected = sum(weights[key] * value for key, value in terms.items())
    assert terms["probability"] > 0
    torch.testing.assert_close(logged["train/loss"], expected)
    torch.testing.assert_close(total.detach(), expected)


def test_gradients_are_clipped_to_the_configured_norm() -> None:
    free, clipped = Recorder(), Recorder()
    torch.manual_seed(0)
    fit(build("scene_consistent"), 1, callbacks=[free])
    limit = 0.5 * min(free.norms)
    assert limit > 0
    torch.manual_seed(0)
    fit(build("scene_consistent", optimizer={"name": "adam", "clip": limit}), 1, callbacks=[clipped])
    assert clipped.norms == pytest.approx([limit] * BATCHES, rel=1e-4)


@pytest.mark.parametrize("name", LEARNED)
def test_the_relaxation_fades_with_optimisation_steps(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    share = Relaxation.at
    monkeypatch.setattr(Relaxation, "at", lambda self, step: (steps.append(step), share(self, step))[1])
    fit(build(name), limit_val_batches=0)
    assert steps == list(range(BATCHES * EPOCHS))


ANNEALED = {
    "marginal": {"forecaster": {"name": "marginal", "modes": 2, "loss_weights": LOSS_WEIGHTS, "annealing": 5.0}},
    "scene_consistent": {
        "forecaster": {"name": "scene_consistent", "modes": 2, "loss_weights": LOSS_WEIGHTS, "annealing": 5.0}
    },
    "epo": {"forecaster": {"name": "epo", "modes": 2}, "objective": {**IMITATION, "annealing": 5.0}},
}
"""The same option in every learned row."""


@pytest.mark.parametrize("name", ANNEALED)
def test_the_temperature_falls_with_optimisation_steps(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    at = Annealing.at
    monkeypatch.setattr(Annealing, "at", lambda self, step: (steps.append(step), at(self, step))[1])
    torch.manual_seed(1)
    fit(build_forecaster(model(**ANNEALED[name])), limit_val_batches=0)
    assert steps == list(range(BATCHES * EPOCHS))


@pytest.mark.parametrize("name", ANNEALED)
def test_annealing_trains_all_modes_of_every_row_at_first(name: str) -> None:
    """The gradient of the imitation term reaches all modes; without annealing, the closest one of each scene."""
    scene, counts = random_scene(4, 2), {}
    for kind, rows in (("plain", LEARNED), ("annealed", ANNEALED)):
        torch.manual_seed(1)
        config = {key: dict(section) for key, section in rows[name].items()}
        for section in config.values():
            section.pop("relaxation", None)
        forecaster = build_forecaster(model(**config))
        forecast = forecaster(scene)
        states = forecast.states.detach().requires_grad_()
        forecaster.losses(scene, dataclasses.replace(forecast, states=states))["imitation"][1].backward()
        touched = (states.grad != 0).flatten(3).any(-1)  # scene, mode, agent
        counts[kind] = touched.sum((1, 2)).tolist()
    assert counts == {"plain": [2] * 4, "annealed": [4] * 4}


@pytest.mark.parametrize("name", LEARNED)
def test_the_relaxation_trains_all_modes_and_ends_after_its_steps(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At first the gradient of the imitation term reaches all modes, and from then on the closest one of each scene."""
    scene, forecaster = random_scene(4, 2), build(name)
    forecast, counts = forecaster(scene), []
    for step in (0, RELAXED["relaxation_steps"] - 1, RELAXED["relaxation_steps"]):
        monkeypatch.setattr(type(forecaster), "global_step", step)
        states = forecast.states.detach().requires_grad_()
        forecaster.losses(scene, dataclasses.replace(forecast, states=states))["imitation"][1].backward()
        counts.append((states.grad != 0).flatten(3).any(-1).sum((1, 2)).tolist())  # scene, mode, agent
    assert counts == [[4] * 4, [4] * 4, [2] * 4]


def test_validation_scores_are_those_of_their_own_epoch() -> None:
    forecaster, recorder = build("scene_consistent", optimizer={"name": "adam", "lr": 0.01}), Recorder()
    validation = fit(forecaster, callbacks=[recorder])
    metrics = ForecastMetrics(forecaster.task.subsets, forecaster.task.shape)
    for scene in validation:
        metrics.update(forecaster.predict(scene), scene)
    expected = {f"val/{key}": float(value) for key, value in metrics.compute().items()}
    first, last = recorder.scores
    assert first["val/minSADE"] != pytest.approx(last["val/minSADE"], rel=1e-3)
    assert last == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("row", ["v_lstm", "v_lstm_sc", "v_lstm_epo"])
def test_squared_rows_have_the_loss_that_the_appendix_prints(row: str) -> None:
    """Appendix E.4: the squared norm of an agent's trajectory, averaged over agents; the closest joint mode counts.

    The marginal baseline takes the closest mode of every agent.
    """
    settings = read(Settings, compose("train", [f"experiment=rpi/{row}_squared"]))
    torch.manual_seed(1)
    _, forecaster = assembly.build(settings)
    scene = random_scene(4, 2, horizon=forecaster.task.horizon)
    scene = dataclasses.replace(scene, future_mask=torch.ones_like(scene.future_mask))
    forecast = forecaster(scene)
    error = forecast.states[..., :2] - scene.future[:, None, ..., :2]
    printed = [
        [[sum(x.item() ** 2 for x in agent.flatten()) for agent in mode] for mode in of_scene] for of_scene in error
    ]
    if row == "v_lstm":
        expected = sum(min(mode[agent] for mode in modes) for modes in printed for agent in range(2)) / 8
    else:
        expected = sum(min(sum(mode) / 2 for mode in modes) for modes in printed) / 4
    weight, value = forecaster.losses(scene, forecast)["imitation"]
    assert weight * value.item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("power", [0.5, float("inf")])
@pytest.mark.parametrize("name", LEARNED)
def test_a_power_below_one_or_without_end_is_refused(name: str, power: float) -> None:
    config = {key: dict(section) for key, section in LEARNED[name].items()}
    config["objective" if name == "epo" else "forecaster"]["power"] = power
    with pytest.raises(Exception, match="power must be 1 or more, and finite, not"):
        build_forecaster(model(**config))


@pytest.mark.parametrize("backward", ["unrolled", "truncated"])
def test_training_has_states_of_initial_strategies_only_where_they_are_taught(backward):
    """With ``unrolled``, the strategies learn through the solution, and no loss reads the states."""
    forecaster, scene = build("epo", backward={"name": backward}), random_scene(2, 2)
    assert (forecaster.train()(scene).initial_states is None) == (backward == "unrolled")
    assert ("initial" in forecaster.weighted_losses(scene)[1]) == (backward != "unrolled")
    assert forecaster.predict(scene).initial_states.isfinite().all()


def test_scenes_with_another_time_step_are_refused_in_training_and_tests() -> None:
    forecaster, scene = build("epo"), random_scene(4, 2)
    loader = DataLoader([dataclasses.replace(scene, dt=2.0 * scene.dt)], batch_size=None)
    trainer = lightning.Trainer(
        accelerator="cpu", max_steps=1, logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    for run in (trainer.fit, trainer.validate, trainer.test):
        with pytest.raises(
            ValueError, match=f"dt = {2.0 * scene.dt} s, but this forecaster was built for {scene.dt} s"
        ):
            run(forecaster, loader)
    with pytest.raises(ValueError, match="this forecaster was built for"):
        forecaster.predict(dataclasses.replace(scene, dt=2.0 * scene.dt))
