"""Time of a training step by stage: ``python -m benchmarks.training_step [--device cuda] [--rows ROW,ROW] [override ...]``.

It measures the forecasters of the paper's RPI experiments, or those of other rows of ``conf/experiment/rpi``, on batches of
32 scenes, composed as by `epo train` but without Lightning's own bookkeeping. Overrides are those of `epo train`, such as
``solver.backend=pytorch``. On a GPU, the last lines are the time of whole steps, also from a CUDA graph (``trainer.graph``).
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from benchmarks.command_line import parser_of
from benchmarks.devices import device_name, require
from benchmarks.measure import positive
from epo_lightning.experiment import assembly, step_graph
from epo_lightning.experiment.config.compose import OF_GAMES, compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.forecasters import Forecaster
from epo_lightning.forecasters.epo import EPO
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.schema import read
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import Minimiser

EXPERIMENTS = ("v_lstm", "v_lstm_sc", "v_lstm_epo")
STAGES = (
    "data",
    "backbone",
    "decoders",
    "layer, forward",
    "losses and the rest of forward",
    "layer, backward",
    "rest of backward",
    "optimizer",
)
WARM_UP = 5
"""Rounds before the first one that counts."""
RESIDENT = 64
"""Batches that are held on a GPU, and taken in turn."""
GOAL = 0.15
"""Goal for the layer's share of a step."""


class Clock:
    """Time [s] by stage: CPU time of the process, or on a GPU elapsed time until it is idle.

    The time of a nested stage does not count for the outer one.
    """

    def __init__(self, device: torch.device) -> None:
        self.on_gpu = device.type == "cuda"
        self.spent = dict.fromkeys(STAGES, 0.0)
        self._inner = 0.0

    def now(self) -> float:
        """The time [s]."""
        if not self.on_gpu:
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time within this context for ``name``."""
        outer, self._inner = self._inner, 0.0
        start = self.now()
        yield
        elapsed = self.now() - start
        self.spent[name] += elapsed - self._inner
        self._inner = outer + elapsed


class Cut:
    """A solution's derivative (``backward=``) with the graph cut around it, so that the layer is timed apart from the rest.

    The graph is cut at the features of the backbone too: otherwise the backward pass of the losses would run through the
    backbone before that of the layer has added its gradients.
    """

    def __init__(self, differentiate: Backward, clock: Clock) -> None:
        self.differentiate, self.clock = differentiate, clock
        self.features, self.inputs, self.outputs = Edges(), Edges(), Edges()

    def __getattr__(self, name: str) -> Any:
        """All other attributes are those of the derivative."""
        return getattr(self.differentiate, name)

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Solve, between two cuts."""
        parameters = parameters.map(self.inputs.cut)
        with self.clock.stage("layer, forward"):
            solution = self.differentiate(minimiser, energy, scene, parameters)
        return solution.map(self.outputs.cut)

    def backward(self, loss: Tensor) -> None:
        """Backward pass through the whole graph, from cut to cut."""
        with self.clock.stage("rest of backward"):
            loss.backward()
        with self.clock.stage("layer, backward"):
            self.outputs.backward()
        with self.clock.stage("rest of backward"):
            self.inputs.backward()
            self.features.backward()


class Edges:
    """The tensors before and after a cut of the graph."""

    def __init__(self) -> None:
        self.pairs: list[tuple[Tensor, Tensor]] = []

    def cut(self, tensor: Tensor) -> Tensor:
        """The same values as a leaf of a new graph."""
        if not tensor.requires_grad:
            return tensor
        after = tensor.detach().requires_grad_()
        self.pairs.append((tensor, after))
        return after

    def backward(self) -> None:
        """Pass the gradients of the leaves on to the tensors before the cut."""
        reached = [(before, after.grad) for before, after in self.pairs if after.grad is not None]
        torch.autograd.backward([before for before, _ in reached], [gradient for _, gradient in reached])
        self.pairs = []


class Prepared(NamedTuple):
    """A forecaster with all that its training steps need; its scenes may be made up."""

    title: str
    model: Forecaster
    optimizer: torch.optim.Optimizer
    batches: Iterator[Scene]
    made_up: bool


def prepare(experiment: str, overrides: Sequence[str], device: torch.device) -> Prepared:
    """The forecaster of an experiment on a device, in training mode; overrides of games are left out for rows without one.

    Raises:
        ConfigError: overrides that cannot work.
    """
    words = [word for word in overrides if "epo" in experiment or not word.startswith(OF_GAMES)]
    settings = read(Settings, compose("train", [f"experiment=rpi/{experiment}", *words]))
    data = assembly.build_data(settings.data)
    model = assembly.build_model(settings, data)
    assert isinstance(model, Forecaster)
    step_graph.check(settings, model)
    model = model.to(device).train()
    made_up = False
    try:
        data.setup("fit")
        batches: Iterator[Scene] = _forever(data.train_dataloader())
    except ConfigError:
        if isinstance(model, EPO) and "goal_headings" in model.energy.needs:
            raise  # random scenes have none
        made_up = True
        batches = _random_scenes(data.batch_size, data.task.horizon, data.task.dt)
    if device.type == "cuda":  # batches that are on the device already, as a data set that fits into its memory
        batches = itertools.cycle([next(batches).to(device) for _ in range(RESIDENT)])
    optimizer = model.optimizer.configure(model.parameters(), 1000, model.shared_weights)["optimizer"]
    return Prepared(settings.title, model, optimizer, batches, made_up)


class Step:
    """A forecaster with its data and optimizer, instrumented to time its training steps."""

    def __init__(self, experiment: str, overrides: Sequence[str], device: torch.device) -> None:
        self.title, self.model, self.optimizer, self.batches, self.made_up = prepare(experiment, overrides, device)
        self.clock = Clock(device)
        self.cut: Cut | None = None
        if isinstance(self.model, EPO):
            self.cut = Cut(self.model.differentiable_solve, self.clock)
            self.model.differentiable_solve = self.cut  # type: ignore[assignment]
        for name, module in self.model.named_children():
            if not name.endswith("_metrics"):
                self._time(module, "backbone" if name == "backbone" else "decoders")

    def _time(self, module: nn.Module, stage: str) -> None:
        forward = module.forward

        def timed(*arguments: Any, **named: Any) -> Any:
            with self.clock.stage(stage):
                result = forward(*arguments, **named)
            return self.cut.features.cut(result) if self.cut and stage == "backbone" else result

        module.forward = timed

    def take(self) -> dict[str, float]:
        """Seconds of one training step by stage."""
        self.clock.spent = dict.fromkeys(STAGES, 0.0)
        with self.clock.stage("data"):
            scene = next(self.batches)
        with self.clock.stage("losses and the rest of forward"):
            terms = self.model.losses(scene, self.model(scene))
            loss = torch.stack([weight * value for weight, value in terms.values()]).sum()
        if self.cut:
            self.cut.backward(loss)
        else:
            with self.clock.stage("rest of backward"):
                loss.backward()
        with self.clock.stage("optimizer"):
            self.optimizer.step()
            self.optimizer.zero_grad()
        return self.clock.spent


def _forever(loader: Any) -> Iterator[Scene]:
    while True:
        yield from loader


def _random_scenes(batch: int, horizon: int, dt: float) -> Iterator[Scene]:
    """Random scenes of two agents, used where the data set has not been generated."""
    while True:
        state = torch.randn(batch, 2, 19, 4)
        yield Scene(
            history=state,
            dt=dt,
            future=torch.randn(batch, 2, horizon, 4),
            goal_candidates=torch.randn(batch, 2, 1, 2),
            size=torch.full((batch, 2, 2), 0.5),
            subset=torch.arange(batch) % 2,
            id=torch.arange(batch),
        )


def measure(steps: Sequence[Step], repeats: int) -> list[dict[str, float]]:
    """Median milliseconds by stage; the forecasters take turns."""
    taken: list[list[dict[str, float]]] = [[] for _ in steps]
    for round_ in range(repeats + WARM_UP):
        for step, spent in zip(steps, taken, strict=True):
            found = step.take()
            if round_ >= WARM_UP:
                spent.append(found)
    return [{stage: 1e3 * statistics.median(t[stage] for t in spent) for stage in STAGES} for spent in taken]


def whole_step(prepared: Prepared, repeats: int, graph: bool) -> float:
    """Milliseconds of a whole training step, from its batch to its new weights; the host does not wait between two steps.

    Args:
        prepared: the forecaster.
        repeats: number of steps.
        graph: whether forward pass, losses and backward pass are replayed from a CUDA graph.

    Raises:
        ConfigError: the step cannot be captured.
    """
    model, clock = prepared.model, Clock(prepared.model.device)
    replayed = step_graph.StepGraph()
    if graph:
        replayed.begin(model)
    started = 0.0
    for number in range(-step_graph.WARM_UP - WARM_UP, repeats):
        if number == 0:
            started = clock.now()
        scene = next(prepared.batches)
        if graph:
            replayed.step(scene)
        else:
            total, _ = model.weighted_losses(scene)
            prepared.optimizer.zero_grad()
            total.backward()
        prepared.optimizer.step()
    return 1e3 * (clock.now() - started) / repeats


def whole_steps(
    overrides: Sequence[str], device: torch.device, repeats: int, rows: Sequence[str] = EXPERIMENTS
) -> Iterator[str]:
    """Lines about whole training steps without and with a CUDA graph, and about +EPO compared with +SC."""
    captured: dict[str, float] = {}
    for experiment in rows:
        usual = prepare(experiment, overrides, device)
        line = f"a whole step of {usual.title}: {whole_step(usual, repeats, graph=False):.2f} ms"
        try:
            with_graph = prepare(experiment, [*overrides, "trainer.accelerator=gpu", "trainer.graph=true"], device)
            captured[experiment] = whole_step(with_graph, repeats, graph=True)
            yield f"{line}, {captured[experiment]:.2f} ms from a CUDA graph"
        except ConfigError as error:
            yield f"{line}; from a CUDA graph: {error}"
    if {"v_lstm_sc", "v_lstm_epo"} <= captured.keys():
        ratio = captured["v_lstm_epo"] / captured["v_lstm_sc"]
        yield f"from CUDA graphs, a step of +EPO takes {ratio:.2f} times that of +SC"


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("training_step", __doc__)
    parser.add_argument("overrides", nargs="*", help="as for `epo train`")
    parser.add_argument(
        "--rows", default=",".join(EXPERIMENTS), help="experiments of conf/experiment/rpi, separated by commas"
    )
    parser.add_argument("--repeats", type=positive, default=50, help="training steps; the median counts")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="where the forecasters are trained")
    arguments = parser.parse_args(given)
    device = require(arguments.device)
    torch.set_num_threads(1)
    assembly.quiet()
    try:
        steps = [Step(experiment, arguments.overrides, device) for experiment in arguments.rows.split(",")]
    except ConfigError as error:
        raise SystemExit(str(error)) from error
    found = measure(steps, arguments.repeats)
    source = "random scenes: no data in the cache" if steps[0].made_up else "RPI data"
    where = f"{device_name(device)}, elapsed" if device.type == "cuda" else "one thread, CPU"
    table = Table(title=f"a training step, {where} time in ms; {source}")
    table.add_column("")
    for step in steps:
        table.add_column(step.title, justify="right")
    for stage in STAGES:
        table.add_row(stage, *(f"{ms[stage]:.2f}  {ms[stage] / sum(ms.values()):4.0%}" for ms in found))
    table.add_section()
    table.add_row("together", *(f"{sum(ms.values()):.2f}  100%" for ms in found))
    console = Console()
    console.print(table)
    last = found[-1]
    share = (last["layer, forward"] + last["layer, backward"]) / sum(last.values())
    console.print(f"the layer's share of a step of {steps[-1].title}: {share:.1%} (goal: less than {GOAL:.0%})")
    if device.type == "cuda":
        for line in whole_steps(arguments.overrides, device, arguments.repeats, arguments.rows.split(",")):
            console.print(line)


if __name__ == "__main__":
    main()
