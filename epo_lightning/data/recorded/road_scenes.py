"""Scenes of vehicles on a map of one's own, as recordings would give them, so that trained forecasters can read them."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from epo_lightning.data.recorded.assembling import common_axes
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.routes import Routes, pieces
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.surroundings import nearest_pieces
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.scene import HEADING, SPEED, Scene


class RoadScenes:
    """Scenes as :func:`~epo_lightning.data.recorded.windows.extract` and
    :class:`~epo_lightning.data.recorded.scenes.RecordedScenes` make them, without a future.

    A call returns lanes, reference lines and goal candidates (Appendix E.1) of the given vehicles, in the axes that
    forecasters of highways read: x along the mean heading of the vehicles, and the origin at their mean position.
    ``scene.frame`` leads back to the map (:func:`~epo_lightning.frames.in_world`).

    Args:
        lanes: the map.
        windows: settings of the windows, those of the forecasters' data; by default those of exiD and of simulated highways.
            With ``lanes=None``, a scene has all lanes of the map.

    Raises:
        ValueError: windows with a number of reference lines (``lines``), as forecasters of junctions have it.
    """

    def __init__(self, lanes: LaneGraph, windows: WindowConfig | None = None) -> None:
        self.lanes, self.windows = lanes, windows or WindowConfig()
        if self.windows.lines is not None:
            raise ValueError(
                f"windows.lines is {self.windows.lines}: lines through junctions are made of recordings only"
            )
        self._routes = Routes(lanes)
        self._pieces = pieces(lanes)

    def on_lanes(self, states: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
        """Mask of the vehicles that are on a lane of the map; only these can be in a scene."""
        states = np.asarray(states, dtype=float)
        return self.lanes.locate(states[:, :2], states[:, HEADING]).lane >= 0

    def __call__(
        self,
        history: Float[np.ndarray, "B N H 4"],
        size: Float[np.ndarray, "B N 2"],
        history_mask: Bool[np.ndarray, "B N H"] | None = None,
        agent_mask: Bool[np.ndarray, "B N"] | None = None,
        kind: Int[np.ndarray, "B N"] | None = None,
        framed: int | None = None,
        on_lanes_only: bool = True,
    ) -> Scene:
        """The scenes of some vehicles.

        Args:
            history: states x, y [m], heading [rad], speed [m/s] in the coordinates of the map, ``windows.dt`` apart; the
                last step is the current one.
            size: length and width [m].
            history_mask: steps at which a vehicle was observed; None for all.
            agent_mask: vehicles that are there; the first one of every scene must be. None for all.
            kind: classes of the vehicles, indices into :data:`~epo_lightning.scene.KINDS`; None for cars.
            framed: number of vehicles, the first ones, that decide on a scene's frame and lanes; None for all.
            on_lanes_only: whether a vehicle on no lane, or against its direction, is an error. If not, its lines and goals
                are those of the last lane, and mean nothing; a closed loop goes on with them.

        Raises:
            ValueError: arrays whose shapes do not fit, a first vehicle that is not there, observed states that are not
                finite, or a vehicle that is on no lane.
        """
        history, size, history_mask, agent_mask, kind = _checked(history, size, history_mask, agent_mask, kind)
        first = np.arange(agent_mask.shape[1]) < (agent_mask.shape[1] if framed is None else framed)
        if not (agent_mask & first)[:, :1].all() or not agent_mask.shape[1]:
            raise ValueError("the first vehicle of every scene must be there (agent_mask[:, 0]), and framed at least 1")
        scene, agent = there = np.nonzero(agent_mask)
        now = history[there][:, -1]
        here = self.lanes.locate(now[:, :2], now[:, HEADING])
        lost = np.flatnonzero(here.lane < 0)
        if on_lanes_only and len(lost):
            x, y = now[lost[0], :2]
            raise ValueError(
                f"agent {agent[lost[0]]} of scene {scene[lost[0]]} is on no lane, at ({x:.1f}, {y:.1f}) m: leave it out "
                "with agent_mask (`on_lanes` says which states are on lanes), or correct the map or its heading"
            )
        route = self._routes.of(now[:, :2], now[:, SPEED], here, self.windows.horizon * self.windows.dt)
        limit = self.lanes.speed_limit[here.lane]
        counted = agent_mask & first
        last = np.where(counted[..., None], history[:, :, -1], 0.0)
        centre, direction = common_axes(last[..., :2], last[..., HEADING], counted)
        origin = np.floor(centre)
        turns = 2 * np.pi * np.round(now[:, HEADING] / (2 * np.pi))
        past = history[there].copy()
        past[..., :2] -= origin[scene][:, None]
        past[..., HEADING] -= turns[:, None]
        place = np.full(agent_mask.shape, -1, dtype=np.int32)
        place[there] = np.arange(len(now))
        steps = (len(now), self.windows.horizon)
        chosen = nearest_pieces(self._pieces, centre, self.windows.lanes or len(self._pieces))
        most = chosen.shape[1]
        rows = np.where(chosen >= 0, np.arange(chosen.size).reshape(chosen.shape), -1)
        tables = SceneTables(
            history=past.astype(np.float32),
            history_mask=history_mask[there],
            future=np.zeros((*steps, 4), dtype=np.float32),
            future_mask=np.zeros(steps, dtype=bool),
            size=size[there].astype(np.float32),
            kind=kind[there],
            track=place[there],
            candidates=(route.candidates - origin[scene][:, None]).astype(np.float32),
            references=(route.references - origin[scene][:, None, None]).astype(np.float32),
            reference_speed=np.where(np.isnan(limit), self.windows.speed_limit, limit).astype(np.float32),
            polylines=self._pieces[chosen.ravel()] - origin.repeat(most, 0)[:, None],
            agents=place,
            lanes=rows,
            centre=centre - origin,
            direction=direction,
            recording=np.arange(len(origin), dtype=np.int32),
            frame=np.zeros(len(origin), dtype=np.int64),
            origin=origin,
        )
        columns = {name: torch.as_tensor(values) for name, values in tables.columns().items()}
        scenes = RecordedScenes(columns, self.windows.dt, "aligned", ("",))[torch.arange(len(origin))]
        return dataclasses.replace(scenes, future=None, future_mask=None, id=None)


def _checked(
    history: np.ndarray,
    size: np.ndarray,
    history_mask: np.ndarray | None,
    agent_mask: np.ndarray | None,
    kind: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The vehicles of scenes as arrays, with the values of those that are None.

    Raises:
        ValueError: shapes that do not fit, or observed states of present vehicles that are not finite.
    """
    history, size = np.asarray(history, dtype=float), np.asarray(size, dtype=float)
    if history.ndim != 4 or history.shape[3] != 4:
        raise ValueError(f"history has shape {list(history.shape)}, expected [B, N, H, 4]: x, y, heading and speed")
    steps, vehicles = history.shape[:3], history.shape[:2]
    history_mask = np.ones(steps, bool) if history_mask is None else np.asarray(history_mask, bool)
    agent_mask = np.ones(vehicles, bool) if agent_mask is None else np.asarray(agent_mask, bool)
    kind = np.zeros(vehicles, int) if kind is None else np.asarray(kind, int)
    for name, values, shape in (
        ("size", size, (*vehicles, 2)),
        ("history_mask", history_mask, steps),
        ("agent_mask", agent_mask, vehicles),
        ("kind", kind, vehicles),
    ):
        if values.shape != shape:
            raise ValueError(f"{name} has shape {list(values.shape)}, expected {list(shape)}, as history")
    observed = history_mask & agent_mask[..., None]
    bad = np.argwhere(observed & ~np.isfinite(history).all(-1))
    if len(bad):
        scene, agent, step = bad[0]
        raise ValueError(
            f"agent {agent} of scene {scene} was observed at step {step} of history, but is not finite there"
        )
    return history, size, history_mask, agent_mask, kind
