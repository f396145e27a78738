"""Results files: the records of all runs of a report in one JSON file, from which it is written without run folders.

::

    {
     "format": "epo_lightning results", "version": 1,
     "title", "command", "sweep", "left_out":  as in :class:`~epo_lightning.report.write.Report`; the title is
                                                the name of the file (:func:`results_name`) when it is read
     "runs": [{
       "folder":   the run folder
       "reported": the splits whose scores are in the tables
       "config":   the settings that decide on the result, with title, experiment and budget
       "record":   command, commit, versions, data digest, parameters, steps, seconds and beginning of the training
       "scores":   the contents of metrics.json, metrics-<split>.json, scores-on-<test>.json and runtime.json, by name
       "log":      training step and validation score of every validation, as text
     }],
     "digest":    hash of everything else
    }

The file has no weights, scenes or forecasts, so pictures of scenes and of learned weights cannot be drawn from it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from epo_lightning.files import read_json, write_file
from epo_lightning.identity import DIGEST, ELSEWHERE, SECTIONS, digest_of
from epo_lightning.masking import mask
from epo_lightning.registry import ConfigError
from epo_lightning.report.curves import METRIC
from epo_lightning.report.entries import (
    LOG,
    OBJECT,
    OBJECTS,
    OBJECTS_BY_NAME,
    PAIRS,
    TEXT,
    TEXTS,
    check_configuration,
    check_entries,
    check_record,
)
from epo_lightning.report.records import CONFIG, RECORD, TIME, Records
from epo_lightning.report.runs import EvaluatedRun, read_other, read_run, scored, scored_elsewhere
from epo_lightning.report.write import Report, is_measured

FORMAT, VERSION = "epo_lightning results", 1
SETTINGS = (*SECTIONS, "title", "experiment", "budget")
"""Sections of a configuration that are saved."""
RECORDED = (
    *("command", "git_commit", "versions", "data_digest", "identity", "row", "parameters"),
    *("began", "steps", "seconds", "status"),
)
"""Entries of run.json that are saved."""
LOGGED = ("step", METRIC)
"""Columns of the log that are saved."""
_REPORT = {"title": TEXT, "command": TEXT, "sweep": TEXT, "left_out": PAIRS, "runs": OBJECTS}
_RUN = {"folder": TEXT, "reported": TEXTS, "config": OBJECT, "record": OBJECT, "scores": OBJECTS_BY_NAME, "log": LOG}


@dataclass(frozen=True, eq=False)
class SavedRun:
    """Records of one run from a results file (:class:`~epo_lightning.report.records.Records`).

    Attributes:
        path: the run folder that they were read from; it need not exist.
        settings: the saved part of the configuration.
        record: the saved entries of run.json.
        scores: contents of the files with scores and times, by name.
        validations: the saved columns of the log.
    """

    path: Path
    settings: dict[str, Any] = field(repr=False)
    record: dict[str, Any] = field(repr=False)
    scores: Mapping[str, dict[str, Any]] = field(repr=False)
    validations: Sequence[Sequence[str]] = field(repr=False)

    def config(self) -> dict[str, Any]:
        return self.settings

    def names(self) -> list[str]:
        return sorted([CONFIG, RECORD, *self.scores])

    def content(self, name: str) -> dict[str, Any]:
        return self.scores[name]

    def log(self) -> list[dict[str, str]]:
        return [dict(zip(LOGGED, row, strict=False)) for row in self.validations]


def results_name(file: str | Path) -> str:
    """Title of the reports of a results file: the name of the file without ``.json``."""
    return Path(file).name.removesuffix(".json")


def save_results(report: Report, file: str | Path) -> None:
    """Write the results file of a report. The same runs give the same bytes.

    Raises:
        ConfigError: a file of a run folder is damaged, or the report has no run.
        OSError: the file cannot be written.
    """
    if not report.runs:
        raise ConfigError(f"{file} is not written: the report {report.title} has no run with the scores that it shows")
    reported: dict[Path, list[str]] = {}
    for run in report.evaluated:
        reported.setdefault(run.path, []).append(run.split)
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "title": report.title,
        "command": report.command,
        "sweep": report.sweep,
        "left_out": [list(entry) for entry in report.left_out],
        "runs": [_saved(run, reported.get(run.path, [])) for run in report.runs],
    }
    content = mask(content)
    write_file(Path(file).expanduser(), json.dumps({**content, DIGEST: digest_of(content)}, indent=1) + "\n")


def _saved(run: Records, reported: Sequence[str]) -> dict[str, Any]:
    """The entry of one run in a results file."""
    config, record, rows = run.config(), run.record, run.log()
    settings = {key: config[key] for key in SETTINGS if key in config}
    for section, _, key in (place.partition(".") for place in ELSEWHERE):
        if isinstance(values := settings.get(section), Mapping):
            settings[section] = {name: value for name, value in values.items() if name != key}
    names = [*scored(run), *scored_elsewhere(run), *({TIME} & {*run.names()})]
    validations = [row for row in rows if METRIC in row] or rows[:1]  # a log without validations is not a missing one
    return {
        "folder": str(run.path),
        "reported": list(reported),
        "config": settings,
        "record": {key: record[key] for key in RECORDED if key in record},
        "scores": {name: _without_digest(run.content(name)) for name in names},
        "log": [[row[column] for column in LOGGED if column in row] for row in validations],
    }


def _without_digest(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Scores without their digest, which secrets that are masked would change; the whole file has one of its own."""
    return {key: value for key, value in scores.items() if key != DIGEST}


def read_results(file: str | Path) -> Report:
    """The report of a results file, as it was saved, with the name of the file as its title.

    Raises:
        ConfigError: the file is missing or damaged, is no results file, or was written by another version.
    """
    file = Path(file).expanduser()
    again = "epo report <sweep> save=<file> writes such a file"
    try:
        content = read_json(file)
    except ConfigError as error:
        raise ConfigError(f"{error}; {again}") from error
    if content.get("format") != FORMAT:
        raise ConfigError(f"{file} is no results file: it has no entry format: {FORMAT!r}; {again}")
    if content.get("version") != VERSION:
        raise ConfigError(
            f"{file} is a results file of version {content.get('version')!r}, this program reads version {VERSION}; {again}"
        )
    digest = content.pop(DIGEST, None)
    remedy = (
        f"take the committed file again, or write it again with `{content.get('command', 'epo report')} save={file}`"
    )
    if digest != digest_of(content):
        raise ConfigError(
            f"{file} is damaged: its content does not have the digest {digest}; was it edited, or copied incompletely? "
            f"{remedy[0].upper()}{remedy[1:]}"
        )
    check_entries(content, _REPORT, str(file), remedy)
    if not content["runs"]:
        raise ConfigError(f"{file} is damaged: its entry runs is empty, and a report needs a run; {remedy}")
    runs, evaluated = [], list[EvaluatedRun]()
    for number, entry in enumerate(content["runs"]):
        run, shown = _read_entry(entry, f"{file}, entry {number} of runs,", remedy)
        runs.append(run)
        evaluated += shown
    return Report(
        title=results_name(file),
        command=content["command"],
        runs=tuple(runs),
        evaluated=tuple(evaluated),
        left_out=tuple((folder, why) for folder, why in content["left_out"]),
        sweep=content["sweep"],
    )


def _read_entry(entry: Mapping[str, Any], where: str, remedy: str) -> tuple[SavedRun, list[EvaluatedRun]]:
    """The records of one run, and its scores on the splits that the report shows.

    Raises:
        ConfigError: the entry is damaged; the message begins with ``where`` and ends with ``remedy``.
    """
    check_entries(entry, _RUN, where, remedy)
    check_configuration(entry["config"], f"{where} config", remedy)
    check_record(entry["record"], f"{where} record", remedy)
    run = SavedRun(Path(entry["folder"]), entry["config"], entry["record"], entry["scores"], entry["log"])
    if not is_measured(run):
        raise ConfigError(
            f"{where} is damaged: its entry scores has neither scores nor the time of a forecast; {remedy}"
        )
    try:
        found = read_run(run)
        read_other(run)  # the tables of transfer read it again
    except ConfigError as error:
        raise ConfigError(f"{where} is damaged: {error}. {remedy[0].upper()}{remedy[1:]}") from error
    known = [one.split for one in found]
    for split in entry["reported"]:
        if split not in known:
            raise ConfigError(
                f"{where} is damaged: its entry reported has the split {split!r}, and the run has scores on "
                f"{', '.join(known) or 'no split'}; {remedy}"
            )
    return run, [one for one in found if one.split in entry["reported"]]
