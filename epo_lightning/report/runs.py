"""Evaluated runs, read from the records of runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from epo_lightning.identity import DIGEST, check_unchanged, data_recipe, digest_of, identity, row_identity
from epo_lightning.masking import mask
from epo_lightning.registry import ConfigError
from epo_lightning.report.columns import TRUE
from epo_lightning.report.entries import NUMBERS_BY_NAME, TEXTS, check_configuration, check_known, check_record
from epo_lightning.report.records import CONFIG, RECORD, Records
from epo_lightning.run_folder import FINISHED, OTHER, RunFolder, discover, neighbour

_ABOUT = {"agents": NUMBERS_BY_NAME, "notes": TEXTS}
"""Entries on the scenes of other data, which older files lack."""
UNLEARNED = "constant_velocity"
"""The forecaster that learns nothing."""
TRAIN = "train one first, epo train experiment=rpi/v_lstm_epo"
COPY = "copy the run folder again from where it was made, or move it away"


@dataclass(frozen=True)
class EvaluatedRun:
    """One run and its scores on one split.

    Attributes:
        path: the run folder.
        name: label of its row in tables.
        seed: seed of the run.
        data: name of the data set on which it was evaluated.
        trained_data: name of its own data set.
        backbone, forecaster: names of its parts.
        experiment: name of its experiment file; empty for none.
        goal: use of given goals, ``energy`` or ``all``.
        budget: name of its budget.
        split: split on which it was evaluated.
        checkpoint: name of the evaluated checkpoint.
        data_digest: digest of the data on which it was evaluated.
        trained_digest: digest of the data on which it was trained.
        metrics: scores by name, displacements in m; with the errors of inferred costs, where the true ones are known.
        git_commit: commit of the code; the installed version outside a checkout.
        code: hash of the code; empty for runs of versions that did not record it.
        command: command of the training.
        parameters: number of trained parameters, where known.
        identity: hash of all settings that affect its result.
        row: the same hash without the seed, shared by the runs of a row.
        config: its resolved configuration.
        records: all records of the run.
    """

    path: Path
    name: str
    seed: int
    data: str
    trained_data: str
    backbone: str
    forecaster: str
    experiment: str
    goal: str
    budget: str
    split: str
    checkpoint: str
    data_digest: str
    trained_digest: str
    metrics: Mapping[str, float]
    git_commit: str
    code: str
    command: str
    parameters: int | None
    identity: str
    row: str
    config: Mapping[str, Any] = field(repr=False)
    records: Records = field(repr=False, compare=False)

    @property
    def learned(self) -> bool:
        """Whether the forecaster was trained; constant velocity has neither a budget nor training data."""
        return self.forecaster != UNLEARNED


def find_runs(folder: str | Path) -> list[RunFolder]:
    """All runs in and below a folder, in the order of their paths.

    Raises:
        ConfigError: no folder (with the nearest one), no run (with the command that makes one), or scores of a run that lost
            its records.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        beside = neighbour(folder)
        raise ConfigError(f"no folder {folder} to report on: {f'did you mean {beside}?' if beside else TRAIN}")
    known = list(discover(folder))
    for record in folder.rglob("run.json"):
        _require_records(RunFolder(record.parent))
    for config in folder.rglob("config.yaml"):  # a run that was killed before its record existed has no scores
        if scored(RunFolder(config.parent)):
            _require_records(RunFolder(config.parent))
    if not known:
        raise ConfigError(f"no run in or below {folder}: {TRAIN}")
    return known


def checked_records(run: Records) -> tuple[dict[str, Any], dict[str, Any]]:
    """Configuration and record of a run, whose entries are of the expected kinds, where they are not missing.

    Raises:
        ConfigError: a file is missing or damaged, or the configuration was changed since the run began; the message names
            the file and the entry, and says what to do.
    """
    _require_records(run)
    config, record = _sound(run.config, COPY), _sound(lambda: run.record, COPY)
    check_configuration(config, str(run.path / CONFIG), COPY)
    check_record(record, str(run.path / RECORD), COPY)
    check_unchanged(config, record, run.path / CONFIG)
    return config, record


def scored(run: Records) -> list[str]:
    """Names of files with a run's scores: ``metrics.json`` of the test split first, then ``metrics-<split>.json``."""
    names = run.names()
    return [*(["metrics.json"] if "metrics.json" in names else []), *(n for n in names if fnmatch(n, "metrics-*.json"))]


def collect(runs: str | Path | Iterable[Records]) -> list[EvaluatedRun]:
    """All evaluated runs, one entry for every split that a run was evaluated on.

    Args:
        runs: records of runs, or a folder that contains them at any depth. Runs without scores are left out.

    Raises:
        ConfigError: no folder, no run or no evaluated run (with the command that makes one), or a damaged file.
    """
    where = f"in or below {runs}" if isinstance(runs, str | Path) else "of this report"
    known = _listed(runs)
    if not known:
        raise ConfigError(f"no run {where}: {TRAIN}")
    found = [evaluated for run in known for evaluated in read_run(run)]
    if not found:
        begun = next((run for run in known if RECORD in run.names()), known[0])
        open_ones = [run for run in known if RECORD in run.names() and _status(run) != FINISHED]
        remedy = f"epo evaluate runs={runs}" if isinstance(runs, str | Path) else f"epo evaluate run={begun.path}"
        first = f"epo train resume={open_ones[0].path} continues an unfinished run, and then " if open_ones else ""
        raise ConfigError(f"{none_evaluated(len(known), where)}: {first}{remedy} does it")
    return found


def none_evaluated(count: int, where: str) -> str:
    """Statement that no run is evaluated, in a place such as ``below runs``."""
    return f"the only run {where} is not evaluated" if count == 1 else f"none of the {count} runs {where} is evaluated"


def _status(run: Records) -> Any:
    return _sound(lambda: run.record, COPY).get("status")


def _listed(runs: str | Path | Iterable[Records]) -> list[Records]:
    return [*find_runs(runs)] if isinstance(runs, str | Path) else [*runs]


def read_run(run: Records) -> list[EvaluatedRun]:
    """Scores of one run, one entry for every split on which it was evaluated.

    Raises:
        ConfigError: a file is missing or damaged, or lacks an entry; the message names both and says what to do.
    """
    names = scored(run)
    if not names:
        return []
    config, record = checked_records(run)
    return [_read_split(run, config, record, name) for name in names]


def read_other(run: Records) -> list[tuple[EvaluatedRun, Mapping[str, Any]]]:
    """Scores of one run on other data, each with the contents of its file, in the order in which they were written.

    Raises:
        ConfigError: as :func:`read_run`.
    """
    names = scored_elsewhere(run)
    if not names:
        return []
    config, record = checked_records(run)
    found: list[tuple[EvaluatedRun, Mapping[str, Any]]] = []
    for name in names:
        file = run.path / name
        again = f"delete it, and `epo evaluate run={run.path} data=<data set>` writes it again"
        content = _sound(lambda name=name: run.content(name), again)  # type: ignore[misc]
        for key in ("data", "split", "test", "checkpoint"):
            _entry(content, file, again, key)
        check_known(content, _ABOUT, str(file), again)
        found.append((_evaluated(run, config, record, file, content, str(content["split"]), again), content))
    return found


def read_parts(run: Records) -> list[EvaluatedRun]:
    """Scores of the best checkpoint of one run on a part of its own data (``data.share``), of each part the ones that were
    written last.

    Raises:
        ConfigError: as :func:`read_run`.
    """
    found: dict[tuple[str, str], EvaluatedRun] = {}
    for one, content in read_other(run):
        if is_part(one, content):
            part = f"{one.data}, {100 * content['settings']['share']:.10g}% of the scenes"
            found[part, one.split] = replace(one, data=part)
    return list(found.values())


def is_part(run: EvaluatedRun, content: Mapping[str, Any]) -> bool:
    """Whether scores are those of the best checkpoint on a part of the run's own data: the same windows, fewer scenes."""
    settings = content.get("settings")
    shares = [
        section.get("share", 1) if isinstance(section, Mapping) else 1 for section in (settings, run.config["data"])
    ]
    known = all(isinstance(share, int | float) for share in shares)
    same = run.checkpoint == "best" and run.data_digest == run.trained_digest
    return known and same and 0 < shares[0] < shares[1]


def scored_elsewhere(run: Records) -> list[str]:
    """Names of files with a run's scores on other data; of the same test and checkpoint, later versions come later."""
    return sorted((name for name in run.names() if fnmatch(name, f"{OTHER}*.json")), key=lambda name: (len(name), name))


def _read_split(run: Records, config: Mapping[str, Any], record: Mapping[str, Any], name: str) -> EvaluatedRun:
    file = run.path / name
    split = file.stem.removeprefix("metrics").removeprefix("-") or "test"
    again = f"epo evaluate run={run.path} split={split} writes it again"
    result = _sound(lambda: run.content(name), again)
    return _evaluated(run, config, record, file, result, split, again)


def _evaluated(
    run: Records,
    config: Mapping[str, Any],
    record: Mapping[str, Any],
    file: Path,
    result: Mapping[str, Any],
    split: str,
    again: str,
) -> EvaluatedRun:
    """The scores in one file of a run folder; ``again`` says how to write it again."""
    metrics = _entry(result, file, again, "metrics")
    if result.get(DIGEST, digest_of(result)) != digest_of(result):  # earlier versions wrote none
        raise ConfigError(f"{file} was edited: its scores do not have the digest {result[DIGEST]}; {again}")
    check_known(result, dict.fromkeys(("metrics", "truth"), NUMBERS_BY_NAME), str(file), again)
    of_costs = {f"{TRUE}{name}": value for name, value in result.get("truth", {}).items()}
    if result.get("split", split) != split:
        raise ConfigError(f"{file} holds scores of the {result['split']} split, was it renamed? {again}")
    digest = str(_entry(result, file, again, "data_digest"))
    config_file, record_file = run.path / CONFIG, run.path / RECORD

    def setting(*keys: str) -> str:
        return str(_entry(config, config_file, COPY, *keys))

    def recorded(key: str) -> str:
        return str(_entry(record, record_file, COPY, key))

    seed = int(setting("seed"))
    trained = recorded("data_digest")
    _entry(config, config_file, COPY, "data", "name")
    trained_data = data_name(config["data"])
    return EvaluatedRun(
        path=run.path,
        name=mask(setting("title")),
        seed=seed,
        data=_tested_data(result, trained_data),
        trained_data=trained_data,
        backbone=setting("backbone", "name"),
        forecaster=setting("forecaster", "name"),
        experiment=str(config.get("experiment") or ""),
        goal=str(config.get("goal", "energy")),
        budget=setting("budget", "name"),
        split=split,
        checkpoint=str(result.get("checkpoint", "best")),
        data_digest=digest,
        trained_digest=trained,
        metrics={name: float(value) for name, value in {**metrics, **of_costs}.items()},
        git_commit=str(record.get("git_commit") or _version(record)),
        code=str((record.get("versions") or {}).get("code") or ""),
        command=mask(recorded("command")),  # older versions wrote secrets
        parameters=record.get("parameters"),
        identity=identity(config, trained),
        row=row_identity(config, trained),
        config=config,
        records=run,
    )


def _tested_data(result: Mapping[str, Any], trained: str) -> str:
    """Name of the data set of a file of scores: its own, or that of the run's training if it names none."""
    settings = result.get("settings")
    if isinstance(settings, Mapping) and isinstance(settings.get("name"), str):
        return data_name({**settings, "games_share": 1})  # the share is that of the training games
    return str(result.get("data", trained))


def data_option(section: Mapping[str, Any]) -> str:
    """Option ``data=`` of a data set, from the ``data`` section of a configuration; RPI's hard split is ``rpi_hard``."""
    return str(section.get("dataset") or section["name"]) + ("_hard" if section.get("split") == "hard" else "")


def data_name(section: Mapping[str, Any]) -> str:
    """Name of a data set in tables and captions, from the ``data`` section of a configuration.

    Each later recipe of RPI and each kind of its players is a data set. A training on a share of the games is not compared
    with one on all of them, and scenes drawn in the shapes of two tasks are two data sets.
    """
    name = data_option(section)
    if (recipe := data_recipe(section)) != 1:
        name = f"{name}, recipe {recipe}"
    if (players := section.get("solver")) not in (None, "potential"):
        name = f"{name}, {players} players"
    share = section.get("games_share", 1)
    if isinstance(share, int | float) and share < 1:
        return f"{name}, {100 * share:.10g}% of the training games"
    return f"{name} ({section['like']})" if name == "drawn" and "like" in section else name


def _version(record: Mapping[str, Any]) -> str:
    """An installed copy has no commit; its version says which code it was."""
    versions = record.get("versions")
    version = versions.get("epo_lightning") if isinstance(versions, Mapping) else None
    return f"version {version}" if version else "unknown"


def _entry(content: Any, file: Path, remedy: str, *keys: str) -> Any:
    for key in keys:
        content = content.get(key) if isinstance(content, Mapping) else None
    if content is None:
        raise ConfigError(f"{file} has no entry {'.'.join(keys)}: was it written by another version? {remedy}")
    return content


def _sound(read: Callable[[], dict[str, Any]], remedy: str) -> dict[str, Any]:
    """Result of ``read`` on a file; an error is extended by what to do about it."""
    try:
        return read()
    except ConfigError as error:
        raise ConfigError(f"{error}; {remedy}") from error


def _require_records(run: Records) -> None:
    for name in (CONFIG, RECORD):
        if name not in run.names():
            raise ConfigError(f"the run folder {run.path} has no {name}: {COPY}")
