"""Trained forecasters that ship with the package, each as a run folder without logs: ``<data>/<row>``.

``epo_lightning.load("rpi/v_lstm_epo")`` loads one, and ``epo predict run=rpi/v_lstm_epo`` draws its forecasts. Beside what
every run folder holds (:mod:`epo_lightning.run_folder`), each has a model card, ``card.md``, and a few scenes of its test
split, ``scenes.safetensors``. ``recipes.yaml`` says how each is made, and ``make checkpoint`` makes them again.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from epo_lightning.registry import ConfigError, nearest

if TYPE_CHECKING:
    from epo_lightning.scene import Scene

HOME = Path(__file__).parent


def names() -> list[str]:
    """Names of the forecasters that ship with the package, such as ``rpi/v_lstm_epo``."""
    return sorted(name_of(record.parent) for record in HOME.rglob("run.json"))


def name_of(folder: Path) -> str:
    """Name of the shipped run in ``folder``, a folder below this package's."""
    return folder.absolute().relative_to(HOME).as_posix()


def folder_of(run: str | Path) -> Path | None:
    """Folder of the shipped run with that name; None for any other name, and for a path that exists."""
    return HOME / str(run) if str(run) in names() and not Path(run).exists() else None


def checkpoint_of(run: str | Path) -> Path | None:
    """Checkpoint of the shipped run with that name; None as :func:`folder_of`."""
    folder = folder_of(run)
    return folder / "checkpoints" / "best.ckpt" if folder else None


def ships(folder: Path) -> bool:
    """Whether ``folder`` is that of a shipped run: nothing is written there."""
    return folder.absolute().is_relative_to(HOME)


def card(run: str | Path) -> str:
    """Model card of a shipped run, given by name or folder: data, budget, scores, limits, command, commit, seed.

    Raises:
        ConfigError: no forecaster of this name ships with the package.
    """
    return _shipped(run, "card.md").read_text(encoding="utf-8")


def examples(run: str | Path) -> Scene:
    """Scenes of the test split that ship with a run, given by name or folder, for forecasts without its data set.

    Raises:
        ConfigError: no forecaster of this name ships with the package.
    """
    import safetensors

    from epo_lightning.scene import Scene

    with safetensors.safe_open(_shipped(run, "scenes.safetensors"), framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        return Scene(**tensors, dt=float((file.metadata() or {})["dt"]))


def _shipped(run: str | Path, name: str) -> Path:
    """A file that ships with a run."""
    file = (folder_of(run) or Path(run)) / name
    if not file.is_file():
        hint = nearest(str(run), names())
        raise ConfigError(f"{str(run)!r} is no forecaster that ships with the package ({hint}): there is no {file}")
    return file
