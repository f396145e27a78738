"""Random scenes and games for tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from epo_lightning.forecast import GameParameters
from epo_lightning.game import feature_derivatives
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.expansion import expand

BOUNDS = {"vel": (-0.05, 0.6), "acc": (-0.3, 0.3), "turnr": (-0.2, 0.2), "jerk": (-1.0, 1.0), "turnacc": (-0.8, 1.2)}
"""Bounds that random controls leave; no two signals have the same."""
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
    lanes: int = 0,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """Agents within a few metres of each other, moving, each with two wiggly lines to follow, among lanes anywhere."""
    state = torch.randn(scenes, agents, history, 4, dtype=dtype)
    state[..., 3].abs_()
    way = torch.linspace(-4.0, 4.0, 6, dtype=dtype)
    lines = torch.stack((way.expand(scenes, agents, 2, 6), torch.randn(scenes, agents, 2, 6, dtype=dtype)), -1)
    drawn: dict[str, torch.Tensor] = {}
    if lanes:
        drawn["lanes"] = torch.randn(scenes, lanes, 4, 4, dtype=dtype)
        drawn["lane_mask"] = torch.arange(4) <= torch.randint(4, (scenes, lanes, 1))
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
        **drawn,
    )


def highway_scene(scenes: int = 3, agents: int = 4, *, candidates: int = 6, horizon: int = 8) -> Scene:
    """Vehicles on three lanes of a motorway, up to 60 m apart, that keep or change their lane.

    Of every scene, one lane has no vector and one agent no last future step; agents have between one and all candidates.
    """
    steps, reference_lines, lanes, vectors = 10, 3, 5, 4
    speed = 20.0 + 10.0 * torch.rand(scenes, agents)
    lane = torch.randint(reference_lines, (scenes, agents))
    start = torch.stack((60.0 * torch.rand(scenes, agents) - 30.0, 3.5 * lane), -1)
    time = 0.2 * torch.arange(1 - steps, horizon + 1)
    drift = torch.randn(scenes, agents, 1) * time.clamp_min(0.0)
    position = torch.stack((start[..., :1] + speed[..., None] * time, start[..., 1:] + drift), -1)
    motion = torch.stack((torch.zeros_like(drift), speed[..., None].expand_as(drift)), -1)
    states = torch.cat((position, motion), -1)
    future_mask = torch.ones(scenes, agents, horizon, dtype=torch.bool)
    future_mask[torch.arange(scenes), torch.randint(agents, (scenes,)), -1:] = False
    history_mask = torch.arange(steps) >= torch.randint(steps - 1, (scenes, agents, 1))

    middles = 3.5 * torch.arange(reference_lines)[:, None]
    along = torch.linspace(-60.0, 120.0, 12)
    line = torch.stack((along.expand(reference_lines, 12), middles.expand(reference_lines, 12)), -1)
    on = torch.randint(reference_lines, (scenes, agents, candidates))
    ahead = speed[..., None] * (1.0 + torch.rand(scenes, agents, candidates))
    across = 3.5 * torch.arange(lanes)[:, None] + 0.01 * torch.randn(lanes, vectors + 1)
    points = torch.stack((torch.linspace(-100.0, 150.0, vectors + 1).expand_as(across), across), -1)
    points = points + torch.randn(scenes, 1, 1, 2)
    lane_mask = torch.ones(scenes, lanes, vectors, dtype=torch.bool)
    lane_mask[:, 1, 2:] = lane_mask[:, 3] = False
    return Scene(
        history=states[:, :, :steps].contiguous(),
        dt=0.2,
        history_mask=history_mask,
        future=states[:, :, steps:].contiguous(),
        future_mask=future_mask,
        goal_candidates=torch.stack((start[..., :1] + ahead, 3.5 * on), -1),
        goal_mask=torch.arange(candidates) <= torch.randint(candidates, (scenes, agents, 1)),
        goal_reference=on,
        size=torch.tensor([4.5, 1.9]).repeat(scenes, agents, 1),
        kind=torch.zeros(scenes, agents, dtype=torch.long),
        lanes=torch.cat((points[..., :-1, :], points[..., 1:, :]), -1),
        lane_mask=lane_mask,
        references=line.repeat(scenes, agents, 1, 1, 1),
        reference_speed=speed + torch.randn(scenes, agents),
        frame=torch.zeros(scenes, 3),
        id=torch.arange(scenes),
    )


def reordered(scene: Scene, order: list[int]) -> Scene:
    """Scene with its agents in another order."""
    whose = ("history", "history_mask", "agent_mask", "future", "future_mask", "goal_candidates", "goal_mask")
    whose += ("goal_reference", "goal_headings", "size", "kind", "references", "reference_mask", "reference_speed")
    fields = dict(vars(scene))
    return Scene(**{**fields, **{name: fields[name][:, order] for name in whose if fields[name] is not None}})


def random_game(
    scene: Scene,
    modes: int = 2,
    horizon: int = 7,
    own: tuple[str, ...] = ALL,
    spread: float = 0.5,
    pair: tuple[str, ...] = ("proximity",),
) -> GameParameters:
    """Weights around one, controls of about ``spread``, and margins of up to 1 m."""
    scenes, agents = scene.agent_mask.shape
    dtype = scene.history.dtype
    pairs = agents * (agents - 1) // 2
    return GameParameters(
        own_weights={name: 0.5 + torch.rand(scenes, modes, agents, dtype=dtype) for name in own},
        pair_weights={name: 0.5 + 3.0 * torch.rand(scenes, modes, pairs, dtype=dtype) for name in pair},
        initial_controls=spread * torch.randn(scenes, modes, agents, horizon, 2, dtype=dtype),
        goals=torch.randn(scenes, modes, agents, 2, dtype=dtype),
        reference=None if scene.references is None else torch.randint(2, (scenes, modes, agents)),
        goal_headings=torch.randn(scenes, modes, agents, dtype=dtype),
        margins={n: torch.rand(scenes, modes, pairs, dtype=dtype) for n in pair if PAIR_FEATURES[n].margin},
        reference_controls=spread * torch.randn(scenes, modes, agents, horizon, 2, dtype=dtype),
    )


def leaves_of(parameters: GameParameters) -> GameParameters:
    """Game parameters as leaves of a graph, which require gradients."""
    return parameters.map(
        lambda tensor: tensor.detach().clone().requires_grad_() if tensor.is_floating_point() else tensor
    )


def widen(parameters: GameParameters, agents: int = 2, filling: float = float("nan")) -> GameParameters:
    """The game of a scene that :func:`pad` gave absent agents, all of them holding ``filling``."""
    given = parameters.initial_controls.shape[2]
    _, second = torch.triu_indices(given + agents, given + agents, 1)
    real = second < given

    def grow(tensor: torch.Tensor | None, dim: int = 2) -> torch.Tensor | None:
        if tensor is None:
            return None
        shape = list(tensor.shape)
        shape[dim] = agents
        return torch.cat((tensor, tensor.new_full(shape, filling if tensor.is_floating_point() else -99)), dim)

    def grow_pairs(tensor: torch.Tensor | None) -> torch.Tensor | None:
        if tensor is None:
            return None
        wide = tensor.new_full((*tensor.shape[:2], len(real)), filling)
        wide[..., real] = tensor
        return wide

    return GameParameters(
        own_weights={name: grow(weight) for name, weight in parameters.own_weights.items()},
        pair_weights={name: grow_pairs(weight) for name, weight in parameters.pair_weights.items()},
        initial_controls=grow(parameters.initial_controls),
        goals=grow(parameters.goals),
        reference=grow(parameters.reference),
        context=grow(parameters.context, 1),
        order=grow_pairs(parameters.order),
        goal_headings=grow(parameters.goal_headings),
        margins={name: grow_pairs(margin) for name, margin in parameters.margins.items()},
        reference_controls=grow(parameters.reference_controls),
    )


def pad(
    scene: Scene,
    agents: int = 2,
    steps: int = 0,
    filling: float = float("nan"),
    *,
    lanes: int = 0,
    vectors: int = 0,
    candidates: int = 0,
) -> Scene:
    """Padded scene: absent agents, lanes, vectors and goal candidates appended and unobserved steps put before its
    history, all of which hold ``filling``."""

    def grow(tensor: torch.Tensor | None, dim: int, count: int, value: float | bool, before: bool = False):
        if tensor is None or count == 0:
            return tensor
        shape = list(tensor.shape)
        shape[dim] = count
        extra = torch.full(shape, value, dtype=tensor.dtype)
        return torch.cat((extra, tensor) if before else (tensor, extra), dim)

    history = grow(grow(scene.history, 1, agents, filling), 2, steps, filling, before=True)
    history_mask = grow(grow(scene.history_mask, 1, agents, False), 2, steps, False, before=True)
    drawn = scene.lane_mask
    behind = None if scene.lanes is None else torch.where(drawn[..., None], scene.lanes, filling)
    return Scene(
        history=history,
        dt=scene.dt,
        history_mask=history_mask,
        agent_mask=grow(scene.agent_mask, 1, agents, False),
        future=grow(scene.future, 1, agents, filling),
        future_mask=grow(scene.future_mask, 1, agents, False),
        goal_candidates=grow(grow(scene.goal_candidates, 1, agents, filling), 2, candidates, filling),
        goal_mask=grow(grow(scene.goal_mask, 1, agents, False), 2, candidates, False),
        goal_headings=grow(grow(scene.goal_headings, 1, agents, filling), 2, candidates, filling),
        game_steps=scene.game_steps,
        goal_reference=grow(grow(scene.goal_reference, 1, agents, -99), 2, candidates, -99),
        size=grow(scene.size, 1, agents, filling),
        kind=grow(scene.kind, 1, agents, -99),
        lanes=grow(grow(behind, 1, lanes, filling), 2, vectors, filling),
        lane_mask=grow(grow(drawn, 1, lanes, False), 2, vectors, False),
        frame=scene.frame,
        references=grow(scene.references, 1, agents, filling),
        reference_mask=grow(scene.reference_mask, 1, agents, True),
        reference_speed=grow(scene.reference_speed, 1, agents, filling),
        subset=scene.subset,
        id=scene.id,
    )


@contextmanager
def nearest_points_held() -> Iterator[None]:
    """The nearest points of reference lines are held under differentiation, as in the Gauss-Newton model."""
    sliding = feature_derivatives.nearest_point
    feature_derivatives.nearest_point = lambda position, line: tuple(part.detach() for part in sliding(position, line))
    try:
        yield
    finally:
        feature_derivatives.nearest_point = sliding


def ahead(values: torch.Tensor) -> torch.Tensor:
    """The next entry of the last dimension, zero after the last one."""
    return torch.nn.functional.pad(values[..., 1:], (0, 1))


def times(model, change, damping):
    """(J^T J + damping) times a change of the controls, through the trajectory and without the matrix.

    Changes and results are [S, N, 2, K].
    """
    nodes = model.at.dt * change.cumsum(-1)
    moved = model.at.to_positions((model.at.moves * nodes[:, :, :, None]).sum(2))
    control = (model.control + damping[:, None, None, None]) * change
    if model.rate is not None:
        rate = model.rate * (ahead(change) - change) / model.at.dt**2
        control -= rate - torch.nn.functional.pad(rate[..., :-1], (1, 0))
    node = model.node * nodes
    if model.cross is not None:
        same, following = model.cross.unbind(2)
        node[:, :, 0] += same * nodes[:, :, 1] + following * ahead(nodes[:, :, 1])
        node[:, :, 1] += same * nodes[:, :, 0]
        node[:, :, 1, 1:] += (following * nodes[:, :, 0])[..., :-1]
    x, y = moved.unbind(2)
    xx, xy, yy = model.position.unbind(2)
    force = torch.stack((xx * x + xy * y, xy * x + yy * y), 2)
    if model.pair_position is not None:
        first, second = model.edges.ends(moved)
        xx, xy, yy = (-model.pair_position).unbind(1)
        by_second, by_first = (
            torch.stack((xx * x + xy * y, xy * x + yy * y), 1) for x, y in (second.unbind(1), first.unbind(1))
        )
        model.edges.spread_(force, by_second, by_first)
    node += (model.at.moves * model.at.to_velocities(force)[:, :, None]).sum(3)
    flat = nodes.flatten(2)[..., None]
    if model.own_dense is not None:
        node += (model.own_dense @ flat).view_as(node)
    if model.pair_dense is not None:
        first, second = model.edges.ends(flat)
        by_second, by_first = model.pair_dense @ second, model.pair_dense.mT @ first
        model.edges.spread_(node, *(part.view(-1, 2, model.at.horizon) for part in (by_second, by_first)))
    return control + model.at.dt * node.flip(-1).cumsum(-1).flip(-1)


def normal_equations(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: torch.Tensor, exact=False
):
    """The model's gradient [B, M, N, K, 2] and matrix [B, M, n, n] in the controls, in the order of ``controls``."""
    model = expand(energy, scene, parameters, controls, every_pair=True, exact=exact)
    none, steps, agents = controls.new_zeros(model.at.problems), model.at.horizon, model.at.agents
    units = torch.eye(2 * steps * agents, dtype=controls.dtype).view(-1, agents, steps, 2).transpose(-1, -2)
    columns = [times(model, unit.expand(model.at.problems, -1, -1, -1), none) for unit in units]
    matrix = torch.stack([column.transpose(-1, -2).flatten(1) for column in columns], -1)
    shape = *controls.shape[:2], 2 * steps * agents, 2 * steps * agents
    return model.gradient.transpose(-1, -2).reshape(controls.shape), matrix.reshape(shape)
