"""Lines about the progress of driven episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

SILENCE = 30.0
"""Time [s] between two lines about a planner; the first chunk always has one."""


class Progress:
    """The progress of all planners in the episodes of one kind.

    Args:
        kind: kind of the episodes.
        episodes: number of episodes of every planner.
        planners: names of the planners.
        tell: called with a line per planner at first, and then every :data:`SILENCE` seconds.
    """

    def __init__(self, kind: str, episodes: int, planners: Iterable[str], tell: Callable[[str], None]) -> None:
        self.kind, self.episodes, self._tell = kind, episodes, tell
        self._left = dict.fromkeys(planners, episodes)
        self._driven = dict.fromkeys(self._left, 0)
        self.seconds = dict.fromkeys(self._left, 0.0)
        self._told = time.monotonic()

    def skip(self, planner: str, count: int) -> None:
        """Count episodes that were driven before."""
        self._left[planner] -= count

    def drove(self, planner: str, count: int, seconds: float) -> None:
        """Count episodes that were driven in some seconds."""
        first = not self._driven[planner]
        self._left[planner] -= count
        self._driven[planner] += count
        self.seconds[planner] += seconds
        if first or time.monotonic() - self._told >= SILENCE:
            done = self.episodes - self._left[planner]
            self._tell(
                f"{self.kind:8} {planner}: {done} of {self.episodes} episodes, {self.seconds[planner]:.0f} s{self._rest()}"
            )
            self._told = time.monotonic()

    def _rest(self) -> str:
        """The time that all planners still need, once each of them has driven."""
        waiting = [name for name, left in self._left.items() if left]
        if not waiting or not all(self._driven[name] for name in waiting):
            return ""
        rest = sum(self._left[name] * self.seconds[name] / self._driven[name] for name in waiting)
        return f"; {self.kind} takes about {rest / 60:.0f} min more" if rest >= 90 else ""
