"""Random games for the timings, from a fixed seed, in three families.

``exid``    merging vehicles on a highway. **Every pair overlaps at some steps of every problem**, so that no ratio profits
            from solvers that skip pairs which are apart.
``rpi``     a robot and a pedestrian that meet, with the features of ``conf/energy/rpi.yaml``; the pair overlaps as well.
``sparse``  vehicles spread along a road in couples: about one active neighbour each, for any number of vehicles.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import Scene

SETTINGS = ("exid", "rpi", "sparse")
HIGHWAY = ("goal", "lane", "velref", "vel", "acc", "jerk", "steer", "turnr", "turnacc")
"""The nine own features of the highway setting."""
SIZES = {
    "exid": {"B": 32, "M": 5, "N": 4, "K": 20, "S": 2},
    "rpi": {"B": 32, "M": 2, "N": 2, "K": 40, "S": 2},
    "sparse": {"B": 32, "M": 2, "N": 8, "K": 20, "S": 2},
}
"""Default numbers of scenes B, modes M, agents N, time steps K and solver steps S of every setting."""
LANE_WIDTH = 3.5
LANE_POINTS = 30


@dataclass(frozen=True)
class Game:
    """A batch of problems with the settings of the solver.

    Attributes:
        setting: one of :data:`SETTINGS`.
        energy, scene, parameters: the problems.
        steps, step_size, damping: of the solver.
    """

    setting: str
    energy: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    steps: int
    step_size: float = 0.3
    damping: float = 10.0

    @property
    def sizes(self) -> dict[str, int]:
        """B, M, N, K and S."""
        batch, modes, agents, horizon, _ = self.parameters.initial_controls.shape
        return {"B": batch, "M": modes, "N": agents, "K": horizon, "S": self.steps}

    def to(self, target: torch.dtype | torch.device | str) -> Game:
        """The same game on a device, or in another precision."""
        return dataclasses.replace(self, scene=self.scene.to(target), parameters=self.parameters.to(target))


def make(setting: str, seed: int = 0, **sizes: int | None) -> Game:
    """The game of a setting in float32; sizes B, M, N, K, S that are None are the setting's own.

    All numbers are drawn in float64 and from ``seed`` alone.

    Raises:
        ConfigError: an unknown setting or size, or a size that is too small.
    """
    if setting not in SETTINGS:
        raise ConfigError(f"unknown setting {setting!r}: {nearest(setting, SETTINGS)}")
    chosen = {**SIZES[setting], **{name: size for name, size in sizes.items() if size is not None}}
    for name, size in chosen.items():
        least = 2 if name == "K" else 1
        if name not in SIZES[setting] or size < least:
            raise ConfigError(f"{name} = {size}: a game takes B, M, N and S of at least 1, and K of at least 2")
    draw = torch.Generator().manual_seed(seed)
    batch, modes, agents, horizon, steps = (chosen[name] for name in "BMNKS")
    scene = (_walkers if setting == "rpi" else _vehicles)(batch, agents, horizon, setting == "sparse", draw)
    energy = _rpi_energy() if setting == "rpi" else FeatureEnergy(own=HIGHWAY)
    parameters = _parameters(energy, scene, modes, horizon, draw)
    return Game(setting, energy, scene, parameters, steps).to(torch.float32)


def activity(game: Game) -> tuple[float, float]:
    """Share of pairs that overlap at some step of a problem, and share of steps at which a pair overlaps."""
    parameters = game.parameters
    overlaps = game.energy.residuals(game.scene, parameters, parameters.initial_controls)["proximity"] != 0
    return overlaps.any(-1).float().mean().item(), overlaps.float().mean().item()


def _rpi_energy() -> FeatureEnergy:
    section = dict(compose("train", ["experiment=rpi/v_lstm_epo"])["energy"])
    del section["name"]
    return FeatureEnergy(**section)


def _between(low: float, high: float, *shape: int, draw: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, dtype=torch.float64, generator=draw)


def _vehicles(batch: int, agents: int, horizon: int, sparse: bool, draw: torch.Generator) -> Scene:
    """Vehicles at 20 to 30 m/s that all meet at one place; in ``sparse`` scenes, pairs of them at places 60 m apart."""
    dt = 0.2
    meeting = _between(0.4, 0.6, batch, 1, draw=draw) * horizon * dt
    if sparse:
        couple = torch.arange(agents) // 2
        speed = 25.0 + _between(-1.0, 1.0, batch, agents, draw=draw)
        place = 60.0 * couple.double()[None]
    else:
        order = torch.stack([torch.randperm(agents, generator=draw) for _ in range(batch)])
        speed = 20.0 + 10.0 * (order + _between(0.25, 0.75, batch, agents, draw=draw)) / agents
        place = torch.zeros(1, agents, dtype=torch.float64)
    # Merging: closer than the width of a lane, so that discs of half a vehicle's length overlap.
    side = torch.arange(agents) % 2 * 2.0 - 1.0 + _between(-0.2, 0.2, batch, agents, draw=draw)
    along = place - meeting * speed
    heading = _between(-0.002, 0.002, batch, agents, draw=draw)
    state = torch.stack((along, side, heading, speed), -1)
    ahead = torch.linspace(-20.0, 40.0 * horizon * dt, LANE_POINTS, dtype=torch.float64)
    lateral = LANE_WIDTH * torch.arange(-1, 2) + _between(-0.2, 0.2, batch, agents, 1, draw=draw)
    x = (along[..., None, None] + ahead).expand(-1, -1, 3, -1)
    references = torch.stack((x, lateral[..., None] + 1e-4 * ahead.square()), -1)  # lanes curve gently
    length = _between(4.0, 5.0, batch, agents, draw=draw)
    return Scene(
        history=state[:, :, None],
        dt=dt,
        size=torch.stack((length, torch.full_like(length, 1.9)), -1),
        references=references,
        reference_speed=speed + _between(-2.0, 2.0, batch, agents, draw=draw),
    )


def _walkers(batch: int, agents: int, horizon: int, _: bool, draw: torch.Generator) -> Scene:
    """Pedestrians at about 1 m/s that would meet about halfway."""
    dt = 0.1
    meeting = _between(0.4, 0.6, batch, 1, draw=draw) * horizon * dt
    speed = _between(0.8, 1.4, batch, agents, draw=draw)
    around = 2 * torch.pi * torch.arange(agents) / agents
    heading = around + _between(-0.5, 0.5, batch, agents, draw=draw)
    direction = torch.stack((heading.cos(), heading.sin()), -1)
    start = _between(-0.05, 0.05, batch, agents, 2, draw=draw) - (meeting * speed)[..., None] * direction
    state = torch.cat((start, heading[..., None], speed[..., None]), -1)
    return Scene(history=state[:, :, None], dt=dt, size=torch.full((batch, agents, 2), 0.5, dtype=torch.float64))


def _parameters(energy: FeatureEnergy, scene: Scene, modes: int, horizon: int, draw: torch.Generator) -> GameParameters:
    """Weights about one, goals near the positions reached at constant velocity, initial strategies near zero."""
    batch, agents = scene.agent_mask.shape
    speed = scene.current[..., 3]
    noise = torch.randn(batch, modes, agents, horizon, 2, dtype=torch.float64, generator=draw)
    direction = torch.stack((scene.current[..., 2].cos(), scene.current[..., 2].sin()), -1)
    ahead = scene.current[..., :2] + (speed * horizon * scene.dt)[..., None] * direction
    off = torch.randn(batch, modes, agents, 2, dtype=torch.float64, generator=draw)
    chosen = {}
    if "lane" in energy.own:
        chosen["reference"] = torch.randint(3, (batch, modes, agents), generator=draw)
    return GameParameters(
        own_weights={name: _between(0.5, 1.5, batch, modes, agents, draw=draw) for name in energy.own},
        pair_weights={"proximity": _between(2.0, 4.0, batch, modes, agents * (agents - 1) // 2, draw=draw)},
        # Turn rates scale with 1 / speed, so that lateral accelerations are alike.
        initial_controls=0.3 * noise * torch.stack((torch.ones_like(speed), 1 / (1 + speed)), -1)[:, None, :, None],
        goals=ahead[:, None] + off * (0.03 * speed * horizon * scene.dt)[:, None, :, None],
        **chosen,
    )
