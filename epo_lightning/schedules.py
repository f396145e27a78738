"""Schedules of training losses: numbers that change with the optimisation step, such as a temperature."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor


@dataclass
class Schedule(ABC):
    """A number of a loss that falls during training and ends at zero.

    Attributes:
        held: a tensor that takes the place of the number until it is zero. A CUDA graph repeats the numbers of Python with
            which it was captured, but reads the value that a tensor has at each replay.
    """

    held: Tensor | None = field(default=None, init=False, repr=False, compare=False)

    @abstractmethod
    def number(self, step: int) -> float:
        """The number at an optimisation step."""

    @contextmanager
    def holding(self, tensor: Tensor) -> Iterator[None]:
        """Context of losses in which the tensor takes the place of the number."""
        self.held = tensor
        try:
            yield
        finally:
            self.held = None

    def at(self, step: int) -> float | Tensor:
        """The number at an optimisation step, or the tensor that holds it."""
        number = self.number(step)
        return self.held if self.held is not None and number > 0 else number


def is_positive(number: float | Tensor) -> bool:
    """Whether the number of a schedule is above zero; a tensor takes its place only then."""
    return isinstance(number, Tensor) or number > 0


@dataclass
class Relaxation(Schedule):
    """Schedule of a loss that trains all modes a little at first: (1 - share) * closest mode + share * mean over modes.

    The paper's loss trains only the mode that is closest to the data. A mode that starts far from the data gets no gradient
    and stays unused. With a small share of the mean early in training, every mode is drawn towards the data.

    Attributes:
        share: share of the mean at the first step; 0 is the paper's loss.
        steps: optimisation steps over which the share falls linearly to zero.
    """

    share: float = 0.0
    steps: int = 1000

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1 or self.steps < 1:
            raise ValueError(
                f"relaxation must be in [0, 1] and relaxation_steps 1 or more, not {self.share} and {self.steps}"
            )

    def number(self, step: int) -> float:
        """The share at an optimisation step."""
        return self.share * max(0.0, 1.0 - step / self.steps)


HARDEST = 0.01
"""Temperature [m] at which annealing ends and the hard minimum begins: modes 5 cm apart are told apart by then."""


@dataclass
class Annealing(Schedule):
    """Schedule of a loss with a soft minimum over modes, whose temperature falls (annealed winner-takes-all).

    With the distances d_m [m] of the modes from the data and the temperature T [m], the loss is

        -T log mean_m exp(-h(d_m) / T),    h(d) = sqrt(d^2 + T^2) - T,

    so every mode gets the share softmin(h(d) / T) of the gradient: at a high temperature all shares are equal; as it falls,
    those of farther modes shrink, and in the end the closest mode has all of it. This is the loss of Xu et al.
    (Annealed Winner-Takes-All for Motion Forecasting, arXiv 2409.11172), whose temperatures start at about 10 and fall by a
    factor of 0.834 per epoch, with two differences. The fall is geometric too, but counted in optimisation steps. And h,
    which is quadratic below T and nearly d far above it, takes the place of d: with d itself, the pull does not weaken
    close to an alternative, so that a mode at the likelier one would never leave it for the other.

    Attributes:
        temperature: T [m] at the first step; 0 is the paper's loss. Useful values are below half the distance between
            modes that should be found; at higher ones all modes first go to one place and may be late to part.
        steps: optimisation steps in which T falls to :data:`HARDEST`. The loss is the hard minimum from then on.
    """

    temperature: float = 0.0
    steps: int = 2000

    def __post_init__(self) -> None:
        if not (self.temperature == 0 or HARDEST < self.temperature < math.inf) or self.steps < 1:
            raise ValueError(
                f"annealing must be 0, or a temperature above {HARDEST} m, and annealing_steps 1 or more, not "
                f"{self.temperature} and {self.steps}"
            )

    def number(self, step: int) -> float:
        """The temperature [m] at an optimisation step; 0 for the hard minimum."""
        if self.temperature == 0 or step >= self.steps:
            return 0.0
        return float(self.temperature * (HARDEST / self.temperature) ** (step / self.steps))


class Softness(NamedTuple):
    """Power, relaxation and temperature of an imitation loss at an optimisation step; the defaults are the paper's loss.

    Attributes:
        power: 1 for Euclidean distances; above, exponent of each coordinate's error (:func:`.losses.distances`).
        relaxation: share of the mean over modes (:class:`Relaxation`).
        temperature: temperature [m] of the soft minimum (:class:`Annealing`); 0 for the minimum.
    """

    power: float = 1.0
    relaxation: float | Tensor = 0.0
    temperature: float | Tensor = 0.0


@dataclass(frozen=True)
class ImitationSchedule:
    """Schedule of an imitation loss: how it changes during training.

    Attributes:
        power: 1 for Euclidean distances; above, exponent of each coordinate's error (:func:`.losses.distances`).
        relaxation, annealing: schedules of the share of the mean, and of the temperature.

    Raises:
        ValueError: a power below 1, whose gradient has no bound near a distance of zero, or an infinite one; or a power
            other than 1 with annealing, whose temperature is a distance in metres.
    """

    power: float
    relaxation: Relaxation
    annealing: Annealing

    def __post_init__(self) -> None:
        if not 1 <= self.power < math.inf:
            raise ValueError(f"power must be 1 or more, and finite, not {self.power}")
        if self.power != 1 and self.annealing.temperature > 0:
            raise ValueError(
                f"annealing={self.annealing.temperature:g} and power={self.power:g} exclude each other: the temperature is "
                "a distance [m], and errors to a power have another unit; choose one of both"
            )

    def at(self, step: int) -> Softness:
        """The loss at an optimisation step."""
        return Softness(self.power, self.relaxation.at(step), self.annealing.at(step))


def schedules_in(owner: object) -> list[Schedule]:
    """The schedules that are attributes of an objective or a forecaster; those within other objects are not found."""
    found: list[Schedule] = []
    for value in vars(owner).values():
        if isinstance(value, Schedule):
            found.append(value)
        elif isinstance(value, ImitationSchedule):
            found += value.relaxation, value.annealing
    return found
