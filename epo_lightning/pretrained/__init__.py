"""Trained forecasters that ship with the package, each as a run folder without logs.

``rpi`` is V-LSTM + EPO with a relaxed loss (:class:`~epo_lightning.losses.Relaxation`), trained on a fifth of the hard split
of the robot-pedestrian data. Its run.json holds the command, commit, seed and data digest that it was made with,
metrics.json its scores, and scenes.safetensors a few scenes of the test split. ``make checkpoint`` makes it again.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from epo_lightning.scene import Scene

HOME = Path(__file__).parent


def names() -> list[str]:
    """Names of the runs that ship with the package."""
    return sorted(record.parent.name for record in HOME.glob("*/run.json"))


def folder_of(run: str | Path) -> Path | None:
    """Folder of the shipped run with that name; None for any other name, and for a path that exists."""
    return HOME / str(run) if str(run) in names() and not Path(run).exists() else None


def ships(folder: Path) -> bool:
    """Whether ``folder`` is that of a shipped run: nothing is written there."""
    return folder.absolute().parent == HOME


def examples(run: str | Path) -> Scene:
    """Scenes of the test split that ship with a run, given by name or folder, for forecasts without its data set."""
    import safetensors

    from epo_lightning.scene import Scene

    folder = folder_of(run) or Path(run)
    with safetensors.safe_open(folder / "scenes.safetensors", framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        return Scene(**tensors, dt=float((file.metadata() or {})["dt"]))
