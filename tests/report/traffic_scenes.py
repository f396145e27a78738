"""Traffic scenes with forecasts for the tests of pictures and animations."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.patches import Polygon
from torch import Tensor

from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.scene import KINDS, Scene

HISTORY, FUTURE, DT, LANE = 10, 20, 0.2, 3.6
STEPS = HISTORY + FUTURE
SIZES = torch.tensor([[4.6, 1.9], [5.4, 2.0], [16.0, 2.5], [4.4, 1.8]])
PLACES = torch.tensor([0.0, -28.0, 30.0, 12.0])
SPEEDS = torch.tensor([30.0, 33.0, 24.0, 26.0])
LATERAL = torch.tensor([0.0, LANE, 0.0, -LANE])


def states(places: Tensor, speeds: Tensor, lateral: Tensor) -> Tensor:
    """Straight ahead along x at constant speeds, [1, N, H + K, 4]."""
    time = DT * torch.arange(1 - HISTORY, FUTURE + 1)
    x = places[:, None] + speeds[:, None] * time
    y, zero, speed = lateral[:, None].expand_as(x), torch.zeros_like(x), speeds[:, None].expand_as(x)
    return torch.stack([x, y, zero, speed], -1)[None]


def road(lanes: int = 3) -> Tensor:
    """Lanes along x, [1, lanes, V, 4]."""
    x = torch.arange(-300.0, 400.0, 20.0)
    y = LANE * (torch.arange(lanes) - 1)[:, None].expand(-1, len(x))
    points = torch.stack([x.expand_as(y), y], -1)
    return torch.cat([points[:, :-1], points[:, 1:]], -1)[None]


def traffic() -> Scene:
    """Four vehicles on three lanes; the first one changes lane."""
    track = states(PLACES, SPEEDS, LATERAL)
    track[0, 0, HISTORY:, 1] = torch.linspace(0, LANE, FUTURE)
    kinds = [KINDS.index(kind) for kind in ("car", "van", "truck", "car")]
    return Scene(
        history=track[:, :, :HISTORY],
        future=track[:, :, HISTORY:],
        dt=DT,
        size=SIZES[None],
        kind=torch.tensor([kinds]),
        lanes=road(),
    )


def short() -> Scene:
    """Traffic of one and a half seconds, for quick animations."""
    scene = traffic()
    return dataclasses.replace(
        scene,
        history=scene.history[:, :, -3:],
        history_mask=scene.history_mask[:, :, -3:],
        future=scene.future[:, :, :6],
        future_mask=scene.future_mask[:, :, :6],
    )


def forecast(scene: Scene, modes: int = 3) -> JointForecast:
    """Modes that drift apart, the last one the most likely; every agent's goal is its last position."""
    steps = FUTURE if scene.future is None else scene.future.shape[2]
    time = DT * torch.arange(1, steps + 1)
    start = scene.current[:, None, :, None].repeat(1, modes, 1, steps, 1)
    start[..., 0] += start[..., 3] * time
    start[..., 1] += 0.4 * torch.arange(modes)[:, None, None] * time
    likely = torch.arange(1.0, modes + 1)
    game = GameParameters({}, {}, torch.zeros(*start.shape[:-1], 2), goals=start[..., -1, :2].clone())
    return JointForecast(start, (likely / likely.sum())[None], parameters=game)


def boxes(axes: Axes, color: str, filled: bool = True) -> list[np.ndarray]:
    """Corners of the boxes and discs of one colour: agents at t0, or outlines."""
    patches = [patch for patch in axes.patches if isinstance(patch, Polygon)]
    if filled:
        chosen = [p for p in patches if p.get_facecolor()[3] == 1 and to_hex(p.get_facecolor()) == color.lower()]
    else:
        chosen = [p for p in patches if p.get_facecolor()[3] == 0 and to_hex(p.get_edgecolor()) == color.lower()]
    return [patch.get_xy()[:-1] for patch in chosen]
