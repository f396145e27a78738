"""Notes of a report on what readers should know of its rows before they compare them."""

from __future__ import annotations

from collections.abc import Sequence

from epo_lightning.report.labels import value_text
from epo_lightning.report.rows import BATCH, Row, setting


def of_different_code(rows: Sequence[Row]) -> list[str]:
    """Notes on the data sets whose runs were trained by different code; where it was not recorded, at different commits."""
    notes = []
    for data in dict.fromkeys(row.runs[0].data for row in rows):
        codes: dict[tuple[str, str], dict[str, list[str]]] = {}
        for row in rows:
            for run in row.runs:
                if run.data == data and run.learned:
                    code = (
                        run.code,
                        "" if run.code else f" at commit {run.git_commit[:7]}, whose code was not recorded",
                    )
                    codes.setdefault(code, {}).setdefault(row.name, []).append(str(run.seed))
        if len(codes) < 2:
            continue
        groups = (
            ", ".join(f"{name} (seed {', '.join(dict.fromkeys(seeds))})" for name, seeds in trained.items()) + where
            for (_, where), trained in codes.items()
        )
        notes.append(
            f"Runs on {data} were trained by different code, which may explain differences between them: "
            f"{'; '.join(groups)}. To train all of them with the present code, choose another folder (runs=<folder>)."
        )
    return notes


def of_different_batches(rows: Sequence[Row]) -> list[str]:
    """Notes on the data sets whose rows were trained with different batch sizes, which labels do not always show."""
    notes = []
    for data in dict.fromkeys(row.runs[0].data for row in rows):
        sizes: dict[str, list[str]] = {}
        for row in rows:
            if row.runs[0].data == data and row.runs[0].learned:
                sizes.setdefault(value_text(setting(row.runs[0].config, BATCH)), []).append(row.name)
        if len(sizes) > 1:
            ordered = sorted(sizes.items(), key=lambda entry: (len(entry[0]), entry[0]))  # of numbers
            groups = "; ".join(f"{size}: {', '.join(dict.fromkeys(names))}" for size, names in ordered)
            notes.append(
                f"Rows on {data} were trained with different batch sizes ({groups}): after equally many epochs, those with "
                "larger batches have taken fewer steps; after equally many steps, they have seen more scenes."
            )
    return notes


def untaught(rows: Sequence[Row]) -> list[str]:
    """A note on rows with runs that may have an untaught mode, if there are any."""
    named = [
        f"{row.name} ({row.runs[0].data}; {len(row.missing)} of {len(row.runs)} runs)" for row in rows if row.missing
    ]
    if not named:
        return []
    return [
        "In more than a fifth of the scenes of one side, these rows have no mode near the future (score `missed`): "
        f"{', '.join(named)}. A mode may be untaught, and then errors say little about the method (docs/concepts.md, Modes)."
    ]
