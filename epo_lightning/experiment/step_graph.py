"""A training step as one CUDA graph: forward pass, losses and backward pass are captured once and replayed for every batch.

The networks are small, so a step on a GPU takes as long as the host needs to launch its hundreds of kernels. A replay is one
launch. Of every batch only the values change: they are copied into the tensors of a static scene, and a replay overwrites
static losses and gradients. The optimizer, gradient clipping and logging are outside of the graph and stay as they are.

A graph repeats what was launched while it was captured. Nothing in a step may therefore make the host wait, be drawn on the
CPU, or change from step to step except by tensors on the device. Relaxation and annealing of a loss are such tensors; the
host writes their numbers before every step. When one of them ends, the step is captured once more without it.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor, nn

from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecasters import Forecaster
from epo_lightning.registry import ConfigError, one_line
from epo_lightning.scene import FIELDS, Scene
from epo_lightning.schedules import Schedule

WARM_UP = 3
"""Training steps before the capture: they compile kernels and make handles of libraries, which a capture cannot contain."""


class Outcome(NamedTuple):
    """Losses and gradients of a step, in tensors that a replay overwrites.

    Attributes:
        names: names of the loss terms.
        losses: the weighted sum and every term.
        gradients: gradient of every parameter; None where the loss does not depend on it.
    """

    names: tuple[str, ...]
    losses: Float[Tensor, " _"]
    gradients: list[Tensor | None]


class Recorder:
    """Runs and captures steps on a stream of its own, as captures need it."""

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)

    def run(self, step: Callable[[], Outcome]) -> Outcome:
        """Run a step."""
        current = torch.cuda.current_stream(self.stream.device)
        self.stream.wait_stream(current)
        with torch.cuda.stream(self.stream):
            outcome = step()
        current.wait_stream(self.stream)
        return outcome

    def record(self, step: Callable[[], Outcome]) -> Callable[[], Outcome]:
        """A function that replays a step; the step itself is only captured here.

        Raises:
            RuntimeError: the step cannot be captured.
        """
        graph = torch.cuda.CUDAGraph()
        gc.collect()  # the memory of an earlier graph must not be released in the middle of a capture
        # The outer context restores the current stream also after a capture that fails, which the inner one does not.
        with torch.cuda.stream(self.stream), torch.cuda.graph(graph, stream=self.stream):
            outcome = step()

        def replay() -> Outcome:
            graph.replay()
            return outcome

        return replay


class StepGraph(Callback):
    """Callback that lets a :class:`Forecaster` take its training steps from a CUDA graph.

    The first :data:`WARM_UP` batches, also after a number of the loss has ended, and batches of other shapes than the first
    one are computed without the graph.
    """

    def __init__(self) -> None:
        self._end()

    def _end(self) -> None:
        """Forget the graph and its memory."""
        self._steps = 0
        self._parameters: list[nn.Parameter] = []
        self._layout: tuple[Any, ...] | None = None
        self._numbers: list[tuple[Schedule, Tensor]] = []
        self._changing: list[bool] = []
        self._replay: Callable[[Scene], Outcome] | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, Forecaster)
        self.begin(pl_module)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if isinstance(pl_module, Forecaster):
            pl_module.step_graph = None
        self._end()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self.teardown(trainer, pl_module, "fit")  # Lightning does not, and the forecaster may be trained again

    def begin(self, forecaster: Forecaster) -> None:
        """Take over the training steps of a forecaster, which is on its device already."""
        self._forecaster = forecaster
        self._parameters = [parameter for parameter in forecaster.parameters() if parameter.requires_grad]
        self._recorder = Recorder(forecaster.device)
        self._numbers = [
            (schedule, torch.zeros((), device=forecaster.device, dtype=self._parameters[0].dtype))
            for schedule in forecaster.schedules
        ]
        forecaster.step_graph = self.step

    def step(self, scene: Scene) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum of the losses of a batch and every term; the parameters then have the gradients of the sum.

        The host does not wait for the device, except for a capture: one, and one more when a number of the loss has ended.

        Raises:
            ConfigError: the step cannot be captured, or it draws numbers on the CPU.
        """
        layout = _layout(scene)
        self._layout = self._layout or layout
        self._write_numbers()
        self._steps += 1
        if self._steps <= WARM_UP or layout != self._layout:
            outcome = self._recorder.run(lambda: self._compute(scene))
        else:
            self._replay = self._replay or self._capture(scene)
            outcome = self._replay(scene)
        # A step without the graph, or a validation, has put other gradients or none in the place of the static ones.
        for parameter, gradient in zip(self._parameters, outcome.gradients, strict=True):
            parameter.grad = gradient
        total, *terms = outcome.losses.clone().unbind()
        return total, dict(zip(outcome.names, terms, strict=True))

    def _write_numbers(self) -> None:
        """Bring the numbers of the loss at this step to the device; forget the graph if one of them has ended."""
        numbers = [schedule.number(self._forecaster.global_step) for schedule, _ in self._numbers]
        changing = [number > 0 for number in numbers]
        if changing != self._changing:
            self._changing, self._replay, self._steps = changing, None, 0
        for (_, held), number in zip(self._numbers, numbers, strict=True):
            if number > 0:
                held.fill_(number)

    def _compute(self, scene: Scene) -> Outcome:
        # Without gradients to add to, the backward pass makes new tensors, which a replay overwrites.
        for parameter in self._parameters:
            parameter.grad = None
        with ExitStack() as held:
            for schedule, number in self._numbers:
                held.enter_context(schedule.holding(number))
            total, terms = self._forecaster.weighted_losses(scene)
        total.backward()
        losses = torch.stack([total.detach(), *terms.values()])
        return Outcome(tuple(terms), losses, [parameter.grad for parameter in self._parameters])

    def _capture(self, scene: Scene) -> Callable[[Scene], Outcome]:
        """Capture the step; returns a function that replays it with another batch of the same layout."""
        static = scene.map(torch.clone)
        before = torch.get_rng_state()
        try:
            again = self._recorder.record(lambda: self._compute(static))
        except RuntimeError as error:
            cause = error.__context__ or error  # the end of a broken capture has an error of its own
            raise ConfigError(
                f"this training step cannot be captured as a CUDA graph ({one_line(cause, 300)}): "
                "set trainer.graph=false"
            ) from error
        if not torch.equal(before, torch.get_rng_state()):
            raise ConfigError(
                "this training step draws random numbers on the CPU, which a CUDA graph would repeat in every step: "
                "set trainer.graph=false"
            )

        def replay(batch: Scene) -> Outcome:
            for name in FIELDS:
                if (target := getattr(static, name)) is not None:
                    target.copy_(getattr(batch, name))
            return again()

        return replay


def _layout(scene: Scene) -> tuple[Any, ...]:
    """Everything about a scene that a graph cannot change: its time step, and shapes and number types of its tensors."""
    tensors = (getattr(scene, name) for name in FIELDS)
    return scene.dt, *(None if tensor is None else (tensor.shape, tensor.dtype) for tensor in tensors)


def check(settings: Settings, forecaster: Forecaster) -> None:
    """Refuse ``trainer.graph`` for a training whose steps no graph can repeat.

    Raises:
        ConfigError: the setting that has to change.
    """
    if not settings.trainer.graph:
        return
    solver = forecaster.solver
    if solver is not None and solver.on_host:
        named = " and ".join(
            f"solver.{key}={settings.solver[key]}" for key in ("name", "backend") if key in settings.solver
        )
        raise ConfigError(
            f"trainer.graph=true with {named}: its games are solved on the host, which a CUDA graph cannot contain; set "
            "trainer.graph=false, or use levenberg_marquardt with solver.backend=pytorch, or with solver.backend=warp "
            "(pip install 'epo_lightning[gpu]') and solver.adaptive=false"
        )
