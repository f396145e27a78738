"""The worlds of ``epo drive`` by name: their kinds of episodes, and the runs that can drive in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from epo_lightning.checks import check_choice
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.drive.rpi import PEDESTRIANS, RPIWorld
from epo_lightning.drive.world import World
from epo_lightning.registry import ConfigError
from epo_lightning.schema import read

CONSTANT_VELOCITY, BEST_RESPONSE, JOINT, DRIVER = "constant_velocity", "best_response", "joint", "driver"


@dataclass(frozen=True)
class WorldEntry:
    """A world as ``epo drive`` knows it.

    Attributes:
        kinds: kinds of its episodes, the values of ``others``.
        make: function from the number of episodes, their seed and their kind to the world.
        refuse: function from the configuration of a run's data to the reason why the run cannot drive here; None if it can.
        baselines: titles of the planners that need no run, by their names in ``baselines``.
    """

    kinds: tuple[str, ...]
    make: Callable[[int, int, str], World]
    refuse: Callable[[Mapping[str, Any]], str | None]
    baselines: Mapping[str, str]

    def check_kinds(self, world: str, kinds: tuple[str, ...]) -> None:
        """Refuse kinds of episodes that are unknown or named twice.

        Raises:
            ConfigError: the message names the kind, and the nearest known one.
        """
        for kind in kinds:
            check_choice("others", kind, self.kinds, f"world={world}")
            if kinds.count(kind) > 1:
                raise ConfigError(f"others names {kind!r} twice: name each kind of others once")


def _of_rpi(data: Mapping[str, Any]) -> str | None:
    return None if data["name"] == "rpi" else "takes runs of data=rpi, such as rpi/v_lstm_epo"


def _of_roads(data: Mapping[str, Any]) -> str | None:
    """The reason why a forecaster cannot read scenes that are made with the paper's windows of recordings with a map."""
    wanted = "takes runs of recorded traffic with a map, such as highway_sim/hivt_m_epo"
    if "windows" not in data or not data.get("map", True):
        return wanted
    own, paper = read(WindowConfig, data["windows"], "data.windows"), WindowConfig()
    for name in ("dt", "history", "horizon", "agents", "lanes", "lines"):
        if getattr(own, name) != getattr(paper, name):
            return f"{wanted}, with data.windows.{name}={getattr(paper, name)}, not {getattr(own, name)}"
    frame = data.get("frame", "aligned")
    return None if frame == "aligned" else f"{wanted}, with data.frame=aligned, not {frame}"


def _sumo(episodes: int, seed: int, kind: str) -> World:
    from epo_lightning.drive.sumo import sumo_world  # the extra `sim`

    return sumo_world(episodes, seed, kind)


def _highway_env(episodes: int, seed: int, kind: str) -> World:
    from epo_lightning.drive.highway_env import highway_env_world  # the extra `drive`

    return highway_env_world(episodes, seed, kind)


_ASSUMED = {
    CONSTANT_VELOCITY: "response to constant velocity",
    BEST_RESPONSE: "iterated best response, assumed game",
    JOINT: "assumed game",
}
WORLDS: Mapping[str, WorldEntry] = {
    "rpi": WorldEntry(
        kinds=PEDESTRIANS,
        make=RPIWorld,
        refuse=_of_rpi,
        baselines={
            CONSTANT_VELOCITY: "response to constant velocity",
            BEST_RESPONSE: "iterated best response, true game",
            JOINT: "true game",
        },
    ),
    "sumo": WorldEntry(
        kinds=("dense", "free"),
        make=_sumo,
        refuse=_of_roads,
        baselines={DRIVER: "SUMO's driver", **_ASSUMED},
    ),
    "highway_env": WorldEntry(
        kinds=("merge", "roundabout"),
        make=_highway_env,
        refuse=_of_roads,
        baselines={DRIVER: "highway-env's driver", **_ASSUMED},
    ),
}
"""The worlds by their names in ``world``."""


def world_entry(world: str) -> WorldEntry:
    """A world by name.

    Raises:
        ConfigError: the message names the nearest known one.
    """
    check_choice("world", world, WORLDS)
    return WORLDS[world]
