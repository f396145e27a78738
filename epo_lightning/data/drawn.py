"""Random scenes in memory, for time measurements, smoke tests and checks without a data set.

Tables of records are drawn at random, and the classes of the real data
(:class:`~epo_lightning.data.rpi.scenes.RPIDataset`, :class:`~epo_lightning.data.recorded.scenes.RecordedScenes`) make scenes
of them, so all shapes are those of real scenes. A model cannot learn anything useful from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from epo_lightning.checks import check_choice
from epo_lightning.data import cache
from epo_lightning.data.cache import SPLITS
from epo_lightning.data.datamodule import SceneDataModule, SceneDataset
from epo_lightning.data.recorded.routes import (
    ACCELERATING,
    BEHIND,
    BEYOND,
    BRAKING,
    LINES,
    PER_LINE,
    POINTS,
    SPACING,
    VECTORS,
)
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.windows import MOST_AGENTS, WindowConfig
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.metrics.functional.interaction import SUBSETS
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import KINDS, heading_vector
from epo_lightning.task import Task

VERSION = 1
"""Version of the draws: raised whenever the same seed would give other scenes."""
LANE_WIDTH, LANES = 3.5, 4
"""Width [m] and number of the road's lanes."""
DRAWN_LANES = 32
"""Number of lane polylines of a scene."""
HEADWAY = 25.0
"""Mean distance [m] from a vehicle to the next one on its lane."""


@dataclass(frozen=True)
class Preset:
    """Sizes of one sort of random scenes (RPI, highway, pedestrians), and the function that draws their tables.

    Attributes:
        agents: default number of agents.
        task: sizes and units, those of the real data.
        tables: function from (scenes, agents, preset, generator) to the columns of records of this task.
    """

    agents: int
    task: Task
    tables: Callable[[int, int, Preset, torch.Generator], dict[str, Tensor]]

    @property
    def history(self) -> int:
        """Number H of observed steps."""
        assert self.task.history is not None
        return self.task.history

    @property
    def time(self) -> Tensor:
        """Times of the steps of history and future [s]; the last step of the history is at zero."""
        return self.task.dt * torch.arange(1 - self.history, self.task.horizon + 1, dtype=torch.float64)


def _between(low: float, high: float, *shape: int, draw: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, dtype=torch.float64, generator=draw)


def _curves(start: Tensor, heading: Tensor, speed: Tensor, turn: Tensor, time: Tensor) -> Tensor:
    """States [.., time, 4] of agents that move on circles; ``start`` is their position at time zero."""
    angle = heading[..., None] + turn[..., None] * time
    # Length of the chord of an arc; the formula also holds for a straight line.
    half = 0.5 * turn[..., None] * time
    chord = speed[..., None] * time * torch.sinc(half / torch.pi)
    middle = heading[..., None] + half
    x, y = start[..., 0, None] + chord * middle.cos(), start[..., 1, None] + chord * middle.sin()
    return torch.stack((x, y, angle, speed[..., None].expand_as(angle)), -1)


def _walkers(scenes: int, agents: int, preset: Preset, draw: torch.Generator, apart: float) -> Tensor:
    """States [scenes, agents, H + K, 4] of agents that all pass a common point at a distance of about ``apart`` [m]."""
    speed = _between(0.7, 1.5, scenes, agents, draw=draw)
    heading = _between(-torch.pi, torch.pi, scenes, agents, draw=draw)
    turn = _between(-0.1, 0.1, scenes, agents, draw=draw)
    half = 0.5 * preset.task.horizon * preset.task.dt
    way = heading_vector(heading)
    start = _between(-apart, apart, scenes, agents, 2, draw=draw) - half * speed[..., None] * way
    return _curves(start, heading, speed, turn, preset.time)


def _rpi(scenes: int, agents: int, preset: Preset, draw: torch.Generator) -> dict[str, Tensor]:
    """Records with two modes each: both agents meet, and continue with different turn rates in each mode."""
    states = _walkers(scenes, agents, preset, draw, apart=0.5)
    history, now = states[:, :, : preset.history], states[:, :, preset.history - 1]
    turn = _between(-0.1, 0.1, scenes, 2, agents, draw=draw)
    start, heading, speed = (
        now[:, None, :, part].expand(-1, 2, *[-1] * dims) for part, dims in ((slice(2), 2), (2, 1), (3, 1))
    )
    futures = _curves(start, heading, speed, turn, preset.time[preset.history :])
    return {
        "history": history.float(),
        "goals": futures[:, 0, :, -1, :2].float(),
        "goal_headings": futures[:, 0, :, -1, 2].float(),
        "game_steps": torch.full((scenes,), preset.task.horizon),
        "states": futures.float(),
        "modes": torch.full((scenes,), 2),
    }


def _recorded(states: Tensor, present: Tensor, preset: Preset, draw: torch.Generator) -> dict[str, Tensor]:
    """The columns of scene tables without a map; every agent of every scene has its own row."""
    scenes, agents = present.shape
    rows = states.flatten(0, 1).float()
    history, future = rows[:, : preset.history], rows[:, preset.history :]
    member = torch.arange(scenes * agents, dtype=torch.int32).view(scenes, agents)
    return {
        "history": history,
        "history_mask": torch.ones(history.shape[:2], dtype=torch.bool),
        "future": future,
        "future_mask": torch.ones(future.shape[:2], dtype=torch.bool),
        "track": torch.arange(len(rows)),
        "polylines": torch.zeros(0, VECTORS + 1, 2, dtype=torch.float64),
        "agents": member.where(present, -1).int(),
        "lanes": torch.zeros(scenes, 0, dtype=torch.int32),
        "centre": torch.zeros(scenes, 2, dtype=torch.float64),
        "direction": torch.zeros(scenes, dtype=torch.float64),
        "recording": torch.zeros(scenes, dtype=torch.int32),
        "frame": torch.arange(scenes),
        "origin": torch.zeros(1, 2, dtype=torch.float64),
    }


def _pedestrians(scenes: int, agents: int, preset: Preset, draw: torch.Generator) -> dict[str, Tensor]:
    """Columns of scenes with at least two pedestrians each."""
    states = _walkers(scenes, agents, preset, draw, apart=3.0)
    count = torch.randint(min(2, agents), agents + 1, (scenes, 1), generator=draw)
    rows = scenes * agents
    return {
        **_recorded(states, torch.arange(agents) < count, preset, draw),
        "size": torch.full((rows, 2), 0.5),
        "kind": torch.full((rows,), KINDS.index("pedestrian")),
    }


def _highway(scenes: int, agents: int, preset: Preset, draw: torch.Generator) -> dict[str, Tensor]:
    """Columns of scenes on a straight road, with vehicles one behind the other; about a third of them change lane."""
    rows, time = scenes * agents, preset.time
    order = torch.rand(scenes, agents, dtype=torch.float64, generator=draw).argsort(1)
    lane, place = order % LANES, order // LANES
    along = HEADWAY * (place - 0.5 * ((agents - 1) // LANES)) + _between(-5.0, 5.0, scenes, agents, draw=draw)
    # Vehicles on the same lane have similar speeds.
    pace = _between(22.0, 33.0, scenes, LANES, draw=draw).gather(1, lane)
    speed = pace + _between(-1.0, 1.0, scenes, agents, draw=draw)
    acceleration = _between(-0.5, 0.5, scenes, agents, draw=draw)
    side = torch.randint(-1, 2, (scenes, agents), generator=draw)
    side = side.where(torch.rand(scenes, agents, generator=draw) < 0.5, 0)
    side = ((lane + side).clamp(0, LANES - 1) - lane) * LANE_WIDTH
    length = 4.0  # [s] that a change takes
    begin = _between(-length / 2, length / 2, scenes, agents, draw=draw)
    share = ((time - begin[..., None]) / length).clamp(0.0, 1.0)
    x = along[..., None] + speed[..., None] * time + 0.5 * acceleration[..., None] * time**2
    y = LANE_WIDTH * lane[..., None] + side[..., None] * 0.5 * (1.0 - (torch.pi * share).cos())
    forwards = speed[..., None] + acceleration[..., None] * time
    sideways = side[..., None] * 0.5 * torch.pi / length * (torch.pi * share).sin()
    states = torch.stack((x, y, torch.atan2(sideways, forwards), torch.hypot(forwards, sideways)), -1)

    now, pace = states[:, :, preset.history - 1].flatten(0, 1), speed.flatten()
    until = preset.task.horizon * preset.task.dt
    far = pace * until + 0.5 * ACCELERATING * until**2
    near = pace * until - 0.5 * BRAKING * until**2
    middle = LANE_WIDTH * (lane.flatten()[:, None] + torch.arange(1, -2, -1))  # left, own, right

    def lines(start: Tensor, end: Tensor, points: int) -> Tensor:
        """Points [rows, R, points, 2] on every vehicle's three lines, from ``start`` to ``end`` [m] ahead of it."""
        ahead = start[:, None] + (end - start)[:, None] * torch.linspace(0.0, 1.0, points, dtype=torch.float64)
        x = (now[:, :1] + ahead)[:, None].expand(-1, LINES, -1)
        return torch.stack((x, middle[..., None].expand_as(x)), -1).float()

    pieces = DRAWN_LANES // LANES
    across = LANE_WIDTH * torch.arange(LANES, dtype=torch.float64).repeat_interleave(pieces)
    reach = SPACING * VECTORS * (torch.arange(pieces + 1) - pieces // 2 + 1.0)
    ends = torch.stack((reach[:-1], reach[1:]), 1).repeat(LANES, 1)
    points = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * torch.linspace(0.0, 1.0, VECTORS + 1)
    truck = torch.rand(rows, generator=draw) < 0.2
    return {
        **_recorded(states, torch.ones(scenes, agents, dtype=torch.bool), preset, draw),
        "size": torch.where(truck[:, None], torch.tensor([12.0, 2.5]), torch.tensor([4.6, 1.9])),
        "kind": torch.where(truck, KINDS.index("truck"), KINDS.index("car")),
        "candidates": lines(near, far, PER_LINE).flatten(1, 2),
        "references": lines(torch.full_like(far, -BEHIND), far + BEYOND, POINTS),
        "reference_speed": (pace + 2.0).float(),
        "polylines": torch.stack((points.double(), across[:, None].expand(-1, VECTORS + 1)), -1),
        "lanes": torch.arange(len(points), dtype=torch.int32).expand(scenes, -1),
    }


HIGHWAY = Preset(
    WindowConfig.agents,
    Task(
        WindowConfig.horizon,
        WindowConfig.dt,
        SUBSETS,
        shape="box",
        candidates=LINES * PER_LINE,
        map=True,
        scale=20.0,
        history=WindowConfig.history,
    ),
    _highway,
)

LIKE: Mapping[str, Preset] = {
    "rpi": Preset(RPIData.num_agents, RPIData.task, _rpi),
    "highway": HIGHWAY,
    "urban": HIGHWAY,
    "pedestrians": Preset(4, Task(12, 0.4, SUBSETS, candidates=0, scale=5.0, history=8), _pedestrians),
}
"""The sorts of random scenes, by the name in ``data.like``."""


@register("data", "drawn")
class DrawnData(SceneDataModule):
    """Scenes drawn in memory, with the shapes of a task.

    Args:
        like: ``rpi`` (two discs with given goals), ``highway`` or ``urban`` (vehicles, lanes and goal candidates) or
            ``pedestrians`` (no map, no goals).
        agents: number per scene; None for that of the task.
        scenes: number per split.
        seed: seed of the random scenes, and of the order of batches unless a run sets its own.
        batch_size: scenes per batch.
    """

    def __init__(
        self, like: str = "highway", agents: int | None = None, scenes: int = 256, seed: int = 0, batch_size: int = 32
    ) -> None:
        super().__init__(batch_size, seed)
        check_choice("data.like", like, LIKE)
        self.like, self.preset = like, LIKE[like]
        if agents is not None and not 1 <= agents <= MOST_AGENTS:
            raise ConfigError(f"data.agents must be between 1 and {MOST_AGENTS}, or null for the task's, not {agents}")
        if scenes < 1:
            raise ConfigError(f"data.scenes must be 1 or more, not {scenes}")
        self.num_agents, self.scenes = self.preset.agents if agents is None else agents, scenes
        self.task, self.history = self.preset.task, self.preset.history

    @property
    def digest(self) -> str:
        """Hash of what the scenes are drawn from."""
        drawn = {"drawn": VERSION, "like": self.like, "agents": self.num_agents, "scenes": self.scenes}
        return cache.digest({**drawn, "seed": self.seed})[:16]

    def generate(self, workers: int | None = None, progress: bool = True) -> Path:
        """Refuse: drawn scenes are never written.

        Raises:
            ConfigError: always; it names what to do instead.
        """
        raise ConfigError(
            "data=drawn is drawn in memory, there is nothing to generate: use it with `epo train data=drawn`"
        )

    def open(self, split: str) -> SceneDataset:
        """The scenes of a split."""
        draw = torch.Generator().manual_seed(len(SPLITS) * self.seed + SPLITS.index(split))
        if self.like == "rpi":
            # Every record becomes two scenes, one per mode.
            tables = self.preset.tables(-(-self.scenes // 2), self.num_agents, self.preset, draw)
            return RPIDataset(tables, seed=self.seed)
        tables = self.preset.tables(self.scenes, self.num_agents, self.preset, draw)
        shape = None if split == "train" else self.task.shape
        return RecordedScenes(tables, self.task.dt, "aligned", [split], shape)
