"""Where the time of a training step goes: ``python -m benchmarks.training_step [override ...]``.

Forecasters of the paper's RPI experiments, batches of 32 scenes, everything as `epo train` composes it, without Lightning's
own bookkeeping. Overrides are those of `epo train`, for example ``solver.backend=pytorch``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings, read
from epo_lightning.forecasters import Forecaster
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import GameParameters, Scene, Solution

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
GOAL = 0.15
"""Share of a step that we want the layer to stay below."""


class Clock:
    """CPU time [s] by stage. What is timed within a stage does not count for that stage as well."""

    def __init__(self) -> None:
        self.spent = dict.fromkeys(STAGES, 0.0)
        self._inner = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens within for ``name``."""
        outer, self._inner = self._inner, 0.0
        start = time.process_time()
        yield
        elapsed = time.process_time() - start
        self.spent[name] += elapsed - self._inner
        self._inner = outer + elapsed


class Cut:
    """A solver around which the graph is cut, so that its own forward and backward can be timed apart from the rest.

    The features from which everything is decoded are a third place to cut: otherwise the backward pass of the losses would
    run through the backbone before that of the layer is known.
    """

    def __init__(self, solver: Callable[[FeatureEnergy, Scene, GameParameters], Solution], clock: Clock) -> None:
        self.solver, self.clock = solver, clock
        self.features, self.inputs, self.outputs = Edges(), Edges(), Edges()

    def __call__(self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> Solution:
        """Solve, between two cuts."""
        parameters = parameters.map(self.inputs.cut)
        with self.clock.stage("layer, forward"):
            solution = self.solver(energy, scene, parameters)
        return solution.map(self.outputs.cut)

    def backward(self, loss: Tensor) -> None:
        """Backward through everything, from cut to cut."""
        with self.clock.stage("rest of backward"):
            loss.backward()
        with self.clock.stage("layer, backward"):
            self.outputs.backward()
        with self.clock.stage("rest of backward"):
            self.inputs.backward()
            self.features.backward()


class Edges:
    """Where a graph was cut: tensors before and after."""

    def __init__(self) -> None:
        self.pairs: list[tuple[Tensor, Tensor]] = []

    def cut(self, tensor: Tensor) -> Tensor:
        """The same numbers, as a leaf."""
        if not tensor.requires_grad:
            return tensor
        after = tensor.detach().requires_grad_()
        self.pairs.append((tensor, after))
        return after

    def backward(self) -> None:
        """Hand on the gradients that have arrived."""
        reached = [(before, after.grad) for before, after in self.pairs if after.grad is not None]
        torch.autograd.backward([before for before, _ in reached], [gradient for _, gradient in reached])
        self.pairs = []


class Step:
    """One forecaster and its data, ready to take training steps on the clock."""

    def __init__(self, experiment: str, overrides: Sequence[str]) -> None:
        settings = read(Settings, compose("train", [f"experiment=rpi/{experiment}", *overrides]))
        data = assembly.build_data(settings.data)
        model = assembly.build_model(settings, data)
        assert isinstance(model, Forecaster)
        self.model = model.train()
        self.title, self.made_up = settings.title, False
        try:
            data.setup("fit")
            self.batches: Iterator[Scene] = _forever(data.train_dataloader())
        except ConfigError:
            self.made_up = True
            self.batches = _random_scenes(data.batch_size, data.task.horizon, data.task.dt)
        self.optimizer = self.model.optimizer.configure(self.model.parameters(), 1000)["optimizer"]
        self.clock = Clock()
        self.cut: Cut | None = None
        if hasattr(self.model, "solver"):
            self.cut = Cut(self.model.solver, self.clock)  # type: ignore[arg-type]
            self.model.solver = self.cut  # type: ignore[assignment]
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
        """Seconds by stage of one training step."""
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
    """Two agents within metres of each other, where the data set has not been generated."""
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
    """Median milliseconds by stage, of steps that the forecasters take in turns."""
    taken: list[list[dict[str, float]]] = [[] for _ in steps]
    for round_ in range(repeats + 5):
        for step, spent in zip(steps, taken, strict=True):
            found = step.take()
            if round_ >= 5:  # warm by now
                spent.append(found)
    return [{stage: 1e3 * statistics.median(t[stage] for t in spent) for stage in STAGES} for spent in taken]


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training_step", description=__doc__)
    parser.add_argument("overrides", nargs="*", help="as for `epo train`")
    parser.add_argument("--repeats", type=int, default=50, help="training steps; the median counts")
    arguments = parser.parse_args(given)
    torch.set_num_threads(1)
    assembly.quiet()
    try:
        steps = [Step(experiment, arguments.overrides) for experiment in EXPERIMENTS]
    except ConfigError as error:
        raise SystemExit(str(error)) from error
    found = measure(steps, arguments.repeats)
    source = "random scenes: no data in the cache" if steps[0].made_up else "RPI data"
    table = Table(title=f"a training step, one thread, CPU time in ms; {source}")
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


if __name__ == "__main__":
    main()
