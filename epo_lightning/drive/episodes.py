"""Episodes: a planner drives its agent through a world, step by step."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.drive.planners import Plan, Planner
from epo_lightning.drive.world import World
from epo_lightning.scene import Scene


@dataclass
class Episodes:
    """The record of B episodes of T planned steps.

    Attributes:
        dt: time step [s].
        states: states of all agents at the first planned step and after every step.
        controls: executed controls of the planned agent.
        agent_mask: agents that exist at each of these times.
        size: length and width of every agent [m].
        found: whether a plan was found at each step; elsewhere the rest of an earlier plan was followed.
        progress: how far the planned agent has come [m].
        plans: positions of the joint futures that were planned at each step, for films; empty unless asked for.
        wall, processor: seconds that each plan took, by the clock and of processor time.
    """

    dt: float
    states: Float[Tensor, "B N T+1 4"]
    controls: Float[Tensor, "B T 2"]
    agent_mask: Bool[Tensor, "B N T+1"]
    size: Float[Tensor, "B N 2"]
    found: Bool[Tensor, "B T"]
    progress: Float[Tensor, "B T+1"]
    plans: list[Float[Tensor, "B N K 2"]] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)


def play(world: World, planner: Planner, keep_plans: bool = False) -> Episodes:
    """Drive until the world's episodes are finished.

    Args:
        world: the world, which is changed.
        planner: the planner of the agent with index :data:`~epo_lightning.drive.world.EGO`.
        keep_plans: whether the planned futures are kept.
    """
    scene = world.observe()
    seen: list[Scene] = [scene]
    controls: list[Tensor] = []
    found: list[Tensor] = []
    plans: list[Tensor] = []
    wall: list[float] = []
    processor: list[float] = []
    previous: Plan | None = None
    while not world.finished:
        began, worked = time.perf_counter(), time.thread_time()
        plan = planner(scene, previous).or_else(previous, scene)
        wall.append(time.perf_counter() - began)
        processor.append(time.thread_time() - worked)
        world.advance(plan.controls[:, 0])
        controls.append(plan.controls[:, 0].double())
        found.append(plan.found)
        if keep_plans:
            plans.append(plan.states[..., :2])
        previous, scene = plan, world.observe()
        seen.append(scene)
    states = torch.stack([scene.current for scene in seen], 2).double()
    size = scene.size
    assert size is not None
    return Episodes(
        dt=scene.dt,
        states=states,
        controls=torch.stack(controls, 1),
        agent_mask=torch.stack([scene.agent_mask for scene in seen], 2),
        size=size.double(),
        found=torch.stack(found, 1),
        progress=world.progress(states[:, 0]),
        plans=plans,
        wall=wall,
        processor=processor,
    )


def times(worlds: Iterable[World], planner: Planner) -> tuple[list[float], list[float]]:
    """Seconds of every plan of single scenes, by the clock and of processor time; the first plan warms up."""
    wall: list[float] = []
    processor: list[float] = []
    for world in worlds:
        played = play(world, planner)
        wall += played.wall
        processor += played.processor
    return wall[1:], processor[1:]
