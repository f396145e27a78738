"""Highway rows from recordings to the table: generate, train, evaluate, report and predict on the small fixture.

That every row works is tested on drawn scenes (test_smoke.py); here is what needs recordings.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from experiment.conftest import Epo

from epo_lightning.experiment.config.compose import tree

FIXTURE = Path(__file__).parents[1] / "fixtures" / "exid_sim"
DATA = (f"data.folder={FIXTURE}", "data.batch_size=4")
ROWS = sorted(file.stem for file in (tree() / "conf" / "experiment" / "exid").glob("*.yaml"))
SHARED = Path(os.environ.get("EPO_SHARED", Path(__file__).parents[2].parent / "shared"))


def test_the_rows_are_the_papers() -> None:
    backbones = ("v_lstm", "vibes", "hivt_m")
    main = {f"{backbone}{suffix}" for backbone in backbones for suffix in ("", "_sc", "_epo")}
    assert set(ROWS) == main | {"const_vel", "v_lstm_epo_no_init", "v_lstm_epo_no_goal"}
    for data in ("us101", "highway_sim"):
        twins = sorted(file.stem for file in (tree() / "conf" / "experiment" / data).glob("*.yaml"))
        assert twins == ROWS


@pytest.mark.parametrize("data", ["us101", "highway_sim"])
@pytest.mark.parametrize("row", ROWS)
def test_twins_on_other_data_differ_in_one_line(data: str, row: str) -> None:
    folder = tree() / "conf" / "experiment"
    one, other = ((folder / name / f"{row}.yaml").read_text().splitlines()[2:] for name in ("exid", data))
    assert len(one) == len(other)
    assert sum(a != b for a, b in zip(one, other, strict=True)) == 1


def test_rows_from_recordings_to_the_table(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("generate", "data=exid", *DATA, "progress=false", "workers=1") == 0
    assert "next: epo train experiment=exid/v_lstm_epo data.folder=" in capsys.readouterr().out
    for row in ("const_vel", "hivt_m_sc", "vibes_epo", "v_lstm_epo_no_goal"):
        assert epo("train", f"experiment=exid/{row}", *DATA, "budget=smoke", "callbacks.progress=none") == 0, row
    assert epo("evaluate", "runs=runs") == 0
    assert epo("report", "runs=runs", "out=report") == 0
    text = (tmp_path / "report" / "results.md").read_text()
    for title in ("Const. Vel.", "V-LSTM + EPO, no goal", "HiVT-M + SC", "VIBES + EPO"):
        assert f"| {title} |" in text
    for value in ("(1.16,", "(2.57,", "(2.64,"):  # the paper's, of three of its rows
        assert value in text
    (run,) = (tmp_path / "runs" / "exid" / "vibes_epo").iterdir()
    metrics = json.loads((run / "metrics.json").read_text())["metrics"]
    assert 0 < metrics["minSADE"] < metrics["minSFDE"]
    assert epo("predict", f"run={run}", "out=seen", "scenes=3", "figures=2", "animate=1") == 0
    index = json.loads((tmp_path / "seen" / "index.json").read_text())
    assert index["dt"] == 0.2
    pictures = {file.suffix for file in (tmp_path / "seen" / "figures").iterdir()}
    assert pictures == {".png", ".gif"}


@pytest.mark.skipif(not (SHARED / "data" / "us101").is_dir(), reason="the US-101 scenarios are not here")
def test_us101_gives_the_known_number_of_windows(epo: Epo, tmp_path: Path) -> None:
    """27 long scenes of which 21 are here gave 5931 windows, and 1640 with a lane change."""
    assert epo("generate", "data=us101", f"data.folder={SHARED / 'data' / 'us101'}", "progress=false", "workers=1") == 0
    (folder,) = (tmp_path / "cache").glob("us101-*")
    report = json.loads((folder / "manifest.json").read_text())["report"]
    parts = [report[part] for part in ("train", "val", "test")]
    scenes = sum(part["scenes"] for part in parts)
    any_kind = scenes + sum(part["no lane change"] for part in parts)
    assert any_kind == pytest.approx(5931 * 21 / 27, rel=0.1)
    assert scenes == pytest.approx(1640 * 21 / 27, rel=0.1)
