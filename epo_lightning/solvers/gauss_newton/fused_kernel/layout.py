"""Places of arrays in the memory that a game uses while it is solved or differentiated."""

from __future__ import annotations

from dataclasses import dataclass

CONTROL_ITEMS = 13
"""Numbers of an agent and a control: see ``PULL`` and the others in `constants.py`."""
PAIR_ROWS = 9
"""Numbers of a pair feature at a state: its gradient by the first and by the second agent (4 each), and its value."""
PAIR_COTANGENTS = 10
"""Numbers of a pair at a state in the adjoint: 6 of positions, 2 of heading and speed of each agent."""


@dataclass(frozen=True)
class Layout:
    """First numbers of the arrays; the shape of each, with A agents, P pairs, K steps, F pair features, O own features.

    The arrays from ``hessian`` on are those of a step, and those from ``along`` on those of its adjoint, in the same place.
    ``fast`` is used on CPUs only: GPUs have shared memory in its place.

    Attributes:
        path: trajectories and their sines and cosines [6, A, K + 1].
        linear: gradient by the controls, as the recursion leaves it [K, 2 A].
        mu: product of the inverse Hessian and a cotangent [A, K, 2].
        tangents: of the trajectories along mu and along the step [2, 4, A, K + 1].
        costs: sums along time of gradients [8, A, K], and single sums [A + P].
        control: derivatives by controls [K, 13, A].
        fast: what the recursion works on.
        hessian: of the costs of a state by positions, headings and speeds, and their gradient [K, 4 A + 1, 4 A].
        rows: pair features [F, K, 9, P].
        energy: by agent and by pair [A + P, K].
        along: cotangents of positions (6), heading and speed [8, A, K].
        rates: cotangents of the changes of controls [2, A, K + 1].
        touching: cotangents of pairs [10, P, K].
        weights: products for the gradients by weights of own features [O, A, K], of pair features and margins [2, F, P, K].
        numbers: of all together.
    """

    path: int
    linear: int
    mu: int
    tangents: int
    costs: int
    control: int
    fast: int
    hessian: int
    rows: int
    energy: int
    along: int
    rates: int
    touching: int
    weights: int
    numbers: int


def layout(agents: int, steps: int, own: int, pair: int) -> Layout:
    """The places for games of ``agents`` agents and ``steps`` steps with these numbers of features."""
    A, K, P = agents, steps, agents * (agents - 1) // 2
    shared = {
        "path": 6 * A * (K + 1),
        "linear": 2 * A * K,
        "mu": 2 * A * K,
        "tangents": 8 * A * (K + 1),
        "costs": 8 * A * K + A + P,
        "control": CONTROL_ITEMS * A * K,
        "fast": fast_numbers(A),
    }
    of_step = {"hessian": (4 * A + 1) * 4 * A * K, "rows": pair * K * PAIR_ROWS * P, "energy": (A + P) * K}
    of_adjoint = {
        "along": 8 * A * K,
        "rates": 2 * A * (K + 1),
        "touching": PAIR_COTANGENTS * P * K,
        "weights": own * A * K + 2 * pair * P * K,
    }
    places: dict[str, int] = {}

    def reserve(sizes: dict[str, int], start: int) -> int:
        for name, size in sizes.items():
            places[name] = start
            start += -(-size // 4) * 4  # four numbers are read at once, and their place must be a multiple of four
        return start

    start = reserve(shared, 0)
    end = max(reserve(of_step, start), reserve(of_adjoint, start))
    return Layout(**places, numbers=end)


def fast_numbers(agents: int) -> int:
    """Numbers of the recursion's arrays: the value function, two arrays of a row per control, and controls of two steps."""
    controls = 2 * agents
    way_back = 5 * controls * (3 * controls + 4) + 2 * CONTROL_ITEMS * agents + 4
    streamed = 12 * controls + 4 * (factor_numbers(agents) + controls)
    return max(way_back, streamed)


def factor_numbers(agents: int) -> int:
    """Numbers of a step that the recursion keeps: gains [2 A, 6 A], second derivatives by changes of controls, motions."""
    controls = 2 * agents
    return 3 * controls**2 + controls + 4 * agents
