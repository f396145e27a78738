"""The damped step as a linear-quadratic problem: the recursions of `kernel/riccati.hpp` by columns, in C++.

The state of A agents with M = 2 A controls holds the changes of positions p, of z = (heading, speed), and of the controls c
of the step before:  p+ = p + Z z,  z+ = z + dt c,  c+ = c.  A step eliminates its controls,

    L L' = H_cc,   G = L^-1 H_cx,   P = H_xx - G' G,

and keeps the gains L^-T G for the way forward. A thread owns a column of P, and one more column is the gradient, on which
the same operations act. L is so small that every thread computes it for itself. Numbers of agents are constants of the
compiler, so that columns are in registers.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel import constants, layout, threads


def bodies(T: Any, agents: int, fast: layout.Fast, backwards: bool) -> dict[str, str]:
    """The functions of :func:`make` in C++, without their heads."""
    source = Path(__file__).with_name("recursion.hpp").read_text()
    values = {
        "T": threads.number_type(T),
        "A": agents,
        "CPU_LANE": threads.cpu_lane(backwards),
        "ITEMS": layout.CONTROL_ITEMS,
        "SHARED": int(fast.shared),
        "STEPS": fast.steps,
        "CONTROL": fast.control,
        "OWN": fast.own,
        "ROWS": fast.rows,
        "FACTORS": fast.factors,
        **{name: getattr(constants, name) for name in ("PULL", "RATE", "DAMPED_STIFFNESS", "RATE_STIFFNESS")},
        **{name: getattr(constants, name) for name in ("COUPLING", "MOTION")},
    }
    for name, value in values.items():
        source = source.replace(f"${name}$", str(value))
    head, *parts = source.split("// ---- ")
    code = dict(part.split("\n", 1) for part in parts)
    stream = code.pop("stream")
    return {name: head + (stream if name in ("pull", "push") else "") + body for name, body in code.items()}


@no_type_check
def make(T: Any, agents: int, fast: layout.Fast, backwards: bool) -> SimpleNamespace:
    """The recursions for numbers of type ``T``, with fast memory for ``fast``."""
    Array = wp.array(dtype=T)
    code = bodies(T, agents, fast, backwards)

    @wp.func_native(code["begin"])
    def begin(fast: Array, end: int): ...

    @wp.func_native(code["slopes"])
    def add_slopes(fast: Array, count: int, first: int, last: int, dt: T): ...

    @wp.func_native(code["eliminate"])
    def eliminate(
        work: Array,
        linear: int,
        fast: Array,
        factors: Array,
        record: int,
        pairs: int,
        first: int,
        last: int,
        end: int,
        dt: T,
    ) -> int: ...

    @wp.func_native(code["pull"])
    def pull(work: Array, linear: int, fast: Array, factors: Array, end: int, dt: T): ...

    @wp.func_native(code["push"])
    def push(
        work: Array,
        linear: int,
        fast: Array,
        factors: Array,
        end: int,
        dt: T,
        to: Array,
        place: int,
        own_rows: int,
        rows: wp.array(dtype=wp.int32),
        count: int,
        K: int,
    ): ...

    return SimpleNamespace(begin=begin, add_slopes=add_slopes, eliminate=eliminate, pull=pull, push=push)
