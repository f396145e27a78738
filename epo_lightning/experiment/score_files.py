"""Files of scores in a run folder, which never replace each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from epo_lightning.data.cache import file_digest
from epo_lightning.experiment.other_data import OtherData
from epo_lightning.files import read_json, write_json
from epo_lightning.identity import DIGEST, digest_of
from epo_lightning.metrics.forecast import OWN
from epo_lightning.registry import ConfigError, parts
from epo_lightning.report.columns import is_own
from epo_lightning.run_folder import OTHER, RunFolder, numbered

SECTIONS = ("metrics", "truth")
"""Sections of a file of scores that hold numbers by name."""
LOCK = ".scores.lock"
"""File in a run folder that a process locks while it writes scores: two evaluations may end at the same moment."""
PATIENCE = 60.0
"""Longest wait for another process that writes scores [s]."""
TOLERANCE = 1e-5
"""Relative difference below which two scores are the same: machines and batch sizes change the last digits."""


def keep_other(run: RunFolder, other: OtherData, which: str, checkpoint: Path, metrics: Mapping[str, float]) -> Path:
    """Write scores on other data to a file of their own, and return it.

    The name ``scores-on-<data>-<split>-<digest>-<digest>.json`` has digests of the test and of the checkpoint. If the file
    holds the same scores it stays as it is; if it holds others, which another version computed, the name gets a number.
    """
    digest = file_digest(checkpoint)[:16]
    stem = f"{OTHER}{other.name}-{other.split}-{other.test[:8]}-{digest[:8]}"
    scored = {
        "data": other.name,
        "split": other.split,
        "data_digest": other.digest,
        "test": other.test,
        "checkpoint": which,
        "checkpoint_digest": digest,
        "settings": {key: value for key, value in other.section.items() if key != "root"},
        "notes": list(other.notes),
        **other.about(),
        "metrics": dict(metrics),
    }
    return _beside(run, stem, scored, ("test", "checkpoint_digest"))


def keep(run: RunFolder, scored: dict[str, Any], checkpoint: Path) -> Path:
    """Write scores without ever replacing others, and return the file that holds them.

    The scores of the best checkpoint are ``metrics.json`` (``metrics-val.json`` on the validation split). If that file holds
    the same scores already it stays as it is; if they lack scores that older versions did not compute, these are added.
    Registered metrics are replaced.
    Scores of another checkpoint, and scores that differ from those in the file, go to
    ``scores-<split>-<checkpoint>-<digest>.json``, which records the digest of the checkpoint as well as of the data. If that
    file holds others, the name gets a number.
    """
    file = run.metrics_file(scored["split"])
    if scored["checkpoint"] == "best":
        if not _readable(file):
            _write(file, scored)
        stored = read_json(file)
        if _same(stored, scored):
            _complete(file, scored)
            return file
    digest = file_digest(checkpoint)[:16]
    stem = f"scores-{scored['split']}-{Path(scored['checkpoint']).stem}-{digest[:8]}"
    return _beside(run, stem, {**scored, "checkpoint_digest": digest}, ("data_digest", "checkpoint_digest"))


@contextmanager
def alone(run: RunFolder) -> Iterator[None]:
    """Context in which no other process writes scores of the run. A folder that cannot be written needs no lock.

    Raises:
        ConfigError: another process holds the lock for longer than scores take to be written.
    """
    lock = FileLock(run.path / LOCK, timeout=PATIENCE)
    try:
        lock.acquire()
    except Timeout:
        raise ConfigError(
            f"another process has written scores of {run.path} for {PATIENCE:.0f} s: stop it, or remove {run.path / LOCK}"
        ) from None
    except OSError:
        yield
        return
    try:
        yield
    finally:
        lock.release()


def _beside(run: RunFolder, stem: str, scored: dict[str, Any], keys: Sequence[str]) -> Path:
    """The file of a stem, with a number if need be, that holds these scores; written if there is none."""
    for file in numbered(run.path / f"{stem}.json"):
        if not _readable(file):
            _write(file, scored)
            return file
        if _same(read_json(file), scored, keys):
            _complete(file, scored)
            return file
    raise AssertionError("unreachable")


def _write(file: Path, scored: Mapping[str, Any]) -> None:
    """Write scores with a digest, by which a report finds numbers that were edited later."""
    write_json(file, {**scored, DIGEST: digest_of(scored)})


def _complete(file: Path, scored: Mapping[str, Any]) -> None:
    """Add scores that a file lacks; registered metrics get their new values, because their code is the user's."""
    stored = read_json(file)
    completed: dict[str, Any] = {**scored, **stored}
    registered = tuple(OWN + name for name in parts("metric"))
    for section in (name for name in SECTIONS if name in completed):
        own = {name: value for name, value in scored.get(section, {}).items() if is_own(name)}
        # A metric that is registered now and has no value has lost its earlier one.
        kept = {name: value for name, value in stored.get(section, {}).items() if not name.endswith(registered)}
        completed[section] = {**scored.get(section, {}), **kept, **own}
    if completed != stored:
        _write(file, completed)


def _readable(file: Path) -> bool:
    """Whether a file holds scores as they were written. The caller replaces a missing, damaged or edited file."""
    try:
        content = read_json(file)
    except ConfigError:
        return False
    if content.get(DIGEST, digest_of(content)) != digest_of(content):
        return False
    return all(
        isinstance(scores, dict) and all(isinstance(value, int | float) for value in scores.values())
        for scores in (content.get("metrics"), content.get("truth", {}))
    )


def _same(
    stored: dict[str, Any], scored: dict[str, Any], keys: Sequence[str] = ("split", "data_digest", "checkpoint")
) -> bool:
    """Whether new scores are of the same data and checkpoint as stored ones, and equal them up to the last digits.

    Registered metrics are not compared.
    """
    if any(stored.get(key) != scored[key] for key in keys):
        return False
    pairs = [
        (value, scored.get(section, {}).get(name, math.inf))
        for section in SECTIONS
        for name, value in stored.get(section, {}).items()
        if not is_own(name)
    ]
    return all(
        math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=1e-9) or (math.isnan(one) and math.isnan(other))
        for one, other in pairs
    )
