"""Parts of a data set: the same bytes whoever extracts them, also after kills; gathered without all of them in memory."""

from __future__ import annotations

import os
import pickle
import signal
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.data.recorded import parts as parts_module
from epo_lightning.data.recorded.extraction import Extracted, outcomes
from epo_lightning.data.recorded.gathering import Spool, gather, gathered
from epo_lightning.data.recorded.parts import Parts
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tables import INDEX_OF, OF_AGENTS, OF_SCENES, SceneTables, joined, selected
from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.experiment import generation
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import KINDS

from .roads import FOUR, curve, recording

WINDOWS = {"dt": 0.2}
JOBLIB = find_spec("hydra_plugins.hydra_joblib_launcher") is not None


def read(file: Path) -> Recording:
    """The recording of a file, whose text is how far its road is turned; it can kill its process, once."""
    with (file.parent / "read.log").open("a") as log:
        log.write(f"{file.stem}\n")
    try:
        (file.parent / f"kill-{file.stem}").unlink()
    except FileNotFoundError:
        pass
    else:
        os.kill(os.getpid(), signal.SIGKILL)
    text = file.read_text()
    if text == "empty":
        return recording(vehicles=FOUR[:2], name=file.stem)
    return recording(curve(800.0, float(text)), name=file.stem)


@register("format", "deadly")
def deadly(folder: Path) -> list[RecordingSource]:
    return [
        RecordingSource(file.stem, file.stem.partition("-")[0], (file,), partial(read, file))
        for file in folder.glob("*.road")
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "roads"
    made.mkdir()
    for number, group in enumerate("aabbcc"):
        (made / f"{group}-{number}.road").write_text("empty" if number == 2 else str(0.1 * number))
    return made


def data(folder: Path, root: str = "cache") -> RecordedData:
    where = {"folder": str(folder), "root": str(folder.parent / root)}
    return RecordedData("roads", "deadly", windows=WINDOWS, test=["a"], **where)


def contents(module: RecordedData) -> dict[str, bytes]:
    """The files that are checked when a data set is read."""
    return {file.name: file.read_bytes() for file in module.folder.iterdir() if file.suffix != ".csv"}


def reads(folder: Path) -> list[str]:
    file = folder / "read.log"
    return file.read_text().split() if file.exists() else []


def test_parts_of_several_recordings_give_the_same_bytes_as_parts_of_one(folder, monkeypatch):
    data(folder).generate(workers=1, progress=False)
    expected = contents(data(folder))
    monkeypatch.setattr(parts_module, "MOST", 2)
    several = data(folder, "several")
    assert len(Parts(folder, several.sources()).files) == 2
    several.generate(workers=1, progress=False)
    assert contents(several) == expected
    assert set(expected) == {"train.safetensors", "val.safetensors", "test.safetensors", "manifest.json"}


def test_only_missing_and_damaged_parts_are_extracted_again(folder, monkeypatch):
    module = data(folder)
    whole = data(folder, "whole")
    whole.generate(workers=1, progress=False)

    def stop(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr(RecordedData, "_write", stop)
    with pytest.raises(OSError, match="full"):
        module.generate(workers=1, progress=False)
    monkeypatch.undo()
    (work,) = module.root.glob(".*-parts")
    files = sorted(work.glob("*.safetensors"))
    assert len(files) == 6
    files[1].unlink()
    files[3].write_bytes(files[3].read_bytes()[:-1])
    files[4].write_bytes(b"")
    assert [outcomes(file) is None for file in files] == [False, True, False, True, True, False]
    (folder / "read.log").unlink()
    module.generate(workers=1, progress=False)
    assert reads(folder) == ["a-1", "b-3", "c-4"]
    assert contents(module) == contents(whole)
    assert not work.exists()


def test_a_job_whose_file_is_gone_extracts_nothing_more(folder, tmp_path):
    module = data(folder)
    tasks = Parts(tmp_path, module.sources()).tasks(module.windows, True, True, False)
    assert pickle.loads(pickle.dumps(tasks[0]))[1:] == tasks[0][1:], "jobs get their parts in a file"
    file = tmp_path / "0.pickle"
    generation._extract(file, tasks[0])
    assert not reads(folder)
    file.touch()
    for _ in range(2):
        generation._extract(file, tasks[0])
    assert reads(folder) == ["a-0"]


@pytest.mark.skipif(not JOBLIB, reason="the extra `local` is not installed")
@pytest.mark.slow
def test_jobs_of_a_launcher_one_of_which_is_killed_give_the_same_bytes(folder, capfd):
    data(folder, "alone").generate(workers=1, progress=False)
    expected = contents(data(folder, "alone"))
    (folder / "read.log").unlink()
    (folder / "kill-b-3").touch()
    launch = generation.launching(["hydra/launcher=local", "hydra.launcher.n_jobs=2"], 2, [])
    module = data(folder)
    module.generate(progress=True, launch=launch)
    said = capfd.readouterr()
    assert "the launcher broke down" in said.out
    assert "recording 6 of 6 extracted" in said.err
    assert contents(module) == expected
    assert reads(folder).count("b-3") == 2
    assert len(reads(folder)) <= 6 + 2, "at most what two jobs were doing is done twice"
    assert not list(module.root.glob(".*-parts"))


def test_what_a_launcher_cannot_send_is_named(folder):
    module = data(folder)
    module.list_sources = lambda _: [
        replace(source, read=lambda file=source.files[0]: read(file)) for source in deadly(folder)
    ]
    with pytest.raises(ConfigError, match=r"cannot send these recordings .*function at module level"):
        module.generate(progress=False, launch=generation.launching(["hydra/launcher=local"], 2, []))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("data=exid", "hydra/launcher=local"), "jobs=<number> belong together"),
        (("data=exid", "jobs=2"), "hydra/launcher=<name> and jobs=<number> belong together"),
        (("hydra/launcher=local", "jobs=2"), "data=rpi has no recordings"),
        (("data=exid", "jobs=0", "hydra/launcher=local"), "jobs is 0"),
    ],
)
def test_a_launcher_without_jobs_or_recordings_is_refused(words, message):
    from epo_lightning.experiment.config.compose import compose
    from epo_lightning.experiment.verbs import generate_and_print

    with pytest.raises(ConfigError, match=message):
        generate_and_print(compose("generate", words), words)


def tables(draw: np.random.Generator, lanes: int, lines: bool) -> SceneTables:
    """Random scenes of one recording."""
    agents, polylines, scenes = draw.integers(1, 6), draw.integers(0, 5), draw.integers(1, 4)
    number = {"A": agents, "T": polylines, "S": scenes, "O": 1}

    def values(*shape: int) -> np.ndarray:
        return draw.normal(size=shape).astype(np.float32)

    def index(rows: int, *shape: int) -> np.ndarray:
        return draw.integers(-1, max(rows, 0), shape).astype(np.int32) if rows else np.full(shape, -1, np.int32)

    a, t, s = (number[name] for name in "ATS")
    return SceneTables(
        values(a, 3, 4),
        draw.random((a, 3)) < 0.5,
        values(a, 2, 4),
        draw.random((a, 2)) < 0.5,
        values(a, 2),
        draw.choice([KINDS.index("car"), KINDS.index("pedestrian")], a),
        draw.integers(0, 99, a),
        values(a, 4, 2),
        values(a, 2, 5, 2),
        values(a),
        values(t, 4, 2),
        index(a, s, 3),
        index(t, s, lanes),
        draw.normal(size=(s, 2)),
        draw.normal(size=s),
        np.zeros(s, np.int32),
        draw.integers(0, 99, s),
        draw.normal(size=(1, 2)),
        draw.integers(1, 3, a).astype(np.int32) if lines else None,
    )


def plainly(names: list[str], found: dict[str, SceneTables | None]) -> dict[str, np.ndarray]:
    """The columns of a split, joined in memory row by row."""
    known = [(number, found[name]) for number, name in enumerate(names) if found[name] is not None]
    widest = max(part.lanes.shape[1] for _, part in known)
    before = dict.fromkeys(("agents", "lanes"), 0)
    columns: dict[str, list] = {}
    for number, part in known:
        for name in (*OF_AGENTS, "polylines", *OF_SCENES):
            value = getattr(part, name)
            if value is None:
                continue
            for row in value:
                if name in before:
                    row = [-1 if entry < 0 else int(entry) + before[name] for entry in row]
                    row += [-1] * (widest - len(row) if name == "lanes" else 0)
                columns.setdefault(name, []).append(number if name == "recording" else row)
            columns.setdefault(name, [])
        before["agents"] += len(part.history)
        before["lanes"] += len(part.polylines)
    origins = [found[name].origin[0] if found[name] is not None else np.zeros(2) for name in names]
    return {name: np.array(rows) for name, rows in {**columns, "origin": origins}.items()}


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), empty=st.lists(st.booleans(), min_size=1, max_size=5), lines=st.booleans())
def test_gathered_columns_are_those_joined_in_memory(tmp_path_factory, seed, empty, lines):
    draw = np.random.default_rng(seed)
    names = [f"r{number}" for number in range(len(empty) + 1)]
    found = {name: tables(draw, int(draw.integers(1, 4)), lines) for name in names}
    found |= {name: None for name, none in zip(names, empty, strict=False) if none}
    full = [part for part in found.values() if part is not None]
    widest = max(part.lanes.shape[1] for part in full)
    outcome = Extracted({}, {})
    made, about = gather(
        *(names, found, {name: {} for name in names}, dict.fromkeys(names, outcome)),
        widest=widest,
        folder=tmp_path_factory.mktemp("spool") / "train",
    )
    expected = plainly(names, found)
    assert set(made) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(made[name].numpy(), values.reshape(made[name].shape), err_msg=name)
    together = joined(full)
    for name, values in together.columns().items():
        if name not in ("recording", "origin"):
            assert made[name].numpy().dtype == values.dtype
            np.testing.assert_array_equal(made[name].numpy(), values)
    speed = np.concatenate([part.history[:, -1, 3] for part in full])
    assert about["speed [m/s], 5th and 95th percentile"] == np.percentile(speed, [5, 95]).tolist()
    walks = np.concatenate([part.kind for part in full]) == KINDS.index("pedestrian")
    for name, some in (("pedestrians", walks), ("others", ~walks)):
        shown = about.get(f"speed of {name} [m/s], 5th and 95th percentile")
        assert shown == (np.percentile(speed[some], [5, 95]).tolist() if 0 < walks.sum() < len(walks) else None)
    counts = [(row >= 0).sum() for part in full for row in part.agents]
    assert about["agents per scene"] == float(np.mean(counts))
    assert set(INDEX_OF.values()) == {"history", "polylines", "origin"}


def test_scenes_are_gathered_in_files_that_exist_as_long_as_they_are_used(tmp_path):
    draw = np.random.default_rng(0)
    lanes = {"a": 2, "b": 5, "c": 3, "d": 4}
    found = {name: tables(draw, count, True) for name, count in lanes.items()} | {"none": None}
    counts = {name: {"scenes": 0 if part is None else len(part)} for name, part in found.items()}
    outcome = {"a": (3, 1), "b": (5, 3), "c": (0, 0), "d": (7, 7), "none": (0, 0)}
    extracted = {
        name: Extracted({}, {"moving agents": moving, "ends far from lanes": far} if moving else {})
        for name, (moving, far) in outcome.items()
    }
    parts = SimpleNamespace(folder=tmp_path, lanes=lanes.__getitem__)  # only these are asked for their lanes
    splits = {"train": ["a", "none", "b"], "val": ["c"], "test": ["d"]}
    folder = tmp_path / "columns"
    (folder / "train").mkdir(parents=True)  # as a killed process leaves it
    (folder / "train" / "agents").write_text("half")
    with (
        pytest.raises(RuntimeError, match="while they are used"),
        gathered(splits, found, counts, extracted, parts) as made,
    ):
        tensors, about = made
        assert folder.is_dir()
        assert {split: rows["lanes"].shape[1] for split, rows in tensors.items()} == {"train": 5, "val": 3, "test": 4}
        share = "moving agents that end over 10 m from all lanes given"
        assert {split: shown.get(share) for split, shown in about.items()} == {"train": 0.5, "val": None, "test": 1.0}
        assert about["train"]["scenes"] == len(found["a"]) + len(found["b"])
        raise RuntimeError("while they are used")
    assert not folder.exists()
    parts.folder = tmp_path / "file"
    parts.folder.touch()
    refused = gathered(splits, found, counts, extracted, parts)
    with pytest.raises(OSError, match=r"cannot write .*: set data.root to a folder that can be written"), refused:
        pass


def test_rows_of_another_shape_or_dtype_are_refused(tmp_path):
    spool = Spool(tmp_path / "spool")
    spool.append({"a": np.zeros((2, 3), np.float32), "empty": np.zeros((0, 4))})
    for wrong in (np.zeros((1, 2), np.float32), np.zeros((1, 3))):
        with pytest.raises(ValueError, match=r"column 'a' .* those before float32 \[3\]"):
            spool.append({"a": wrong})
    spool.append({"a": np.ones((1, 3), np.float32)})
    columns = spool.columns()
    np.testing.assert_array_equal(columns["a"], [[0, 0, 0], [0, 0, 0], [1, 1, 1]])
    assert columns["empty"].shape == (0, 4)


def test_no_scene_is_selected_from_none():
    assert selected(None, None) is None
    assert selected(tables(np.random.default_rng(0), 2, False), None) is None
