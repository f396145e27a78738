"""The report over many runs: tables by :mod:`epo_lightning.report`, with figures of what the runs forecast."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from epo_lightning.experiment import assembly
from epo_lightning.experiment.evaluate import open_checkpoint, open_data
from epo_lightning.experiment.predict import choose, eventful, forecast_of, is_traffic, pairs, spread
from epo_lightning.experiment.settings import ReportSettings, Settings, read
from epo_lightning.registry import ConfigError
from epo_lightning.report import build_tables, collect, write_report
from epo_lightning.run_folder import RunFolder, discover

SCENES, GAMES = 4, 512
"""How many scenes are drawn, and over how many the distribution of learned weights is taken."""

ORDER = ("constant_velocity", "marginal", "scene_consistent", "epo")


def report(settings: ReportSettings) -> str:
    """Print the tables; write results.md, results.csv and figures/.

    Raises:
        ConfigError: no evaluated run below the folder, or one that cannot be read.
    """
    assembly.quiet()
    runs, out = Path(settings.runs).expanduser(), Path(settings.out).expanduser()
    build_tables(collect(runs))  # whatever cannot be reported is said before anything is drawn
    evaluated = [run for run in discover(runs) if run.metrics_file().is_file()]
    drawn = draw(evaluated, out / "figures")
    return write_report(runs, out, figures=drawn, preface=preface(evaluated))


def preface(runs: Iterable[RunFolder]) -> str:
    """What a reader has to know before the numbers: that the budget was not the paper's, and how to use that."""
    budgets = sorted({run.record.get("budget", "paper") for run in runs} - {"paper"})
    if not budgets:
        return ""
    return (
        f"**Budget: {', '.join(budgets)}.** These runs saw less data or fewer steps than the paper's, so the numbers show "
        "that everything works, not which row is best, and do not reproduce the table. The paper's settings are those of "
        "`epo train` without `budget=`."
    )


def draw(runs: list[RunFolder], folder: Path) -> list[Path]:
    """The joint predictions of all rows over the same scenes, and the weights of the games they inferred.

    Every row is drawn by its first run; rows that were trained on other data than the first row are left out.
    """
    from epo_lightning.report.figures import joint_predictions
    from epo_lightning.report.scenes import highway_comparison
    from epo_lightning.report.style import AGENTS
    from epo_lightning.report.weights import learned_weights

    rows: dict[str, RunFolder] = {}
    for run in runs:
        record = run.record
        same_data = not rows or record["data_digest"] == next(iter(rows.values())).record["data_digest"]
        if same_data:
            rows.setdefault(record["title"], run)
    rows = dict(sorted(rows.items(), key=lambda row: _rank(row[1])))
    of_rows = {title: read(Settings, run.config()) for title, run in rows.items()}
    try:
        first = next(iter(rows))
        forecasters = {title: open_checkpoint(of_rows[title], run.checkpoint()) for title, run in rows.items()}
        data, shape = open_data(rows[first], of_rows[first]), forecasters[first].configuration.get("shape", "disc")
        # Records with two futures are found among all scenes only.
        scenes, _ = choose(data, "test", None if data.subsets else GAMES)
    except ConfigError as error:
        print(f"no figures: {error}")
        return []
    folder.mkdir(parents=True, exist_ok=True)
    drawn: list[Path] = []
    if is_traffic(scenes, shape):
        for number, row in enumerate(eventful(scenes, SCENES), 1):
            forecasts = {title: forecast_of(forecaster, scenes[row]) for title, forecaster in forecasters.items()}
            drawn.append(highway_comparison(scenes[row], forecasts, folder / f"scene_{number}.png"))
    else:
        shown, others = pairs(scenes, SCENES)
        other = None if others is None or scenes.future is None else scenes.future[others]
        forecasts = {title: forecast_of(forecaster, scenes[shown]) for title, forecaster in forecasters.items()}
        drawn.append(joint_predictions(scenes[shown], forecasts, folder / "joint_predictions.png", other))
    many = spread(scenes, GAMES)
    games = {title: forecast_of(forecasters[title], many) for title, f in forecasts.items() if f.parameters is not None}
    if games:
        names = () if is_traffic(scenes, shape) else AGENTS
        drawn.append(learned_weights(games, folder / "learned_weights.png", names))
    return drawn


def _rank(run: RunFolder) -> tuple[bool, int, str]:
    record = run.record
    name = record["forecaster"]
    return record["goal"] != "energy", ORDER.index(name) if name in ORDER else len(ORDER), record["title"]
