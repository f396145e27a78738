"""The fused backend in NVIDIA Warp: one launch takes all steps of all games, and another one computes their adjoint.

A game is solved by one warp of a GPU, or by four if there are few games; see
:mod:`~epo_lightning.solvers.gauss_newton.fused_kernel`. The same source is compiled for CPUs, where it is meant for tests.
The host never waits: statuses stay on the device, and after a first call (which compiles the kernels) a call can be captured
in a CUDA graph. ``pip install 'epo_lightning[gpu]'`` brings Warp; it is imported when this backend is first used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.backends import kernel_games
from epo_lightning.solvers.gauss_newton.backends.recorded_steps import take_steps
from epo_lightning.solvers.gauss_newton.kernel.interface import SIGNALS
from epo_lightning.warp_kernels import described, installed, launch, warp

if TYPE_CHECKING:
    from epo_lightning.solvers.gauss_newton.fused_kernel.features import Features
    from epo_lightning.solvers.gauss_newton.fused_kernel.layout import Fast

SIZES = (2, 4, 8)
"""Numbers of agents up to which there are kernels, each with matrices of its own size in shared memory and registers."""
FEW = 2 * 132
"""Games of a launch up to which each has four warps: two for a multiprocessor of an H100 or H200."""
MULTIPROCESSORS = 132
"""Of an H100 or H200."""
LONGEST = 2**31 - 1
"""Largest number of entries of an array of Warp."""


def obstacle(energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> str | None:
    """Reason why the fused kernels cannot solve a game; None where they can."""
    controls = parameters.initial_controls
    if not installed():
        return "the fused layer needs NVIDIA Warp: pip install 'epo_lightning[gpu]'"
    if controls.device.type not in ("cpu", "cuda"):
        return f"the fused layer runs on CUDA devices and CPUs, and these tensors are on {controls.device}"
    reason = kernel_games.unknown(energy, scene, parameters, SIZES[-1], "the fused layer")
    if reason is not None:
        return reason
    lines = scene.references if "lane" in energy.own else None
    if max(2 * controls.numel(), 0 if lines is None else lines.numel()) > LONGEST:
        return "the fused layer counts states and points of lines in 32 bits, and this batch has too many: split it"
    return None


def solve(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    keep_iterates: bool = False,
    exact: bool = False,
) -> Solution:
    """S damped Gauss-Newton steps, as :func:`epo_lightning.solvers.gauss_newton.backends.pytorch.solve` takes them.

    The solution is differentiable with respect to weights, margins, goals, their headings, reference controls and
    initial controls.

    Raises:
        ValueError: ``exact``: these kernels have no Newton steps.
    """
    if exact:
        raise ValueError(
            "solver.backend is 'warp', which has no Newton steps; 'compiled', 'host' (on a GPU) and 'pytorch' have them"
        )
    call = _Call(energy, scene, parameters, steps, step_size, damping, keep_iterates)
    return take_steps(call, parameters.initial_controls)


def kernels(
    dtype: torch.dtype, agents: int, steps: int, games: int, device: torch.device, features: Features
) -> SimpleNamespace:
    """The kernels for a type of numbers and a number of agents and, on GPUs, for features, steps and the number of games."""
    warp()
    from epo_lightning.solvers.gauss_newton.fused_kernel.constants import TEAM, WARP
    from epo_lightning.solvers.gauss_newton.fused_kernel.kernels import make

    double, size = dtype == torch.float64, size_for(agents)
    if device.type != "cuda":
        return make(double, size)
    return make(double, size, features, steps, TEAM if games <= FEW else WARP)


def resident(fast: Fast, dtype: torch.dtype) -> int:
    """Blocks of a launch: as many as an H100 or H200 holds at a time. Each solves several games in turn, in the same memory.

    A block also takes some integers, and 1 kB more than it asks for, of the 228 kB that a multiprocessor has.
    """
    shared = 1280 + fast.numbers * dtype.itemsize * int(fast.shared)
    return MULTIPROCESSORS * min(16, 228 * 1024 // shared)


def size_for(agents: int) -> int:
    """The number of agents of the kernels that solve games of ``agents`` agents."""
    return next(size for size in SIZES if agents <= size)


class _Call:
    """One call of the kernels: the tensors that they read and write, and the structures that describe them."""

    def __init__(
        self,
        energy: FeatureEnergy,
        scene: Scene,
        parameters: GameParameters,
        steps: int,
        step_size: float,
        damping: Tensor,
        keep_iterates: bool,
    ) -> None:
        from epo_lightning.solvers.gauss_newton.fused_kernel.features import Features

        controls = parameters.initial_controls
        self.steps, self.keep_iterates, self.dtype = steps, keep_iterates, controls.dtype
        self.shape = tuple(controls.shape)
        self.own = [parameters.own_weights[name] for name in energy.own]
        self.pair = [parameters.pair_weights[name] for name in energy.pair]
        self.margins = [parameters.margins[name] for name in energy.decoded_margins]
        self.targets: dict[str, Tensor] = {name: getattr(parameters, name) for name in energy.targets}
        self.inputs = (*self.own, *self.pair, *self.margins, *self.targets.values())
        self.record = torch.is_grad_enabled() and any(x.requires_grad for x in (controls, *self.inputs))
        coupled = energy.pair if self.shape[2] > 1 else ()
        fixed = [name for name in coupled if name in energy.margins]
        self.features = Features(tuple(energy.own), tuple(coupled), (*energy.decoded_margins, *fixed))
        games = self.shape[0] * self.shape[1]
        self.kernels = kernels(self.dtype, self.shape[2], self.shape[3], games, controls.device, self.features)
        with torch.no_grad():
            self.kept: list[Tensor] = []
            self._describe(energy, scene, parameters, step_size, damping)
            self._reserve(controls)

    def _read(self, name: str, tensor: Tensor, dtype: torch.dtype | None = None) -> None:
        """Have the kernels read a tensor, which lives as long as this call."""
        tensor = tensor.detach().to(self.dtype if dtype is None else dtype).contiguous()
        self.kept.append(tensor)
        _point(self.game, **{name: tensor})

    def _describe(
        self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters, step_size: float, damping: Tensor
    ) -> None:
        """Fill the kernels' description of the games."""
        batch, modes, agents, horizon, _ = self.shape
        game = self.game = self.kernels.Game()
        game.G, game.M, game.N, game.K = batch * modes, modes, agents, horizon
        game.dt, game.step_size = scene.dt, step_size
        game.own_count, game.pair_count = len(self.features.own), len(self.features.pair)
        game.pair_stride, game.slides = min(energy.pair_stride, horizon + 1), int(energy.lane_slides)
        game.own_slot = type(game.own_slot)(*self.features.own_slots)
        game.pair_feature = type(game.pair_feature)(*self.features.pair_features)
        game.margin_slot = type(game.margin_slot)(*self.features.margin_slots)
        bounds = [0.0] * (2 * len(SIGNALS))
        for index, name in enumerate(SIGNALS):
            if not isinstance(bound := energy.bounds.get(name, {}), Mapping):
                bounds[2 * index : 2 * index + 2] = bound
        game.bounds = type(game.bounds)(*bounds)
        self._read("initial", scene.current)
        self._read("present", scene.agent_mask.view(torch.uint8), torch.uint8)
        size = scene.current.new_zeros(batch, agents, 2) if scene.size is None else scene.size
        self._read("size", size)
        self._read("own", _stacked(self.own) if self.own else size)
        if self.features.pair:
            self._read("pair", _stacked(self.pair))
            pairs = (batch, modes, agents * (agents - 1) // 2)
            fixed = self.features.margins[len(self.margins) :]
            margins = [*self.margins, *(energy.margin(scene, parameters, name).expand(pairs) for name in fixed)]
            if margins:
                self._read("margins", _stacked([margin.to(self.dtype) for margin in margins]))
        for name, tensor in self.targets.items():
            self._read(name, tensor)
        if scene.game_steps is not None:
            game.cut = 1
            self._read("ends", scene.game_steps, torch.int64)
        if "lane" in energy.own:
            assert scene.references is not None
            assert scene.reference_mask is not None
            assert parameters.reference is not None
            references = scene.references.contiguous()
            # The kernels read points as pairs of numbers, which a view may begin in the middle of.
            aligned = references.data_ptr() % (2 * references.element_size()) == 0
            self._read("references", references if aligned else references.clone())
            self._read("exists", scene.reference_mask.view(torch.uint8), torch.uint8)
            self._read("reference", parameters.reference, torch.int64)
            game.lines, game.points = scene.references.shape[2:4]
        if "velref" in energy.own:
            assert scene.reference_speed is not None
            self._read("speeds", scene.reference_speed)
        self._read("damping", damping)
        game.damping_of_game, game.damping_of_agent = (agents, 1) if damping.dim() == 3 else (1, 0)

    def _reserve(self, controls: Tensor) -> None:
        """Allocate what the kernels write: results, and what the adjoint reads of all steps if they are recorded."""
        from epo_lightning.solvers.gauss_newton.fused_kernel.layout import factor_numbers, layout

        batch, modes, agents, horizon, _ = shape = self.shape
        games, new = batch * modes, controls.new_empty
        stacked = self.record or self.keep_iterates
        self.blocks = min(games, resident(self.kernels.fast, self.dtype)) if controls.device.type == "cuda" else 1
        stages, slots = (self.steps, games) if self.record else (1, self.blocks)
        self.iterates = new((self.steps + 1 if stacked else 1, *shape))
        self.directions = new((max(self.steps, 1) if self.record else 1, *shape))
        self.states: Tensor | None = new((*shape[:-1], 4))
        self.initial_energy, self.energy, self.gradient_norm = new((3, batch, modes)).unbind(0)
        self.status = torch.empty(shape[:2], dtype=torch.int64, device=controls.device)
        self.factors = new(max(stages, 1) * slots * factor_numbers(size_for(agents)) * horizon)
        self.nearest = new(int(self.record) * stages * slots * 4 * agents * (horizon + 1))
        self.taken = torch.empty(max(stages, 1) * games, dtype=torch.int32, device=controls.device)
        self.start = controls.detach().contiguous()
        fast = self.kernels.fast
        places = layout(size_for(agents), horizon, self.game.own_count, self.game.pair_count, fast)
        self.memory = places.numbers
        run = self.arguments = self.kernels.Run()
        run.steps, run.record, run.blocks, run.slots = self.steps, int(self.record), self.blocks, slots
        for name, place in asdict(places).items():
            setattr(run.at, name, place)
        run.iterate_stride = controls.numel() if stacked else 0
        run.direction_stride = controls.numel() if self.record else 0
        arrays = (
            "start",
            "iterates",
            "directions",
            "states",
            "initial_energy",
            "energy",
            "gradient_norm",
            "status",
            "factors",
            "nearest",
            "taken",
        )
        _point(run, **{name: getattr(self, name) for name in arrays})

    def _launch(self, kernel: Any, *inputs: Any) -> None:
        """Launch a kernel on PyTorch's current stream, with memory for its blocks."""
        device = self.iterates.device
        work = self.iterates.new_empty(self.blocks * self.memory)
        numbers = torch.empty(self.blocks * (4 * self.shape[2] + 2), dtype=torch.int32, device=device)
        _point(self.arguments, work=work, numbers=numbers)
        launch(kernel, self.blocks, self.kernels.threads, [self.game, self.arguments, *inputs], device)

    def run(self) -> None:
        """Take all steps; fills the results."""
        self._launch(self.kernels.solve)

    def differentiate(self, controls: Tensor, iterates: Tensor | None, states: Tensor | None) -> list[Tensor | None]:
        """Gradients by ``inputs``, for cotangents of the final controls, of all iterates and of the states.

        ``controls`` is overwritten: on return it holds the gradient by the initial controls.
        """
        batch, modes, agents = self.shape[:3]
        new = controls.new_zeros
        own = new((max(len(self.own), 1), batch, modes, agents))
        pairs = (batch, modes, agents * (agents - 1) // 2)
        pair, margins = new((len(self.pair), *pairs)), new((len(self.margins) + len(self.pair), *pairs))
        targets = {name: new(tensor.shape) for name, tensor in self.targets.items()}
        by = self.kernels.Gradients()
        _point(by, controls=controls, own=own, pair=pair, margins=margins, iterates=iterates, states=states, **targets)
        by.along_iterates, by.along_states = int(iterates is not None), int(states is not None)
        self._launch(self.kernels.differentiate, by)
        count = len(self.own)
        found = [*own[:count].unbind(0), *pair.unbind(0), *margins[: len(self.margins)].unbind(0)]
        return [*found, *targets.values()]


def _stacked(tensors: list[Tensor]) -> Tensor:
    """The tensors one after the other; a single one is not copied."""
    return torch.stack(tensors) if len(tensors) > 1 else tensors[0]


def _point(structure: Any, **tensors: Tensor | None) -> None:
    """Point arrays of a structure of Warp to the memory of contiguous tensors, whose owner keeps them.

    Tensors that may be larger than Warp's arrays (iterates, factors, memory) are cut short: the kernels find their parts by
    pointers.
    """
    fields = structure.__ctype__()
    for name, tensor in tensors.items():
        if tensor is not None and tensor.numel():
            flat = tensor.view(-1)[:LONGEST]
            setattr(fields, name, described(flat))
