"""A trained forecaster, network and solver, as a program of PyTorch's own operations, which runs without this package."""

from __future__ import annotations

import copy
import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import ExportSettings
from epo_lightning.experiment.opening import open_checkpoint, settings_of
from epo_lightning.experiment.predict import MEANING, scenes_of
from epo_lightning.experiment.program_files import FORMATS, Format, Run, Tensors
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.forecasters.epo import EPO
from epo_lightning.forecasters.game_forecaster import GameForecaster
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.scene import FIELDS, Scene
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OUTPUTS = ("states", "probabilities")
"""Outputs of a program, by name."""
NOT_READ = ("dt", "future", "future_mask", "subset", "id", "frame")
"""Fields of a scene that no forecaster reads."""
PYTORCH = "2.11"
"""First version of PyTorch with which all programs were tried; 2.7 and 2.9 fail in ``torch.export``."""
TOLERANCE = 1e-5
"""Largest difference between the outputs of a program and those of its forecaster, divided by values above 1.

Positions of 150 m have a resolution of 1.5e-5 m in single precision."""


class Program(nn.Module):
    """A forecaster as a function of the tensors of scenes, by name."""

    def __init__(self, forecaster: Forecaster, dt: float) -> None:
        super().__init__()
        self.forecaster, self.dt = forecaster, dt

    def forward(self, tensors: Tensors) -> Tensors:
        forecast = self.forecaster(Scene(**tensors, dt=self.dt))
        return {name: getattr(forecast, name) for name in OUTPUTS}


def export(
    settings: ExportSettings, overrides: Sequence[str] = (), tell: Callable[[str], None] = lambda line: None
) -> tuple[Path, float]:
    """Write a run's forecaster as a program (``torch.export``), for any number of scenes.

    The file also says its title, time step, and what :func:`describe` says. Other sizes are those of the example.

    Args:
        settings: the run, the scenes that are the example, and the file.
        overrides: the user's overrides; settings of other data that they name do not follow the run.
        tell: called with a line of progress before the longest part.

    Returns:
        the file, and the largest difference between the program in it and the forecaster on the example.

    Raises:
        ConfigError: a run that cannot be opened, a forecaster that cannot be exported, a file that exists, a package that is
            missing, or a program that differs from its forecaster.
    """
    form = FORMATS[settings.format]
    file = Path(settings.out or f"forecaster{form.suffix}").expanduser()
    check_file(file, form)
    assembly.quiet()
    run = RunFolder.open(settings.run)
    of_run = settings_of(run)
    forecaster: Forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
    check_exportable(forecaster, of_run.title, form)
    scenes = forecaster.as_input(scenes_of(run, of_run, settings, forecaster, overrides).scenes)
    forecast = forecaster.predict(scenes)
    wanted = {name: getattr(forecast, name) for name in OUTPUTS}
    tensors = inputs_of(forecaster, scenes)
    tell(f"{of_run.title}: the program is traced and compared, which can take some minutes")
    program = program_of(forecaster, tensors, scenes.dt)
    with TemporaryDirectory(dir=file.parent, prefix=".export-") as folder:
        unchecked = Path(folder) / file.name
        form.write(program, {"title": of_run.title, "dt": scenes.dt, **describe(program)}, unchecked)
        difference = largest_difference(form.load(unchecked), tensors, wanted)
        if not difference <= TOLERANCE:
            raise ConfigError(
                f"the program of {of_run.title} differs from its forecaster by {difference:.2g}: it is not written"
            )
        unchecked.replace(file)
    return file, difference


def check_file(file: Path, form: Format) -> None:
    """Refuse a file that exists, cannot be written or has another format's suffix, and a format whose packages are missing.

    The folder of the file is made.

    Raises:
        ConfigError: see above; the message names the file or the package.
    """
    if file.exists():
        raise ConfigError(f"{file} exists: nothing is overwritten; choose another out=<file>")
    if file.suffix != form.suffix:
        raise ConfigError(f"out={file} must end in {form.suffix}, as files of this format do")
    missing = [name for name in form.packages if find_spec(name) is None]
    if missing:
        raise ConfigError(f"format=onnx needs {', '.join(missing)}: pip install 'epo_lightning[onnx]'")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        TemporaryDirectory(dir=file.parent, prefix=".export-").cleanup()
    except OSError as error:
        raise ConfigError(f"out={file} cannot be written ({error.strerror}): choose another out=<file>") from error


def check_exportable(forecaster: Forecaster, title: str, form: Format) -> None:
    """Refuse forecasters with a number of steps that depends on values, and those with operations that the format lacks.

    Raises:
        ConfigError: see above; the message names the part. Or PyTorch is too old.
    """
    if torch.__version__ < PYTORCH:
        raise ConfigError(
            f"epo export needs PyTorch {PYTORCH} or later, and {torch.__version__} is installed: "
            f"pip install 'torch>={PYTORCH}'"
        )
    games = games_of(forecaster)
    if games and not form.games:
        raise ConfigError(
            f"{title} cannot be exported as ONNX, which has no Cholesky factorisation: use format=pt2 or format=aoti"
        )
    obstacles = list(dict.fromkeys(obstacle for game in games for obstacle in _obstacles(game)))
    if obstacles:
        raise ConfigError(
            f"{title} cannot be exported: a program has a fixed sequence of operations, and {'; '.join(obstacles)}. A run "
            "keeps its settings: train one with these"
        )


def _obstacles(game: GameForecaster) -> list[str]:
    """Parts of a game that a program cannot have, each with the setting that does without it."""
    found = []
    if isinstance(game, EPO) and game.calibration is not None:
        found.append("its calibration takes as many steps as the values need (without: forecaster.calibration=null)")
    if not isinstance(game.solver, LevenbergMarquardt):
        found.append(
            f"its solver, {type(game.solver).__name__}, takes as many steps as the values need (a fixed number: "
            "solver=levenberg_marquardt solver.adaptive=false)"
        )
    elif game.solver.adaptive:
        found.append(
            "its solver takes adaptive steps, which depend on the values (a fixed number: solver.adaptive=false)"
        )
    if isinstance(game, EPO) and game.gate is not None:
        found.append("its gate chooses pairs by their values (without: forecaster.gate=null)")
    return found


def games_of(forecaster: Forecaster) -> list[GameForecaster]:
    """The parts of a forecaster that solve games; a refinement may refine another one's solutions."""
    return [part for part in forecaster.modules() if isinstance(part, GameForecaster)]


def inputs_of(forecaster: Forecaster, scenes: Scene) -> Tensors:
    """The tensors of scenes that the forecaster may read, by name."""
    ends = isinstance(forecaster, EPO) and forecaster.game_horizon > forecaster.task.horizon
    kinds = any(isinstance(game.energy, FeatureEnergy) and game.energy.bounded_by_kind for game in games_of(forecaster))
    left_out = {*NOT_READ, *(() if ends else ("game_steps",)), *(() if kinds else ("kind",))}
    values = {field.name: getattr(scenes, field.name) for field in dataclasses.fields(scenes)}
    return {name: value.clone() for name, value in values.items() if name not in left_out and value is not None}


def program_of(forecaster: Forecaster, example: Tensors, dt: float) -> ExportedProgram:
    """The program of a forecaster for any number of scenes and, where its operations allow this, of agents and lanes.

    A game's solver lays out its matrices for a number of agents, which is that of the example.
    """
    forecaster = copy.deepcopy(forecaster)  # the program's solvers are those of plain PyTorch
    games = games_of(forecaster)
    for game in games:
        if isinstance(game.solver, LevenbergMarquardt):
            game.solver = dataclasses.replace(game.solver, backend="pytorch")
    program = Program(forecaster, dt).eval().requires_grad_(False)
    # A size of one, or one that other dimensions have as well, could become a constant of the program.
    scenes = torch.arange(7) % example["history"].shape[0]
    seven = {name: value[scenes] for name, value in example.items()}
    free = {"B": Dim("B", min=1), "L": Dim.AUTO} | ({} if games else {"N": Dim.AUTO})
    shapes = {
        name: {axis: free[letter] for axis, letter in enumerate(FIELDS[name][1]) if letter in free} for name in example
    }
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*were assigned during export")  # an LSTM lists its weights anew
        return torch.export.export(program, (seven,), dynamic_shapes=(shapes,), strict=False)


def largest_difference(run: Run, given: Tensors, wanted: Tensors) -> float:
    """Largest |found - wanted| / max(1, |wanted|) for all scenes and for the first one alone.

    Infinity for outputs of another shape, as those of a program for one number of scenes; NaN if an output is NaN.
    """
    differences = []
    for scenes in (slice(None), slice(1)):
        found = run({name: value[scenes] for name, value in given.items()})
        for name in wanted:
            expected = wanted[name][scenes]
            if found[name].shape != expected.shape:
                return math.inf
            differences.append(((found[name] - expected).abs() / expected.abs().clamp(min=1.0)).max())
    return float(torch.stack(differences).max())


def describe(program: ExportedProgram) -> dict[str, Any]:
    """Shape, type and meaning of the inputs and outputs of a program, by name.

    Sizes that are free have their letters: B scenes, N agents, L lanes.
    """
    signature = program.graph_signature
    values = {node.name: node.meta["val"] for node in program.graph.nodes if isinstance(node.meta.get("val"), Tensor)}
    inputs = {name.removeprefix("tensors_"): values[name] for name in signature.user_inputs}
    outputs = dict(zip(OUTPUTS, (values[name] for name in signature.user_outputs), strict=True))
    letters: dict[str, Any] = {}
    for name, value in inputs.items():
        letters.update(zip(map(str, value.shape), FIELDS[name][1], strict=True))

    def described(name: str, value: Tensor) -> dict[str, Any]:
        shape = [letters[str(size)] if isinstance(size, torch.SymInt) else size for size in value.shape]
        return {"shape": shape, "dtype": str(value.dtype).removeprefix("torch."), "meaning": MEANING[name]}

    return {
        "inputs": {name: described(name, value) for name, value in inputs.items()},
        "outputs": {name: described(name, value) for name, value in outputs.items()},
    }
