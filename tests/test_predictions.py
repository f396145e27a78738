"""Files of predictions: what is written is read again, and every mistake in a file is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from games import highway_scene, pad
from safetensors.numpy import save_file

from epo_lightning import refine
from epo_lightning.experiment import train
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import PredictSettings
from epo_lightning.experiment.predict import predict
from epo_lightning.predictions import OPTIONAL, read_predictions, write_predictions
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene


def traffic() -> Scene:
    """The same three scenes in every call."""
    torch.manual_seed(0)
    return highway_scene(3)


def forecasts(channels: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    scene = traffic()
    return scene.future[:, None, ..., :channels].repeat(1, 2, 1, 1, 1), torch.tensor([[0.3, 0.7]] * 3)


@pytest.mark.parametrize("channels", [2, 4])
def test_what_is_written_is_read_again(channels: int, tmp_path: Path) -> None:
    states, probabilities = forecasts(channels)
    scene = traffic()
    file = write_predictions(tmp_path / "mine.npz", states, probabilities, scene)
    read = read_predictions(file)
    assert torch.equal(read.states, states)
    assert torch.equal(read.probabilities, probabilities)
    assert read.scene.dt == scene.dt
    for name in ("history", *OPTIONAL):
        assert torch.equal(getattr(read.scene, name), getattr(scene, name)), name
    assert torch.equal(refine(*read).states, refine(states, probabilities, scene).states)
    with pytest.raises(ConfigError, match="nothing is overwritten"):
        write_predictions(file, states, probabilities, scene)


def test_numbers_have_the_precision_of_the_futures(tmp_path: Path) -> None:
    (states, probabilities), scene = forecasts(), traffic()
    for index, (futures, of_scene) in enumerate([(torch.float64, torch.float32), (torch.float32, torch.float64)]):
        path = tmp_path / f"{index}.npz"
        shifted = states.to(futures) * (1.0 + 1e-12)
        read = read_predictions(write_predictions(path, shifted, probabilities.to(futures), scene.to(of_scene)))
        assert torch.equal(read.states, shifted)
        assert {read.scene.history.dtype, read.scene.size.dtype, read.probabilities.dtype} == {futures}


def test_absent_agents_may_hold_anything(tmp_path: Path) -> None:
    states, probabilities = forecasts()
    wide = torch.cat((states, torch.full_like(states[:, :, :2], torch.nan)), 2)
    file = write_predictions(tmp_path / "mine.npz", wide, probabilities, pad(traffic()))
    assert read_predictions(file).states.shape[2] == 6


@pytest.mark.slow
def test_what_epo_predict_wrote_is_read(tmp_path: Path) -> None:
    words = [
        "data=drawn",
        "data.scenes=16",
        "data.batch_size=4",
        "data.like=highway",
        "budget=smoke",
        "callbacks.progress=none",
    ]
    run = train.train(compose("train", ["experiment=highway/v_lstm", *words, f"runs={tmp_path}"]))
    predict(PredictSettings(run=str(run.path), out=str(tmp_path / "out"), scenes=4, figures=0))
    read = read_predictions(tmp_path / "out")
    assert read.states.shape[:3] == (4, 5, 4)
    assert refine(*read).states.isfinite().all()


def good() -> dict[str, Any]:
    states, probabilities = forecasts()
    return {
        "states": states.numpy(),
        "probabilities": probabilities.numpy(),
        "history": traffic().history.numpy(),
        "dt": 0.2,
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": None}, "lacks the array 'states'"),
        ({"dt": None}, "lacks the array 'dt'"),
        ({"sizes": np.ones((3, 4, 2))}, "unknown array 'sizes': did you mean 'size'"),
        ({"dt": np.ones(3)}, r"dt has shape \[3\]"),
        ({"dt": -0.1}, r"dt must be positive"),
        ({"states": np.ones((3, 2, 4, 8, 4), int)}, r"states is of type torch\.int64"),
        ({"states": np.ones((3, 2, 5, 8, 4))}, r"takes \[3, M, 4, K, 2 or 4\]"),
        ({"states": np.full((3, 2, 4, 8, 2), np.inf)}, "not finite"),
        ({"probabilities": np.ones((3, 2))}, "sum to 1"),
        ({"history": np.ones((3, 4, 4))}, "history"),
        ({"agent_mask": np.ones((3, 4))}, "agent_mask"),
        ({"agent_mask": np.full((3, 4), 2)}, "agent_mask"),
        ({"size": np.zeros((3, 4, 2))}, "length and width must be positive"),
        ({"states": np.array([object()])}, "not a NumPy archive of plain arrays"),
        ({"dt": np.True_}, "dt has .* type bool; it is one number"),
        ({"dt": np.array("a")}, "dt has .* it is one number"),
        ({"id": np.array(["a", "b", "c"])}, "id is of type <U1, expected numbers"),
        ({"kind": np.full((3, 4), 9)}, r"scene\.kind\[0, 0\] is 9; kinds are 0 to 7"),
        ({"kind": np.full((3, 4), -2)}, r"scene\.kind\[0, 0\] is -2"),
    ],
)
def test_mistakes_are_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "bad.npz", **{name: a for name, a in {**good(), **changes}.items() if a is not None})
    with pytest.raises(ConfigError, match=message) as error:
        read_predictions(tmp_path / "bad.npz")
    assert "bad.npz" in str(error.value)


def test_numbers_that_one_of_the_libraries_lacks_are_converted(tmp_path: Path) -> None:
    there = np.array([[1, 1, 0, 1]] * 3)
    np.savez(tmp_path / "unsigned.npz", **good(), kind=np.full((3, 4), 6, np.uint64), agent_mask=there)
    scene = read_predictions(tmp_path / "unsigned.npz").scene
    assert (scene.kind == 6).all()
    assert scene.agent_mask.tolist() == there.astype(bool).tolist()
    states, probabilities = forecasts()
    scene = Scene(traffic().history.bfloat16(), 0.2)
    write_predictions(tmp_path / "short.npz", states, probabilities, scene)
    assert torch.equal(read_predictions(tmp_path / "short.npz").scene.history, scene.history.float())


def test_dt_in_a_list_and_other_byte_orders_are_read(tmp_path: Path) -> None:
    plain = good()
    np.savez(tmp_path / "plain.npz", **plain)
    np.savez(tmp_path / "other.npz", **{**plain, "dt": np.array([0.2]), "states": plain["states"].astype(">f4")})
    one, other = (read_predictions(tmp_path / f"{name}.npz") for name in ("plain", "other"))
    assert torch.equal(one.states, other.states)
    assert one.scene.dt == other.scene.dt == 0.2


def test_archives_and_folders_with_wrong_bytes_are_named(tmp_path: Path) -> None:
    """Damaged archives raise errors of zlib and zipfile, and not only those of NumPy."""
    file = write_predictions(tmp_path / "mine.npz", *forecasts(), traffic())
    content, random = file.read_bytes(), np.random.default_rng(0)
    messages = []
    for _ in range(200):
        damaged = bytearray(content)
        for at in random.integers(len(content), size=4):
            damaged[at] = random.integers(256)
        file.write_bytes(damaged)
        try:
            read_predictions(file)
        except ConfigError as error:
            messages.append(str(error))
    assert len(messages) > 100
    assert all("mine.npz" in message for message in messages)
    save_file({"states": np.ones((1, 1, 1, 2, 2), "f4")}, tmp_path / "forecasts.safetensors")
    for index in ("[1]", "null", '"dt"', "{}"):
        (tmp_path / "index.json").write_text(index)
        with pytest.raises(ConfigError, match=r"index\.json has no entry dt"):
            read_predictions(tmp_path)


def test_missing_damaged_and_misnamed_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no predictions at"):
        read_predictions(tmp_path / "none.npz")
    with pytest.raises(ConfigError, match=r"lacks forecasts\.safetensors"):
        read_predictions(tmp_path)
    np.savez(tmp_path / "whole.npz", **good())
    content = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(ConfigError, match="damaged"):
        read_predictions(tmp_path / "cut.npz")
    with pytest.raises(ConfigError, match=r"mine\.npz"):
        write_predictions(tmp_path / "mine.csv", *forecasts(), traffic())
