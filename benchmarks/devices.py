"""The layer on a GPU: ``python -m benchmarks.epo_layer --device cuda``; docs/benchmarks.md explains the output."""

from __future__ import annotations

import gc
import json
import shutil
import statistics
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from benchmarks import measure, peer, reference
from benchmarks.games import LANE_POINTS, Game, make
from benchmarks.implementations import Implementation, Missing
from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

BATCHES = (32, 128, 512, 2048, 8192, 32768, 65536)
LONGEST = 1e3
"""An implementation that took longer than this [ms] is not measured in larger batches."""
TOLERANCE = 1e-5
"""Largest difference from the reference in float64, of controls, and of gradients relative to their largest entry."""
STATIONARY = 1e-4
"""Norm of the gradient below which a lane change counts as solved."""


@dataclass(frozen=True)
class Timing:
    """One line of the JSON file; values that were not measured are null.

    Attributes:
        forward_ms, forward_backward_ms: medians, from an idle device to an idle device.
        games_per_s: games solved per second, forward.
        peak_share: operations of the cheapest method per second, as a share of the rate of a large float32 product.
        millijoules: energy of the device for one call, forward and backward.
    """

    setting: str
    implementation: str
    device: str
    B: int
    M: int
    N: int
    K: int
    S: int
    forward_ms: float
    forward_backward_ms: float
    games_per_s: float
    peak_share: float | None
    millijoules: float | None


def implementations(device: torch.device) -> tuple[str, ...]:
    """Names of what is measured on a device."""
    return (
        ("peer", "pytorch", "host", "warp", "graph")
        if device.type == "cuda"
        else ("peer", "pytorch", "compiled", "warp")
    )


def prepare(name: str, game: Game) -> Implementation:
    """An implementation on the device of a game; ``graph`` is ``warp`` in a CUDA graph.

    Raises:
        Missing: it cannot run here.
    """
    if name == "peer":
        try:
            return Implementation(name, game, peer.prepare(game, peer.LINEAR_SOLVERS[0]))
        except ImportError as error:
            raise Missing("Theseus is not installed") from error
    backend = "warp" if name == "graph" else name
    layer = LevenbergMarquardt(game.steps, game.step_size, game.damping, backend=backend)
    try:
        layer(game.energy, game.scene[0], game.parameters[0])
    except ValueError as error:
        raise Missing(str(error)) from error
    found = Implementation(name, game, lambda parameters: layer(game.energy, game.scene, parameters).controls)
    return Captured(name, game, found.solve) if name == "graph" else found


class Captured(Implementation):
    """An implementation whose calls are captured in CUDA graphs, and replayed."""

    @cached_property
    def graphs(self) -> dict[str, tuple[Any, Any]]:
        """The graph of each call, with its results, which a replay overwrites."""
        return {}

    def _replay(self, name: str, action: Callable[[], Any]) -> Any:
        if name not in self.graphs:
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):  # a first call outside the capture compiles the kernels
                action()
            torch.cuda.current_stream().wait_stream(side)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                result = action()
            self.graphs[name] = graph, result
        graph, result = self.graphs[name]
        graph.replay()
        torch.cuda.synchronize()
        return result

    def _wait(self) -> None:
        """Nothing: no call may wait while it is captured."""

    def forward(self) -> Tensor:
        """The controls, computed without a graph of autograd."""
        return self._replay("forward", super().forward)

    def forward_backward(self) -> tuple[Tensor, ...]:
        """Controls, and gradients by all weights, goals and initial controls, for a fixed random cotangent."""
        _ = self.cotangent
        return self._replay("forward_backward", super().forward_backward)


def disagreement(name: str, game: Game) -> float:
    """Difference from the reference on the CPU, on four scenes in float64: of controls, and relative of gradients."""
    few = list(range(min(4, game.sizes["B"])))
    small = Game(game.setting, game.energy, game.scene[few], game.parameters[few], game.steps).to(torch.float64)
    found = prepare(name, small).forward_backward()
    plain = small.to("cpu")
    expected = Implementation("reference", plain, reference.prepare(plain)).forward_backward()
    worst = [
        (a.cpu() - b).abs().max().item() / (1.0 if i == 0 else max(1e-3, b.abs().max().item()))
        for i, (a, b) in enumerate(zip(found, expected, strict=True))
    ]
    return max(worst) if all(w == w for w in worst) else float("inf")


def milliseconds(action: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a call that ends with an idle device, after three calls that do not count."""
    for _ in range(3):
        action()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def product_rate(device: torch.device) -> float:
    """Rate [GFLOP/s] of a large product of matrices in float32, without TF32."""
    torch.backends.cuda.matmul.allow_tf32 = False
    size = 8192 if device.type == "cuda" else 1024
    matrix = torch.randn(size, size, device=device)

    def action() -> None:
        matrix @ matrix
        if device.type == "cuda":
            torch.cuda.synchronize()

    return 2 * size**3 / milliseconds(action, 5) / 1e6


@contextmanager
def power(device: torch.device) -> Iterator[list[float]]:
    """Samples of the power [W] that a GPU takes meanwhile, from nvidia-smi; none on other devices."""
    samples: list[float] = []
    if device.type != "cuda" or shutil.which("nvidia-smi") is None:
        yield samples
        return
    query = ["nvidia-smi", "--query-gpu=power.draw", "--format=csv,noheader,nounits", f"--id={device.index or 0}"]
    done = threading.Event()

    def sample() -> None:
        while not done.is_set():
            found = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
            if found.replace(".", "", 1).isdigit():
                samples.append(float(found))
            done.wait(0.05)

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield samples
    finally:
        done.set()
        thread.join()


def energy_of(action: Callable[[], Any], device: torch.device, seconds: float = 1.0) -> float | None:
    """Energy [mJ] of a call: mean power of the device, times the time of a call; None where it is unknown."""
    if device.type != "cuda":
        return None
    calls, start = 0, time.perf_counter()
    with power(device) as samples:
        while time.perf_counter() - start < seconds:
            action()
            calls += 1
        took = time.perf_counter() - start
    return 1e3 * statistics.mean(samples) * took / calls if samples else None


def sizes(
    setting: str, batches: Sequence[int], device: torch.device, repeats: int, console: Console, **others: int | None
) -> Iterator[Timing]:
    """Times of all implementations over batch sizes, each within memory and :data:`LONGEST`.

    Raises:
        SystemExit: an implementation differs from the reference.
    """
    rate = product_rate(device)
    console.print(f"{device_name(device)}: a large float32 product takes {rate:.0f} GFLOP/s")
    left = list(implementations(device))
    for batch in batches:
        game = make(setting, **{**others, "B": batch}).to(device)
        for name in list(left):
            gc.collect()  # of the implementation before
            if device.type == "cuda":
                torch.cuda.empty_cache()
            try:
                if batch == batches[0] and not (worst := disagreement(name, game)) <= TOLERANCE:
                    raise SystemExit(
                        f"nothing was measured: {name} differs from the reference by {worst:.1e} in float64"
                    )
                timing = _timing(name, game, device, rate, repeats)
            except Missing as reason:
                console.print(f"{name}: left out, {reason}")
                left.remove(name)
                continue
            except torch.OutOfMemoryError:
                console.print(f"{name}: out of memory at B={batch}")
                left.remove(name)
                continue
            console.print(describe(timing))
            yield timing
            if timing.forward_backward_ms > LONGEST:
                left.remove(name)


def _timing(name: str, game: Game, device: torch.device, rate: float, repeats: int) -> Timing:
    ready = prepare(name, game)
    shape = game.sizes
    problems = shape["B"] * shape["M"]
    forward = milliseconds(ready.forward, repeats)
    both = milliseconds(ready.forward_backward, repeats)
    operations, _ = measure.operations(shape["N"], shape["K"], LANE_POINTS if "lane" in game.energy.own else 0)
    return Timing(
        setting=game.setting,
        implementation=name,
        device=device_name(device),
        **shape,
        forward_ms=forward,
        forward_backward_ms=both,
        games_per_s=1e3 * problems / forward,
        peak_share=problems * shape["S"] * operations / forward / 1e6 / rate if name != "peer" else None,
        millijoules=energy_of(ready.forward_backward, device),
    )


def describe(timing: Timing) -> str:
    """A timing in one line."""
    share = "" if timing.peak_share is None else f", {timing.peak_share:.1%} of the product's rate"
    energy = "" if timing.millijoules is None else f", {timing.millijoules:.2f} mJ"
    return (
        f"{timing.setting} B={timing.B} {timing.implementation}: forward {timing.forward_ms:.3f} ms, with backward "
        f"{timing.forward_backward_ms:.3f} ms, {timing.games_per_s:,.0f} games/s{share}{energy}"
    )


def lane_change(batch: int, horizon: int) -> Game:
    """Two vehicles beside each other on two lanes, each of which wants the other's lane; starts and speeds are random."""
    draw = torch.Generator().manual_seed(0)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=draw, dtype=torch.float64)

    side = torch.tensor([0.0, 3.5], dtype=torch.float64)
    along = between(-3.0, 3.0, batch, 2)
    speed = between(8.0, 12.0, batch, 2)
    state = torch.stack((along, side.expand(batch, 2), torch.zeros_like(along), speed), -1)
    far = torch.linspace(-20.0, 100.0, 2, dtype=torch.float64)
    lines = torch.stack((far.expand(batch, 2, 1, 2), side.flip(0)[:, None, None].expand(batch, 2, 1, 2)), -1)
    size = torch.tensor([4.0, 1.8], dtype=torch.float64).expand(batch, 2, 2)
    scene = Scene(state[:, :, None], 0.2, size=size, references=lines, reference_speed=speed)
    own = ("lane", "velref", "acc", "turnr")
    weights = {"lane": 0.3, "velref": 0.5, "acc": 1.0, "turnr": 10.0}
    parameters = GameParameters(
        own_weights={name: torch.full((batch, 1, 2), weights[name], dtype=torch.float64) for name in own},
        pair_weights={"proximity": torch.full((batch, 1, 1), 5.0, dtype=torch.float64)},
        initial_controls=torch.zeros(batch, 1, 2, horizon, 2, dtype=torch.float64),
        reference=torch.zeros(batch, 1, 2, dtype=torch.long),
    )
    return Game("lane_change", FeatureEnergy(own), scene, parameters, 0)


def lane_changes(device: torch.device, repeats: int, console: Console, batch: int = 1024, most: int = 80) -> None:
    """Games per second of lane changes, by the fewest adaptive steps that solve 99 % of them."""
    for horizon in (10, 20):
        game = lane_change(batch, horizon).to(device)
        for name in implementations(device):
            if name in ("peer", "graph", "pytorch"):
                continue
            for steps in (5, 10, 20, 40, 80):
                if steps > most:
                    continue
                layer = LevenbergMarquardt(steps, 1.0, 1.0, adaptive=True, backend=name)

                def action(layer: LevenbergMarquardt = layer, game: Game = game) -> Any:
                    with torch.no_grad():
                        solution = layer(game.energy, game.scene, game.parameters)
                    if device.type == "cuda":
                        torch.cuda.synchronize()
                    return solution

                try:
                    solved = (action().gradient_norm < STATIONARY).double().mean().item()
                except ValueError as reason:
                    console.print(f"{name}: left out, {reason}")
                    break
                if solved >= 0.99 or steps == most:
                    ms = milliseconds(action, repeats)
                    console.print(
                        f"lane change, T={horizon}, B={batch}, {name}: {solved:.1%} below a gradient of {STATIONARY:g} "
                        f"after {steps} adaptive steps, {ms:.2f} ms, {1e3 * batch / ms:,.0f} games/s"
                    )
                    break


def device_name(device: torch.device) -> str:
    """The name of a GPU, or of the kind of device."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def run(
    device: torch.device,
    settings: Sequence[str],
    batches: Sequence[int],
    repeats: int,
    path: Path | None,
    console: Console,
    **others: int | None,
) -> None:
    """Measure everything, and append a JSON line per timing."""
    for setting in settings:
        for timing in sizes(setting, batches, device, repeats, console, **others):
            if path is not None:
                with path.open("a") as file:
                    file.write(json.dumps(asdict(timing)) + "\n")
    lane_changes(device, repeats, console)


def require(name: str) -> torch.device:
    """The device of that name.

    Raises:
        SystemExit: this machine has none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise SystemExit(
            "--device cuda: PyTorch sees no GPU on this machine (torch.cuda.is_available() is False). Without --device, the "
            "layer is measured on the CPU"
        )
    return torch.device(name)
