"""Pictures of a report: the same scenes with the forecasts of every row, and the weights of the inferred games."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_checkpoint, open_data, settings_of
from epo_lightning.experiment.pictures import choose, eventful, forecast_of, is_traffic, pairs, spread
from epo_lightning.registry import ConfigError
from epo_lightning.report.figures import joint_predictions
from epo_lightning.report.rows import Row
from epo_lightning.report.scenes import draw_rows
from epo_lightning.report.style import AGENTS
from epo_lightning.report.weights import learned_weights
from epo_lightning.run_folder import RunFolder

SCENES, GAMES = 4, 512
"""How many scenes are drawn, and over how many the distribution of learned weights is taken."""


def draw(rows: Iterable[Row], folder: Path) -> tuple[list[Path], list[str]]:
    """The joint predictions of rows over the same scenes, and the weights of the games they inferred.

    Every row is drawn by its first run, and of rows with the same title the best is. Rows that were trained on other data
    than the first one are not drawn.

    Returns:
        the pictures, and notes on what could not be drawn.
    """
    assembly.quiet()
    runs: dict[str, tuple[RunFolder, Settings]] = {}
    forecasters: dict[str, Any] = {}
    notes = []
    for row in _best_of_titles(rows):
        run = RunFolder(row.runs[0].path)
        try:
            settings = settings_of(run)
            forecasters[row.name] = open_checkpoint(settings, run.checkpoint())
            runs[row.name] = run, settings
        except ConfigError as error:
            notes.append(f"{row.name} is not drawn: {error}")
    if not runs:
        return [], notes
    try:
        first = next(iter(runs))
        data, shape = open_data(*runs[first]), forecasters[first].task.shape
        # Records with two futures (RPI) are found among all scenes only.
        scenes, _ = choose(data, "test", None if "alternative" in data.task.subsets else GAMES)
    except ConfigError as error:
        return [], [*notes, f"No scenes are drawn: {error}"]
    folder.mkdir(parents=True, exist_ok=True)
    drawn: list[Path] = []
    if is_traffic(scenes, shape):
        for number, index in enumerate(eventful(scenes, SCENES), 1):
            forecasts = {title: forecast_of(forecaster, scenes[index]) for title, forecaster in forecasters.items()}
            drawn.append(draw_rows(scenes[index], forecasts, folder / f"scene_{number}.png"))
    else:
        shown, others = pairs(scenes, SCENES)
        other = None if others is None or scenes.future is None else scenes.future[others]
        forecasts = {title: forecast_of(forecaster, scenes[shown]) for title, forecaster in forecasters.items()}
        drawn.append(joint_predictions(scenes[shown], forecasts, folder / "joint_predictions.png", other))
    many = spread(scenes, GAMES)
    # An energy may be a network, without weights that have names.
    inferred = {title: forecast.parameters for title, forecast in forecasts.items()}
    weighted = [title for title, game in inferred.items() if game is not None and game.own_weights]
    games = {title: forecast_of(forecasters[title], many) for title in weighted}
    if games:
        names = () if is_traffic(scenes, shape) else AGENTS
        drawn.append(learned_weights(games, folder / "learned_weights.png", names))
    return drawn, notes


def _best_of_titles(rows: Iterable[Row]) -> list[Row]:
    """Rows that saw the data of the first one; of those with the same title, which differ in settings, the best."""
    best: dict[str, Row] = {}
    for row in rows:
        first = next(iter(best.values()), row)
        other = best.get(row.title, row)
        if row.runs[0].trained_digest == first.runs[0].trained_digest and _score(row) <= _score(other):
            best[row.title] = row
    return list(best.values())


def _score(row: Row) -> float:
    cell = row.cells.get("minSADE")
    return math.inf if cell is None or math.isnan(cell.mean) else cell.mean
