"""Parts of a data set that a launcher's jobs extract: each part goes to one job, and what is lost is divided anew."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from epo_lightning.data.cache import CacheError
from epo_lightning.data.recorded.parts import PartTask
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.data.workers import Report
from epo_lightning.experiment import generation

Job = Callable[[list[list[str]]], list[object]]
"""What a launcher does with the names of the parts of all jobs; it returns the results of the jobs."""


class Launcher:
    """A launcher whose jobs write the names of their parts into the files of these; without Hydra and recordings."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, work: Job) -> None:
        self.folder, self.work = folder, work
        self.told: list[str] = []
        self.divided: list[list[list[str]]] = []
        monkeypatch.setattr(generation.compose, "jobs", lambda *_: [["data=roads"]])
        monkeypatch.setattr(generation.compose, "launch", self._launch)

    def _launch(self, verb: str, words: Sequence[str], listed: Sequence[Any], *_: object) -> list[SimpleNamespace]:
        (place,) = self.folder.glob("jobs-*")  # jobs of an earlier command find their files gone
        contents = [pickle.loads((place / f"{number}.pickle").read_bytes()) for number in range(len(listed))]
        assert len(list(place.iterdir())) == len(listed)
        parts = [[task.file.name for task in content["tasks"]] for content in contents]
        self.divided.append(parts)
        return [SimpleNamespace(_return_value=result) for result in self.work(parts)]

    def extract(self, names: Sequence[str]) -> None:
        for name in names:
            (self.folder / name).touch()

    def run(self, parts: int, jobs: int) -> None:
        files = [self.folder / f"{number}.part" for number in range(parts)]
        tasks = [PartTask([], WindowConfig(), True, file, True, True) for file in files]
        report = SimpleNamespace(bar=contextlib.nullcontext(), advance=lambda task: self.told.append(task.file.name))
        generation.launching([], jobs, [])(tasks, cast(Report, report))


@pytest.mark.parametrize(("jobs", "sizes"), [(4, [2, 2, 1, 1]), (9, [1, 1, 1, 1, 1, 1])])
def test_every_part_goes_to_one_job_and_no_job_has_none(
    jobs: int, sizes: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(parts: list[list[str]]) -> list[object]:
        for names in parts:
            launcher.extract(names)
        return [None] * len(parts)

    (tmp_path / "jobs-1").mkdir()
    (tmp_path / "jobs-1" / "0.pickle").touch()
    launcher = Launcher(tmp_path, monkeypatch, work)
    launcher.run(6, jobs)
    (parts,) = launcher.divided
    assert [len(names) for names in parts] == sizes
    assert (
        sorted(name for names in parts for name in names)
        == sorted(launcher.told)
        == [f"{number}.part" for number in range(6)]
    )


def test_parts_of_a_launcher_that_broke_down_are_divided_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(parts: list[list[str]]) -> list[object]:
        launcher.extract(parts[0])
        if len(launcher.divided) == 1:
            raise RuntimeError("a worker was killed")
        return [None] * len(parts)

    launcher = Launcher(tmp_path, monkeypatch, work)
    launcher.run(6, 2)
    assert launcher.divided == [
        [["0.part", "2.part", "4.part"], ["1.part", "3.part", "5.part"]],
        [["1.part", "5.part"], ["3.part"]],
        [["3.part"]],
    ]
    assert "a worker was killed): 3 parts are left" in capsys.readouterr().out


def test_parts_that_every_attempt_loses_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    launcher = Launcher(tmp_path, monkeypatch, lambda parts: [None] * len(parts))
    with pytest.raises(
        CacheError, match=r"6 of 6 parts were not extracted \(jobs were lost\).*run the same command again"
    ):
        launcher.run(6, 2)
    assert len(launcher.divided) == generation.ATTEMPTS


def test_the_error_of_a_job_is_that_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    launcher = Launcher(tmp_path, monkeypatch, lambda parts: [None, ValueError("recording 3 has no lanes")])
    with pytest.raises(ValueError, match="recording 3 has no lanes"):
        launcher.run(2, 2)
    assert len(launcher.divided) == 1
