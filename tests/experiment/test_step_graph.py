"""Training steps from a CUDA graph: the bookkeeping with a stand-in that computes again, and on a GPU the graph itself."""

from __future__ import annotations

import copy
import dataclasses
import json
from typing import Any

import lightning
import pytest
import torch
from experiment.conftest import Epo
from experiment.replays import Again
from games import random_scene
from suites import IMITATION, LOSS_WEIGHTS, model
from torch import nn
from torch.utils.data import DataLoader

from epo_lightning.experiment import gpus, step_graph
from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.experiment.step_graph import WARM_UP, StepGraph
from epo_lightning.forecasters import Forecaster, build_forecaster
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

EPO = {"forecaster": {"name": "epo", "modes": 2}, "objective": IMITATION}
ODD = 3
"""Number of scenes of the last batch of an epoch; the others have one more."""


class Draws(Again):
    """Stand-in that takes the step while it is captured, as the host does."""

    def record(self, step: Any) -> Any:
        step()
        return super().record(step)


class Fails(Again):
    """Stand-in whose capture fails, and its end too."""

    def record(self, step: Any) -> Any:
        try:
            raise RuntimeError("operation not permitted\nwhen stream is capturing")
        except RuntimeError as error:
            raise RuntimeError("capture failed") from error


class Frozen(Again):
    """Stand-in whose replays see the number of the step at which they were captured, as a graph does."""

    def record(self, step: Any) -> Any:
        replay, at = super().record(step), Forecaster.global_step.fget(self.forecaster)  # type: ignore[attr-defined]

        def frozen() -> Any:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(Forecaster, "global_step", at)
                return replay()

        self.captures = getattr(self, "captures", 0) + 1
        return frozen


class Losses(lightning.Callback):
    """The logged losses of every epoch."""

    def __init__(self) -> None:
        self.epochs: list[dict[str, float]] = []

    def on_train_epoch_end(self, _: lightning.Trainer, module: Forecaster) -> None:  # type: ignore[override]
        self.epochs.append({name: float(value) for name, value in module.step_means.means().items()})


@pytest.fixture
def again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_graph, "Recorder", Again)


def forecaster(**changes: Any) -> Forecaster:
    torch.manual_seed(1)
    return build_forecaster(model(**{**EPO, "optimizer": {"name": "adam", "lr": 1e-3, "clip": 0.5}, **changes}))


def batches(count: int = 6) -> list[Scene]:
    """The batches of an epoch, the last one with fewer scenes."""
    torch.manual_seed(2)
    scenes = [random_scene(ODD + 1, 2) for _ in range(count)]
    return [*scenes[:-1], scenes[-1][list(range(ODD))]]


def fit(
    trained: Forecaster, graph: StepGraph | None = None, accelerator: str = "cpu", epochs: int = 3, **options: Any
) -> list[dict[str, float]]:
    """Train with a validation after every epoch; returns the logged losses of the epochs."""
    losses = Losses()
    trainer = lightning.Trainer(
        accelerator=accelerator,
        devices=1,
        max_epochs=epochs,
        callbacks=[losses, *([graph] if graph else [])],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **options,
    )
    trainer.fit(trained, *(DataLoader(scenes, batch_size=None) for scenes in (batches(), batches(2))))
    return losses.epochs


def together(trained: Forecaster) -> torch.Tensor:
    return nn.utils.parameters_to_vector(trained.parameters()).detach().cpu()


def test_replayed_steps_train_like_usual_ones_also_between_batches_of_another_size(again) -> None:
    usual, graphed = forecaster(), forecaster()
    before = together(usual)
    graph = StepGraph()
    torch.manual_seed(3)
    expected = fit(usual)
    torch.manual_seed(3)
    assert fit(graphed, graph) == expected
    assert set(expected[0]) >= {"train/loss", "train/imitation", "train/probability"}
    found = graph._recorder
    assert found.runs == WARM_UP + 3, "the first batches, and the last one of every epoch"
    assert found.replays == 3 * 5 - WARM_UP
    assert torch.equal(together(graphed), together(usual))
    assert (together(graphed) - before).abs().max() > 1e-3
    for name, value in usual.state_dict().items():  # statistics of batch normalisation too
        assert torch.equal(graphed.state_dict()[name], value), name
    assert graphed.step_graph is None, "the graph's memory is free after the training"


CHANGING = {
    "marginal": {"forecaster": {"name": "marginal", "modes": 2, "loss_weights": LOSS_WEIGHTS}},
    "scene_consistent": {"forecaster": {"name": "scene_consistent", "modes": 2, "loss_weights": LOSS_WEIGHTS}},
    "imitation": {"objective": IMITATION},
    "contrastive": {
        "objective": {
            "name": "contrastive",
            "weights": {"contrastive": 1.0, "magnitude": 0.1, "initial": 1.0, "goal": 0.1, "probability": 0.1},
        },
        "solver": {"name": "langevin", "steps": 2},
        "backward": {"name": "detached"},
    },
    "conditional": {
        "objective": {"name": "conditional", "weights": {"density": 1.0, "marginal": 0.1, "regression": 0.1}},
        "solver": {"name": "enumeration", "candidates": 4},
    },
    "laplace": {
        "objective": {"name": "laplace", "weights": {"density": 1.0, "initial": 1.0, "goal": 0.1}},
        "backward": {"name": "detached"},
    },
}
"""Forecasters whose losses can change during training."""
RELAXED = ("marginal", "scene_consistent", "imitation")


@pytest.mark.parametrize(
    ("name", "key"), [*((name, "annealing") for name in CHANGING), *((name, "relaxation") for name in RELAXED)]
)
def test_losses_that_change_from_step_to_step_change_in_replays(name: str, key: str, monkeypatch) -> None:
    """The first 11 of 18 steps have another loss than the last ones, which are captured once more."""
    monkeypatch.setattr(step_graph, "Recorder", Frozen)
    sections = {section: dict(values) for section, values in CHANGING[name].items()}
    sections["objective" if "objective" in sections else "forecaster"] |= {key: 0.5, f"{key}_steps": 11}
    usual, graphed = forecaster(**sections), forecaster(**sections)
    monkeypatch.setattr(Frozen, "forecaster", graphed, raising=False)
    graph = StepGraph()
    torch.manual_seed(3)
    expected = fit(usual)
    torch.manual_seed(3)
    found = fit(graphed, graph)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-3)
    assert graph._recorder.captures == 2, "with the changing number and without it"  # type: ignore[attr-defined]
    assert all(schedule.held is None for schedule in graphed.schedules), "usual steps have their numbers again"


def test_losses_between_the_steps_have_the_numbers_of_python(again, monkeypatch) -> None:
    """Such as those of a validation step or of a copy: the number of the last step would be an old one for them."""
    objective = {**IMITATION, "relaxation": 0.5, "relaxation_steps": 11}
    trained, usual, graph = forecaster(objective=objective), forecaster(objective=objective), StepGraph()
    graph.begin(trained)
    for scene in batches()[:5]:
        graph.step(scene)
    monkeypatch.setattr(Forecaster, "global_step", 10)
    (loss, _), (expected, _) = trained.weighted_losses(scene), usual.weighted_losses(scene)
    assert loss == expected
    assert all(schedule.held is None for schedule in copy.deepcopy(trained).schedules)


def test_a_training_that_fails_leaves_a_forecaster_that_trains_without_its_graph(again, monkeypatch) -> None:
    trained, usual = forecaster(), forecaster()
    monkeypatch.setattr(StepGraph, "_capture", lambda *_: (_ for _ in ()).throw(RuntimeError("out of memory")))
    with pytest.raises(RuntimeError, match="out of memory"):
        fit(trained, StepGraph())
    assert trained.step_graph is None
    trained.load_state_dict(usual.state_dict())
    torch.manual_seed(3)
    expected = fit(usual)
    torch.manual_seed(3)
    assert fit(trained) == expected


def test_the_losses_of_a_step_stay_when_the_next_one_overwrites_the_graphs_tensors(again) -> None:
    trained, graph = forecaster(), StepGraph()
    graph.begin(trained)
    steps = [graph.step(scene) for scene in batches()[:5]]
    values = [[float(total), *map(float, terms.values())] for total, terms in steps]
    assert len({tuple(each) for each in values}) == 5
    for scene, each in zip(batches()[3:5], values[3:5], strict=True):
        total, terms = trained.weighted_losses(scene)
        torch.testing.assert_close(torch.tensor(each), torch.stack([total, *terms.values()]))


def test_another_time_step_or_missing_field_is_another_layout(again) -> None:
    trained, graph = forecaster(), StepGraph()
    graph.begin(trained)
    scene = batches()[0]
    for _ in range(WARM_UP + 1):
        graph.step(scene)
    for other in (
        dataclasses.replace(scene, id=None),
        dataclasses.replace(scene, dt=0.2),
        dataclasses.replace(scene, size=scene.size.double()),
    ):
        total, _ = graph.step(other)
        torch.testing.assert_close(total, trained.weighted_losses(other)[0])
    assert graph._recorder.replays == 1  # type: ignore[attr-defined]


def test_numbers_drawn_on_the_host_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(step_graph, "Recorder", Draws)
    backbone = {"name": "v_lstm", "dropout": 0.1}
    trained, graph = forecaster(backbone=backbone), StepGraph()
    graph.begin(trained)
    with pytest.raises(ConfigError, match=r"draws random numbers on the CPU, .* set trainer.graph=false"):
        for scene in batches():
            graph.step(scene)


def test_a_failed_capture_is_one_sentence_with_its_cause(monkeypatch) -> None:
    monkeypatch.setattr(step_graph, "Recorder", Fails)
    graph = StepGraph()
    graph.begin(forecaster())
    with pytest.raises(ConfigError) as error:
        for scene in batches():
            graph.step(scene)
    assert "(operation not permitted when stream is capturing): set trainer.graph=false" in str(error.value)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"accelerator": "cpu"}, "trainer.accelerator"),
        ({"devices": 2}, "trainer.devices"),
        ({"detect_anomaly": True}, "trainer.detect_anomaly"),
    ],
)
def test_settings_that_exclude_a_graph_are_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=rf"trainer\.graph=true .*{named}"):
        TrainerSettings(**{"accelerator": "gpu", "graph": True, **changes})


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (
            ("experiment=rpi/v_lstm_epo", "solver.adaptive=true"),
            "solver.name=levenberg_marquardt and solver.backend=auto",
        ),
        (
            ("experiment=rpi/v_lstm_epo", "solver.backend=host"),
            "solver.name=levenberg_marquardt and solver.backend=host",
        ),
        (("experiment=rpi/v_lstm_epo_feedback", "solver.backend=pytorch"), "solver.name=feedback"),
        (("experiment=rpi/v_lstm_epo", "solver=both_sides", "backward=implicit"), "solver.name=both_sides"),
    ],
)
def test_runs_whose_steps_no_graph_can_repeat_are_refused(refused: Any, words: tuple[str, ...], named: str) -> None:
    message = refused("train", *words, "data=tiny", "budget=smoke", "trainer.accelerator=auto", "trainer.graph=true")
    assert f"trainer.graph=true with {named}" in message


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_machine_without_a_gpu_is_named(refused: Any) -> None:
    words = ("experiment=rpi/v_lstm_sc", "data=tiny", "budget=smoke", "trainer.accelerator=auto")
    assert "trainer.graph=true needs a CUDA device" in refused("train", *words, "trainer.graph=true")


def test_a_run_with_a_graph_is_the_same_run(again, epo: Epo, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpus, "accelerator", lambda settings: "cpu")
    words = (
        "experiment=rpi/v_lstm_sc",
        "data=tiny",
        "budget=smoke",
        "callbacks.progress=none",
        "trainer.accelerator=auto",
    )
    assert epo("train", *words, "run_dir=usual") == 0
    assert epo("train", *words, "run_dir=graphed", "trainer.graph=true") == 0
    one, other = (json.loads((tmp_path / name / "run.json").read_text()) for name in ("usual", "graphed"))
    assert one["identity"] == other["identity"]
    assert one["best"] == other["best"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("backend", ["pytorch", "warp"])
def test_a_gpu_trains_the_same_weights_with_and_without_a_graph(backend: str) -> None:
    if backend == "warp":
        pytest.importorskip("warp")
    # A small learning rate: where a gradient is rounding alone, Adam makes a whole step of it.
    optimizer = {"name": "adam", "lr": 1e-4, "clip": 0.5}
    objective = {**IMITATION, "relaxation": 0.5, "relaxation_steps": 13}  # of 24 steps
    solver = {"name": "levenberg_marquardt", "steps": 2, "backend": backend}
    usual = forecaster(solver=solver, objective=objective, optimizer=optimizer)
    graphed = copy.deepcopy(usual)
    expected = fit(usual, accelerator="gpu", epochs=4)
    found = fit(graphed, StepGraph(), accelerator="gpu", epochs=4)
    torch.testing.assert_close(together(graphed), together(usual), rtol=0, atol=1e-4)
    for one, other in zip(found, expected, strict=True):
        for name, value in other.items():
            assert one[name] == pytest.approx(value, rel=1e-3, abs=1e-4), name
