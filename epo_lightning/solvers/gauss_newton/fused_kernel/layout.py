"""Places of arrays in the memory that a game uses while it is solved or differentiated."""

from __future__ import annotations

from dataclasses import dataclass

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import WARP

CONTROL_ITEMS = 13
"""Numbers of an agent and a control: see ``PULL`` and the others in `constants.py`."""
PAIR_ROWS = 9
"""Numbers of a pair feature at a state: its gradient by the first and by the second agent (4 each), and its value."""
PAIR_COTANGENTS = 10
"""Numbers of a pair at a state in the adjoint: 6 of positions, 2 of heading and speed of each agent."""


@dataclass(frozen=True)
class Layout:
    """First numbers of the arrays; the shape of each, with A agents, P pairs, K steps, F pair features, O own features.

    The array ``energy`` is that of a step, and those from ``mu`` on are those of its adjoint, in the same place. ``fast`` is
    used where a game has no shared memory, and ``path`` where :class:`Fast` has no place for it.

    Attributes:
        path: trajectories and their sines and cosines [6, A, K + 1].
        linear: gradient by the controls, as the recursion leaves it [K, 2 A].
        fast: see :class:`Fast`.
        energy: by agent and by pair [A + P, K], and sums along time of each [A + P].
        mu: product of the inverse Hessian and a cotangent [A, K, 2].
        tangents: of the trajectories along mu and along the step [2, 4, A, K + 1].
        along: cotangents of positions (6), heading and speed [8, A, K].
        rates: cotangents of the changes of controls [2, A, K + 1].
        touching: cotangents of pairs [10, P, K].
        weights: products for the gradients by weights of own features [O, A, K], of pair features and margins [2, F, P, K].
        numbers: of all together.
    """

    path: int
    linear: int
    fast: int
    energy: int
    mu: int
    tangents: int
    along: int
    rates: int
    touching: int
    weights: int
    numbers: int


def layout(agents: int, steps: int, own: int, pair: int, fast: Fast) -> Layout:
    """The places for games of ``agents`` agents and ``steps`` steps with these numbers of features."""
    A, K, P = agents, steps, agents * (agents - 1) // 2
    shared = {
        "path": 0 if fast.path >= 0 else 6 * A * (K + 1),
        "linear": 2 * A * K,
        "fast": 0 if fast.shared else fast.numbers,
    }
    of_step = {"energy": (A + P) * (K + 1)}
    of_adjoint = {
        "mu": 2 * A * K,
        "tangents": 8 * A * (K + 1),
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


@dataclass(frozen=True)
class Fast:
    """Places in the fast memory of a game: shared memory on a GPU.

    The costs of ``steps`` steps are in it at a time, just before the recursion needs them.

    Attributes:
        steps: C, the number of those steps.
        control: derivatives by controls [C + 1, 13, A], at k modulo C + 1: the recursion needs those of the next step too.
        hessian: of the costs of a state by positions, headings and speeds, and their gradient [C, 4 A + 1, 4 A].
        path: trajectories and their sines and cosines [6, A, K + 1]; -1 where they are in the other memory.
        rows: pair features [F, C, 9, P].
        numbers: of all together. The first ones, up to ``control``, are the arrays of the recursion.
        shared: whether this is shared memory.
    """

    steps: int
    control: int
    hessian: int
    path: int
    rows: int
    numbers: int
    shared: bool


STEPS_ON_CPUS = 4
"""Steps whose costs are in fast memory at a time on a CPU."""
MOST_SHARED = 46_000
"""Bytes of shared memory that a game may have, below the 48 kB that a compiler reserves without being asked."""
SHARED_OF_MANY = 13_200
"""Bytes with which 16 games are in the shared memory of a multiprocessor of an H100 or H200 at a time."""


def fast(agents: int, pair: int, horizon: int | None, double: bool, threads: int) -> Fast:
    """Places for games of ``agents`` agents with ``pair`` pair features.

    Args:
        agents: A.
        pair: F.
        horizon: K on a GPU; None on a CPU.
        double: whether numbers have double precision.
        threads: of a game: of few games, one has the memory of a multiprocessor nearly for itself.
    """
    A, P = agents, agents * (agents - 1) // 2
    sizes = {"control": CONTROL_ITEMS * A, "hessian": (4 * A + 1) * 4 * A, "rows": pair * PAIR_ROWS * P}
    recursion = 5 * 2 * A * (6 * A + 4)  # the value function and two arrays of a row per control
    steps, path, most = STEPS_ON_CPUS, 0, 0
    if horizon is not None:
        most = (SHARED_OF_MANY if threads == WARP else MOST_SHARED) // (8 if double else 4)
        path = 6 * A * (horizon + 1)
        path = path if path <= most // 3 else 0
        left = most - recursion - sizes["control"] - path
        steps = max(1, min(left // sum(sizes.values()), horizon))
    places = [recursion]
    for count in ((steps + 1) * sizes["control"], steps * sizes["hessian"], path, steps * sizes["rows"]):
        places.append(places[-1] + -(-count // 4) * 4)
    control, hessian, at_path, rows, numbers = places
    shared = horizon is not None and numbers * (8 if double else 4) <= MOST_SHARED
    return Fast(steps, control, hessian, at_path if path else -1, rows, numbers, shared)


def factor_numbers(agents: int) -> int:
    """Numbers of a step that the recursion keeps: gains [2 A, 6 A], second derivatives by changes of controls, motions."""
    controls = 2 * agents
    return 3 * controls**2 + controls + 4 * agents
