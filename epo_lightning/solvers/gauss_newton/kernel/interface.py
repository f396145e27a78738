"""The kernel's C interface as :mod:`ctypes` structures, and the library behind it.

Its structures, enumerations and constants are declared in `game.hpp` as well. The library exports them (`layout.hpp`), and
loading compares them with those of this module.
"""

from __future__ import annotations

import ctypes
import functools

from epo_lightning.forecast import Status
from epo_lightning.game import circles, vehicles
from epo_lightning.game.features import SLOWEST_STEERING, WHEELBASE
from epo_lightning.solvers.gauss_newton.backends.pytorch import (
    LEAST_DAMPING,
    LEAST_RAISED_DAMPING,
    MOST_DAMPING,
    RETRIES,
)
from epo_lightning.solvers.gauss_newton.kernel.build import load

OWN = (
    "goal",
    "lane",
    "velref",
    "vel",
    "acc",
    "turnr",
    "jerk",
    "turnacc",
    "steer",
    "velb",
    "accb",
    "turnrb",
    "jerkb",
    "turnaccb",
    "heading",
    "accref",
    "turnrref",
)
"""Own features in the kernel's order."""
PAIR = ("proximity", "clearance", "circles", "headway", "longitudinal", "lateral", "time_to_conflict")
"""Pair features in the kernel's order."""
SIGNALS = ("vel", "acc", "turnr", "jerk", "turnacc")
"""Signals with bounds in the kernel's order."""
GIVEN = 7
"""Entries of a given residual: its value, and its derivatives by the four numbers of a state and by its two controls."""
GIVEN_PAIR = 9
"""Entries of a given residual of a pair: its value, and its derivatives by the states of both agents."""
MOST_AGENTS = 64
"""Contacts are a 64-bit mask in the kernel, hence at most 64 agents."""

Address, Integer, Real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class EpoGame(ctypes.Structure):
    """The game as the kernel reads it: sizes, addresses and strides of its tensors; fields as in `game.hpp`."""

    _fields_ = (
        *((name, Integer) for name in ("B", "M", "N", "K", "lines", "points", "pair_stride")),
        ("dt", Real),
        ("bounds", Real * 2 * len(SIGNALS)),
        ("initial", Address),
        *((name, Integer) for name in ("initial_b", "initial_n")),
        ("present", Address),
        ("size", Address),
        ("own", Address * len(OWN)),
        ("own_strides", Integer * 3 * len(OWN)),
        ("pair", Address * len(PAIR)),
        ("pair_strides", Integer * 3 * len(PAIR)),
        ("margins", Address * len(PAIR)),
        ("margin_strides", Integer * 3 * len(PAIR)),
        ("goals", Address),
        *((name, Integer) for name in ("goals_b", "goals_m", "goals_n", "goals_x")),
        *((name, Address) for name in ("references", "reference", "reference_speed", "goal_headings")),
        ("goal_heading_strides", Integer * 3),
        ("reference_controls", Address),
        ("ends", Address),
        ("lane_slides", Integer),
        ("given", Address),
        ("given_count", Integer),
        ("given_pairs", Address),
        ("given_pair_count", Integer),
        ("given_curvature", Address),
        ("given_pair_curvature", Address),
    )


class EpoRun(ctypes.Structure):
    """The arguments and outputs of a solve; fields as in `game.hpp`."""

    _fields_ = (
        ("steps", Integer),
        ("step_size", Real),
        ("damping", Address),
        *((name, Integer) for name in ("damping_problem", "damping_agent")),
        *((name, Integer) for name in ("exact", "adaptive", "record")),
        ("start", Address),
        ("iterates", Address),
        ("iterate_stride", Integer),
        *((name, Address) for name in ("directions", "states", "initial_energy", "energy", "gradient_norm", "status")),
    )


class EpoGradients(ctypes.Structure):
    """Cotangents that the adjoint reads and gradients that it adds to; fields as in `game.hpp`."""

    _fields_ = (
        ("controls", Address),
        ("iterates", Address),
        ("states", Address),
        ("own", Address * len(OWN)),
        ("pair", Address * len(PAIR)),
        ("margins", Address * len(PAIR)),
        ("goals", Address),
        ("goal_headings", Address),
        ("reference_controls", Address),
        ("adjoint", Address),
    )


_PARTS = ("A", "B", "own_cost", "pair_cost", "effort", "push")


class EpoLQGames(ctypes.Structure):
    """Linear-quadratic games and their equilibria; fields as in `game.hpp`."""

    _fields_ = (
        *((name, Integer) for name in ("games", "N", "K")),
        ("rho", Real),
        *((name, Address) for name in (*_PARTS, "free", "gains", "offsets", "unique")),
    )


class EpoLQGradients(ctypes.Structure):
    """The cotangent that the adjoint of equilibria reads and the gradients that it writes; fields as in `game.hpp`."""

    _fields_ = tuple((name, Address) for name in ("controls", *_PARTS))


class EpoPolicies(ctypes.Structure):
    """Policies around trajectories, and the trajectories that follow them; fields as in `game.hpp`."""

    _fields_ = (
        *((name, Integer) for name in ("games", "N", "K")),
        *((name, Real) for name in ("dt", "beta")),
        *(
            (name, Address)
            for name in ("start", "states", "controls", "gains", "offsets", "length", "visited", "chosen")
        ),
    )


class EpoFeedback(ctypes.Structure):
    """The arguments and results of iterated LQ games; fields as in `game.hpp`."""

    _fields_ = (
        *((name, Integer) for name in ("iterations", "remembered", "trials", "terms")),
        *((name, Real) for name in ("tolerance", "rho", "largest_move", "shortest", "dependent")),
        ("controls", Address),
        ("status", Address),
    )


class _Entry(ctypes.Structure):
    _fields_ = (("name", ctypes.c_char_p), ("value", Real))


def layout() -> dict[str, float]:
    """Sizes, offsets and constants that this module shares with the kernel, under the names of `layout.hpp`."""
    found: dict[str, float] = {}
    for structure in (EpoGame, EpoRun, EpoGradients, EpoLQGames, EpoLQGradients, EpoPolicies, EpoFeedback):
        name = structure.__name__
        found[f"sizeof {name}"] = ctypes.sizeof(structure)
        found |= {f"{name}.{field[0]}": getattr(structure, field[0]).offset for field in structure._fields_}
    found |= {name.upper(): index for index, name in enumerate(OWN)} | {"OWN_COUNT": len(OWN)}
    found |= {name.upper(): index for index, name in enumerate(PAIR)} | {"PAIR_COUNT": len(PAIR)}
    found |= {f"BOUND_{name.upper()}": index for index, name in enumerate(SIGNALS)} | {"BOUND_COUNT": len(SIGNALS)}
    found |= {status.name: status.value for status in Status}
    return found | {
        "GIVEN_COUNT": GIVEN,
        "GIVEN_PAIR_COUNT": GIVEN_PAIR,
        "kMostAgents": MOST_AGENTS,
        "kWheelbase": WHEELBASE,
        "kSlowestSteering": SLOWEST_STEERING,
        "kThreeFrom": circles.THREE_FROM,
        "kFiveFrom": circles.FIVE_FROM,
        "kTimeGap": vehicles.TIME_GAP,
        "kConflictTime": vehicles.CONFLICT_TIME,
        "kSlow": vehicles.SLOW,
        "kLeastSize": vehicles.LEAST_SIZE,
        "kRetries": RETRIES,
        "kLeastRaisedDamping": LEAST_RAISED_DAMPING,
        "kLeastDamping": LEAST_DAMPING,
        "kMostDamping": MOST_DAMPING,
    }


def _check_layout(library: ctypes.CDLL) -> None:
    """Compare :func:`layout` with the library's own table.

    Raises:
        RuntimeError: they differ; the message names every entry that does.
    """
    library.epo_layout.restype = ctypes.POINTER(_Entry)
    table, theirs, index = library.epo_layout(), {}, 0
    while table[index].name is not None:
        theirs[table[index].name.decode()] = table[index].value
        index += 1
    ours = layout()
    differences = [
        f"{name} is {ours.get(name, 'missing')} in Python and {theirs.get(name, 'missing')} in the kernel"
        for name in sorted(ours.keys() | theirs.keys())
        if ours.get(name) != theirs.get(name)
    ]
    if differences:
        raise RuntimeError(
            f"the compiled layer does not fit kernel/interface.py: {'; '.join(differences)}. "
            "Change interface.py and game.hpp together: they describe the same structures and constants."
        )


@functools.cache
def find() -> ctypes.CDLL | str:
    """The library, or the reason why there is none.

    Raises:
        RuntimeError: the library's structures or constants differ from those of this module.
    """
    try:
        loaded = load()
    except OSError as error:
        return (
            f"{error}; with a C++ compiler on the path, "
            "`python -m epo_lightning.solvers.gauss_newton.kernel.build` builds it"
        )
    _check_layout(loaded)
    run = (ctypes.POINTER(EpoGame), ctypes.POINTER(EpoRun))
    loaded.epo_solve.argtypes = (Integer, *run, Integer, ctypes.POINTER(Address))
    loaded.epo_differentiate.argtypes = (Address, *run, ctypes.POINTER(EpoGradients))
    loaded.epo_release.argtypes, loaded.epo_release.restype = (Address,), None
    loaded.epo_lq_equilibria.argtypes = (ctypes.POINTER(EpoLQGames), Integer)
    loaded.epo_lq_pull_back.argtypes = (ctypes.POINTER(EpoLQGames), ctypes.POINTER(EpoLQGradients), Integer)
    loaded.epo_lq_follow.argtypes = (ctypes.POINTER(EpoPolicies), Integer)
    loaded.epo_feedback.argtypes = (ctypes.POINTER(EpoGame), ctypes.POINTER(EpoFeedback), Integer)
    loaded.epo_feedback_pull_back.argtypes = (*loaded.epo_feedback.argtypes[:2], ctypes.POINTER(EpoGradients), Integer)
    called = ("solve", "differentiate", "lq_equilibria", "lq_pull_back", "lq_follow", "feedback", "feedback_pull_back")
    for name in (*called, "levels", "built"):
        getattr(loaded, f"epo_{name}").restype = Integer
    loaded.epo_choose.argtypes, loaded.epo_choose.restype = (Integer,), None
    return loaded


def library() -> ctypes.CDLL:
    """The library.

    Raises:
        RuntimeError: it is missing, or differs from this module.
    """
    found = find()
    if isinstance(found, str):
        raise RuntimeError(f"the compiled layer is missing: {found}")
    return found


def check(outcome: int) -> None:
    """Check what a function of the library has returned.

    Raises:
        MemoryError: there was not enough memory for its work.
    """
    if outcome:
        raise MemoryError("there is not enough memory for the compiled layer: solve fewer scenes or modes at a time")
