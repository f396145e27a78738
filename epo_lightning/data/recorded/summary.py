"""Summary of each recording: windows, scenes, reasons, seconds and warnings, as a table and as CSV beside a data set."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from epo_lightning.data.cache import SPLITS
from epo_lightning.data.recorded.clock import TOO_SHORT
from epo_lightning.data.recorded.duplicates import AGAIN, ELSEWHERE
from epo_lightning.data.recorded.extraction import Extracted
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.windows import AT_ENDS, MOMENTS, REASONS
from epo_lightning.scene import KINDS

FILE = "recordings.csv"
"""Name of the table in the folder of a data set."""
BEFORE = (TOO_SHORT, AT_ENDS)
"""Reasons for which a possible window is none: its agent is not observed in the whole of it."""
LOST = (*REASONS, AGAIN, ELSEWHERE)
"""Reasons for which windows are left out, in the order of the filters."""
COUNTED = (MOMENTS, *BEFORE, "windows", *LOST, "scenes")
"""All counts whose unit is the window; other counts are those of items that a reader left out."""
SHORT_TRACKS = "tracks shorter than a window"
"""A count of tracks that is not reported: ``TOO_SHORT`` counts the same in windows."""
SHOWN = 60
"""Largest number of recordings that are printed."""
AT_ONCE = 1 << 16
"""Largest number of agents whose goal candidates are in memory at once."""


def by_unit(counts: Mapping[str, int]) -> dict[str, Any]:
    """Counts of windows in the order of the filters, and under ``notes`` those of other items; zeros are left out."""
    found: dict[str, Any] = {name: int(counts[name]) for name in COUNTED if counts.get(name)}
    for name in ("windows", "scenes"):
        found.setdefault(name, 0)
    notes = {name: int(count) for name, count in counts.items() if name not in (*COUNTED, SHORT_TRACKS) and count}
    return {**found, **({"notes": notes} if notes else {})}


def describe(scenes: SceneTables) -> dict[str, Any]:
    """Statistics of the scenes of a split, for the report."""
    speed = scenes.history[:, -1, 3]
    found: dict[str, Any] = {
        "agents per scene": float((scenes.agents >= 0).sum(1).mean()),
        "speed [m/s], 5th and 95th percentile": [float(value) for value in np.percentile(speed, [5, 95])],
    }
    walks = scenes.kind == KINDS.index("pedestrian")
    if 0 < walks.sum() < len(walks):  # together, wrong units of one kind could not be seen
        for name, chosen in (("pedestrians", walks), ("others", ~walks)):
            found[f"speed of {name} [m/s], 5th and 95th percentile"] = [
                float(v) for v in np.percentile(speed[chosen], [5, 95])
            ]
    ends = scenes.future_mask[:, -1]
    if scenes.candidates.shape[1] and ends.any():
        nearest_goal = distance_to_goals(scenes)[ends]
        found["way to the nearest goal candidate [m], mean and 95th percentile"] = [
            float(nearest_goal.mean()),
            float(np.percentile(nearest_goal, 95)),
        ]
    return found


def distance_to_goals(scenes: SceneTables) -> np.ndarray:
    """Distance [A] from the last future position of every agent to its nearest goal candidate [m]."""
    found = []
    for first in range(0, max(1, len(scenes.history)), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        way = np.linalg.norm(scenes.candidates[rows] - scenes.future[rows, -1, None, :2], axis=-1)
        if scenes.lines is not None:
            per_line = scenes.candidates.shape[1] // scenes.references.shape[1]
            way = np.where(np.arange(way.shape[1]) < per_line * scenes.lines[rows, None], way, np.inf)
        found.append(np.asarray(way.min(1)))
    return np.concatenate(found)


def by_split(report: Mapping[str, Any]) -> list[str]:
    """Lines of a table of the counts of every split, from the report of a data set."""
    splits = sorted(report["recordings"], key=lambda split: SPLITS.index(split) if split in SPLITS else len(SPLITS))
    names = {name: None for split in splits for name in report[split] if name != "notes"}
    notes = {name: None for split in splits for name in report[split].get("notes", {})}
    counts = [name for name in names if all(isinstance(report[split].get(name, 0), int) for split in splits)]
    unknown = [
        name for name in counts if name not in COUNTED
    ]  # older versions counted windows and other items together
    order = {
        **{name: "" if name == MOMENTS else "less: " for name in (MOMENTS, *BEFORE)},
        "windows": "",
        **dict.fromkeys((*LOST, *sorted(unknown)), "less: "),
        "scenes": "",
        **{name: "" for name in names if name not in counts},
    }
    lines = [f"  {'':<64}" + "".join(f"{split:>18}" for split in splits)]
    lines.append(f"  {'recordings':<64}" + "".join(f"{len(report['recordings'][split]):>18}" for split in splits))
    for name, prefix in order.items():
        lines += _line(prefix + name, [report[split].get(name, 0) for split in splits])
    for name in sorted(notes):
        lines += _line(f"left out before: {name}", [report[split].get("notes", {}).get(name, 0) for split in splits])
    return lines


def _line(name: str, values: Sequence[Any]) -> list[str]:
    """One line of a table by split; none if all values are zero."""
    return [f"  {name:<64}" + "".join(f"{_number(value):>18}" for value in values)] if any(values) else []


def _number(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_number, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def rows_of(
    sources: Sequence[RecordingSource],
    splits: Mapping[str, Sequence[RecordingSource]],
    extracted: Mapping[str, Extracted],
    counts: Mapping[str, Mapping[str, int]],
) -> list[dict[str, Any]]:
    """One row per recording, in the order of ``sources``.

    Args:
        sources: all recordings, also those that cannot be read.
        splits: recordings of each split.
        extracted: content of each recording's file, by name.
        counts: final counts of each recording, by name.
    """
    split_of = {source.name: split for split, held in splits.items() for source in held}
    rows = []
    for source in sources:
        part, count = extracted[source.name], counts.get(source.name, {})
        about = part.about
        units = by_unit(count)
        moving = about.get("moving agents", 0)
        rows.append(
            {
                "recording": source.name,
                "group": source.group,
                "split": split_of.get(source.name, "left out"),
                "recorded [s]": f"{about['recorded']:.1f}" if "recorded" in about else "",
                "agents": about.get("agents", ""),
                **{name: count.get(name, 0) for name in COUNTED},
                "ends far from all lanes given": f"{about['ends far from lanes'] / moving:.4f}" if moving else "",
                "notes": "; ".join(f"{name}: {value}" for name, value in units.get("notes", {}).items()),
                "seconds": f"{about.get('seconds', 0.0):.2f}",
                "warnings": "; ".join(about.get("warnings", ())),
                "problem": part.problem or "",
            }
        )
    return rows


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as CSV with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def per_recording(folder: Path) -> list[str]:
    """Lines of a table of the recordings of a data set; empty for a data set of a version that wrote none."""
    file = folder / FILE
    if not file.is_file():
        return []
    with file.open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    shown = [
        {
            "recording": row["recording"],
            "split": row["split"],
            "agents": row["agents"],
            "windows": row["windows"],
            "scenes": row["scenes"],
            "far ends": f"{float(row['ends far from all lanes given']):.0%}"
            if row["ends far from all lanes given"]
            else "",
            "seconds": row["seconds"],
            "why fewer, and warnings": _why(row),
        }
        for row in rows[:SHOWN]
    ]
    names = list(shown[0])
    width = {name: max(len(name), *(len(row[name]) for row in shown)) for name in names}
    texts = {"recording", "split", names[-1]}

    def line(row: Mapping[str, str]) -> str:
        cells = [row[name].ljust(width[name]) if name in texts else row[name].rjust(width[name]) for name in names]
        return ("  " + "  ".join(cells)).rstrip()

    lines = [line({name: name for name in names}), *map(line, shown)]
    if len(rows) > SHOWN:
        lines.append(f"  and {len(rows) - SHOWN} more")
    return [*lines, f"  all columns in {file}"]


def _why(row: Mapping[str, str]) -> str:
    """Reasons for which windows of a recording were left out, and its warnings."""
    if row["problem"]:
        return f"not read: {row['problem']}"
    reasons = [f"{name}: {row[name]}" for name in LOST if int(row.get(name) or 0)]
    if not int(row["windows"]):
        reasons += [f"{name}: {row[name]}" for name in BEFORE if int(row.get(name) or 0)]
    reasons += [row["notes"]] if row["notes"] else []
    reasons += [f"warning: {row['warnings']}"] if row["warnings"] else []
    return ", ".join(reasons)
