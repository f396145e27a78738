"""Debugging: overfitting of a few batches, the profile, and the location of the first nan."""

from __future__ import annotations

import csv
import gzip
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from experiment.conftest import Epo
from lightning.pytorch import Trainer
from torch import Tensor

from epo_lightning.data.drawn import DrawnData
from epo_lightning.experiment.config.compose import compose, tree
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.debugging import PROFILED, FewBatches, NonFinite
from epo_lightning.experiment.train import folder_for
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters import Forecaster, build_forecaster
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover
from epo_lightning.scene import Scene
from epo_lightning.schema import read

WAYS = sorted(file.stem for file in (tree() / "conf" / "debug").glob("*.yaml"))
RPI = ("data=drawn", "data.like=rpi", "data.scenes=64")


def only_run(folder: Path) -> RunFolder:
    (run,) = discover(folder)
    return run


def logged(run: RunFolder, name: str) -> list[float]:
    with (run.logs / "metrics.csv").open(newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


def test_debugging_runs_have_their_own_folders() -> None:
    settings = [
        read(Settings, compose("train", ["experiment=rpi/v_lstm", *([f"debug='{way}'"] if way else [])]))
        for way in ("", *WAYS)
    ]
    folders = {folder_for(each).path for each in settings}
    assert len(folders) == len(settings)
    for each in settings[1:]:
        assert (each.callbacks.patience, each.callbacks.progress) == (None, "lines")


def test_overfit_reaches_a_small_loss_on_a_few_scenes(epo: Epo, tmp_path: Path) -> None:
    words = ("debug=overfit", "trainer.max_epochs=100", "trainer.validate_every=50")
    assert epo("train", "experiment=rpi/v_lstm_sc", *RPI, *words) == 0
    run = only_run(tmp_path)
    losses = logged(run, "train/loss")
    assert len(losses) == 100
    assert losses[-1] < losses[0] / 6
    scores = logged(run, "val/minSADE")
    assert len(scores) == 2
    assert scores[-1] < 0.05


def test_overfit_sees_the_same_scenes_in_every_epoch() -> None:
    data = DrawnData("rpi", batch_size=4, scenes=64)
    data.setup("fit")
    few = FewBatches(data, 2)
    epochs = [
        [scene.id.tolist() for scene in loader] for loader in (*[few.train_dataloader()] * 2, few.val_dataloader())
    ]
    assert epochs[0] == epochs[1] == epochs[2]
    assert [len(ids) for ids in epochs[0]] == [4, 4]
    assert epochs[0][0] != epochs[0][1]


def test_the_profile_is_a_table_and_a_trace(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("train", "experiment=rpi/v_lstm", *RPI, "debug=profile", "data.batch_size=4") == 0
    folder = only_run(tmp_path).path.relative_to(tmp_path) / "profile"
    said = capsys.readouterr().out
    table = (folder / "operations.txt").read_text()
    assert f"{PROFILED} training steps" in table
    for operation in ("aten::addmm", "Optimizer.step#Adam.step"):
        (row,) = (line.split() for line in table.splitlines() if line.split()[:1] == [operation])
        assert int(row[-1]) % PROFILED == 0
    with gzip.open(folder / "trace.json.gz", "rt") as file:
        assert len(json.load(file)["traceEvents"]) > 1000
    for name in ("operations.txt", "trace.json.gz"):
        assert str(folder / name) in said


def test_a_training_too_short_for_a_profile_prints_a_note(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("train", "experiment=rpi/v_lstm", *RPI, "debug=profile", "trainer.max_steps=2") == 0
    assert "profile: none" in capsys.readouterr().out


def test_the_first_nan_ends_a_run_with_one_message(epo: Epo, capsys: pytest.CaptureFixture[str], tmp_path) -> None:
    words = ("debug=nan", "budget=smoke", "optimizer.lr=1e30")
    assert epo("train", "experiment=rpi/v_lstm_sc", *RPI, *words) == 2
    message = capsys.readouterr().err.strip()
    assert re.match(r"epo: step 1: backbone\.\S+ \(\w+\) returns (nan|inf); scenes of the training split: \d", message)
    assert only_run(tmp_path).record["status"] == "failed"


def test_finite_training_is_not_interrupted(epo: Epo) -> None:
    for row, like in (("exid/hivt_m_epo", "highway"), ("ucy/v_lstm_epo", "pedestrians")):
        words = (f"experiment={row}", "data=drawn", f"data.like={like}", "data.scenes=64", "budget=smoke", "debug=nan")
        assert epo("train", *words) == 0, row


def watched(change: Callable[[Forecaster, list[Scene]], None]) -> str:
    """The message that ends the training of a forecaster in which something was broken on purpose."""
    data = DrawnData("rpi", batch_size=4, scenes=64)
    data.setup("fit")
    few = FewBatches(data, 2)
    config = compose("train", ["experiment=rpi/v_lstm_sc"])
    parts = ("backbone", "forecaster", "dynamics", "energy", "solver", "backward", "objective")
    forecaster = build_forecaster(
        {**{part: config[part] for part in (*parts, "optimizer", "goal")}, **data.task.to_config()}
    )
    change(forecaster, few.batches)
    quiet = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    trainer = Trainer(max_epochs=1, accelerator="cpu", callbacks=[NonFinite()], limit_val_batches=0, **quiet)
    with pytest.raises(ConfigError) as error:
        trainer.fit(forecaster, few)
    return str(error.value)


def test_nan_in_the_data_is_reported_first() -> None:
    ids = []

    def poison(_: Forecaster, batches: list[Scene]) -> None:
        batches[1].history[2, 0, 3, 1] = torch.inf
        ids.append(int(batches[1].id[2]))

    message = watched(poison)
    assert f"step 1: the data contain numbers that are not finite; scenes of the training split: {ids[0]};" in message


def test_the_module_and_its_scene_are_named() -> None:
    ids = []

    def break_one_row(forecaster: Forecaster, batches: list[Scene]) -> None:
        def spoil(_: torch.nn.Module, __: tuple[Tensor, ...], output: Tensor) -> Tensor:
            return output.index_fill(0, torch.tensor([1]), torch.nan)

        forecaster.backbone.to_graph.register_forward_hook(spoil)
        ids.append(int(batches[0].id[1]))

    message = watched(break_one_row)
    assert f"step 0: backbone.to_graph (Linear) returns nan; scenes of the training split: {ids[0]};" in message


def test_all_scenes_are_named_where_the_rows_of_an_output_are_no_scenes() -> None:
    ids: list[int] = []

    def break_all(forecaster: Forecaster, batches: list[Scene]) -> None:
        forecaster.backbone.to_graph.register_forward_hook(lambda *_: torch.full((3, 5), torch.nan))
        ids.extend(map(int, batches[0].id))

    message = watched(break_all)
    assert f"returns nan; scenes of the training split: {', '.join(map(str, ids))};" in message


def with_term(forecaster: Forecaster, term: Callable[[Tensor], Tensor]) -> None:
    """Add a term to the loss that depends on a parameter."""
    plain, weight = forecaster.losses, forecaster.backbone.to_graph.weight

    def losses(scene: Scene, forecast: JointForecast) -> dict[str, tuple[float, Tensor]]:
        return {**plain(scene, forecast), "broken": (1.0, term(weight))}

    forecaster.losses = losses  # type: ignore[method-assign]


def test_the_term_of_the_loss_is_named() -> None:
    message = watched(lambda forecaster, _: with_term(forecaster, lambda weight: (0.0 * weight.sum()).log()))
    assert "step 0: the loss is -inf, by its term broken; scenes" in message


def test_the_parameter_and_the_operation_are_named() -> None:
    message = watched(lambda forecaster, _: with_term(forecaster, lambda weight: (0.0 * weight.sum()).sqrt()))
    assert "step 0: the gradient of backbone.to_graph.weight is not finite" in message
    assert "Function 'MulBackward0' returned nan values" in message
    assert f'{Path(__file__).name}", line ' in message
