"""Small vehicle-crowd clips in the public format of DUT and CITR: image axes, y down."""

from __future__ import annotations

from pathlib import Path

import numpy as np

RATE = 23.976


def pedestrians(count: int = 4, frames: int = 12, seed: int = 0) -> str:
    """The table of pedestrians that walk straight on; number 0 stands still."""
    random = np.random.default_rng(seed)
    lines = ["id,frame,label,x_est,y_est,vx_est,vy_est"]
    start, way = random.uniform(2, 8, (count, 2)), random.uniform(-1.5, 1.5, (count, 2))
    for frame in range(1, frames + 1):
        for id in range(count):
            x, y = start[id] + (0 if id == 0 else (frame - 1) / RATE) * way[id]
            vx, vy = (0.02, -0.01) if id == 0 else way[id]
            lines.append(f"{id},{frame},ped,{float(x)!r},{float(y)!r},{float(vx)!r},{float(vy)!r}")
    return "\n".join(lines) + "\n"


def vehicles(frames: int = 10, first: int = 3, speed: float = 4.0, turn: float = 0.3) -> str:
    """The table of a vehicle that drives on a circle and of one that is parked."""
    lines = ["id,frame,label,x_est,y_est,psi_est,vel_est"]
    for k in range(frames):
        psi = 3.0 + turn * k / RATE
        x, y = 20 + speed / turn * (np.sin(psi) - np.sin(3.0)), 5 - speed / turn * (np.cos(psi) - np.cos(3.0))
        lines.append(f"0,{first + k},veh,{float(x)!r},{float(y)!r},{float(psi)!r},{speed!r}")
        lines.append(f"1,{first + k},veh,30.0,10.0,-1.5,0.0")
    return "\n".join(lines) + "\n"


def write(
    folder: Path, name: str = "square_01", ped: str | bytes | None = None, veh: str | bytes | None = None
) -> Path:
    """One clip; an empty text leaves a table out."""
    folder.mkdir(parents=True, exist_ok=True)
    for label, content in (("ped", pedestrians() if ped is None else ped), ("veh", vehicles() if veh is None else veh)):
        if content:
            path = folder / f"{name}_traj_{label}_filtered.csv"
            path.write_bytes(content.encode() if isinstance(content, str) else content)
    return folder
