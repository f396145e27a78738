"""Episodes: a planner drives its agent through a world, step by step."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.drive.planners import Plan, Planner
from epo_lightning.drive.world import EGO, Outcome, World
from epo_lightning.frames import in_world
from epo_lightning.game.dynamics import controls_between
from epo_lightning.scene import Scene


@dataclass
class Episodes:
    """The record of B episodes of T planned steps.

    Attributes:
        dt: time step [s].
        outcome: what happened.
        controls: executed controls of the planned agent; changes of its speed and heading where the world drove it. NaN
            after the end of an episode.
        found: whether a plan was found at each step; elsewhere the rest of an earlier plan was followed.
        plans: positions of the joint futures that were planned at each step, for films; empty unless asked for. NaN for
            agents that are not there, and after the end of an episode.
        wall, processor: seconds that each plan took, by the clock and of processor time.
    """

    dt: float
    outcome: Outcome
    controls: Float[Tensor, "B T 2"]
    found: Bool[Tensor, "B T"]
    plans: list[Float[Tensor, "B N K 2"]] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)


def play(world: World, planner: Planner | None, episodes: Sequence[int], keep_plans: bool = False) -> Episodes:
    """Begin some episodes of a world, and drive until they are finished.

    Args:
        world: the world, which is changed.
        planner: the planner of the agent with index :data:`~epo_lightning.drive.world.EGO`; None for the world's own driver.
        episodes: the episodes.
        keep_plans: whether the planned futures are kept.
    """
    count = len(episodes)
    found: list[Tensor] = []
    controls: list[Tensor] = []
    plans: list[Tensor] = []
    wall: list[float] = []
    processor: list[float] = []
    last: tuple[Tensor, Scene, Plan] | None = None
    world.reset(episodes)
    while len(going := world.going):
        if planner is None:
            world.advance(None)
            continue
        scene = world.observe()
        previous = None if last is None else _onward(*last, going, scene)
        began, worked = time.perf_counter(), time.thread_time()
        plan = planner(scene, previous).or_else(previous, scene)
        wall.append(time.perf_counter() - began)
        processor.append(time.thread_time() - worked)
        world.advance(plan.controls[:, 0])
        controls.append(_spread(plan.controls[:, 0].double(), going, count, torch.nan))
        found.append(_spread(plan.found, going, count, True))
        if keep_plans:
            plans.append(_spread(outside(plan.states[..., :2], scene), going, count, torch.nan))
        last = going, scene, plan
    outcome = world.outcome()
    executed = _executed(outcome, world.dt)
    return Episodes(
        dt=world.dt,
        outcome=outcome,
        controls=torch.stack(controls, 1) if controls else executed,
        found=torch.stack(found, 1) if found else torch.ones(executed.shape[:2], dtype=torch.bool),
        plans=plans,
        wall=wall,
        processor=processor,
    )


def _onward(were: Int[Tensor, " b"], before: Scene, plan: Plan, going: Int[Tensor, " b"], scene: Scene) -> Plan:
    """The plan of the last step for the episodes that go on, in the frames of their scenes."""
    left = torch.isin(were, going)
    return plan[left].seen_from(before[left], scene)


def _spread(values: Tensor, going: Int[Tensor, " b"], count: int, rest: float) -> Tensor:
    """Values [b, ...] of some episodes as values [B, ...] of all, with ``rest`` for the others."""
    return values.new_full((count, *values.shape[1:]), rest).index_copy_(0, going, values)


def _executed(outcome: Outcome, dt: float) -> Float[Tensor, "B T 2"]:
    """Changes of the planned agent's speed and heading per second; NaN after the end of an episode."""
    changes = controls_between(outcome.states[:, EGO], dt)
    return changes.where(outcome.agent_mask[:, EGO, 1:, None], torch.nan)


def outside(position: Float[Tensor, "B N K 2"], scene: Scene) -> Float[Tensor, "B N K 2"]:
    """Positions of a scene in the world's frame; NaN for agents that are not there."""
    position = position.double()
    if scene.frame is not None:
        position = in_world(position, scene.frame.double())
    return position.where(scene.agent_mask[:, : position.shape[1], None, None], torch.nan)


def chunks(world: World) -> Iterator[range]:
    """All episodes of a world, as many at a time as can be begun together."""
    for first in range(0, len(world), world.together):
        yield range(first, min(first + world.together, len(world)))


def times(world: World, planner: Planner, episodes: Sequence[int]) -> tuple[list[float], list[float]]:
    """Seconds of every plan of single scenes, by the clock and of processor time; each episode's first plan warms up."""
    wall: list[float] = []
    processor: list[float] = []
    for episode in episodes:
        played = play(world, planner, [episode])
        wall += played.wall[1:]
        processor += played.processor[1:]
    return wall, processor
