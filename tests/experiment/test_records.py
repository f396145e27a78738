"""What a run writes down about itself: readable for those whom the umask allows, without secrets, fit for a shell."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from experiment.conftest import TINY, Epo

ROW = "experiment=rpi/v_lstm_sc"


@pytest.fixture(params=[0o027, 0o002], ids=["group reads", "group writes"])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_files_of_runs_sweeps_and_reports_have_the_permissions_that_the_umask_leaves(
    epo: Epo, umask: int, tmp_path: Path
) -> None:
    words = ("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/v_lstm_epo", "score=test")
    assert epo(*words, "logger=[tensorboard]") == 0
    assert epo("predict", "run=runs/rpi/v_lstm_epo/" + next(Path("runs/rpi/v_lstm_epo").iterdir()).name) == 0
    assert epo("report", "rpi_main") == 0
    entries = list(tmp_path.rglob("*"))
    assert {"metrics.csv", "best.ckpt", "index.html", "run.json", "sweep.json"} <= {path.name for path in entries}
    for path in entries:
        expected = (0o777 if path.is_dir() else 0o666) & ~umask
        assert oct(path.stat().st_mode & 0o777) == oct(expected), path
