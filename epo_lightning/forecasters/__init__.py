"""Forecasters: LightningModules that join a backbone, decoders, an energy and a solver."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from epo_lightning import pretrained
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.forecasters.checkpoint import read_checkpoint
from epo_lightning.registry import ConfigError, build, check_keys, lookup, nearest, one_line, place
from epo_lightning.task import TASK_KEYS, Task

__all__ = ["Forecaster", "Task", "build_forecaster", "check_model", "load"]

SUPPLIED: Mapping[str, tuple[str, ...]] = {
    "backbone": ("goal_input", "map_input", "scale"),
    "dynamics": (),
    "energy": ("dynamics", "width", "horizon", "shape", "scale"),
    "solver": (),
    "backward": (),
    "objective": (),
    "optimizer": (),
    "forecaster": ("task", "optimizer", "backbone", "dynamics", "energy", "solver", "backward", "objective", "given"),
}
"""Arguments that :func:`build_forecaster` supplies to the constructors of each kind of part; a configuration must not set
them. A constructor gets only those that are in its signature. The kinds are in the order in which parts are built."""
GOALS = ("energy", "all")
"""Uses of a given goal: ``energy``, in the energy only (the paper); ``all``, also as an input of the network."""


def check_model(model: Mapping[str, Any]) -> None:
    """Check a model's configuration without building anything: names, keys and the choice of ``goal``.

    Raises:
        ConfigError: an unknown or missing key, with the nearest known name; or ``goal=all`` where no network can read goals.
    """
    known = (*SUPPLIED, *TASK_KEYS, "goal", "given")
    for key in model:
        if key not in known:
            raise ConfigError(f"unknown key {key!r} of a model: {nearest(key, known)}")
    for section in SUPPLIED:
        if section not in model:
            raise ConfigError(f"the model's configuration lacks the section {section!r}")
    if model["goal"] not in GOALS:
        raise ConfigError(f"unknown goal {model['goal']!r}: {nearest(str(model['goal']), GOALS)}")
    if model["goal"] == "all" and model.get("candidates", 1) > 1:
        raise ConfigError(
            f"goal is 'all', which needs one given goal per agent as an input of the network, but this data has "
            f"{model['candidates']} candidates per agent: use goal=energy, and the forecaster chooses among the candidates"
        )
    for kind, supplied in SUPPLIED.items():
        check_keys(kind, model[kind], supplied)
    takes_backbone = "backbone" in _arguments("forecaster", model)
    if model["goal"] == "all" and takes_backbone and "goal_input" not in _arguments("backbone", model):
        raise ConfigError(
            f"goal is 'all', which makes the given goal an input of the network, but backbone {model['backbone']['name']} "
            "has no argument goal_input: use goal=energy, or add it, and read scene.goal_candidates where it is true"
        )


def _arguments(kind: str, model: Mapping[str, Any]) -> Mapping[str, inspect.Parameter]:
    """Arguments of the constructor of a part."""
    return inspect.signature(lookup(kind, model[kind]["name"])).parameters


def build_forecaster(model: Mapping[str, Any]) -> Forecaster:
    """Build a forecaster, and those parts that are arguments of its constructor.

    Args:
        model: the sections ``forecaster``, ``backbone``, ``dynamics``, ``energy``, ``solver``, ``backward``, ``objective``
            and ``optimizer``, each with the ``name`` of a part and its arguments; ``goal`` (``energy`` or ``all``); the
            fields of a :class:`~epo_lightning.task.Task`; and, in checkpoints of forecasters on top of another one, the
            configuration of that one, ``given``, whose weights follow. Without it, it is loaded from ``forecaster.frozen``.

    Raises:
        ConfigError: as :func:`check_model`, or a value that a part refuses.
    """
    check_model(model)
    task = Task.from_config(model)
    named = _arguments("forecaster", model)
    parts: dict[str, Any] = {"task": task}
    # Parts that the forecaster does not take are not built: drawing their initial weights would use random numbers, and the
    # initial weights of the other parts would change.
    if "backbone" in named:
        parts["backbone"] = build(
            "backbone", model["backbone"], goal_input=model["goal"] == "all", map_input=task.map, scale=task.scale
        )
        if not isinstance(getattr(parts["backbone"], "width", None), int):
            part = type(parts["backbone"])
            raise ConfigError(
                f"the backbone {part.__name__} ({place(part)}) must set self.width, the size of its features z, to a number"
            )
    if "dynamics" in named or "energy" in named:
        parts["dynamics"] = build("dynamics", model["dynamics"])
    if "energy" in named:
        of_features = {"width": parts["backbone"].width} if "backbone" in named else {}
        parts["energy"] = build(
            "energy",
            model["energy"],
            dynamics=parts["dynamics"],
            horizon=task.horizon,
            shape=task.shape,
            scale=task.scale,
            **of_features,
        )
    for kind in ("solver", "backward", "objective"):
        if kind in named:
            parts[kind] = build(kind, model[kind])
    parts["optimizer"] = build("optimizer", model["optimizer"])
    if "given" in named:
        parts["given"] = _given(model)
    forecaster: Forecaster = build("forecaster", model["forecaster"], **parts)
    forecaster.configuration = dict(model)
    return forecaster


def _given(model: Mapping[str, Any]) -> Forecaster:
    """The forecaster on top of which another one is built: see :func:`build_forecaster`.

    Raises:
        ConfigError: no forecaster is named, or it cannot be loaded.
    """
    if "given" in model:
        return build_forecaster(model["given"])
    frozen = model["forecaster"].get("frozen")
    if not frozen:
        raise ConfigError(
            "forecaster.frozen names no trained forecaster: give a run folder, a checkpoint or the name of a shipped "
            "forecaster, such as forecaster.frozen=runs/highway_sim/v_lstm/short-s0"
        )
    # The forecaster on top is built in single precision, to which this one is rounded.
    return load(frozen).float()


def load(checkpoint: str | Path) -> Forecaster:
    """Load a trained forecaster in evaluation mode. The checkpoint alone is needed, and no code in it is executed.

    Args:
        checkpoint: path of a ``.ckpt`` file or of a run folder, whose best epoch is meant; or the name of a forecaster that
            ships with the package, ``load("rpi/v_lstm_epo")``. A path that exists takes precedence.

    Raises:
        ConfigError: as :func:`~epo_lightning.forecasters.checkpoint.read_checkpoint`, or weights of another architecture.
    """
    checkpoint = pretrained.checkpoint_of(checkpoint) or Path(checkpoint).expanduser()
    if checkpoint.is_dir():
        checkpoint = checkpoint / "checkpoints" / "best.ckpt"
    content = read_checkpoint(checkpoint)
    forecaster = build_forecaster(content["configuration"])
    if any(tensor.dtype == torch.double for tensor in content["state_dict"].values()):
        forecaster = forecaster.double()  # trained with trainer.precision=64-true; loading would round the weights
    try:
        forecaster.load_state_dict(content["state_dict"])
    except RuntimeError as error:
        raise ConfigError(
            f"{checkpoint} does not fit the architecture that its own configuration describes; it was written by another "
            f"version or for another model: {one_line(error, 300)}"
        ) from error
    return forecaster.eval()
