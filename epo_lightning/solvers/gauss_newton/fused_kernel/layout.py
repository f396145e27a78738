"""Places of arrays in the memory that a game uses while it is solved or differentiated."""

from __future__ import annotations

from dataclasses import dataclass

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import WARP

CONTROL_ITEMS = 13
"""Numbers of an agent and a control: see ``PULL`` and the others in `constants.py`."""
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
        "fast": fast.numbers,
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
        own: second derivatives of a state's costs by position, heading and speed of an agent, and the gradient [C, A, 5, 4].
        path: trajectories and their sines and cosines [6, A, K + 1]; -1 where they are in the other memory.
        factors: what the recursion keeps of a step and its linear terms [K, :func:`factor_numbers` + 2 A]; -1 without room.
        weights: of own features [O, A], of pair features [F, P], and their margins [F, P].
        rows: gradients of pair features by the state of an agent, with every other agent [F, C, A, A, 4]; the values of all
            pairs are in the places of agents with themselves.
        numbers: of all together. The first ones, up to ``control``, are the arrays of the recursion.
        shared: whether this is shared memory.
    """

    steps: int
    control: int
    own: int
    path: int
    factors: int
    weights: int
    rows: int
    numbers: int
    shared: bool


STEPS_ON_CPUS = 4
"""Steps whose costs are in fast memory at a time on a CPU."""
MOST_SHARED = 46_000
"""Bytes of shared memory that a game may have, below the 48 kB that a compiler reserves without being asked."""
SHARED_OF_MANY = 13_400
"""Bytes with which 16 games are in the shared memory of a multiprocessor of an H100 or H200 at a time."""


def fast(agents: int, own: int, pair: int, horizon: int | None, double: bool, threads: int) -> Fast:
    """Places for games of ``agents`` agents with ``own`` and ``pair`` features.

    Args:
        agents: A.
        own: O.
        pair: F.
        horizon: K on a GPU; None on a CPU.
        double: whether numbers have double precision.
        threads: number of threads of a game. Games with more than a warp are few, and each may have more memory.
    """
    A, P = agents, agents * (agents - 1) // 2
    each = {"control": CONTROL_ITEMS * A, "own": 20 * A, "rows": pair * 4 * A * A}
    recursion = recursion_numbers(A)
    weights = own * A + 2 * pair * P
    steps, path, factors = STEPS_ON_CPUS, 0, 0
    if horizon is not None:
        most = (SHARED_OF_MANY if threads == WARP else MOST_SHARED) // (8 if double else 4)
        path = 6 * A * (horizon + 1)
        path = path if path <= most // 3 else 0
        left = most - recursion - each["control"] - path - weights - 16  # places are rounded up to multiples of four
        # At least as many steps as give each thread of a warp an agent.
        steps = min(max(left // sum(each.values()), WARP // A), horizon)
        factors = horizon * (factor_numbers(A) + 2 * A)
        factors = factors if steps == horizon and factors <= left - steps * sum(each.values()) else 0
    counts = {
        "recursion": recursion,
        "control": (steps + 1) * each["control"],
        "own": steps * each["own"],
        "path": path,
        "factors": factors,
        "weights": weights,
        "rows": steps * each["rows"],
    }
    places, numbers = {}, 0
    for name, count in counts.items():
        places[name] = numbers if count or name not in ("path", "factors") else -1
        numbers += -(-count // 4) * 4
    del places["recursion"]
    shared = horizon is not None and numbers * (8 if double else 4) <= MOST_SHARED
    return Fast(steps, **places, numbers=numbers, shared=shared)


def recursion_numbers(agents: int) -> int:
    """Numbers of the recursion's arrays: the value function, and two arrays of a row per control; or what it streams."""
    controls = 2 * agents
    way_back = 4 * controls * (3 * controls + 4) + controls * 8 * agents
    streamed = 4 * 3 * controls + 4 * (factor_numbers(agents) + controls)
    return max(way_back, streamed)


def factor_numbers(agents: int) -> int:
    """Numbers of a step that the recursion keeps: gains [2 A, 6 A], second derivatives by changes of controls, motions."""
    controls = 2 * agents
    return 3 * controls**2 + controls + 4 * agents
