"""Strict parsing of CSV tables: errors name file, row and column."""

from __future__ import annotations

import codecs
import difflib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import polars as pl

from epo_lightning.data.errors import RecordingError

Types = Mapping[str, pl.DataType]

INT, FLOAT, FLAG, TEXT = pl.Int64(), pl.Float64(), pl.Boolean(), pl.String()
INTS, FLOATS = pl.List(INT), pl.List(FLOAT)
COMPRESSED = (b"\x1f\x8b", b"PK\x03\x04")
"""First bytes of files of gzip and zip."""


def read_table(
    path: Path,
    types: Types,
    required: Iterable[str],
    optional: Iterable[str] = frozenset(),
    missing: Mapping[str, float] = MappingProxyType({}),
    told_by: Mapping[str, str] = MappingProxyType({}),
) -> pl.DataFrame:
    """Columns of a CSV file by name and type; their order in the file does not matter.

    Args:
        types: types of the columns that are read.
        required: columns whose values must not be missing.
        optional: columns that may be absent.
        missing: numbers that mean a missing value, by column.
        told_by: columns that are missing where another column is missing.

    Raises:
        RecordingError: there is no such file, a column is missing or repeated, a row is cut off, or a text is not a number.
    """
    try:
        data = path.read_bytes().rstrip(b"\r\n")
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    _check_text(path, data)
    header, _, body = data.partition(b"\n")
    names = [name.strip(' \r"') for name in header.decode("utf-8-sig", errors="replace").split(",")]
    if not body:
        raise RecordingError(path, "there are no rows in it: was the file cut off? Copy it again")
    for name in types:
        if names.count(name) > 1:
            raise RecordingError(path, f"there are {names.count(name)} columns called {name}: keep one of them")
        if name not in names and name not in optional:
            others = sorted(set(names) - set(types))
            close = [other for other in others if other.lower() == name.lower()]
            close = close or difflib.get_close_matches(name, others, n=1)
            raise RecordingError(path, f"there is no column {name}" + (f"; is it {close[0]!r}?" if close else ""))
    _check_fields(path, data, body, len(names))
    present = [name for name in types if name in names]
    flat = {name: types[name] if types[name] in (INT, FLOAT) else TEXT for name in present}
    try:
        table = _parsed(body, names, flat)
    except pl.exceptions.PolarsError as error:
        try:
            table = _parsed(body, names, dict.fromkeys(present, TEXT))
        except pl.exceptions.PolarsError:
            raise RecordingError(path, f"the file is no CSV table ({str(error).splitlines()[0]})") from error
    table = pl.DataFrame([_typed(path, table[name], types[name], missing.get(name)) for name in present])
    for name in set(required) & set(present):
        raise_first(path, table[name].is_null().to_numpy(), f"there is no {name}")
    return table.with_columns(
        pl.when(pl.col(other).is_null()).then(None).otherwise(pl.col(name)).alias(name)
        for name, other in told_by.items()
        if name in present and other in present
    )


def _check_text(path: Path, data: bytes) -> None:
    """Check that a file is text in UTF-8 whose first line has fields separated by commas."""
    if data.startswith(COMPRESSED):
        raise RecordingError(path, "it is compressed: unpack it, for instance with gunzip or unzip")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise RecordingError(path, "it is text in UTF-16: save it as UTF-8")
    header, _, body = data.partition(b"\n")
    if not body and b"\r" in header:
        raise RecordingError(path, "its lines end with carriage returns alone: save it with line feeds at their ends")
    for separator, name in ((b";", "semicolons"), (b"\t", "tabs")):
        if separator in header and b"," not in header:
            raise RecordingError(
                path,
                f"its columns are separated by {name}: save it with commas between them, and with points in numbers",
            )


def _check_fields(path: Path, data: bytes, body: bytes, expected: int) -> None:
    """Check that all rows have as many fields as the header."""
    characters = np.frombuffer(data, dtype=np.uint8)
    rows = np.count_nonzero(characters == ord("\n")) + 1
    if np.count_nonzero(characters == ord(",")) == rows * (expected - 1):
        return
    for row, line in enumerate(body.split(b"\n"), start=2):
        if (fields := line.count(b",") + 1) != expected:
            raise RecordingError(
                path, f"{fields} fields where the header has {expected}: was the file cut off? Copy it again", row=row
            )


def _parsed(body: bytes, names: list[str], types: Types) -> pl.DataFrame:
    """The rows of a CSV file as columns of given types."""
    # The header is replaced by numbers, because names in the file may be repeated.
    places = {name: str(names.index(name)) for name in types}
    header = ",".join(map(str, range(len(names)))).encode()
    table = pl.read_csv(
        b"\n".join((header, body)),
        columns=list(places.values()),
        schema_overrides={places[name]: type for name, type in types.items()},
        quote_char=None,
    )
    return table.select(pl.col(place).alias(name) for name, place in places.items())


def _typed(path: Path, column: pl.Series, type: pl.DataType, missing: float | None) -> pl.Series:
    """A column converted to its type, with missing values as null."""
    if column.dtype == TEXT:
        text = column.str.strip_chars('"').replace("", None)
        column = text.str.split(";") if type.is_nested() else text
        column = column.cast(INT, strict=False).cast(type) if type == FLAG else column.cast(type, strict=False)
        broken = column.is_null() & text.is_not_null()
        if type.is_nested():
            broken |= column.list.eval(pl.element().is_null()).list.any().fill_null(False)
        expected = {INT: "a whole number", FLAG: "0 or 1", FLOAT: "a number"}.get(
            type, "numbers separated by semicolons"
        )
        raise_first(path, broken.to_numpy(), lambda row: f"{column.name} is {text[row]!r}; {expected} was expected")
    if missing is None:
        return column
    alone = column.list.first().set(column.list.len() != 1, None) if type.is_nested() else column
    absent = alone == missing
    return pl.select(pl.when(absent.fill_null(False)).then(None).otherwise(column).alias(column.name)).to_series()


def raise_first(path: Path, bad: np.ndarray, problem: str | Callable[[int], str]) -> None:
    """Raise a RecordingError for the first bad row of a CSV file, if there is one; the header is row 1."""
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise RecordingError(path, problem if isinstance(problem, str) else problem(row), row=row + 2)
