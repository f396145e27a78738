"""Scenes of a split to forecast, their forecasts, and pictures of both."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from epo_lightning.data.datamodule import SceneDataModule, SceneDataset
from epo_lightning.experiment.config.settings import PredictSettings
from epo_lightning.experiment.opening import split_of
from epo_lightning.forecast import JointForecast
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, Scene, X, Y


def choose(data: Any, split: str, count: int | None) -> tuple[Scene, list[dict[str, Any]] | None]:
    """``count`` scenes at even distances in a split, and the recording, frame and tracks of each if the data have them."""
    loader = split_of(data, split)
    if not isinstance(data, SceneDataModule):
        return spread(gather(loader), count), None
    return pick(data.dataset(split), count)


def pick(dataset: SceneDataset, count: int | None) -> tuple[Scene, list[dict[str, Any]] | None]:
    """``count`` scenes at even distances in a data set, and the recording, frame and tracks of each if they are known."""
    scenes = dataset[even(len(dataset), count)]
    provenance = getattr(dataset, "provenance", None)
    return scenes, provenance(scenes.id.tolist()) if provenance and scenes.id is not None else None


def draw(
    settings: PredictSettings, title: str, shape: str, scenes: Scene, forecast: JointForecast
) -> list[tuple[Path, list[int]]]:
    """Draw pictures and animations into ``out``; returns each file with the rows of the scenes that it shows.

    Scenes with lanes, boxes or classes of agents get a picture each. Scenes of equal discs (RPI) share one picture. The
    ``shape`` is the outline of agents, that of the forecaster's task.
    """
    folder = Path(settings.out).expanduser() / "figures"
    ids = list(range(len(scenes.history))) if scenes.id is None else scenes.id.tolist()
    if len(set(ids)) < len(ids):  # a record with two futures, say
        ids = list(range(len(ids)))
    drawn: list[tuple[Path, list[int]]] = []
    if settings.figures and is_traffic(scenes, shape):
        from epo_lightning.report.scenes import draw as draw_scene

        for row in eventful(scenes, settings.figures):
            path, name = folder / f"scene_{ids[row]}.png", f"{title}, scene {ids[row]}"
            drawn.append((draw_scene(scenes[row], forecast[row], path, name), [row]))
    elif settings.figures and scenes.future is not None:
        from epo_lightning.report.figures import joint_predictions

        rows, others = pairs(scenes, settings.figures)
        other = None if others is None else scenes.future[others]
        path = joint_predictions(scenes[rows], {title: forecast[rows]}, folder / "joint_predictions.png", other)
        drawn.append((path, rows.tolist()))
    if settings.animate:
        from epo_lightning.report.animation import animate

        for row in eventful(scenes, settings.animate):
            path, name = folder / f"scene_{ids[row]}.gif", f"{title}, scene {ids[row]}"
            drawn.append((animate(scenes[row], forecast[row], path, name), [row]))
    return drawn


def is_traffic(scenes: Scene, shape: str) -> bool:
    """Whether scenes have lanes, classes of agents, or box-shaped agents."""
    return scenes.lanes is not None or scenes.kind is not None or shape == "box"


def eventful(scenes: Scene, count: int) -> list[int]:
    """Rows of ``count`` scenes, one from each of ``count`` equal parts: the scene whose sideways motions differ most.

    The difference between agents is compared, because in a bend all agents move sideways, while few change lane at a time.
    """
    steps, mask = scenes.history, scenes.history_mask
    if scenes.future is not None:
        assert scenes.future_mask is not None
        steps, mask = scenes.future, scenes.future_mask
    heading, moved = scenes.current[..., None, HEADING], steps[..., :2] - scenes.current[..., None, :2]
    sideways = moved[..., Y] * heading.cos() - moved[..., X] * heading.sin()
    known = scenes.agent_mask[..., None] & mask & sideways.isfinite()
    infinity = torch.full_like(sideways, torch.inf)
    spans = torch.where(known, sideways, -infinity).amax(1) - torch.where(known, sideways, infinity).amin(1)
    spans = spans.amax(1)
    parts = torch.arange(len(spans), device=spans.device).tensor_split(min(count, len(spans)))
    return [int(part[spans[part].argmax()]) for part in parts]


def gather(loader: Iterable[Scene]) -> Scene:
    """All scenes of a loader as one batch."""
    batches = list(loader)
    if not batches:
        raise ConfigError("the split is empty: there is nothing to forecast")
    return Scene.concatenated(batches)


def even(total: int, count: int | None) -> Tensor:
    """``count`` indices at even distances in 0 .. ``total`` - 1; all indices if there are fewer or ``count`` is None."""
    if count is None or count >= total:
        return torch.arange(total)
    return torch.linspace(0, total - 1, count).round().long()


def spread(scenes: Scene, count: int | None) -> Scene:
    """``count`` scenes at even distances; all scenes if there are fewer."""
    return scenes[even(len(scenes.history), count)]


def pairs(scenes: Scene, count: int) -> tuple[Tensor, Tensor | None]:
    """Rows of ``count`` scenes, and the rows of the same records with the alternative future.

    Only records with two futures are taken if there are any (RPI). Otherwise scenes at even distances and None.
    """
    total = len(scenes.history)
    if scenes.id is None or scenes.subset is None:
        return even(total, count), None
    first: dict[int, int] = {}
    both: list[tuple[int, int]] = []
    for index, (record, subset) in enumerate(zip(scenes.id.tolist(), scenes.subset.tolist(), strict=True)):
        if record in first and subset != int(scenes.subset[first[record]]):
            one, other = sorted((first[record], index), key=lambda i: int(scenes.subset[i]))  # type: ignore[index]
            both.append((one, other))
        first.setdefault(record, index)
    if not both:
        return even(total, count), None
    chosen = [both[int(i)] for i in torch.linspace(0, len(both) - 1, min(count, len(both))).round()]
    ones, others = (torch.tensor(indices) for indices in zip(*chosen, strict=True))
    return ones, others


def forecast_of(forecaster: Any, scenes: Scene, batch_size: int = 256) -> JointForecast:
    """The forecasts of many scenes, batch by batch."""
    parts = [forecaster.predict(scenes[slice(i, i + batch_size)]) for i in range(0, len(scenes.history), batch_size)]
    return JointForecast.concatenated(parts)
