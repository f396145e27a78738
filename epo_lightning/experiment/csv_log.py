"""``logs/metrics.csv``: rows are appended, or the whole file is replaced; a kill at any moment loses no written row."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from torch import Tensor

from epo_lightning.files import errors_naming, write_file
from epo_lightning.run_folder import RunFolder, read_log


class CSVLog(Logger):
    """Lightning logger that writes ``logs/metrics.csv`` of a run.

    Columns are sorted by name. A metric that is logged for the first time adds a column, for which the file is replaced.

    Args:
        run: the run folder.
        flush: number of rows that are written together.
        continued_from: optimisation step that a continued run starts from; rows of earlier steps are kept.
    """

    def __init__(self, run: RunFolder, flush: int, continued_from: int = 0) -> None:
        super().__init__()
        self.file = run.logs / "metrics.csv"
        self._flush = flush
        self._columns: list[str] = []
        self._waiting: list[dict[str, Any]] = []
        kept = [row for row in read_log(self.file) if int(row["step"]) < continued_from]
        if kept:
            self._replace(kept)
        else:
            self.file.unlink(missing_ok=True)

    @property
    def name(self) -> str:
        return "CSV"

    @property
    def version(self) -> str:
        return ""

    @property
    def save_dir(self) -> str:
        """The folder of the log; Lightning calls it ``trainer.log_dir``."""
        return str(self.file.parent)

    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Does nothing: config.yaml in the run folder holds the configuration."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        values = {name: value.item() if isinstance(value, Tensor) else value for name, value in metrics.items()}
        self._waiting.append({**values, "step": step or 0})
        if len(self._waiting) >= self._flush:
            self.save()

    def save(self) -> None:
        """Write all rows that were logged since the last call.

        Raises:
            OSError: the disk is full, for instance; the file is unchanged then, and the next call tries the rows again.
        """
        if not self._waiting:
            return
        if self.file.exists() and {*self._columns} >= {name for row in self._waiting for name in row}:
            _append(self.file, _text(self._columns, self._waiting))
        else:
            self._replace([*read_log(self.file), *self._waiting])
        self._waiting = []

    def _replace(self, rows: Sequence[Mapping[str, Any]]) -> None:
        columns = sorted({name for row in rows for name in row})
        header = {name: name for name in columns}
        write_file(self.file, _text(columns, [header, *rows]))
        self._columns = columns


def _text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, columns).writerows(rows)
    return text.getvalue()


def _append(path: Path, text: str) -> None:
    """Add lines at the end of a file, or leave it as it was."""
    with errors_naming(path), path.open("ab", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        try:
            left = memoryview(text.encode())
            while left:
                left = left[file.write(left) :]
        except BaseException:
            with suppress(OSError):
                os.ftruncate(file.fileno(), end)
            raise
