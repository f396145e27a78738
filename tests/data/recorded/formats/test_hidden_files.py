"""Hidden files beside recordings, as macOS writes `._name` for every file on drives of other systems."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.recorded.formats import commonroad_files, crowd_files, waymo_files
from epo_lightning.registry import lookup


def write(format: str, folder: Path) -> None:
    if format == "commonroad":
        (folder / "a.xml").write_text(commonroad_files.scenario(commonroad_files.ROAD, commonroad_files.CAR))
    elif format == "crowd":
        crowd_files.write(folder)
    else:
        waymo_files.write(folder, [waymo_files.scenario()])


@pytest.mark.parametrize("format", ["commonroad", "crowd", "waymo"])
def test_hidden_files_are_no_recordings(format: str, tmp_path: Path) -> None:
    write(format, tmp_path)
    expected = [(source.name, source.files) for source in lookup("format", format)(tmp_path)]
    assert expected
    for file in [path for path in tmp_path.rglob("*") if path.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07")
    assert [(source.name, source.files) for source in lookup("format", format)(tmp_path)] == expected
