"""Scenes from extracted tables, assembled batch by batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from epo_lightning.data.cache import LARGE
from epo_lightning.data.mapped import read_ahead
from epo_lightning.data.recorded.tables import INDEX_OF, OF_AGENTS, OF_SCENES
from epo_lightning.metrics.functional import interactive_scenes
from epo_lightning.scene import Scene

FRAMES = ("fixed", "aligned")
"""Axes of a scene: those of the recording, or x along the mean heading of its agents. The origin is their mean position."""


BLOCK = 1 << 22
"""Size [bytes] of the consecutive scenes that are read at once from a file that may not fit in memory."""
UNKNOWN = -1
"""Subset of a scene that has not been read yet."""


class RecordedScenes:
    """Scenes of one split of a recorded data set.

    Args:
        tables: the columns of an :class:`~epo_lightning.data.recorded.tables.SceneTables`.
        dt: time step [s].
        frame: ``fixed`` (axes of the recording) or ``aligned`` (x along the agents' mean heading).
        names: names of the recordings.
        shape: agents' outline, ``disc`` or ``box``, for the subset of each scene, calm or interactive
            (:func:`~epo_lightning.metrics.functional.interaction.interactive_scenes`). None for scenes without
            ``Scene.subset``: training does not need it. It is computed when a scene is first read, and then kept.
    """

    def __init__(
        self, tables: Mapping[str, Tensor], dt: float, frame: str, names: Sequence[str], shape: str | None = None
    ) -> None:
        self.tables, self.dt, self.frame, self.names = tables, dt, frame, tuple(names)
        self.shape = shape
        size = sum(tensor.nbytes for tensor in tables.values())
        self.block = max(1, len(self) * BLOCK // size) if size >= LARGE else None
        self._subset = torch.full((len(self),), UNKNOWN)

    def __len__(self) -> int:
        return len(self.tables["agents"])

    def set_epoch(self, epoch: int) -> None:
        """Does nothing: every epoch has the same scenes."""

    def read_ahead(self, first: int, last: int) -> None:
        """Ask the system to read the scenes from ``first`` to ``last``, inclusive, from the disk, with agents and lanes."""
        scenes = slice(first, last + 1)
        for name, rows in INDEX_OF.items():
            if name == "recording":
                continue
            index = self.tables[name][scenes]
            index = index[index >= 0]
            of_rows = OF_AGENTS if name == "agents" else (rows,)
            for column in of_rows:
                if column in self.tables and len(index):
                    read_ahead(self.tables[column][int(index.min()) : int(index.max()) + 1])
        for column in OF_SCENES:
            read_ahead(self.tables[column][scenes])

    def __getitem__(self, indices: Tensor) -> Scene:
        of = {name: self.tables[name][indices] for name in ("agents", "lanes", "centre", "direction", "recording")}
        present = of["agents"] >= 0
        rows = of["agents"].clamp_min(0).long()
        angle = of["direction"] if self.frame == "aligned" else torch.zeros_like(of["direction"])
        cosine, sine = angle.cos(), angle.sin()

        def move(points: Tensor) -> Tensor:
            """Positions [B, .., 2] in the frames of their scenes."""
            shape = (len(indices), *[1] * (points.dim() - 2))
            x, y = (points[..., axis] - of["centre"][:, axis].to(points.dtype).view(shape) for axis in range(2))
            if self.frame == "fixed":
                return torch.stack((x, y), -1).float()
            c, s = (value.to(points.dtype).view(shape) for value in (cosine, sine))
            return torch.stack((c * x + s * y, c * y - s * x), -1).float()

        def states(name: str) -> tuple[Tensor, Tensor]:
            values, mask = self.tables[name][rows], self.tables[f"{name}_mask"][rows] & present[..., None]
            heading = values[..., 2:3]
            if self.frame == "aligned":
                # Headings are shifted by whole turns so that the current one lies within half a turn of x.
                now = self.tables["history"][rows, -1, 2].double() - angle[:, None]
                turns = torch.round(now / (2 * torch.pi)) * 2 * torch.pi
                heading = (heading.double() - (angle[:, None] + turns)[..., None, None]).float()
            moved = torch.cat((move(values[..., :2]), heading, values[..., 3:]), -1)
            return moved.where(mask[..., None], 0.0), mask

        def known(values: Tensor) -> Tensor:
            return values.where(present.view(*present.shape, *[1] * (values.dim() - 2)), 0)

        history, history_mask = states("history")
        future, future_mask = states("future")
        origin = self.tables["origin"][of["recording"].long()] + of["centre"]
        on_map: dict[str, Tensor] = {}
        if len(self.tables["polylines"]):
            points = move(self.tables["polylines"][of["lanes"].clamp_min(0).long()])
            there = (of["lanes"] >= 0)[..., None].expand(*points.shape[:2], points.shape[2] - 1)
            candidates, references = self.tables["candidates"], self.tables["references"]
            count = references.shape[1]
            line = torch.arange(count).repeat_interleave(candidates.shape[1] // count).expand(*present.shape, -1)
            on_line = present[..., None].expand(*present.shape, count)
            if "lines" in self.tables:
                on_line = on_line & (torch.arange(count) < self.tables["lines"][rows][..., None])
            on_map = {
                "lanes": torch.cat((points[:, :, :-1], points[:, :, 1:]), -1).where(there[..., None], 0.0),
                "lane_mask": there,
                "goal_candidates": known(move(candidates[rows])),
                "goal_mask": on_line.gather(-1, line),
                "goal_reference": line,
                "references": known(move(references[rows])),
                "reference_mask": on_line,
                "reference_speed": known(self.tables["reference_speed"][rows]),
            }
        scene = Scene(
            history=history,
            dt=self.dt,
            history_mask=history_mask,
            agent_mask=present,
            future=future,
            future_mask=future_mask,
            size=known(self.tables["size"][rows]),
            kind=known(self.tables["kind"][rows]),
            frame=torch.cat((origin, angle[:, None]), -1),
            id=indices,
            **on_map,
        )
        return scene if self.shape is None else dataclasses.replace(scene, subset=self._subset_of(scene, self.shape))

    def _subset_of(self, scene: Scene, shape: str) -> Int[Tensor, " B"]:
        """Index of the subset of every scene, 0 for calm and 1 for interactive."""
        assert scene.id is not None
        if (self._subset[scene.id] == UNKNOWN).any():
            self._subset[scene.id] = interactive_scenes(scene, shape).long()
        return self._subset[scene.id]

    def provenance(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """Recording, frame and tracks of each of some scenes."""
        found = []
        for index in indices:
            agents = self.tables["agents"][index]
            found.append(
                {
                    "recording": self.names[int(self.tables["recording"][index])],
                    "frame": int(self.tables["frame"][index]),
                    "tracks": self.tables["track"][agents[agents >= 0].long()].tolist(),
                }
            )
        return found
