"""The robot-pedestrian game: start states, goals and costs (App. "RPI").

Two unicycles cross a circle of radius 3 m. The robot's start and goal are fixed; the pedestrian starts at the angle ``phi``
from the robot and walks to the opposite point. The cost of agent i is, as a sum over the steps,

    1/2 effort (a^2 + omega^2) + 1/2 slowness v^2 + soft bounds + 1/2 terminal (|p_K - goal|^2 + (theta_K - theta_goal)^2)
    + w max(0, radius - distance)^2,

where the last term is shared by both agents. The game is therefore an exact potential game, whose potential is the sum of
the own costs plus the shared term once.

Sources: the paper's appendix. The constants that it does not print are those of GameInference.jl (Peters, 2020), except for
the radius of the proximity cost: with GameInference's 1.5 m, agents of radius 0.25 m would never come near each other.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AGENTS = 2
DISC_RADIUS = 0.25
"""Radius of an agent's body [m] (App. "Energy Features")."""
DISC_DIAMETER = 2 * DISC_RADIUS
"""Length and width of an agent [m]; agents that are nearer to each other overlap."""
HISTORY = 18
"""Steps before the current state (1.8 s); with the current state, a history has 19 states."""
FUTURE = 40
"""Future steps (4 s)."""
RECIPE = 2
"""Version of the method: raised whenever the same configuration would give other records. Version 1 can still be made."""
FIRST_ANGLE = 1_000_004
"""Last number of the generator's key for the angle of the first placement."""


@dataclass(frozen=True)
class GameConstants:
    """Constants of every main game and sub-game. ``array()`` lists them in this order for the compiled kernels.

    Attributes:
        dt: time step [s].
        effort: weight of squared acceleration [m/s^2] and turn rate [rad/s].
        slowness: weight of squared speed [m/s].
        bound: weight of squared violations of the bounds.
        turn_limit: bound of the absolute turn rate [rad/s].
        acceleration_limit: bound of the absolute acceleration [m/s^2].
        speed_min, speed_max: bounds of the speed [m/s].
        terminal: weight of the squared distance [m] and heading error [rad] at the end.
        radius: distance [m] below which the proximity cost is positive.
        circle: radius of the circle of starts and goals [m].
        steps: horizon of a main game.
        weight_min, weight_max: range of the weight w of the proximity cost.
        sector: smallest angle [rad] between the starts of robot and pedestrian.
    """

    dt: float = 0.1
    effort: float = 10.0
    slowness: float = 30.0
    bound: float = 50.0
    turn_limit: float = math.radians(10.0)
    acceleration_limit: float = 9.81
    speed_min: float = -0.05
    speed_max: float = 2.0
    terminal: float = 300.0
    radius: float = 1.0
    circle: float = 3.0
    steps: int = 100
    weight_min: float = 10.0
    weight_max: float = 100.0
    sector: float = math.radians(30.0)

    def array(self) -> Array:
        """The constants as a vector; the module ``kernels`` names its indices."""
        return np.array(dataclasses.astuple(self), dtype=np.float64)


@dataclass(frozen=True)
class MainGame:
    """One main game at one placement of the pedestrian.

    Attributes:
        game, placement: index of the main game, and of the pedestrian's start position in it.
        weight: w, drawn once per main game and the same for both agents.
        phi: angle [rad] from the robot's start to the pedestrian's, seen from the middle; also the pedestrian's heading.
        start: joint start state, 2 x (x, y, heading, speed).
        goals: (x, y, heading) of each agent.
    """

    game: int
    placement: int
    weight: float
    phi: float
    start: Array
    goals: Array


def generator(*key: int) -> np.random.Generator:
    """Random generator for a purpose, given by a key (seed, game, placement, ...), independent of the order of draws.

    NumPy ignores zeros at the end of a key, so the keys of two purposes must not differ only in such zeros.
    """
    return np.random.default_rng(np.random.SeedSequence(list(key)))


def main_game(
    seed: int, game: int, placement: int, placements: int, constants: GameConstants, recipe: int = RECIPE
) -> MainGame:
    """A main game with both agents at rest: w is drawn once per game, the pedestrian's angle once per placement.

    The circle without the sector around the robot is cut into ``placements`` equal arcs; the angle is uniform within the arc
    of the placement. In recipe 1 the angle of the first placement is a function of w.
    """
    weight = float(generator(seed, game).uniform(constants.weight_min, constants.weight_max))
    arc = (2 * math.pi - 2 * constants.sector) / placements
    # With zero, the key of the first placement would be that of w, as in recipe 1.
    purpose = 0 if placement or recipe == 1 else FIRST_ANGLE
    jitter = float(generator(seed, game, placement, purpose).uniform())
    phi = constants.sector + arc * (placement + jitter)
    phi = math.remainder(phi, 2 * math.pi)
    start, goals = [], []
    for heading in (0.0, phi):
        x, y = constants.circle * math.cos(heading), constants.circle * math.sin(heading)
        start += [-x, -y, heading, 0.0]
        goals.append([x, y, heading])
    return MainGame(game, placement, weight, phi, np.array(start), np.array(goals))
