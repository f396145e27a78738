"""An independent implementation of the energies in plain torch, without code of :mod:`epo_lightning.game`.

It is a function of one batch of problems, for the peer and for the reference. There is no loop over time, agents or pairs;
signals that share an array share every operation; unknowns are ordered by channel, so that nothing is copied. Each of these
choices makes its automatic differentiation faster.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.games import Game
from epo_lightning.forecast import GameParameters

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
"""Features that are computed together; an energy has all features of a group or none (``speed`` may have one)."""
EXCESSES = {"control_excess": ("acc", "turnr"), "rate_excess": ("jerk", "turnacc"), "speed_excess": ("vel",)}
"""Signals with bounds, by group."""


@dataclass(frozen=True)
class Problem:
    """B M problems in one batch: the function of their residuals and its tensors besides the controls.

    Attributes:
        residuals: from unknowns [b, 2 N K], ``tensors``, names of groups and ``still`` to the groups' weighted residuals
            [b, R], for any b. ``still`` treats the nearest points of lanes as constants, as in the Jacobian J of a step;
            otherwise they move along with the positions, as in the gradient through a step.
        groups: all groups of the energy.
        constants: tensors without gradient: initial states, lanes, sizes.
        game: the game that the problems belong to.
    """

    residuals: Callable[[Tensor, dict[str, Tensor], tuple[str, ...], bool], Tensor]
    groups: tuple[str, ...]
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
    assert scene.size is not None

    def per_mode(tensor: Tensor) -> Tensor:
        return tensor[:, None].expand(-1, modes, *tensor.shape[1:]).flatten(0, 1)

    limits = {}
    for group, signals in EXCESSES.items():
        if group in groups:
            bounds = torch.tensor([energy.bounds[name] for name in signals], dtype=torch.float64)
            limits[group] = bounds.to(scene.history).T[..., None, None]
    first, second = torch.triu_indices(agents, agents, 1, device=scene.history.device)
    difference = torch.eye(agents).to(scene.history)[first] - torch.eye(agents).to(scene.history)[second]
    radius = scene.size[..., 0] / 2
    constants = {"initial": per_mode(scene.current.mT), "reach": per_mode(radius[:, first] + radius[:, second])}
    if "lane" in groups:
        assert scene.references is not None
        assert game.parameters.reference is not None
        constants["lanes"] = (
            scene.references[:, None]
            .expand(-1, modes, -1, -1, -1, -1)
            .take_along_dim(game.parameters.reference[..., None, None, None], 3)
            .squeeze(3)
            .flatten(0, 1)
        )
    if "steer" in groups:
        constants["base"] = per_mode(STEER_BASE * scene.size[..., 0])
    if "speed" in groups:
        wanted = {"vel": torch.zeros_like(radius), "velref": scene.reference_speed}
        constants["wanted"] = per_mode(torch.stack([wanted[name] for name in groups["speed"]], 1))  # type: ignore[misc]

    def residuals(unknowns: Tensor, given: dict[str, Tensor], chosen: tuple[str, ...], still: bool) -> Tensor:
        controls = unknowns.view(-1, 2, agents, horizon)
        x0, y0, heading0, speed0 = given["initial"][..., None].unbind(1)
        after = torch.stack((speed0, heading0), 1) + dt * controls.cumsum(-1)
        before = after - dt * controls
        speed, heading = before.unbind(1)
        velocity = speed[:, None] * torch.stack((heading.cos(), heading.sin()), 1)
        position = torch.stack((x0, y0), 1) + dt * velocity.cumsum(-1)  # [b, 2, N, K]
        rate = controls.diff(dim=-1) / dt
        sources = {"control_excess": controls, "rate_excess": rate, "speed_excess": after[:, :1]}
        found = []
        for group in chosen:
            match group:
                case "proximity":
                    distance = (difference @ position).square().sum(1).sqrt()
                    value = (given["reach"][..., None] - distance).relu()
                case "control":
                    value = controls
                case "rate":
                    value = rate
                case "speed":
                    value = after[:, :1] - given["wanted"][..., None]
                case "goal":
                    value = position[..., -1:] - given["goals"][..., None]
                case "lane":
                    value = position - _nearest_point(position.detach() if still else position, given["lanes"])
                case "steer":
                    value = (given["base"][..., None] * controls[:, 1] / speed.clamp_min(1.0)).atan()[:, None]
                case _:
                    lower, upper = limits[group]
                    value = sources[group] - sources[group].clamp(lower, upper)
            found.append((given[group][..., None] * value).flatten(1))
        return torch.cat(found, 1)

    return Problem(residuals, (*groups, *("proximity",) * bool(energy.pair)), constants, game)


def _nearest_point(position: Float[Tensor, "b 2 N K"], lanes: Float[Tensor, "b N Q 2"]) -> Float[Tensor, "b 2 N K"]:
    """The nearest point of every agent's polyline; the choice of the segment is a constant."""
    point = position.permute(0, 2, 3, 1)[..., None, :]  # [b, N, K, 1, 2]
    start, along = lanes[:, :, None, :-1], lanes.diff(dim=2)[:, :, None]
    share = (((point.detach() - start) * along).sum(-1) / along.square().sum(-1)).clamp(0.0, 1.0)
    nearest = (point.detach() - start - share[..., None] * along).square().sum(-1).argmin(-1)[..., None, None]
    start, along = start.take_along_dim(nearest, 3), along.take_along_dim(nearest, 3)
    share = (((point - start) * along).sum(-1) / along.square().sum(-1)).clamp(0.0, 1.0)
    return (start + share[..., None] * along).squeeze(3).permute(0, 3, 1, 2)
