"""The recording format of docs/tutorial.md, with the settings of docs/extend.md, and the format of positions alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml

from epo_lightning import registry
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.sources import with_options
from epo_lightning.experiment.config.compose import tree
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def settings(tmp_path: Path):
    """The tutorial's format, registered, and the YAML of extend.md over those that it builds on."""
    section = (DOCS / "extend.md").read_text().split("## A recording format")[1].split("\n## ")[0]
    (code,) = re.findall(
        r"^`my_format.py`:\n\n```python\n(.*?)```", (DOCS / "tutorial.md").read_text(), re.DOTALL | re.MULTILINE
    )
    (text,) = re.findall(r"```yaml\n(.*?)```", section, re.DOTALL)
    (positions,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    for block in (code, positions):
        exec(block, {})
    merged: dict = {}
    for part in (*((tree() / "conf" / "data" / f"{name}.yaml").read_text() for name in ("exid",)), text):
        entries = yaml.safe_load(part)
        entries.pop("defaults", None)
        windows = {**merged.get("windows", {}), **entries.get("windows", {})}
        merged = {**merged, **entries, "windows": windows}
    merged.pop("name")
    yield {**merged, "folder": str(tmp_path), "root": str(tmp_path / "cache")}
    for name in ("my_csv", "positions"):
        del registry._PARTS["format"][name]


def walkers(seed: int) -> pl.DataFrame:
    """Four pedestrians side by side for eight seconds."""
    random = np.random.default_rng(seed)
    frame, agent = np.tile(np.arange(80), 4), np.repeat(np.arange(4), 80)
    speed = random.uniform(1.0, 1.4, 4)[agent]
    zeros = np.zeros(320)
    columns = {"id": 7 + agent, "frame": frame, "x": speed * frame / 10, "y": 1.0 * agent, "heading": zeros}
    return pl.DataFrame({**columns, "vx": speed, "vy": zeros, "length": zeros + 0.5, "width": zeros + 0.5})


def test_the_documented_format_becomes_scenes(settings, tmp_path):
    for seed in range(3):
        walkers(seed).sample(fraction=1.0, shuffle=True, seed=seed).write_csv(tmp_path / f"{seed}.csv")
    data = RecordedData(**settings)
    data.generate(workers=1, progress=False)
    data.setup("fit")
    scene = next(iter(data.val_dataloader()))
    assert scene.history.shape == (min(32, len(scene.history)), 4, 10, 4)
    assert scene.agent_mask.all()
    assert data.task.shape == "box"
    assert scene.lanes is None


def test_the_documented_format_refuses_invalid_files(settings, tmp_path):
    for seed in range(3):
        walkers(seed).with_columns(vx=pl.col("vx") * 1000).write_csv(tmp_path / f"{seed}.csv")
    with pytest.raises(RecordingError, match=r"\.csv: velocity .* of track 7 .* is it in another unit"):
        RecordedData(**settings).generate(workers=1, progress=False)


def test_the_documented_format_of_positions_computes_velocities_and_headings(settings, tmp_path):
    """One turns to the left and stops, one has a row alone, and one skips frames; by hand at 5 Hz, 0.2 s."""
    rows = [("bus", 0, "truck", 0.0, 0.0), ("bus", 1, "truck", 1.0, 0.0), ("bus", 2, "truck", 1.0, 1.0)]
    rows += [("bus", 3, "truck", 1.0, 1.0), ("lone", 0, "car", 50.0, 0.0)]
    rows += [("anna", 4, "pedestrian", 9.0, 9.0), ("anna", 6, "pedestrian", 8.6, 9.0)]
    pl.DataFrame(rows, ["id", "frame", "kind", "x", "y"], orient="row").write_csv(tmp_path / "one.csv")
    (source,) = with_options("positions", {"rate": 5})(tmp_path)
    tracks = source.read().tracks
    assert tracks.ids.tolist() == [0, 1]
    assert tracks.agent.tolist() == [0, 1, 1, 1]
    assert [KINDS[kind] for kind in tracks.kind] == ["pedestrian", "truck"]
    np.testing.assert_allclose(tracks.velocity, [[-1.0, 0.0], [5.0, 0.0], [0.0, 5.0], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(tracks.heading, [np.pi, 0.0, np.pi / 2, np.pi / 2])
    with pytest.raises(ConfigError, match=r"unknown key data\.options\.video_rate"):
        with_options("positions", {"video_rate": 5})


def test_the_documented_format_of_positions_becomes_scenes(settings, tmp_path):
    for seed in range(3):
        given = walkers(seed).with_columns(id=pl.format("walker {}", "id"), kind=pl.lit("pedestrian"))
        given.select("id", "frame", "kind", "x", "y").sample(fraction=1.0, shuffle=True).write_csv(
            tmp_path / f"{seed}.csv"
        )
    data = RecordedData(**{**settings, "format": "positions", "options": {"rate": 10.0}})
    data.generate(workers=1, progress=False)
    data.setup("fit")
    scene = next(iter(data.val_dataloader()))
    assert scene.agent_mask.all()
    assert (scene.history[..., 3] > 0.99).all()
