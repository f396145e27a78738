"""Highway rows from recordings to the table: generate, train, evaluate, report and predict on the small fixture.

That every row works is tested on drawn scenes (test_smoke.py); here is what needs recordings.
"""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path

import pytest
from experiment.conftest import Epo

from epo_lightning.experiment.config.compose import compose, hydra, jobs, tree
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.config.sources import HIGHWAYS, options_of
from epo_lightning.experiment.train import folder_for
from epo_lightning.identity import differences
from epo_lightning.schema import read

FIXTURE = Path(__file__).parents[1] / "fixtures" / "exid_sim"
DATA = (f"data.folder={FIXTURE}", "data.batch_size=4")
ROWS = sorted(file.stem for file in (tree() / "conf" / "experiment" / "highway").glob("*.yaml"))
SHARED = Path(os.environ.get("EPO_SHARED", Path(__file__).parents[2].parent / "shared"))


def test_the_rows_are_the_papers_and_those_of_other_games() -> None:
    backbones = ("v_lstm", "vibes", "hivt_m")
    main = {f"{backbone}{suffix}" for backbone in backbones for suffix in ("", "_sc", "_epo", "_refined")}
    twins = {f"{backbone}_epo_{name}no_pair" for backbone in backbones for name in ("", "equilibrium_")}
    games = {f"{backbone}_epo_{name}" for backbone in backbones for name in ("interactive", "equilibrium")}
    assert set(ROWS) == main | twins | games | {"const_vel", "v_lstm_epo_no_init", "v_lstm_epo_no_goal"}
    with hydra() as instance:
        options = options_of(instance, "experiment")
    for data in HIGHWAYS:
        assert sorted(name.partition("/")[2] for name in options if name.startswith(f"{data}/")) == ROWS


@pytest.mark.parametrize("data", HIGHWAYS)
@pytest.mark.parametrize(("row", "budget"), [("vibes_epo", "paper"), ("v_lstm_epo_no_goal", "short")])
def test_both_names_of_a_row_are_the_same_run(data: str, row: str, budget: str) -> None:
    new = compose("train", [f"experiment=highway/{row}", f"data={data}", f"budget={budget}"])
    old = compose("train", [f"experiment={data}/{row}", f"budget={budget}"])
    assert new == old
    assert (new["experiment"], new["variant"], new["data"]["dataset"]) == (f"{data}/{row}", "", data)
    assert folder_for(read(Settings, new)).path == Path(f"runs/{data}/{row}/{budget}-s0")


def test_other_data_and_other_settings_get_folders_of_their_own() -> None:
    words = (["data=us101"], ["data=highway_sim"], ["data=drawn"], ["data=us101", "data.seed=3"], [])
    configs = [compose("train", ["experiment=highway/vibes", *more]) for more in words]
    assert len({folder_for(read(Settings, config)).path for config in configs}) == len(words)
    assert [config["experiment"] for config in configs][2] == "highway/vibes"  # not one of the highway data sets


@pytest.mark.parametrize(
    ("sweep", "count"), [("interaction", 2), ("interaction_highway_sim", 3), ("interaction_us101", 3)]
)
def test_every_row_of_an_interaction_sweep_has_a_twin_without_pair_terms(sweep: str, count: int) -> None:
    runs = jobs("train", [f"sweeps={sweep}"])
    assert len(runs) == 3 * 3 * count
    configs = {config["experiment"]: config for config in (compose("train", job) for job in runs if "seed=0" in job)}
    twins = [name for name in configs if name.endswith("_no_pair")]
    assert len(twins) == count
    for twin in twins:
        game = twin.removesuffix("_no_pair")
        assert differences(configs[game], configs[twin]) == [("energy.pair", ["proximity"], [])]
        assert game.replace("_epo", "_sc") in configs


def test_old_names_work_in_globs_and_sweeps() -> None:
    assert len(jobs("train", ["experiment=glob('us101/*')"])) == len(ROWS)
    main = [compose("train", job) for job in jobs("train", ["sweeps=us101_main"])]
    assert len({folder_for(read(Settings, config)).path for config in main}) == 30
    assert {config["experiment"].partition("/")[0] for config in main} == {"us101"}
    assert {config["data"]["dataset"] for config in main} == {"us101"}


@pytest.mark.slow  # tests/docs/test_docs_tutorial.py goes the same way
def test_rows_from_recordings_to_the_table(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("generate", "data=exid", *DATA, "progress=false", "workers=1") == 0
    (following,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("next: ")]
    assert following.startswith("next: epo train experiment=exid/v_lstm_epo data.folder=")
    assert "--config-dir=" in following, "the command finds the configurations that this one found"
    assert "workers=1" not in following
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


@pytest.mark.parametrize("own", [[], ["data.dataset=mine"]])
def test_the_next_command_for_vehicles_without_a_map_is_accepted(
    epo: Epo, capsys: pytest.CaptureFixture[str], own: list[str]
) -> None:
    without_map = ["data.map=false", "data.windows.lane_change=false"]
    assert epo("generate", "data=exid", *DATA, *without_map, *own, "workers=1") == 0
    (following,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("next: ")]
    words = shlex.split(following.removeprefix("next: epo train ").partition(" (")[0])
    assert words[0] == "experiment=dut/v_lstm_epo"
    assert epo("config", "check", *words) == 0


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
