"""Lines about the progress of driven episodes."""

from __future__ import annotations

import pytest

from epo_lightning.drive import progress
from epo_lightning.drive.progress import Progress


def test_the_first_chunk_of_a_planner_is_told_and_then_time_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    now, lines = [0.0], list[str]()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    driving = Progress("plays", 500, ["a", "b"], lines.append)
    for _ in range(2):
        for name in ("a", "b"):
            now[0] += 10.0
            driving.drove(name, 50, 10.0)
    assert lines == [
        "plays    a: 50 of 500 episodes, 10 s",
        "plays    b: 50 of 500 episodes, 10 s; plays takes about 3 min more",
    ]
    now[0] += 10.0
    driving.drove("a", 50, 10.0)
    assert lines[2:] == ["plays    a: 150 of 500 episodes, 30 s; plays takes about 2 min more"]


def test_episodes_that_were_driven_before_take_no_time() -> None:
    lines: list[str] = []
    driving = Progress("plays", 100, ["a", "b"], lines.append)
    driving.skip("a", 100)
    driving.drove("b", 50, 120.0)
    assert lines == ["plays    b: 50 of 100 episodes, 120 s; plays takes about 2 min more"]
    begun = Progress("plays", 100, ["c"], lines.append)
    begun.skip("c", 60)
    begun.drove("c", 40, 10.0)
    assert lines[1:] == ["plays    c: 100 of 100 episodes, 10 s"]
