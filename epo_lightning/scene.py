"""The observed scene, with which every forecast begins, and the letters of the project's shapes.

The letters (``game`` and ``solvers/gauss_newton`` state the few that they use otherwise):

====  ==========================  ======  ================================================================
B     scenes in a batch           P       pairs of agents i < j, P = N (N - 1) / 2
M     joint modes                 G       goal candidates of an agent
N     agents                      X = 4   state: x, y [m], heading [rad], speed [m/s]
H     history steps               U = 2   control: acceleration [m/s^2], turn rate [rad/s]
K     future steps                S       optimisation steps
R     reference lines, residuals  Q       points of a reference line
L     lane polylines              V       vectors of a lane polyline
C     candidate strategies        D       width of the features z
====  ==========================  ======  ================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.batch import Batch

X, Y, HEADING, SPEED = range(4)
KINDS = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "other")
"""Classes of agents; ``Scene.kind`` is an index into this tuple."""
SHAPES = ("disc", "box")
"""Outlines of agents: discs with the length as diameter, or boxes of length times width."""
ACCELERATION, TURN_RATE = range(2)
LARGEST_HEADING = 1e4
"""Largest size of a heading [rad]: in single precision, rounding hides the direction of a larger one."""


def wrapped(turn: Tensor) -> Tensor:
    """The turn in [-pi, pi) that leads to the same direction as a difference of two headings [rad].

    Example:
        From just below pi to just above -pi, as recordings write headings:

        >>> wrapped(torch.tensor(-3.0 - 3.0))
        tensor(0.2832)
    """
    return torch.remainder(turn + math.pi, 2.0 * math.pi) - math.pi


_FLOAT, _INTEGER, _MASK = "floating-point", "integer", "boolean"

FIELDS: Mapping[str, tuple[str, tuple[str | int, ...], str | None]] = {
    "history": (_FLOAT, ("B", "N", "H", 4), None),
    "history_mask": (_MASK, ("B", "N", "H"), None),
    "agent_mask": (_MASK, ("B", "N"), None),
    "future": (_FLOAT, ("B", "N", "K", 4), None),
    "future_mask": (_MASK, ("B", "N", "K"), "future"),
    "goal_candidates": (_FLOAT, ("B", "N", "G", 2), None),
    "goal_mask": (_MASK, ("B", "N", "G"), "goal_candidates"),
    "goal_reference": (_INTEGER, ("B", "N", "G"), "goal_candidates"),
    "size": (_FLOAT, ("B", "N", 2), None),
    "kind": (_INTEGER, ("B", "N"), None),
    "lanes": (_FLOAT, ("B", "L", "V", 4), None),
    "lane_mask": (_MASK, ("B", "L", "V"), "lanes"),
    "references": (_FLOAT, ("B", "N", "R", "Q", 2), None),
    "reference_mask": (_MASK, ("B", "N", "R"), "references"),
    "reference_speed": (_FLOAT, ("B", "N"), None),
    "frame": (_FLOAT, ("B", 3), None),
    "subset": (_INTEGER, ("B",), None),
    "id": (_INTEGER, ("B",), None),
    "goal_headings": (_FLOAT, ("B", "N", "G"), "goal_candidates"),
    "game_steps": (_INTEGER, ("B",), None),
}
"""For every tensor of a :class:`Scene`: number type, shape, and the field that it belongs to, which must be given too."""

_LEAST = {"H": (1, "step; the last one is the current state, t0"), "K": (1, "step"), "Q": (2, "points of each line")}
"""Smallest sizes of some dimensions, with the unit that error messages name."""


@dataclass(frozen=True, repr=False)
class Scene(Batch):
    """A batch of B observed scenes: agents' histories and sizes, the map and, in training, the agents' futures.

    Positions are in one fixed frame for the whole scene. Masks are True where an entry is real and False for padding; the
    values of padding never influence a result. A mask that is left out means that every entry is real.

    Attributes:
        history: states x, y [m], heading [rad], speed [m/s]; the last step is the current one, t0.
        dt: length of a time step [s].
        history_mask: observed steps of the history. An agent that is present is observed at t0.
        agent_mask: agents that exist; the others are padding.
        future: observed states after t0, the first one dt later; None when forecasting.
        future_mask: observed steps of the future.
        goal_candidates: possible goal positions [m] of each agent; G = 1 where the goal is given (RPI).
        goal_mask: candidates that exist.
        goal_reference: index of the reference line on which each candidate lies.
        size: length and width [m].
        kind: class of each agent, an index into :data:`KINDS`.
        lanes: the map, as polylines of vectors from one point of a lane to the next: x, y of both [m].
        lane_mask: lane vectors that exist.
        references: lines that an agent may follow, as points [m] (lane centres); a line with fewer points repeats its
            last one.
        reference_mask: reference lines that exist.
        reference_speed: desired speed of each agent [m/s].
        frame: origin x, y [m] and rotation [rad] of the transformation back to the recording's coordinates:
            world = R(rotation) position + origin.
        subset: index of the named subset of the data that the future belongs to (RPI: executed 0, alternative 1;
            recorded data: calm 0, interactive 1).
        id: index of the scene's record in its data set.
        goal_headings: heading [rad] that an agent wants at each goal candidate, continuous with the agent's heading: it is
            not wrapped to (-pi, pi], so a difference of 2 pi is a full turn.
        game_steps: number of steps from t0 to the end of each scene's game. Controls after the end have no cost and no
            effect. A forecaster whose `game_horizon` is the forecast's removes these numbers. None if all games end
            with the last control.

    Raises:
        TypeError: a field that is not a tensor (numpy arrays included), or a time step that is not a number.
        ValueError: a shape or type of number that does not fit, or a time step that is not positive and finite.
    """

    history: Float[Tensor, "B N H 4"]
    dt: float
    history_mask: Bool[Tensor, "B N H"] = None  # type: ignore[assignment]  # filled in below
    agent_mask: Bool[Tensor, "B N"] = None  # type: ignore[assignment]
    future: Float[Tensor, "B N K 4"] | None = None
    future_mask: Bool[Tensor, "B N K"] | None = None
    goal_candidates: Float[Tensor, "B N G 2"] | None = None
    goal_mask: Bool[Tensor, "B N G"] | None = None
    goal_reference: Int[Tensor, "B N G"] | None = None
    size: Float[Tensor, "B N 2"] | None = None
    kind: Int[Tensor, "B N"] | None = None
    lanes: Float[Tensor, "B L V 4"] | None = None
    lane_mask: Bool[Tensor, "B L V"] | None = None
    references: Float[Tensor, "B N R Q 2"] | None = None
    reference_mask: Bool[Tensor, "B N R"] | None = None
    reference_speed: Float[Tensor, "B N"] | None = None
    frame: Float[Tensor, "B 3"] | None = None
    subset: Int[Tensor, " B"] | None = None
    id: Int[Tensor, " B"] | None = None
    goal_headings: Float[Tensor, "B N G"] | None = None
    game_steps: Int[Tensor, " B"] | None = None

    def __post_init__(self) -> None:
        # Only shapes and types are checked here; checking values would make the host wait for a GPU (`validate_values`).
        if not isinstance(self.dt, Real) or isinstance(self.dt, bool):
            raise TypeError(f"scene.dt is a {type(self.dt).__name__}; it takes a number of seconds")
        if not 0 < self.dt < math.inf:
            raise ValueError(f"scene.dt must be positive and finite [s], not {self.dt}")
        sizes: dict[str, int] = {}
        for name, (numbers, shape, owner) in FIELDS.items():
            value = getattr(self, name)
            if value is not None:
                if owner is not None and getattr(self, owner) is None:
                    raise ValueError(f"scene.{name} describes scene.{owner}, which is None: give both or neither")
                _check_tensor(name, value, numbers, shape, sizes)
            elif name == "history":
                raise TypeError("scene.history is None; it takes a tensor [B, N, H, 4]: x, y, heading, speed")

        for name, (numbers, shape, owner) in FIELDS.items():
            if numbers == _MASK and getattr(self, name) is None and (owner is None or getattr(self, owner) is not None):
                ones = torch.ones([sizes[str(dim)] for dim in shape], dtype=torch.bool, device=self.history.device)
                object.__setattr__(self, name, ones)

    def validate_values(self) -> None:
        """Refuse values that no forecaster can use. On a GPU, this check makes the host wait for the tensors.

        Raises:
            ValueError: a present agent that is not observed at t0, a heading so large that rounding hides its direction, a
                length or width that is not positive and finite, a kind that does not exist, or the index of a reference
                line that does not exist.
        """
        assert self.history_mask is not None
        bad = self.agent_mask & ~self.history_mask[..., -1]
        if bad.any():
            scene, agent = bad.nonzero()[0].tolist()
            raise ValueError(
                f"scene.history_mask[{scene}, {agent}, -1] is False; an agent that is there (agent_mask) is observed at t0"
            )
        bad = (self.history[..., HEADING].abs() > LARGEST_HEADING) & self.history_mask & self.agent_mask[..., None]
        if bad.any():
            scene, agent, step = bad.nonzero()[0].tolist()
            heading = float(self.history[scene, agent, step, HEADING])
            raise ValueError(
                f"scene.history[{scene}, {agent}, {step}] has the heading {heading:g} rad; headings are at most "
                f"{LARGEST_HEADING:g} in size"
            )
        if self.size is not None:
            bad = ~((self.size > 0) & self.size.isfinite()).all(-1) & self.agent_mask
            if bad.any():
                scene, agent = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"scene.size[{scene}, {agent}] is {self.size[scene, agent].tolist()}; length and width must be "
                    "positive and finite [m]"
                )
        if self.kind is not None:
            bad = ((self.kind < 0) | (self.kind >= len(KINDS))) & self.agent_mask
            if bad.any():
                scene, agent = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"scene.kind[{scene}, {agent}] is {int(self.kind[scene, agent])}; kinds are 0 to {len(KINDS) - 1}: "
                    f"{', '.join(KINDS)}"
                )
        if self.goal_reference is not None and self.references is not None:
            lines = self.references.shape[2]
            assert self.goal_mask is not None
            bad = (self.goal_reference < 0) | (self.goal_reference >= lines)
            bad &= self.goal_mask & self.agent_mask[..., None]
            if bad.any():
                at = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"scene.goal_reference{at} is {int(self.goal_reference[tuple(at)])}; scene.references holds the "
                    f"lines 0 to {lines - 1}"
                )

    @property
    def current(self) -> Float[Tensor, "B N 4"]:
        """The states at t0."""
        return self.history[:, :, -1]

    @property
    def current_or_zero(self) -> Float[Tensor, "B N 4"]:
        """The states at t0; zero for absent agents, whose entries are padding of any value."""
        return torch.where(self.agent_mask[..., None], self.current, 0.0)

    @property
    def finite(self) -> Bool[Tensor, " B"]:
        """Mask of the scenes whose real entries are all finite; padding is not checked."""
        result = torch.ones(len(self.history), dtype=torch.bool, device=self.history.device)
        references = None if self.references is None else self.references.flatten(3)
        speed = None if self.reference_speed is None else self.reference_speed[..., None]
        headings = None if self.goal_headings is None else self.goal_headings[..., None]
        for values, mask in (
            (self.history, self.history_mask),
            (self.future, self.future_mask),
            (self.goal_candidates, self.goal_mask),
            (headings, self.goal_mask),
            (self.size, None),
            (references, self.reference_mask),
            (speed, None),
        ):
            if values is not None:
                bad = ~values.isfinite().all(-1)
                bad &= self.agent_mask.view(*self.agent_mask.shape, *[1] * (bad.dim() - 2))
                result &= ~(bad if mask is None else bad & mask).flatten(1).any(1)
        if self.lanes is not None:
            assert self.lane_mask is not None
            result &= (self.lanes.isfinite().all(-1) | ~self.lane_mask).flatten(1).all(1)
        return result


def heading_vector(heading: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2"]:
    """Unit vectors (x, y) in the directions of headings [rad]."""
    return torch.stack((heading.cos(), heading.sin()), -1)


def rotated(vector: Float[Tensor, "*#batch 2"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 2"]:
    """Vectors (x, y) rotated to the left by an angle [rad]; minus a heading leads to its frame, (forward, left).

    Example:
        >>> rotated(torch.tensor([2.0, 1.0]), torch.tensor(math.pi / 2)).round()
        tensor([-1.,  2.])
    """
    (x, y), cosine, sine = vector.unbind(-1), angle.cos(), angle.sin()
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y), -1)


def velocities(states: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 2"]:
    """Velocities (x, y) [m/s] of states."""
    return states[..., SPEED, None] * heading_vector(states[..., HEADING])


def _check_tensor(name: str, value: Any, numbers: str, shape: tuple[str | int, ...], sizes: dict[str, int]) -> None:
    """Compare a field of a scene with its declared type and shape, and store the size of each dimension letter in ``sizes``.

    Raises:
        TypeError: not a tensor.
        ValueError: another type of number or another shape.
    """
    if not isinstance(value, Tensor):
        given = type(value)
        raise TypeError(f"scene.{name} is a {given.__module__}.{given.__qualname__}; convert it with torch.as_tensor")
    kind = "boolean" if value.dtype == torch.bool else "floating-point" if value.is_floating_point() else "integer"
    if kind != numbers:
        hint = "; masks are torch.bool, True where an entry is real" if numbers == _MASK else ""
        raise ValueError(f"scene.{name} is of type {value.dtype}, expected {numbers} numbers{hint}")
    expected = [sizes.get(dim, dim) if isinstance(dim, str) else dim for dim in shape]
    fits = value.dim() == len(expected) and all(
        isinstance(want, str) or want == got for want, got in zip(expected, value.shape, strict=True)
    )
    if not fits:
        words = ", ".join(map(str, expected))
        raise ValueError(f"scene.{name} has shape {list(value.shape)}; this scene takes [{words}]")
    for dim, got in zip(shape, value.shape, strict=True):
        least, unit = _LEAST.get(str(dim), (0, ""))
        if got < least:
            raise ValueError(f"scene.{name} has shape {list(value.shape)}; it takes at least {least} {unit}")
        if isinstance(dim, str):
            sizes[dim] = got


def observed_future(
    scene: Scene, needs: str = "training needs"
) -> tuple[Float[Tensor, "B N K 4"], Bool[Tensor, "B N K"]]:
    """The future of a scene, and the mask of the steps at which present agents were observed.

    Args:
        scene: a batch.
        needs: subject and verb of the error message.

    Raises:
        ValueError: the scene has no future.
    """
    if scene.future is None or scene.future_mask is None:
        raise ValueError(f"{needs} scene.future [B, N, K, 4], which is None")
    return scene.future, scene.future_mask & scene.agent_mask[..., None]
