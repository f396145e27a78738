"""Files of recorded pedestrians in the format of UCY, for commands that read recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def square(folder: Path, name: str = "square", seed: int = 0, frames: int = 30) -> Path:
    """Six pedestrians who wander over a square, in UCY's format at 2.5 Hz."""
    random = np.random.default_rng(seed)
    rows = []
    for person in range(6):
        velocity = random.normal(size=2) + 0.1 * random.normal(size=(frames, 2)).cumsum(0)
        place = random.uniform(-5, 5, size=2) + 0.4 * velocity.cumsum(0)
        rows += [
            f"{10 * k} {person} {place[k, 0]:.5f} 0 {place[k, 1]:.5f} {velocity[k, 0]:.5f} 0 {velocity[k, 1]:.5f}"
            for k in range(frames)
        ]
    (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / name / "obsmat.txt").write_text("\n".join(rows))
    return folder
