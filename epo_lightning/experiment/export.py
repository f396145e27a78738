"""A trained forecaster as a program of PyTorch's own operations, which runs without this package."""

from __future__ import annotations

import dataclasses
import io
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import ExportSettings, Settings
from epo_lightning.experiment.opening import open_checkpoint
from epo_lightning.experiment.predict import MEANING, scenes_of
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.forecasters.epo import EPO
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, write_file
from epo_lightning.scene import Scene
from epo_lightning.schema import read
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OUTPUTS = ("states", "probabilities")
"""What the program gives, by name."""
NOT_READ = ("dt", "future", "future_mask", "subset", "id", "frame", "kind")
"""Fields of a scene that no forecaster reads."""
MOST_SCENES = 65536
"""Largest batch of the program."""
TOLERANCE = 1e-5
"""Largest difference [m] between the program and the forecaster."""


class Program(nn.Module):
    """A forecaster as a function of the tensors of a scene, by name."""

    def __init__(self, forecaster: Forecaster, dt: float) -> None:
        super().__init__()
        self.forecaster, self.dt = forecaster, dt

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        forecast = self.forecaster(Scene(**tensors, dt=self.dt))
        return {name: getattr(forecast, name) for name in OUTPUTS}


def export(settings: ExportSettings, overrides: Sequence[str] = ()) -> tuple[Path, float]:
    """Write a run's forecaster as a program (``torch.export``), for batches of any size.

    The file also has ``about.json``: title, time step, and shape and meaning of every input and output. Sizes other than the
    batch are those of the scenes; smaller scenes are padded, as ``agent_mask`` and the other masks say.

    Args:
        settings: the run, the scenes that are the example, and the file.
        overrides: the user's overrides; settings of other data that they name do not follow the run.

    Returns:
        the file, and the largest difference [m] between the program and the forecaster on the example.

    Raises:
        ConfigError: a run that cannot be opened, a forecaster that cannot be exported, a file that exists, or a program
            that differs from its forecaster.
    """
    file = Path(settings.out).expanduser()
    if file.exists():
        raise ConfigError(f"{file} exists: nothing is overwritten; choose another out=<file>")
    assembly.quiet()
    run = RunFolder.open(settings.run)
    of_run = read(Settings, run.config())
    forecaster: Forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint)).eval()
    check_exportable(forecaster, of_run.title)
    scenes = scenes_of(run, of_run, settings, forecaster, overrides).scenes
    tensors = inputs_of(forecaster, scenes)
    program = torch_program(forecaster, tensors, scenes.dt)
    with torch.no_grad():
        wanted = Program(forecaster, scenes.dt)(tensors)
        difference = max(
            float(
                (program.module()({name: value[:count] for name, value in tensors.items()})[name] - whole[:count])
                .abs()
                .max()
            )
            for count in {1, len(scenes.history)}
            for name, whole in wanted.items()
        )
    if not difference <= TOLERANCE:
        raise ConfigError(
            f"the program of {of_run.title} differs from its forecaster by {difference:.2g} m: it is not written"
        )
    about = {
        "title": of_run.title,
        "dt": scenes.dt,
        "inputs": {name: describe(name, value) for name, value in tensors.items()},
        "outputs": {name: describe(name, value) for name, value in wanted.items()},
    }
    content = io.BytesIO()
    torch.export.save(program, content, extra_files={"about.json": json.dumps(about)})
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, content.getbuffer())
    return file, difference


def check_exportable(forecaster: Forecaster, title: str) -> None:
    """Refuse forecasters whose computation depends on values, such as solvers that stop when they have converged.

    Raises:
        ConfigError: see above; the message names the part.
    """
    if not isinstance(forecaster, EPO):
        return
    solver = forecaster.solver
    if not isinstance(solver, LevenbergMarquardt) or solver.adaptive or forecaster.calibration is not None:
        part = "its calibration" if forecaster.calibration is not None else f"its solver ({type(solver).__name__})"
        raise ConfigError(
            f"{title} cannot be exported: {part} takes as many steps as the values need, and a program has a fixed "
            "sequence of operations. Rows with a fixed number of steps can (solver=levenberg_marquardt, solver.adaptive=false)"
        )


def inputs_of(forecaster: Forecaster, scenes: Scene) -> dict[str, Tensor]:
    """The tensors of scenes that the forecaster may read, by name."""
    ends = isinstance(forecaster, EPO) and forecaster.game_horizon > forecaster.task.horizon
    left_out = NOT_READ if ends else (*NOT_READ, "game_steps")
    values = {field.name: getattr(scenes, field.name) for field in dataclasses.fields(scenes)}
    return {name: value.clone() for name, value in values.items() if name not in left_out and value is not None}


def torch_program(forecaster: Forecaster, tensors: dict[str, Tensor], dt: float) -> torch.export.ExportedProgram:
    """The exported program of a forecaster, with a batch of any size."""
    if isinstance(forecaster, EPO) and isinstance(forecaster.solver, LevenbergMarquardt):
        forecaster.solver = dataclasses.replace(forecaster.solver, backend="pytorch")
    batch = torch.export.Dim("B", min=1, max=MOST_SCENES)
    # An example of one scene would make a program for one scene.
    two = {
        name: value[:2] if len(value) > 1 else value.expand(2, *value.shape[1:]).clone()
        for name, value in tensors.items()
    }
    shapes = ({name: {0: batch} for name in tensors},)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*were assigned during export")  # an LSTM lists its weights anew
        return torch.export.export(Program(forecaster, dt), (two,), dynamic_shapes=shapes, strict=False)


def describe(name: str, value: Tensor) -> dict[str, Any]:
    """Shape, type and meaning of an input or output; B is the batch."""
    return {
        "shape": ["B", *value.shape[1:]],
        "dtype": str(value.dtype).removeprefix("torch."),
        "meaning": MEANING[name],
    }
