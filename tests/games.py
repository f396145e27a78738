"""Random scenes and games for tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from epo_lightning.game import features
from epo_lightning.game.energy import Energy
from epo_lightning.game.features import OWN_FEATURES
from epo_lightning.game.quadratic_model import QuadraticModel
from epo_lightning.scene import GameParameters, Scene

BOUNDS = {"vel": (-0.05, 0.6), "acc": (-0.3, 0.3), "turnr": (-0.2, 0.2), "jerk": (-1.0, 1.0), "turnacc": (-1.0, 1.0)}
"""Narrow enough for random controls to leave them."""
ALL = tuple(OWN_FEATURES)
"""Every built-in own feature."""
EXID = ("goal", "lane", "velref", "vel", "acc", "jerk", "steer", "turnr", "turnacc")
"""The own features of conf/energy/exid.yaml."""


def random_scene(
    scenes: int = 3,
    agents: int = 2,
    *,
    history: int = 19,
    horizon: int = 40,
    size: float = 0.5,
    references: bool = True,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """Agents within a few metres of each other, moving, each with two wiggly lines to follow."""
    state = torch.randn(scenes, agents, history, 4, dtype=dtype)
    state[..., 3].abs_()
    way = torch.linspace(-4.0, 4.0, 6, dtype=dtype)
    lines = torch.stack((way.expand(scenes, agents, 2, 6), torch.randn(scenes, agents, 2, 6, dtype=dtype)), -1)
    return Scene(
        history=state,
        dt=0.1,
        future=torch.randn(scenes, agents, horizon, 4, dtype=dtype),
        goal_candidates=torch.randn(scenes, agents, 1, 2, dtype=dtype),
        size=torch.full((scenes, agents, 2), size, dtype=dtype),
        references=lines if references else None,
        reference_speed=2.0 * torch.rand(scenes, agents, dtype=dtype) if references else None,
        subset=torch.arange(scenes) % 2,
        id=torch.arange(scenes),
    )


def random_game(
    scene: Scene, modes: int = 2, horizon: int = 7, own: tuple[str, ...] = ALL, spread: float = 0.5
) -> GameParameters:
    """Weights around one and controls of about ``spread``."""
    scenes, agents = scene.agent_mask.shape
    dtype = scene.history.dtype
    pairs = agents * (agents - 1) // 2
    return GameParameters(
        own_weights={name: 0.5 + torch.rand(scenes, modes, agents, dtype=dtype) for name in own},
        pair_weights={"proximity": 0.5 + 3.0 * torch.rand(scenes, modes, pairs, dtype=dtype)},
        initial_controls=spread * torch.randn(scenes, modes, agents, horizon, 2, dtype=dtype),
        goals=torch.randn(scenes, modes, agents, 2, dtype=dtype),
        reference=None if scene.references is None else torch.randint(2, (scenes, modes, agents)),
    )


def leaves_of(parameters: GameParameters) -> GameParameters:
    """The same game as leaves of a graph: everything that a solution is differentiated by requires its gradient."""
    return parameters.map(lambda tensor: tensor.clone().requires_grad_() if tensor.is_floating_point() else tensor)


def widen(parameters: GameParameters, agents: int = 2, filling: float = float("nan")) -> GameParameters:
    """The game of a scene that :func:`pad` gave absent agents, all of them holding ``filling``."""
    scenes, modes, given = parameters.initial_controls.shape[:3]
    first, second = torch.triu_indices(given + agents, given + agents, 1)
    real = second < given

    def grow(tensor: torch.Tensor) -> torch.Tensor:
        wide = tensor.new_full((scenes, modes, given + agents, *tensor.shape[3:]), 0)
        wide[:, :, :given] = tensor
        wide[:, :, given:] = filling if tensor.is_floating_point() else -99
        return wide

    def grow_pairs(weight: torch.Tensor) -> torch.Tensor:
        wide = torch.full((scenes, modes, len(first)), filling, dtype=weight.dtype)
        wide[:, :, real] = weight
        return wide

    return GameParameters(
        own_weights={name: grow(weight) for name, weight in parameters.own_weights.items()},
        pair_weights={name: grow_pairs(weight) for name, weight in parameters.pair_weights.items()},
        initial_controls=grow(parameters.initial_controls),
        goals=None if parameters.goals is None else grow(parameters.goals),
        reference=None if parameters.reference is None else grow(parameters.reference),
    )


def pad(scene: Scene, agents: int = 2, steps: int = 0, filling: float = float("nan")) -> Scene:
    """The same scene with absent agents appended and unobserved steps put before its history, all holding ``filling``."""

    def grow(tensor: torch.Tensor | None, dim: int, count: int, value: float | bool, before: bool = False):
        if tensor is None or count == 0:
            return tensor
        shape = list(tensor.shape)
        shape[dim] = count
        extra = torch.full(shape, value, dtype=tensor.dtype)
        return torch.cat((extra, tensor) if before else (tensor, extra), dim)

    history = grow(grow(scene.history, 1, agents, filling), 2, steps, filling, before=True)
    history_mask = grow(grow(scene.history_mask, 1, agents, False), 2, steps, False, before=True)
    return Scene(
        history=history,
        dt=scene.dt,
        history_mask=history_mask,
        agent_mask=grow(scene.agent_mask, 1, agents, False),
        future=grow(scene.future, 1, agents, filling),
        future_mask=grow(scene.future_mask, 1, agents, False),
        goal_candidates=grow(scene.goal_candidates, 1, agents, filling),
        goal_mask=grow(scene.goal_mask, 1, agents, False),
        size=grow(scene.size, 1, agents, filling),
        references=grow(scene.references, 1, agents, filling),
        reference_mask=grow(scene.reference_mask, 1, agents, True),
        reference_speed=grow(scene.reference_speed, 1, agents, filling),
        subset=scene.subset,
        id=scene.id,
    )


@contextmanager
def feet_held() -> Iterator[None]:
    """The nearest points of reference lines stay where they are under differentiation, as in the Gauss-Newton model."""
    sliding = features.foot
    features.foot = lambda position, line: tuple(part.detach() for part in sliding(position, line))
    try:
        yield
    finally:
        features.foot = sliding


def ahead(values: torch.Tensor) -> torch.Tensor:
    """The next entry of the last dimension, zero after the last one."""
    return torch.nn.functional.pad(values[..., 1:], (0, 1))


def times(model, change, damping):
    """(J^T J + damping) times a change of the controls, through the trajectory and without the matrix.

    Changes and results are [S, N, 2, K].
    """
    nodes = model.dt * change.cumsum(-1)
    moved = model._travel((model.moves * nodes[:, :, :, None]).sum(2))
    control = (model.control_stiffness + damping[:, None, None, None]) * change
    if model.rate_stiffness is not None:
        rate = model.rate_stiffness * (ahead(change) - change) / model.dt**2
        control -= rate - torch.nn.functional.pad(rate[..., :-1], (1, 0))
    node = model.node_stiffness * nodes
    if model.cross is not None:
        same, following = model.cross.unbind(2)
        node[:, :, 0] += same * nodes[:, :, 1] + following * ahead(nodes[:, :, 1])
        node[:, :, 1] += same * nodes[:, :, 0]
        node[:, :, 1, 1:] += (following * nodes[:, :, 0])[..., :-1]
    x, y = moved.unbind(2)
    xx, xy, yy = model.pull[:, :, 2:].unbind(2)
    force = torch.stack((xx * x + xy * y, xy * x + yy * y), 2)
    if model.pair_curvature is not None:
        first, second = model.edges.ends(moved)
        xx, xy, yy = (-model.pair_curvature).unbind(1)
        by_second, by_first = (
            torch.stack((xx * x + xy * y, xy * x + yy * y), 1) for x, y in (second.unbind(1), first.unbind(1))
        )
        model.edges.spread_(force, by_second, by_first)
    node += (model.moves * model._after(force)[:, :, None]).sum(3)
    flat = nodes.flatten(2)[..., None]
    if model.blocks is not None:
        node += (model.blocks @ flat).view_as(node)
    if model.pair_blocks is not None:
        first, second = model.edges.ends(flat)
        by_second, by_first = model.pair_blocks @ second, model.pair_blocks.mT @ first
        model.edges.spread_(node, *(part.view(-1, 2, model.steps) for part in (by_second, by_first)))
    return control + model.dt * node.flip(-1).cumsum(-1).flip(-1)


def normal_equations(energy: Energy, scene: Scene, parameters: GameParameters, controls: torch.Tensor, exact=False):
    """The model's gradient [B, M, N, K, 2] and matrix [B, M, n, n] in the controls, in the order of ``controls``."""
    model = QuadraticModel(energy, scene, parameters, controls, every_pair=True, exact=exact)
    none, steps, agents = controls.new_zeros(model.samples), model.steps, model.agents
    units = torch.eye(2 * steps * agents, dtype=controls.dtype).view(-1, agents, steps, 2).transpose(-1, -2)
    columns = [times(model, unit.expand(model.samples, -1, -1, -1), none) for unit in units]
    matrix = torch.stack([column.transpose(-1, -2).flatten(1) for column in columns], -1)
    shape = *controls.shape[:2], 2 * steps * agents, 2 * steps * agents
    return model.gradient.transpose(-1, -2).reshape(controls.shape), matrix.reshape(shape)
