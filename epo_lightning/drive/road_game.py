"""The known costs of a planned vehicle on a road, and the costs that it assumes for the others.

Planners that are given costs minimise :data:`ENERGY` over the next seconds. The planned vehicle follows a reference line,
comes near the reference speed, drives smoothly and keeps its distance. The others want what they would do if they kept their
speed on their lane: deviations from that have a cost, and so do small distances. These costs are chosen by hand, once, on
episodes of other seeds than those of the results.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from epo_lightning.drive.world import EGO
from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import SPEED, TURN_RATE, Scene, wrapped

ENERGY = FeatureEnergy(
    own=("lane", "velref", "accref", "turnrref", "jerk", "turnacc", "velb", "accb"),
    pair=("circles", "headway", "longitudinal", "lateral", "time_to_conflict"),
    margins={"headway": 1.0, "longitudinal": 3.0, "lateral": 0.5, "time_to_conflict": 0.3},
    bounds={"vel": (0.0, 60.0), "acc": (-4.5, 2.5)},
)
"""The energy of the games on roads."""
_OWN = {
    "lane": 0.5,
    "velref": 1.0,
    "accref": 0.5,
    "turnrref": 10.0,
    "jerk": 0.15,
    "turnacc": 5.0,
    "velb": 20.0,
    "accb": 10.0,
}
_OTHERS = {**_OWN, "velref": 0.0, "accref": 0.7}
_PAIR = {"circles": 20.0, "headway": 0.1, "longitudinal": 1.0, "lateral": 2.0, "time_to_conflict": 2.0}
OWN_LINE = 1
"""Index of the line along an agent's own lane."""


def road_game(scene: Scene, line: Int[Tensor, " B"], steps: int, turning: float = 1.0) -> GameParameters:
    """The game of a scene, of one mode, in float64.

    Args:
        scene: scenes with reference lines.
        line: index of the reference line that the planned vehicle of each scene follows.
        steps: number of steps.
        turning: share of a motorway's costs of turning, with which standing is cheaper than driving around a roundabout.
    """
    batch, agents = scene.agent_mask.shape
    mine = torch.arange(agents) == EGO
    keeping = keep_going(scene, steps)
    assert scene.reference_speed is not None
    share = dict.fromkeys(("turnrref", "turnacc"), turning)
    scale = {"velref": scene.reference_speed[:, None].clamp_min(1.0)}  # the share of the reference speed counts
    reference = torch.where(mine, line[:, None], OWN_LINE)[:, None]
    # The planned vehicle's controls are costly in themselves, those of others where they differ from keeping going.
    usual = torch.where(mine[:, None, None], 0.0, keeping)
    return GameParameters(
        own_weights={
            name: (share.get(name, 1.0) * torch.where(mine, weight, _OTHERS[name]) / scale.get(name, 1.0))
            .double()
            .expand(batch, 1, -1)
            for name, weight in _OWN.items()
        },
        pair_weights={
            name: torch.full((batch, 1, agents * (agents - 1) // 2), weight, dtype=torch.double)
            for name, weight in _PAIR.items()
        },
        initial_controls=torch.zeros(batch, 1, agents, steps, 2, dtype=torch.double),
        reference=reference,
        reference_controls=usual[:, None],
    )


def keep_going(scene: Scene, steps: int) -> Float[Tensor, "B N K 2"]:
    """Controls of agents that keep their speed, and turn at a constant rate by as much as their own lane does."""
    assert scene.references is not None
    line = scene.references[:, :, OWN_LINE].double()
    piece = line.diff(dim=2)
    length = piece.norm(dim=-1).clamp_min(1e-6)
    heading = torch.atan2(piece[..., 1], piece[..., 0])
    turn = wrapped(heading.diff(dim=2))
    heading = torch.cat((heading[..., :1], heading[..., :1] + turn.cumsum(2)), 2)  # continuous along the line
    ends = torch.cat((torch.zeros_like(length[..., :1]), length.cumsum(2)), 2)
    nearest = (line - scene.current[:, :, None, :2].double()).norm(dim=-1).argmin(2, keepdim=True)
    way = scene.current[..., SPEED, None].double() * scene.dt * steps
    here = ends.gather(2, nearest)
    turned = _interpolated(torch.cat((here, here + way), 2), ends[..., 1:] - length / 2, heading).diff(dim=2)
    controls = torch.zeros(*turned.shape[:2], steps, 2, dtype=torch.double)
    controls[..., TURN_RATE] = turned / (steps * scene.dt)
    return torch.where(scene.agent_mask[..., None, None], controls, 0.0)


def _interpolated(
    at: Float[Tensor, "B N K"], x: Float[Tensor, "B N Q"], y: Float[Tensor, "B N Q"]
) -> Float[Tensor, "B N K"]:
    """Linear interpolation of y(x), constant beyond both ends."""
    right = torch.searchsorted(x.contiguous(), at.contiguous()).clamp(1, x.shape[-1] - 1)
    x0, x1, y0, y1 = (values.gather(2, index) for values in (x, y) for index in (right - 1, right))
    share = ((at - x0) / (x1 - x0)).clamp(0.0, 1.0)
    return y0 + share * (y1 - y0)
