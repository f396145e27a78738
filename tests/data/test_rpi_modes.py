"""Modes of a game: the cheapest admissible solution of each side."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from epo_lightning.data.rpi.game import GameConstants
from epo_lightning.data.rpi.modes import cheapest
from epo_lightning.data.rpi.solve import Solutions

CONSTANTS = GameConstants()


def solutions(**changes: list[float] | list[bool]) -> Solutions:
    """Five solutions: three pass on one side, and the last two on the other one."""
    count, none = 5, np.zeros(0)
    found = Solutions(
        *(none, none),
        converged=np.ones(count, dtype=bool),
        agent_costs=none,
        potential=np.array([3.0, 2.0, 4.0, 7.0, 6.0]),
        distance=np.full(count, 0.6),
        rotation=np.array([2.0, 1.0, 3.0, -1.0, -2.0]),
        speed=np.full(count, 0.1),
        iterations=none,
    )
    return dataclasses.replace(found, **{name: np.array(values) for name, values in changes.items()})


@pytest.mark.parametrize(
    ("changes", "modes"),
    [
        ({}, {1: 1, -1: 4}),
        ({"converged": [True, False, True, True, True]}, {1: 0, -1: 4}),
        ({"distance": [0.6, 0.49, 0.6, 0.6, 0.3]}, {1: 0, -1: 3}),
        ({"speed": [0.1, CONSTANTS.speed_min - 0.01, CONSTANTS.speed_min, 0.1, 0.1]}, {1: 0, -1: 4}),
        ({"rotation": [2.0, 1.0, 3.0, 1.0, 2.0]}, {1: 1}),
        ({"converged": [False] * 5}, {}),
    ],
)
def test_a_mode_is_the_cheapest_admissible_solution_of_its_side(changes: dict, modes: dict[int, int]) -> None:
    assert cheapest(solutions(**changes), CONSTANTS) == modes


def test_of_equal_costs_up_to_rounding_the_earliest_start_counts() -> None:
    """Else a strategy that is being executed, the first start, would change by rounding."""
    assert cheapest(solutions(potential=[2.0 + 1e-9, 2.0, 2.0, 7.0, 7.0 - 1e-4]), CONSTANTS) == {1: 0, -1: 4}
