"""Forecasts of a run, written for other programs and drawn as pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from epo_lightning import pretrained
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.replaced import keys_of
from epo_lightning.experiment.config.settings import ForecastSettings, PredictSettings, Settings
from epo_lightning.experiment.opening import open_checkpoint, open_data, settings_of
from epo_lightning.experiment.other_data import open_other
from epo_lightning.experiment.pictures import choose, draw, forecast_of, pick, spread
from epo_lightning.files import write_file, write_json
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters import Forecaster
from epo_lightning.predictions import FORECASTS, INDEX
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.scene import KINDS, Scene

MEANING = {
    "states": "[B, M, N, K, 4] x, y [m], heading [rad], speed [m/s] of every joint mode",
    "probabilities": "[B, M] of the joint modes",
    "agent_probabilities": "[B, M, N] of each agent's own modes",
    "goal_probabilities": "[B, N, G] of each agent's goal candidates",
    "logits": "[B, M] unnormalised log-probabilities of the joint modes",
    "agent_logits": "[B, M, N] unnormalised log-probabilities of each agent's own modes",
    "goal_logits": "[B, N, G] unnormalised log-probabilities of each agent's goal candidates",
    "order_logits": "[B, P] of every pair's order being +1, for forecasters whose modes are orders",
    "controls": "[B, M, N, K, 2] acceleration [m/s^2], turn rate [rad/s]",
    "initial_states": "[B, M, N, K, 4] where the solver started",
    "goals": "[B, M, N, 2] goals of the inferred game [m]",
    "headings_at_goals": "[B, M, N] headings wanted at these goals [rad]",
    "reference": "[B, M, N] index of the line in references that an agent follows",
    "history": "[B, N, H, 4] what was observed: x, y [m], heading [rad], speed [m/s]",
    "history_mask": "[B, N, H] which of its steps were observed",
    "agent_mask": "[B, N] which agents exist",
    "future": "[B, N, K, 4] what happened",
    "future_mask": "[B, N, K] which of its steps were observed",
    "goal_candidates": "[B, N, G, 2] where an agent may be heading for [m]",
    "goal_mask": "[B, N, G] which candidates exist",
    "goal_headings": "[B, N, G] heading that an agent wants at each candidate [rad]",
    "goal_reference": "[B, N, G] index of the line in references on which a candidate lies",
    "size": "[B, N, 2] length and width [m]",
    "kind": "[B, N] index into kinds",
    "lanes": "[B, L, V, 4] vectors along the lanes: x, y of both ends [m]",
    "lane_mask": "[B, L, V] which of these vectors exist",
    "references": "[B, N, R, Q, 2] lines that an agent may follow [m]",
    "reference_mask": "[B, N, R] which of these lines exist",
    "reference_speed": "[B, N] the speed at which an agent would like to travel [m/s]",
    "frame": "[B, 3] origin x, y [m] and rotation [rad]: in the recording a position is R(rotation) position + origin",
    "id": "[B] record of the data set",
    "subset": "[B] index into subsets",
    "game_steps": "[B] number of steps from t0 to the end of each game",
}


@dataclass(frozen=True)
class Chosen:
    """The scenes to forecast, their provenance, and the split and data that they are from."""

    scenes: Scene
    origins: list[dict[str, Any]] | None
    about: dict[str, Any]


def predict(settings: PredictSettings, overrides: Sequence[str] = ()) -> list[Path]:
    """Write ``forecasts.safetensors``, ``figures/`` and ``index.json`` for scenes spread over a split.

    The index is written last: a folder without it was left by an interrupted command, and the next one completes it.

    Args:
        settings: the run, the data and the scenes.
        overrides: the user's overrides; settings of other data that they name do not follow the run.

    Returns:
        the files that were written.

    Raises:
        ConfigError: no run, checkpoint or data, or files in ``out`` that would be overwritten.
    """
    assembly.quiet()
    from safetensors.torch import save

    run = RunFolder.open(settings.run)
    out = Path(settings.out).expanduser()
    tensors_file, index_file = out / FORECASTS, out / INDEX
    if index_file.exists():
        raise ConfigError(f"{out} holds forecasts already: nothing is overwritten; choose another out=<folder>")
    of_run = settings_of(run)
    forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
    chosen = scenes_of(run, of_run, settings, forecaster, overrides)
    scenes = chosen.scenes
    forecast = forecast_of(forecaster, scenes)
    tensors = dict(_tensors(scenes, forecast))
    out.mkdir(parents=True, exist_ok=True)
    write_file(tensors_file, save(tensors))
    pictures = draw(settings, of_run.title, forecaster.task.shape, scenes, forecast)
    index = {
        "run": str(run.path),
        "title": of_run.title,
        **chosen.about,
        "dt": scenes.dt,
        "scenes": len(scenes.history),
        "tensors": {name: MEANING.get(name, name.replace("/", " of ")) for name in sorted(tensors)},
        "pictures": [{"file": str(file.relative_to(out)), "rows": rows} for file, rows in pictures],
    }
    if scenes.kind is not None:
        index["kinds"] = list(KINDS)
    if chosen.origins is not None:
        index["provenance"] = chosen.origins
    write_json(index_file, index)
    return [tensors_file, index_file, *(file for file, _ in pictures)]


def scenes_of(
    run: RunFolder, of_run: Settings, settings: ForecastSettings, forecaster: Forecaster, overrides: Sequence[str]
) -> Chosen:
    """The scenes to forecast; where a shipped run's data set is not on this machine, the examples that ship with it.

    Raises:
        ConfigError: the data is missing, has changed, or cannot be read by the run.
    """
    if settings.data is not None:
        given = keys_of(overrides)
        other = open_other(run, of_run, forecaster, settings.data, settings.split, given, settings.workers)
        for note in other.notes:
            print(f"  {note}")
        scenes, origins = pick(other.scenes, settings.scenes)
        about = {"split": other.split, "data_digest": other.digest, "subsets": list(other.task.subsets)}
        return Chosen(scenes, origins, {**about, "data": other.name, "notes": list(other.notes)})
    own = {
        "split": settings.own_split,
        "data_digest": run.record.get("data_digest"),
        "subsets": list(assembly.build_data(of_run.data).task.subsets),
    }
    try:
        return Chosen(*choose(open_data(run, of_run), settings.own_split, settings.scenes), own)
    except ConfigError as missing:
        if not pretrained.ships(run.path):
            raise
        scenes = pretrained.examples(run.path)
        count, name = len(scenes.history), pretrained.name_of(run.path)
        print(f"These are the {count} example scenes that ship with {name}. Its test split is not here: {missing}")
        return Chosen(spread(scenes, settings.scenes), None, own)


def _tensors(scenes: Scene, forecast: JointForecast) -> Iterable[tuple[str, Tensor]]:
    """Everything in :data:`MEANING` that is there, and the weights of the inferred game by name."""
    game = forecast.parameters
    for name in MEANING:
        for owner in (forecast, scenes, game):
            if (value := getattr(owner, name, None)) is not None:
                yield name, value.contiguous()
                break
    if game is not None:
        if game.goal_headings is not None:
            yield "headings_at_goals", game.goal_headings.contiguous()
        for part in ("own_weights", "pair_weights", "margins"):
            for name, value in getattr(game, part).items():
                yield f"{part}/{name}", value.contiguous()
