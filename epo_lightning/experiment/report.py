"""The report over many runs: tables by :mod:`epo_lightning.report`, with figures of what the runs forecast."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from epo_lightning.experiment.config.settings import ReportSettings
from epo_lightning.experiment.sweeps.sweep import Sweep
from epo_lightning.identity import ELSEWHERE
from epo_lightning.registry import ConfigError
from epo_lightning.report.labels import word
from epo_lightning.report.paper import has_values
from epo_lightning.report.render import code
from epo_lightning.report.results import read_results, results_name, save_results
from epo_lightning.report.runs import EvaluatedRun, collect, none_evaluated, scored, scored_elsewhere
from epo_lightning.report.tables import build_tables, distinct
from epo_lightning.report.write import Report, is_measured, is_timed, why_left_out, write_report

RESULTS = "results"
"""Folder of the results files of a template, unless another one is named."""
NOT_DRAWN = "Scenes and learned weights are not drawn: they need checkpoints and data."


def report(settings: ReportSettings) -> Path:
    """Print the tables; write results, figures and index.html.

    Returns:
        the folder of the report.

    Raises:
        ConfigError: no such sweep, no evaluated run, one that cannot be read, or a damaged results file.
    """
    if settings.results and settings.sweep:
        raise ConfigError(
            f"results={settings.results} and the sweep {settings.sweep} name different runs: give one of them"
        )
    sweep = Sweep.find(settings.sweep, (), settings.runs) if settings.sweep else None
    if settings.results:
        subject = read_results(settings.results)
    else:
        subject = of_sweep(sweep) if sweep else Report.of_folder(settings.runs)
    if settings.save:  # the report that is written from the results file has the same bytes
        subject = replace(subject, title=results_name(settings.save))
    out = Path(settings.out or _default_folder(settings, sweep)).expanduser()
    rows = distinct(build_tables(subject.evaluated))  # whatever cannot be reported is said before anything is drawn
    if settings.save:
        save_results(subject, settings.save)
    if settings.scenes and not settings.results:
        from epo_lightning.experiment.report_scenes import draw  # all else is written without Lightning

        drawn, notes = draw(rows, out / "figures")
    else:
        drawn, notes = [], [NOT_DRAWN] if rows else []
    write_report(subject, out, drawn, preface(subject.evaluated), notes)
    return out


def report_page(settings: ReportSettings) -> Path:
    """Write the page of ``template``, whose numbers come from the results files in the folder ``results``.

    Returns:
        the file that was written.

    Raises:
        ConfigError: settings of another kind of report, or as :func:`~epo_lightning.report.template.write_page`.
    """
    from epo_lightning.report.template import write_page

    if settings.sweep or settings.save:
        raise ConfigError(
            "template= writes a page with numbers of results files: leave out the name of a sweep and save="
        )
    return write_page(settings.template or "", settings.results or RESULTS, settings.out)


def _default_folder(settings: ReportSettings, sweep: Sweep | None) -> Path:
    """Folder of a report without ``out``: reports of different runs do not replace each other."""
    if settings.results:
        return Path("report") / results_name(settings.results)
    if sweep:
        return sweep.folder / "report"
    runs, usual = Path(settings.runs).expanduser().resolve(), Path(ReportSettings.runs).resolve()
    return Path("report") / (runs.relative_to(usual) if runs.is_relative_to(usual) else runs.name)


def of_sweep(sweep: Sweep) -> Report:
    """The runs of a sweep, by what the sweep measures: scores on another split belong to another report.

    Raises:
        ConfigError: none of them is done, or one cannot be read.
    """
    jobs = sweep.jobs
    done = [job for job in jobs if is_measured(job.run)]
    if not done:
        raise ConfigError(
            f"{none_evaluated(len(jobs), f'of the sweep {sweep.label}')}: `epo sweep status {sweep.label}` says how far the "
            f"sweep is, epo evaluate runs={os.path.relpath(sweep.root)} evaluates what is finished"
        )
    asked = {job.run.path: job.measures for job in jobs}
    with_scores = [job.run for job in done if scored(job.run)]
    evaluated = [
        run
        for run in (collect(with_scores) if with_scores else ())
        if not asked[run.path] or run.split in asked[run.path]
    ]
    measured = {run.path for run in evaluated}
    measured |= {job.run.path for job in done if is_timed(job.run) or scored_elsewhere(job.run)}
    left_out = []
    for job in jobs:
        if job.run.path not in measured:
            state, error = sweep.state(job), sweep.error(job)
            why = (
                why_left_out(job.run)
                if state == "done"
                else f"{state}: {error}"
                if state == "failed" and error
                else state
            )
            left_out.append((str(job.run.path), why))
    runs = os.path.relpath(sweep.root)
    return Report(
        title=sweep.label,
        command=f"epo report {sweep.label}" + (f" {word('runs', runs)}" if runs != "runs" else ""),
        runs=tuple(job.run for job in jobs if job.run.path in measured),
        evaluated=tuple(evaluated),
        left_out=tuple(left_out),
        sweep=str(sweep.record.get("command", "")),
    )


def preface(runs: Sequence[EvaluatedRun]) -> str:
    """Note before the scores of runs: the budget was not the paper's, and how to use the paper's."""
    budgets = sorted({run.budget for run in runs} - {"paper"})
    words = [word for run in runs for word in _words(run.command)]
    changed = sorted({word for word in words if word.lstrip("+").startswith(("trainer.", "data.")) and _matters(word)})
    if not budgets and not changed:
        return ""
    sentences = [f"**Budget: {', '.join(budgets or ['paper'])}.**"]
    if changed:
        sentences.append(f"Changed by hand: {code(' '.join(changed))}.")
    if any(has_values(run.data) for run in runs):
        sentences.append(
            "These runs saw other data or another number of steps than the paper's, so they do not reproduce its table."
        )
    return " ".join([*sentences, "The paper's settings are those of `epo train` without `budget=`."])


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError:  # an unbalanced quote, written by an older version
        return command.split()


def _matters(word: str) -> bool:
    return word.lstrip("+").partition("=")[0] not in ELSEWHERE
