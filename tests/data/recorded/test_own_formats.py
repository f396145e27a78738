"""Mistakes in a format of one's own are refused in one message that names the file, and says what to do."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.registry import ConfigError, register

from .roads import recording
from .test_plausibility import walking


def source(file: Path) -> RecordingSource:
    """A recording of a road, whatever the file holds."""
    return RecordingSource(file.stem, file.stem, (file,), recording)


RETURNED: dict[str, Callable[[list[Path]], Any]] = {
    "sources": lambda files: [source(file) for file in files],
    "generator": lambda files: (source(file) for file in files),
    "nothing": lambda files: None,
    "one": lambda files: source(files[0]),
    "files": lambda files: files,
    "text": lambda files: "a.feet",
}
"""What the function of the format returns, by the value of its option."""


@register("format", "feet")
def feet(folder: Path, returned: str = "sources", rate: float = 10.0) -> Any:
    """Files ``<name>.feet``, listed as the option says."""
    return RETURNED[returned](list(folder.glob("*.feet")))


def data(folder: Path, **options: Any) -> RecordedData:
    """The data of a folder with four recordings."""
    for name in "abcd":
        (folder / f"{name}.feet").touch()
    return RecordedData("feet", "feet", str(folder), {"dt": 0.2}, root=str(folder / "cache"), options=options)


@pytest.mark.parametrize("returned", ["sources", "generator"])
def test_recordings_may_be_listed_in_any_order_of_any_iterable(tmp_path: Path, returned: str) -> None:
    assert [source.name for source in data(tmp_path, returned=returned).sources()] == list("abcd")


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        ("nothing", r"returned None; a list of RecordingSource was expected: is a return missing\?$"),
        ("one", "returned RecordingSource; a list of RecordingSource was expected$"),
        ("files", "returned list of PosixPath; a list of RecordingSource was expected$"),
        ("text", "returned str of str; a list of RecordingSource was expected$"),
    ],
)
def test_functions_that_return_something_else_are_named_with_their_file(
    tmp_path: Path, returned: str, said: str
) -> None:
    with pytest.raises(ConfigError, match=rf"^{__file__}:\d+: format 'feet' {said}"):
        data(tmp_path, returned=returned).sources()


def test_values_of_options_are_of_the_annotated_type(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^data\.options\.rate must be a number, not 'fast'$"):
        data(tmp_path, rate="fast")
    assert data(tmp_path, rate=12).options == {"rate": 12}


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (
            "position",
            lambda given: given[:-1],
            r"position has the shape \(239, 2\); \(240, 2\) was expected, because agent has",
        ),
        ("velocity", lambda given: given[:, 0], r"velocity has the shape \(240,\); \(240, 2\) was expected"),
        ("kind", lambda given: given[0], r"kind has the shape \(\); \(6,\) was expected, because ids has 6 entries"),
        (
            "kind",
            lambda given: given.astype(str),
            "kind is of type .*: a kind is an index into KINDS .* for car, van, truck",
        ),
        (
            "ids",
            lambda given: given.astype(str),
            r"ids is of type .*: number texts by np\.unique\(ids, return_inverse=True\)\[1\]",
        ),
    ],
)
def test_columns_of_another_length_or_type_are_named(name: str, change: Callable[[np.ndarray], Any], said: str) -> None:
    tracks = walking()
    with pytest.raises(RecordingError, match=f"a.feet: {said}"):
        dataclasses.replace(tracks, **{name: change(getattr(tracks, name))}).check("a.feet")


def test_a_recording_in_the_place_of_its_reader_is_refused() -> None:
    with pytest.raises(
        RecordingError, match=r"^a.feet: the last argument .* is a Recording; .*: partial\(read, file\)"
    ):
        RecordingSource("a", "a", (Path("a.feet"),), recording())  # type: ignore[arg-type]
