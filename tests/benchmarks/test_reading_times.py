"""Benchmarks of data sets at their smallest sizes: extraction, generation and reading."""

from __future__ import annotations

import pytest
from programs import ROOT, refused

from benchmarks import extraction, generation, reading
from epo_lightning.data.recorded.formats.argoverse2 import argoverse2
from epo_lightning.data.recorded.windows import WindowConfig, extract

FIXTURE = ROOT / "tests" / "fixtures" / "exid_sim"


@pytest.mark.slow
def test_extraction_is_timed(capsys):
    extraction.main([str(FIXTURE), "--recordings", "1", "--batches", "2"])
    shown = capsys.readouterr().out
    for stage in ("reading", "extraction", "loading"):
        (number,) = [line.split()[1] for line in shown.splitlines() if line.startswith(stage)][:1]
        assert float(number.replace(",", "")) > 0


@pytest.mark.parametrize("format_", ["commonroad", "ucy", "exid"])
def test_extraction_of_a_folder_of_another_format_is_one_line(format_, tmp_path):
    folder = FIXTURE if format_ != "exid" else tmp_path
    message = refused(extraction.main, folder, "--format", format_)
    assert str(folder) in message
    assert f"--format is {format_}" in message


def test_extraction_of_a_format_that_does_not_exist_names_the_nearest():
    assert "did you mean 'exid'" in refused(extraction.main, FIXTURE, "--format", "exdi")


def test_made_scenarios_have_scenes(tmp_path):
    size = generation.make(tmp_path, 0, 11)
    sources = argoverse2(tmp_path)
    assert [source.group for source in sources] == ["train"] * 9 + ["val"] * 2
    assert size == sum(file.stat().st_size for file in tmp_path.rglob("*.*"))
    windows = WindowConfig(
        **{"dt": 0.1, "history": 50, "horizon": 60, "least_agents": 2, "lane_change": False, "off_lane": "agent"}
    )
    for source in sources[:3]:
        scenes, counts = extract(source.read(), windows)
        assert scenes is not None
        assert counts["windows"] > 0


@pytest.mark.slow
def test_generation_and_reading_are_measured(tmp_path, capsys):
    generation.main(["--recordings", "50", "--folder", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "a million of these recordings" in shown
    (made,) = (tmp_path / "cache-all").glob("argoverse2-*")
    reading.main([str(made), "--gigabytes", "0.01", "--seconds", "0.1", "--folder", str(tmp_path / "repeated")])
    assert capsys.readouterr().out.count("scenes/s") == 8
