"""Constants of the fused kernels: indices of features and signals in the order of `kernel/interface.py`, and of arrays."""

from epo_lightning.forecast import Status
from epo_lightning.scene import TURN_RATE as TURN_RATE
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, PAIR, SIGNALS

GOAL, LANE, VELREF, VEL, HEADING, STEER, VELB = (
    OWN.index(name) for name in ("goal", "lane", "velref", "vel", "heading", "steer", "velb")
)
# Features of accelerations and of turn rates.
ACC, TURNR = OWN.index("acc"), OWN.index("turnr")
ACCB, TURNRB = OWN.index("accb"), OWN.index("turnrb")
ACCREF, TURNRREF = OWN.index("accref"), OWN.index("turnrref")
JERK, TURNACC = OWN.index("jerk"), OWN.index("turnacc")
JERKB, TURNACCB = OWN.index("jerkb"), OWN.index("turnaccb")
BOUND_VEL, BOUND_ACC, BOUND_TURNR, BOUND_JERK, BOUND_TURNACC = range(len(SIGNALS))
PAIRS = len(PAIR)
COMPLETED, DAMPED, STOPPED = (int(status) for status in (Status.COMPLETED, Status.DAMPED, Status.STOPPED))
X, Y, TURNED, SPEED, SINE, COSINE = range(6)  # arrays of a trajectory
NEAR_X, NEAR_Y, AHEAD_X, AHEAD_Y = range(4)  # nearest points of reference lines, and unit tangents there
# Derivatives by the controls of an agent: gradient by turn rate and acceleration, the part of it by their changes, damped
# second derivatives, the part of them by the changes, that by turn rate and speed, and the motion of the position.
PULL, RATE, DAMPED_STIFFNESS, RATE_STIFFNESS, COUPLING, MOTION = 0, 2, 4, 6, 8, 9
WARP = 32
"""Threads of a game on a GPU that has many games to solve: one warp, so that its barrier is cheap."""
TEAM = 128
"""Threads of a game on a GPU that has few games to solve: four warps, which share out its work."""
