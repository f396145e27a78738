"""Scenes of vehicles on a map, in the format of recorded data: forecasters that learned on recordings can read them."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.routes import Routes, pieces
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.surroundings import nearest_pieces
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.windows import AGREE, SPACING, VECTORS, WindowConfig
from epo_lightning.scene import HEADING, SPEED, Scene


class RoadScenes:
    """Scenes as :func:`~epo_lightning.data.recorded.windows.extract` and
    :class:`~epo_lightning.data.recorded.scenes.RecordedScenes` make them, one at a time and without a future.

    Args:
        lanes: the map.
        windows: settings of the windows, those of the forecasters' data.
    """

    def __init__(self, lanes: LaneGraph, windows: WindowConfig) -> None:
        self.lanes, self.windows = lanes, windows
        self._routes = Routes(lanes)
        self._pieces = pieces(lanes, VECTORS, SPACING)

    def on_lanes(self, states: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
        """Mask of the vehicles that are on a lane of the map; only these can be in a scene."""
        return self.lanes.locate(states[:, :2], states[:, HEADING]).lane >= 0

    def __call__(
        self,
        history: Float[np.ndarray, "N H 4"],
        history_mask: Bool[np.ndarray, "N H"],
        agent_mask: Bool[np.ndarray, " N"],
        size: Float[np.ndarray, "N 2"],
        kind: Int[np.ndarray, " N"],
    ) -> Scene:
        """The scene of some vehicles, of which those that are there are on lanes.

        Args:
            history: states x, y [m], heading [rad], speed [m/s]; the last step is the current one.
            history_mask: steps at which a vehicle was observed.
            agent_mask: vehicles that are there.
            size: length and width [m].
            kind: classes of the vehicles, indices into :data:`~epo_lightning.scene.KINDS`.
        """
        there = np.flatnonzero(agent_mask)
        now = history[there, -1]
        here = self.lanes.locate(now[:, :2], now[:, HEADING])
        route = self._routes.of(now[:, :2], now[:, SPEED], here, self.windows.horizon * self.windows.dt)
        limit = self.lanes.speed_limit[here.lane]
        centre = now[:, :2].mean(0)
        ahead = np.array([np.cos(now[:, HEADING]).mean(), np.sin(now[:, HEADING]).mean()])
        scattered = np.linalg.norm(ahead) < AGREE
        origin = np.floor(centre)
        turns = 2 * np.pi * np.round(now[:, HEADING] / (2 * np.pi))
        past = (
            history[there]
            - np.concatenate([np.tile(origin, (len(there), 1)), turns[:, None], 0 * turns[:, None]], 1)[:, None]
        )
        place = np.full(len(agent_mask), -1, dtype=np.int32)
        place[there] = np.arange(len(there))
        steps = (len(there), self.windows.horizon)
        tables = SceneTables(
            history=np.where(history_mask[there][..., None], past, 0.0).astype(np.float32),
            history_mask=history_mask[there],
            future=np.zeros((*steps, 4), dtype=np.float32),
            future_mask=np.zeros(steps, dtype=bool),
            size=size[there].astype(np.float32),
            kind=kind[there],
            track=there,
            candidates=(route.candidates - origin).astype(np.float32),
            references=(route.references - origin).astype(np.float32),
            reference_speed=np.where(np.isnan(limit), self.windows.speed_limit, limit).astype(np.float32),
            polylines=self._pieces - origin,
            agents=place[None],
            lanes=nearest_pieces(self._pieces, centre[None], self.windows.lanes or len(self._pieces)),
            centre=(centre - origin)[None],
            direction=np.array([now[0, HEADING] if scattered else np.arctan2(ahead[1], ahead[0])]),
            recording=np.zeros(1, dtype=np.int32),
            frame=np.zeros(1, dtype=np.int64),
            origin=origin[None],
        )
        columns = {name: torch.as_tensor(values) for name, values in tables.columns().items()}
        scene = RecordedScenes(columns, self.windows.dt, "aligned", ("",))[torch.zeros(1, dtype=torch.long)]
        return dataclasses.replace(scene, future=None, future_mask=None, id=None)
