"""The record of what was driven, ``episodes.jsonl``: a command that was killed goes on from it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.drive.measures import RATES
from epo_lightning.files import errors_naming, write_file
from epo_lightning.registry import ConfigError

REMEDY = "nothing is mixed; choose another out=<folder>, or delete it"


class Driven:
    """A file with a line of what decides on the episodes, then a row per planner and chunk of episodes.

    Every row has a checksum. A row that does not agree with it was damaged or edited; it is dropped with a line that names
    it, and its episodes are driven again. A last line without its line break was cut off by a kill, and is dropped as well.
    The caller keeps other processes away from the file.

    Args:
        path: the file, which is continued, or begun together with its folder.
        settings: settings that decide on what is driven.
        weights: digest of every run's checkpoint, by the run's name in the settings.
        tell: called with a line for every damaged row.

    Raises:
        ConfigError: the file belongs to other settings or weights, or is not text.
    """

    def __init__(
        self, path: Path, settings: Mapping[str, Any], weights: Mapping[str, str], tell: Callable[[str], None]
    ) -> None:
        self.path = path
        self._rows: dict[str, dict[str, dict[int, dict[str, Any]]]] = {}
        begun = json.loads(json.dumps({"settings": settings, "weights": weights}))
        first, *lines = self._lines() or [""]
        if lines:
            self._check(_parsed(first), begun)
        kept = [json.dumps(begun)]
        for number, line in enumerate(lines, 2):
            row = _row(line)
            if row is None:
                tell(f"{path}, line {number} is damaged: its episodes are driven again")
            else:
                self._take(row)
                kept.append(line)
        write_file(path, "\n".join([*kept, ""]))

    def _lines(self) -> list[str]:
        """The complete lines of the file."""
        try:
            return self.path.read_bytes().decode("utf-8").split("\n")[:-1]
        except FileNotFoundError:
            return []
        except (OSError, UnicodeDecodeError) as error:
            reason = f"is not UTF-8 ({error})" if isinstance(error, UnicodeDecodeError) else f"cannot be read ({error})"
            raise ConfigError(f"{self.path} {reason}: restore it, delete it, or choose another out=<folder>") from error

    def _check(self, was: Any, now: Mapping[str, Any]) -> None:
        """Refuse rows of other settings or weights."""
        if not isinstance(was, dict) or not all(isinstance(was.get(name), dict) for name in now):
            raise ConfigError(f"{self.path} was begun by an older version, or its first line is damaged: {REMEDY}")
        if changed := _changed(was["settings"], now["settings"]):
            raise ConfigError(f"{self.path} was begun with other settings ({', '.join(changed)}): {REMEDY}")
        if changed := _changed(was["weights"], now["weights"]):
            raise ConfigError(
                f"{self.path} was begun with other settings: the checkpoint of the run {', '.join(changed)} has changed "
                f"since, as by further training: {REMEDY}"
            )

    def _take(self, row: dict[str, Any]) -> None:
        self._rows.setdefault(row["kind"], {}).setdefault(row["planner"], {})[row["episodes"][0]] = row

    def has(self, kind: str, planner: str, chunk: Sequence[int]) -> bool:
        """Whether a planner has driven some episodes.

        Raises:
            ConfigError: the file holds other episodes together.
        """
        row = self._rows.get(kind, {}).get(planner, {}).get(chunk[0])
        if row is not None and row["episodes"] != list(chunk):
            raise ConfigError(
                f"{self.path} was begun by a version that drove other episodes together: choose another out=<folder>, or "
                "delete it"
            )
        return row is not None

    def add(
        self,
        kind: str,
        planner: str,
        chunk: Sequence[int],
        measures: Mapping[str, Float[Tensor, " B"]],
        rates: Iterable[str] = (),
    ) -> None:
        """Append what a planner has driven, with the names of the further measures that are 0 or 1.

        Raises:
            OSError: the disk is full, for example; it names the file.
        """
        row = {
            "kind": kind,
            "planner": planner,
            "episodes": list(chunk),
            "measures": {name: values.tolist() for name, values in measures.items()},
            "rates": sorted(rates),
        }
        self._take(row)
        with errors_naming(self.path), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({**row, "checksum": _checksum(row)}) + "\n")

    def rates(self, kind: str) -> set[str]:
        """Names of the measures that are 0 or 1."""
        rows = (row for rows in self._rows[kind].values() for row in rows.values())
        return set(RATES).union(*(row["rates"] for row in rows))

    def measured(self, kind: str, planners: Iterable[str]) -> dict[str, dict[str, Float[Tensor, " B"]]]:
        """Measures of all episodes, by planner in the given order."""
        found = {
            planner: [row["measures"] for _, row in sorted(self._rows[kind][planner].items())] for planner in planners
        }
        return {
            planner: {
                name: torch.tensor([value for row in rows for value in row[name]], dtype=torch.double)
                for name in rows[0]
            }
            for planner, rows in found.items()
        }


def _row(line: str) -> dict[str, Any] | None:
    """The row of a line; None if it is damaged.

    Measures need not be finite: the distance from other vehicles is infinite where there is none. So the checksum decides
    whether a row is the one that was written, not its values.
    """
    row = _parsed(line)
    return row if isinstance(row, dict) and row.pop("checksum", None) == _checksum(row) else None


def _checksum(row: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(row).encode()).hexdigest()[:16]


def _changed(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Keys whose values differ."""
    return [key for key in {**now, **was} if key not in was or key not in now or was[key] != now[key]]


def _parsed(line: str) -> Any:
    """The contents of a line of JSON; None for a broken one."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
