"""Random damage to tables, and the rule for what a reader makes of it: one sentence or a valid recording."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.tracks import Recording

VALUES = [
    *(
        "",
        " ",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "1e400",
        "1e300",
        "-1e300",
        "1e20",
        "99999999999999999999",
        "-1",
        "0",
        "1e-320",
    ),
    *(
        "x",
        "1;2",
        ";",
        '"',
        "'",
        "\x00",
        "ä",
        "1_0",
        "0x10",
        "1,5",
        "1.5.2",
        "--1",
        "None",
        "True",
        "9223372036854775807",
    ),
]


def flip(content, random):
    for _ in range(random.integers(1, 6)):
        place = random.integers(len(content))
        content = content[:place] + bytes([random.integers(256)]) + content[place + 1 :]
    return content


def truncate(content, random):
    return content[: random.integers(len(content))]


def splice(content, random):
    """A piece of a file repeated, moved or removed."""
    a, b, c = np.sort(random.integers(0, len(content) + 1, 3))
    return random.choice(
        [content[:a] + content[b:], content[:b] + content[a:], content[:a] + content[b:c] + content[a:b]]
    )


def table(content):
    return [line.split(b",") for line in content.splitlines()]


def text(cells):
    return b"".join(b",".join(row) + b"\n" for row in cells)


def set_cells(content, random):
    cells = table(content)
    for _ in range(random.integers(1, 4)):
        row = cells[random.integers(len(cells))]
        row[random.integers(len(row))] = str(random.choice(VALUES)).encode()
    return text(cells)


def set_used_cell(content, random):
    """A value of a column that matters, also in every row."""
    cells = table(content)
    column = random.integers(min(11, len(cells[0])))
    value = str(random.choice(VALUES)).encode()
    rows = range(1, len(cells)) if random.random() < 0.3 else [random.integers(1, len(cells))]
    for row in rows:
        cells[row][min(column, len(cells[row]) - 1)] = value
    return text(cells)


def swap_columns(content, random):
    """The names of two columns exchanged, but not their values."""
    cells = table(content)
    a, b = random.integers(min(11, len(cells[0])), size=2)
    cells[0][a], cells[0][b] = cells[0][b], cells[0][a]
    return text(cells)


def shuffle_columns(content, random):
    cells = table(content)
    order = random.permutation(len(cells[0]))
    return text([[row[place] for place in order] for row in cells])


def drop_column(content, random):
    cells = table(content)
    place = random.integers(len(cells[0]))
    return text([row[:place] + row[place + 1 :] for row in cells])


def double_column(content, random):
    cells = table(content)
    place = random.integers(len(cells[0]))
    return text([[*row, row[place]] for row in cells])


def swap_rows(content, random):
    lines = content.splitlines(keepends=True)
    a, b = random.integers(0, len(lines), 2)
    lines[a], lines[b] = lines[b], lines[a]
    return b"".join(lines)


def double_row(content, random):
    lines = content.splitlines(keepends=True)
    lines.insert(random.integers(len(lines)), lines[random.integers(len(lines))])
    return b"".join(lines)


def drop_rows(content, random):
    lines = content.splitlines(keepends=True)
    first = random.integers(len(lines))
    del lines[first : first + random.integers(1, 4)]
    return b"".join(lines)


def scale_column(content, random):
    """Another unit."""
    cells = table(content)
    column = random.integers(min(11, len(cells[0])))
    factor = random.choice([0.001, 0.0174533, 0.3048, 3.6, -1, 57.3, 1000])
    for row in cells[1:]:
        if column < len(row) and re.fullmatch(rb"-?[0-9.]+", row[column]):
            row[column] = str(float(row[column]) * factor).encode()
    return text(cells)


CSV = [
    *(flip, truncate, splice, set_cells, set_used_cell, swap_columns, shuffle_columns, drop_column, double_column),
    *(swap_rows, double_row, drop_rows, scale_column),
]
HARMLESS = {shuffle_columns}


def attempt(read: Callable[[], Recording], folder: Path, label: str) -> tuple[Recording | None, str]:
    """The recording, or None with the message of the error, which must begin with a path below ``folder``."""
    try:
        return read(), ""
    except RecordingError as error:
        problem = str(error)
    except BaseException as error:
        raise AssertionError(label) from error
    assert re.fullmatch(rf"{re.escape(str(folder))}[^\n]*?(, row \d+)?: [^\n]{{10,}}", problem), f"{label}: {problem!r}"
    return None, problem


def damage(
    read: Callable[[], Recording],
    folder: Path,
    files: Sequence[Path],
    trials: int,
    check: Callable[[Recording, str], None],
    seed: int = 0,
) -> Counter[str]:
    """Outcomes of reading a folder in which one file after the other is damaged; both outcomes must be frequent.

    Args:
        read: reads the whole folder.
        files: tables to damage, one at a time.
        check: compares a recording that was read with the damaged files; it is called with the recording and a label.
    """
    random = np.random.default_rng(seed)
    contents = {file: file.read_bytes() for file in files}
    outcomes: Counter[str] = Counter()
    for trial in range(trials):
        file = files[random.integers(len(files))]
        change = CSV[random.integers(len(CSV))]
        content = change(contents[file], random)
        file.write_bytes(content)
        label = f"trial {trial}: {change.__name__} of {file.name}: {content[:2000]!r}"
        found, problem = attempt(read, folder, label)
        assert not (problem and change in HARMLESS), f"{label}: {problem}"
        if found is not None:
            found.tracks.check("fuzz")
            if found.lanes is not None:
                found.lanes.check("fuzz")
            check(found, label)
        outcomes["refused" if found is None else "read"] += 1
        file.write_bytes(contents[file])
    assert min(outcomes["refused"], outcomes["read"]) > trials // 20, outcomes
    return outcomes
