"""The road from the command line to the first batch: how much of the code a reader passes, and what is loaded on it."""

from __future__ import annotations

import inspect
import sys
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from experiment.conftest import Epo

import epo_lightning
from epo_lightning.data import cache
from epo_lightning.data.datamodule import SceneDataModule
from epo_lightning.experiment.dashboards import aside  # noqa: F401 - loaded, so that only the run itself is counted
from epo_lightning.forecasters import Forecaster

ROOT = str(Path(epo_lightning.__file__).parent)
RPI = ("experiment=rpi/v_lstm_epo", "data.games=3", "data.placements=1", "callbacks.progress=none")


class FirstBatch(BaseException):
    """The end of the road."""


def passed(epo: Epo, monkeypatch: pytest.MonkeyPatch, *words: str) -> set[tuple[str, str]]:
    """File and name of every function of the package that another one of it calls before the first training step.

    Hooks that Lightning calls are not among them, but what they call is.
    """
    called: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        caller = frame.f_back
        while caller and caller.f_code.co_filename.endswith(("contextlib.py", "functools.py")):
            caller = caller.f_back
        if event == "call" and caller and caller.f_code.co_filename.startswith(ROOT):
            called.add(frame.f_code)

    def stop(*_: Any) -> None:
        raise FirstBatch

    monkeypatch.setattr(Forecaster, "training_step", stop)
    sys.setprofile(note)
    try:
        with pytest.raises(FirstBatch):
            epo(*words)
    finally:
        sys.setprofile(None)
    return {(code.co_filename, code.co_qualname) for code in called if code.co_filename.startswith(ROOT)}


HYDRAS = "experiment/config/sources.py"
"""Sources of the configuration tree, which Hydra calls."""


def named(file: str, qualname: str) -> bool:
    """Whether a function is called by its name: not a special method, a property, a class or an inner function."""
    *home, name = qualname.split(".")
    if name.startswith(("__", "<")) or "<locals>" in home or file.endswith(HYDRAS):
        return False
    found: Any = import_module(".".join(("epo_lightning", *Path(file).relative_to(ROOT).with_suffix("").parts)))
    for word in home:
        found = getattr(found, word, None)
    attribute = inspect.getattr_static(found, name, None)
    return not isinstance(attribute, property | cached_property | type)


def test_the_road_to_the_first_batch_is_short(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> None:
    assert epo("generate", "data=rpi", *RPI[1:3], "progress=false", "workers=1") == 0
    passed(
        epo, monkeypatch, "train", *RPI, "run_dir=first"
    )  # what runs once per process is not counted: imports, and caches
    loaded = []
    load = cache.load
    monkeypatch.setattr(cache, "load", lambda *words: loaded.append(words[1]) or load(*words))
    built = []
    build = SceneDataModule.__init__
    monkeypatch.setattr(SceneDataModule, "__init__", lambda self, *words: built.append(self) or build(self, *words))
    functions = [each for each in passed(epo, monkeypatch, "train", *RPI) if named(*each)]
    files = {file for file, _ in functions}
    assert len(functions) <= 100, "\n".join(sorted(f"{Path(file).name} {name}" for file, name in functions))
    assert len(files) <= 35, "\n".join(sorted(files))
    assert sorted(loaded) == ["train", "val"], "each split is loaded once"
    assert len(built) == 1
