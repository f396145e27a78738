"""The same energies once more, in plain torch and without a line of :mod:`epo_lightning.game`.

One function of one batch of problems, for the peer and for the reference: no loop over time, agents or pairs, signals that
share an array share every operation, and unknowns lie channel by channel so that nothing is copied. Each of these choices
makes automatic differentiation of it faster.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.games import Game
from epo_lightning.scene import GameParameters

STEER_BASE = 0.6
"""Wheelbase as a share of a vehicle's length."""
CHANNELS = {
    "control": ("acc", "turnr"),
    "rate": ("jerk", "turnacc"),
    "speed": ("vel", "velref"),
    "control_excess": ("accb", "turnrb"),
    "rate_excess": ("jerkb", "turnaccb"),
    "speed_excess": ("velb",),
    "goal": ("goal",),
    "lane": ("lane",),
    "steer": ("steer",),
}
"""Features that are computed together; an energy has all features of a group, or none, but for ``speed``."""


@dataclass(frozen=True)
class Problem:
    """B M problems in a row: a function and the tensors it takes besides the controls.

    Attributes:
        residuals: from unknowns [b, 2 N K] and ``tensors`` to weighted residuals [b, R], for any b.
        constants: what nobody differentiates: initial states, lanes, sizes.
        game: where the problems come from.
    """

    residuals: Callable[[Tensor, dict[str, Tensor]], Tensor]
    constants: dict[str, Float[Tensor, "b ..."]]
    game: Game

    def tensors(self, parameters: GameParameters) -> dict[str, Float[Tensor, "b ..."]]:
        """All arguments but the controls; differentiable with respect to ``parameters``."""
        values = dict(self.constants)
        for group, names in _groups(self.game).items():
            values[group] = torch.stack([parameters.own_weights[name] for name in names], 2).flatten(0, 1)
        values["proximity"] = parameters.pair_weights["proximity"].flatten(0, 1)
        if parameters.goals is not None:
            values["goals"] = parameters.goals.flatten(0, 1).mT
        return values

    def unknowns(self, controls: Float[Tensor, "B M N K 2"]) -> Float[Tensor, "b n"]:
        """Controls, channel by channel."""
        return controls.permute(0, 1, 4, 2, 3).flatten(0, 1).flatten(1)

    def controls(self, unknowns: Float[Tensor, "b n"]) -> Float[Tensor, "B M N K 2"]:
        """The inverse of :meth:`unknowns`."""
        sizes = self.game.sizes
        shape = sizes["B"], sizes["M"], 2, sizes["N"], sizes["K"]
        return unknowns.view(shape).permute(0, 1, 3, 4, 2)


def _groups(game: Game) -> dict[str, tuple[str, ...]]:
    own = set(game.energy.own)
    groups = {group: tuple(name for name in names if name in own) for group, names in CHANNELS.items()}
    for group, names in groups.items():
        if names and names != CHANNELS[group] and group != "speed":
            raise ValueError(f"the benchmarks' own residuals take {CHANNELS[group]} together, not {names} alone")
    return {group: names for group, names in groups.items() if names}


def problem(game: Game) -> Problem:
    """The problems of a game for automatic differentiation."""
    sizes, scene, energy = game.sizes, game.scene, game.energy
    agents, horizon, modes, dt = sizes["N"], sizes["K"], sizes["M"], scene.dt
    groups = _groups(game)

    def per_mode(tensor: Tensor) -> Tensor:
        return tensor[:, None].expand(-1, modes, *tensor.shape[1:]).flatten(0, 1)

    def bounds(*signals: str) -> tuple[Tensor, Tensor]:
        lower, upper = torch.tensor([energy.bounds[name] for name in signals], dtype=torch.float64).to(scene.history).T
        return lower[:, None, None], upper[:, None, None]

    excesses = {
        group: (source, *bounds(*signals))
        for group, source, signals in (
            ("control_excess", "control", ("acc", "turnr")),
            ("rate_excess", "rate", ("jerk", "turnacc")),
            ("speed_excess", "after", ("vel",)),
        )
        if group in groups
    }
    first, second = torch.triu_indices(agents, agents, 1, device=scene.history.device)
    difference = torch.eye(agents).to(scene.history)[first] - torch.eye(agents).to(scene.history)[second]
    radius = scene.size[..., 0] / 2
    constants = {"initial": per_mode(scene.current.mT), "reach": per_mode(radius[:, first] + radius[:, second])}
    if "lane" in groups:
        chosen = game.parameters.reference
        constants["lanes"] = (
            scene.references[:, None]
            .expand(-1, modes, -1, -1, -1, -1)
            .take_along_dim(chosen[..., None, None, None], 3)
            .squeeze(3)
            .flatten(0, 1)
        )
    if "steer" in groups:
        constants["base"] = per_mode(STEER_BASE * scene.size[..., 0])
    if "velref" in energy.own:
        constants["reference_speed"] = per_mode(scene.reference_speed)

    def residuals(unknowns: Tensor, given: dict[str, Tensor]) -> Tensor:
        controls = unknowns.view(-1, 2, agents, horizon)
        x0, y0, heading0, speed0 = given["initial"][..., None].unbind(1)
        motion0 = torch.stack((speed0, heading0), 1)
        after = motion0 + dt * controls.cumsum(-1)
        before = after - dt * controls
        speed, heading = before.unbind(1)
        velocity = speed[:, None] * torch.stack((heading.cos(), heading.sin()), 1)
        position = torch.stack((x0, y0), 1) + dt * velocity.cumsum(-1)  # [b, 2, N, K]
        offset = difference @ position
        depth = (given["reach"][..., None] - offset.square().sum(1).sqrt()).relu()
        found = [given["proximity"][..., None] * depth]
        signals = {"control": controls, "rate": controls.diff(dim=-1) / dt, "after": after[:, :1]}
        if "velref" in groups.get("speed", ()):
            wanted = given["reference_speed"][..., None]
            shifts = [wanted if name == "velref" else torch.zeros_like(wanted) for name in groups["speed"]]
            signals["speed"] = after[:, :1] - torch.stack(shifts, 1)
        else:
            signals["speed"] = after[:, :1]
        for group, (source, lower, upper) in excesses.items():
            signals[group] = signals[source] - signals[source].clamp(lower, upper)
        if "goal" in groups:
            signals["goal"] = position[..., -1:] - given["goals"][..., None]
        if "lane" in groups:
            signals["lane"] = position - _foot(position.detach(), given["lanes"])
        if "steer" in groups:
            signals["steer"] = (given["base"][..., None] * controls[:, 1] / speed.clamp_min(1.0)).atan()[:, None]
        found += [given[group][..., None] * signals[group] for group in groups]
        return torch.cat([part.flatten(1) for part in found], 1)

    return Problem(residuals, constants, game)


def _foot(position: Float[Tensor, "b 2 N K"], lanes: Float[Tensor, "b N Q 2"]) -> Float[Tensor, "b 2 N K"]:
    """The closest point of every agent's polyline."""
    start, end = lanes[:, :, None, :-1], lanes[:, :, None, 1:]
    point = position.permute(0, 2, 3, 1)[..., None, :]
    along = end - start
    share = (((point - start) * along).sum(-1) / along.square().sum(-1)).clamp(0.0, 1.0)
    foot = start + share[..., None] * along
    nearest = (point - foot).square().sum(-1).argmin(-1)
    return foot.take_along_dim(nearest[..., None, None], 3).squeeze(3).permute(0, 3, 1, 2)
