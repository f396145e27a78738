"""Forecasts of a run, written for other programs and drawn for people."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from epo_lightning.experiment import assembly
from epo_lightning.experiment.evaluate import open_checkpoint, open_data, split_of
from epo_lightning.experiment.settings import PredictSettings, Settings, read
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, write_json
from epo_lightning.scene import JointForecast, Scene

MEANING = {
    "states": "[B, M, N, K, 4] x, y [m], heading [rad], speed [m/s] of every joint mode",
    "probabilities": "[B, M] of the joint modes",
    "agent_probabilities": "[B, M, N] of each agent's own modes",
    "controls": "[B, M, N, K, 2] acceleration [m/s^2], turn rate [rad/s]",
    "initial_states": "[B, M, N, K, 4] where the solver started",
    "goals": "[B, M, N, 2] goals of the inferred game [m]",
    "history": "[B, N, H, 4] what was observed",
    "future": "[B, N, K, 4] what happened",
    "id": "[B] record of the data set",
    "subset": "[B] index into subsets",
}


def predict(settings: PredictSettings) -> list[Path]:
    """Write ``forecasts.safetensors``, ``index.json`` and ``figures/`` for scenes spread over a split.

    Returns:
        the files that were written.

    Raises:
        ConfigError: no run, checkpoint or data, or files in ``out`` that would be overwritten.
    """
    assembly.quiet()
    from safetensors.torch import save_file

    run = RunFolder.open(settings.run)
    out = Path(settings.out).expanduser()
    tensors_file, index_file = out / "forecasts.safetensors", out / "index.json"
    if tensors_file.exists() or index_file.exists():
        raise ConfigError(f"{out} holds forecasts already: nothing is overwritten; choose another out=<folder>")
    of_run = read(Settings, run.config())
    forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
    scenes = spread(gather(split_of(open_data(run, of_run), settings.split)), settings.scenes)
    forecast = forecast_of(forecaster, scenes)
    tensors = dict(_tensors(scenes, forecast))
    out.mkdir(parents=True, exist_ok=True)
    temporary = tensors_file.with_suffix(".tmp")
    save_file(tensors, temporary)
    temporary.replace(tensors_file)
    written = [tensors_file, index_file]
    if settings.figures and scenes.future is not None:
        from epo_lightning.report.figures import joint_predictions

        shown, other = examples(scenes, settings.figures)
        drawn = {of_run.title: forecast_of(forecaster, shown)}
        written.append(joint_predictions(shown, drawn, out / "figures" / "joint_predictions.png", other))
    write_json(
        index_file,
        {
            "run": str(run.path),
            "title": of_run.title,
            "split": settings.split,
            "data_digest": run.record.get("data_digest"),
            "dt": scenes.dt,
            "scenes": len(scenes.history),
            "subsets": list(forecaster.configuration["subsets"]),
            "tensors": {name: MEANING.get(name, name.replace("/", " of ")) for name in sorted(tensors)},
        },
    )
    return written


def gather(loader: Iterable[Scene]) -> Scene:
    """All scenes of a loader as one batch."""
    batches = list(loader)
    if not batches:
        raise ConfigError("the split is empty: there is nothing to forecast")

    def join(name: str) -> Any:
        values = [getattr(batch, name) for batch in batches]
        return torch.cat(values) if isinstance(values[0], Tensor) else values[0]

    return Scene(**{entry.name: join(entry.name) for entry in dataclasses.fields(Scene)})


def spread(scenes: Scene, count: int | None) -> Scene:
    """``count`` scenes at even distances; all where there are fewer."""
    total = len(scenes.history)
    if count is None or count >= total:
        return scenes
    return scenes[torch.linspace(0, total - 1, count).round().long()]


def examples(scenes: Scene, count: int) -> tuple[Scene, Tensor | None]:
    """Scenes worth drawing: those with two known futures first. The second one is returned beside them."""
    if scenes.id is None or scenes.subset is None or scenes.future is None:
        return spread(scenes, count), None
    first: dict[int, int] = {}
    both: list[tuple[int, int]] = []
    for index, (record, subset) in enumerate(zip(scenes.id.tolist(), scenes.subset.tolist(), strict=True)):
        if record in first and subset != int(scenes.subset[first[record]]):
            one, other = sorted((first[record], index), key=lambda i: int(scenes.subset[i]))  # type: ignore[index]
            both.append((one, other))
        first.setdefault(record, index)
    if not both:
        return spread(scenes, count), None
    chosen = [both[int(i)] for i in torch.linspace(0, len(both) - 1, min(count, len(both))).round()]
    ones, others = (torch.tensor(indices) for indices in zip(*chosen, strict=True))
    return scenes[ones], scenes.future[others]


def forecast_of(forecaster: Any, scenes: Scene, batch_size: int = 256) -> JointForecast:
    """The forecasts of many scenes, batch by batch."""
    parts = [forecaster.predict(scenes[slice(i, i + batch_size)]) for i in range(0, len(scenes.history), batch_size)]
    return _join(parts)


def _join(parts: list[Any]) -> Any:
    """Concatenate equal structures of tensors along their first dimension."""
    first = parts[0]
    if isinstance(first, Tensor):
        return torch.cat(parts)
    if isinstance(first, Mapping):
        return {key: _join([part[key] for part in parts]) for key in first}
    if isinstance(first, tuple):
        return tuple(_join(list(entries)) for entries in zip(*parts, strict=True))
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        names = [entry.name for entry in dataclasses.fields(first)]
        return type(first)(**{name: _join([getattr(part, name) for part in parts]) for name in names})
    return first


def _tensors(scenes: Scene, forecast: JointForecast) -> Iterable[tuple[str, Tensor]]:
    for name in ("states", "probabilities", "agent_probabilities", "controls", "initial_states"):
        if (value := getattr(forecast, name)) is not None:
            yield name, value.contiguous()
    if forecast.parameters is not None:
        if forecast.parameters.goals is not None:
            yield "goals", forecast.parameters.goals.contiguous()
        for kind in ("own_weights", "pair_weights"):
            for name, value in getattr(forecast.parameters, kind).items():
                yield f"{kind}/{name}", value.contiguous()
    for name in ("history", "future", "id", "subset"):
        if (value := getattr(scenes, name)) is not None:
            yield name, value.contiguous()
