"""Forecasters: LightningModules that join a backbone, decoders, an energy and a solver."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from epo_lightning.forecasters.base import Forecaster, Task
from epo_lightning.registry import ConfigError, build, check, lookup, nearest

__all__ = ["Forecaster", "Task", "build_forecaster", "check_model", "load"]

_PARTS = ("backbone", "dynamics", "energy", "solver", "backward", "objective")
_SECTIONS = ("forecaster", "optimizer", *_PARTS)
_SUPPLIED = {
    "backbone": ("goal_input", "map_input", "scale"),
    "energy": ("dynamics", "width", "horizon", "shape", "scale"),
}
"""What parts are told, if they ask, by whoever builds them."""
_TASK = ("horizon", "dt", "subsets", "shape", "candidates", "map", "scale")
GOALS = ("energy", "all")
"""Who is told a given goal: the energy alone (the paper), or the network of every learned forecaster as well."""


def check_model(model: Mapping[str, Any]) -> None:
    """Check a model's configuration without building anything: names, keys and the choice of ``goal``.

    Raises:
        ConfigError: what is unknown or missing, and the nearest known name.
    """
    for key in model:
        if key not in (*_SECTIONS, *_TASK, "goal"):
            raise ConfigError(f"unknown key {key!r} of a model: {nearest(key, (*_SECTIONS, *_TASK, 'goal'))}")
    for section in _SECTIONS:
        if section not in model:
            raise ConfigError(f"the model's configuration lacks the section {section!r}")
    if model["goal"] not in GOALS:
        raise ConfigError(f"unknown goal {model['goal']!r}: {nearest(str(model['goal']), GOALS)}")
    if model["goal"] == "all" and model.get("candidates", 1) > 1:
        raise ConfigError(
            f"goal is 'all', but this data gives no goal that the network could be told, only {model['candidates']} "
            "candidates for each agent: use goal=energy, with which the forecaster chooses among them"
        )
    check("optimizer", model["optimizer"])
    check("forecaster", model["forecaster"], supplied=("task", "optimizer", *_PARTS))
    for kind in _PARTS:
        check(kind, model[kind], supplied=_SUPPLIED.get(kind, ()))


def build_forecaster(model: Mapping[str, Any]) -> Forecaster:
    """Build a forecaster and the parts that its constructor asks for.

    Args:
        model: the sections ``forecaster``, ``backbone``, ``dynamics``, ``energy``, ``solver``, ``backward``, ``objective``
            and ``optimizer``, each with the ``name`` of a part and its arguments; ``goal`` (``energy`` or ``all``); and the
            task: ``horizon``, ``dt``, ``subsets``, ``shape``, ``candidates``, ``map`` and ``scale``.

    Raises:
        ConfigError: as :func:`check_model`, or a value that a part refuses.
    """
    check_model(model)
    wanted = inspect.signature(lookup("forecaster", model["forecaster"]["name"])).parameters
    task = Task(
        model["horizon"],
        model["dt"],
        tuple(model.get("subsets", ())),
        model.get("shape", "disc"),
        model.get("candidates", 1),
        model.get("map", False),
        model.get("scale", 1.0),
    )
    told: dict[str, Any] = {"horizon": task.horizon, "shape": task.shape, "scale": task.scale, "map_input": task.map}
    told["goal_input"] = model["goal"] == "all"
    parts: dict[str, Any] = {}
    for kind in _PARTS:
        # An energy is made of the dynamics, and knows the width of the backbone's features.
        if kind in wanted or (kind == "dynamics" and "energy" in wanted):
            asked = inspect.signature(lookup(kind, model[kind]["name"])).parameters
            supplied = {name: told[name] for name in _SUPPLIED.get(kind, ()) if name in asked}
            parts[kind] = built = build(kind, model[kind], **supplied)
            told |= {"dynamics": built} if kind == "dynamics" else {}
            told |= {"width": built.width} if kind == "backbone" else {}
    parts = {kind: part for kind, part in parts.items() if kind in wanted}
    optimizer = build("optimizer", model["optimizer"])
    forecaster: Forecaster = build("forecaster", model["forecaster"], task=task, optimizer=optimizer, **parts)
    forecaster.configuration = dict(model)
    return forecaster


def load(checkpoint: str | Path) -> Forecaster:
    """A trained forecaster from a checkpoint alone, in evaluation mode: no configuration tree, no pickled code.

    Raises:
        ConfigError: the file is missing, is not a checkpoint of this project, or belongs to another architecture.
    """
    path = Path(checkpoint)
    if not path.is_file():
        raise ConfigError(f"no checkpoint at {path}: give the path of a .ckpt file, such as RUN/checkpoints/best.ckpt")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        configuration, weights = content["configuration"], content["state_dict"]
    except (RuntimeError, EOFError, KeyError, TypeError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{path} is not a checkpoint that epo_lightning wrote, or is damaged ({reason})") from error
    forecaster = build_forecaster(configuration)
    try:
        forecaster.load_state_dict(weights)
    except RuntimeError as error:
        raise ConfigError(
            f"{path} does not fit the architecture that its own configuration describes; it was written by another "
            f"version or for another model: {' '.join(str(error).split())[:300]}"
        ) from error
    return forecaster.eval()
