"""Pages whose numbers come from results files: Jinja templates in which every number is looked up.

A template gets rows by :meth:`Results.rows`, under the name ``results``, and asks them for text::

    {% set rows = results("rpi_hard_settled", digits=4) %}
    {% set sc, epo = rows["V-LSTM + SC, relaxed"], rows["V-LSTM + EPO, relaxed"] %}
    {{ epo.text("SADE") }}                                            .0128 ± .0007
    {{ (epo - sc).text("SADE") }}                                     -.0044 (-.0060 to -.0029)
    {{ epo.over(sc, "SFDE") }}                                        .68
    {{ below([epo - sc], "SADE") }}                                   5 of 5
    {{ table("hard split", {"+SC": sc, "+EPO": epo}, "SADE", "SFDE") }}
    {{ table("paired difference", {"+EPO - +SC": epo - sc}, "SADE", "SFDE") }}

``folds("urban_folds")`` has the same rows with the test split of a cross-validation as the unit, instead of the seed.

Metrics are named as in the tables of reports (``SADE``, ``OR``, ``SADE, k=1``) or as in ``metrics.json``. The name of a
subset or of a stage stands before them: ``interactive SADE``, ``initial SADE``; ``validation SADE`` is the lowest one of the
training's log.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from epo_lightning.registry import ConfigError, nearest
from epo_lightning.report.columns import EQUILIBRIUM, MAIN, MISSING, PROBABILITIES, TRUTH
from epo_lightning.report.costs import last_fifth
from epo_lightning.report.curves import METRIC, validation_log
from epo_lightning.report.folds import mean_scores
from epo_lightning.report.results import read_results
from epo_lightning.report.rows import Row, plain_rows
from epo_lightning.report.runs import EvaluatedRun, read_parts
from epo_lightning.report.statistics import compare
from epo_lightning.report.tables import build_tables, over_folds
from epo_lightning.run_folder import errors_naming, write_file

ENDING = ".j2"
"""Ending of the name of a template; its page has the same name without it."""

METRICS = {
    **{column.label: column.metric for column in (*MAIN, *PROBABILITIES, *EQUILIBRIUM, *TRUTH)},
    "OR": "overlap_jfp",
}
"""Metrics by the names that templates may use for them."""


@dataclass(frozen=True)
class Scores:
    """Scores of one row, by seed and metric.

    Attributes:
        name: name of the row, for error messages.
        by_seed: scores by metric of every seed; of a cross-validation, of every fold.
        digits: number of decimals in texts.
    """

    name: str
    by_seed: Mapping[int, Mapping[str, float]] = field(repr=False)
    digits: int = 3

    @property
    def n(self) -> int:
        """Number of seeds."""
        return len(self.by_seed)

    def values(self, metric: str) -> list[float]:
        """The score of every seed, in the order of the seeds.

        Raises:
            ConfigError: the row has no such metric, or a seed lacks it or has no finite value of it.
        """
        subset, _, label = metric.partition(" ")
        known = {key for scores in self.by_seed.values() for key in scores}
        names = (METRICS.get(metric, metric), f"{subset}/{METRICS.get(label, label)}")
        key = next((name for name in names if name in known), None)
        if key is None:
            raise ConfigError(f"row {self.name!r} has no metric {metric!r}; {nearest(names[0], known)}")
        values = {seed: self.by_seed[seed].get(key, math.nan) for seed in sorted(self.by_seed)}
        for seed, value in values.items():
            if not math.isfinite(value):
                raise ConfigError(
                    f"row {self.name!r}, seed {seed}: {key} is {value}, and a page needs a finite score of every seed"
                )
        return list(values.values())

    def mean(self, metric: str, digits: int | None = None) -> str:
        """Mean over seeds: ``.0128``."""
        return _decimal(statistics.fmean(self.values(metric)), self._places(digits))

    def text(self, metric: str, digits: int | None = None) -> str:
        """Mean and sample standard deviation over seeds: ``.0128 ± .0007``; the mean alone if all seeds agree."""
        values = self.values(metric)
        spread = statistics.stdev(values) if len({*values}) > 1 else None
        mean = self.mean(metric, digits)
        return mean if spread is None else f"{mean} ± {_decimal(spread, self._places(digits))}"

    def seeds(self, metric: str, digits: int | None = None) -> str:
        """The score of every seed: ``.087, .086, .087``."""
        return ", ".join(_decimal(value, self._places(digits)) for value in self.values(metric))

    def over(self, other: Scores, metric: str) -> str:
        """Ratio of the means of this row and another one: ``.68``."""
        return _decimal(statistics.fmean(self.values(metric)) / statistics.fmean(other.values(metric)), 2)

    def __sub__(self, other: Scores) -> Differences:
        """Differences from another row over the seeds that both have.

        Raises:
            ConfigError: the rows have no seed in common.
        """
        seeds = sorted(self.by_seed.keys() & other.by_seed.keys())
        if not seeds:
            raise ConfigError(f"rows {self.name!r} and {other.name!r} have no seed in common")
        found = {
            seed: {
                key: value - other.by_seed[seed][key]
                for key, value in self.by_seed[seed].items()
                if key in other.by_seed[seed]
            }
            for seed in seeds
        }
        return Differences(f"{self.name} - {other.name}", found, self.digits)

    def _places(self, digits: int | None) -> int:
        return self.digits if digits is None else digits


class Differences(Scores):
    """Paired differences of two rows, by seed and metric; negative where the first row has the smaller score."""

    def text(self, metric: str, digits: int | None = None) -> str:
        """Mean difference with its 95 % confidence interval (Student's t): ``-.0044 (-.0060 to -.0029)``."""
        values = self.values(metric)
        found = compare(values, [0.0] * len(values))
        shown = [value for value in (found.mean, found.low, found.high) if value is not None]
        middle, *ends = (_decimal(value, self._places(digits), sign=True) for value in shown)
        return f"{middle} ({' to '.join(ends)})" if ends else middle

    def seeds(self, metric: str, digits: int | None = None) -> str:
        """The difference of every seed: ``+.013, -.060, +.290``."""
        return ", ".join(_decimal(value, self._places(digits), sign=True) for value in self.values(metric))


class Results:
    """Rows of the results files in a folder, and the record of which files were used.

    Args:
        folder: folder of the results files.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        self.used: dict[str, list[EvaluatedRun]] = {}

    def rows(self, name: str, data: str | None = None, digits: int = 3) -> Rows:
        """The rows of a results file by name: scores on the test split, or on the one split that the file has.

        Args:
            name: name of the file without ``.json``.
            data: name of the data set, where the file has scores on several.
            digits: number of decimals in texts of these rows.

        Raises:
            ConfigError: no such file or data set, or a damaged file.
        """
        file, runs = self._read(name)
        found = dict.fromkeys(run.data for run in runs)
        _require_name(file, data, found)
        rows = plain_rows(run for run in runs if data in (None, run.data))
        return Rows(file, _by_unit(rows, digits, _scores))

    def folds(self, name: str, data: str | None = None, digits: int = 3) -> Rows:
        """The rows of a cross-validation by title, with the test split as the unit instead of the seed.

        Args:
            name: name of the file without ``.json``.
            data: name of the data set, where the file has several with folds.
            digits: number of decimals in texts of these rows.

        Raises:
            ConfigError: no such file or data set, a damaged file, or no data set with several test splits.
        """
        file, runs = self._read(name)
        found = {table.data: table.rows for table in over_folds(build_tables(runs))}
        if not found:
            raise ConfigError(
                f"{file} has no cross-validation: runs on one data set with different groups in data.test"
            )
        _require_name(file, data, found)
        return Rows(file, _by_unit(found[data or next(iter(found))], digits, lambda run: run.metrics))

    def _read(self, name: str) -> tuple[Path, list[EvaluatedRun]]:
        """A results file and its runs, scored on the test split, or on the one split that the file has."""
        file = self.folder / f"{name}.json"
        if not file.exists():
            raise ConfigError(
                f"no results file {file}; {nearest(name, (path.stem for path in self.folder.glob('*.json')))}"
            )
        report = read_results(file)
        runs = [*report.evaluated, *(part for run in report.runs for part in read_parts(run))]
        self.used[name] = [run for run in runs if run.split == "test"] or runs
        return file, self.used[name]

    def sources(self) -> str:
        """Table of the results files that were used, with what their runs saw, and how far they had settled.

        The last column is the change of the lowest validation SADE in the last fifth of the training, in the mean of a row:
        the rows that changed most and least.
        """
        lines = []
        for name, runs in sorted(self.used.items()):
            if not runs:
                raise ConfigError(f"results file {name} has no scored runs, so it cannot stand in the list of sources")
            data = dict.fromkeys(f"{run.data} ({run.data_digest})" for run in runs)
            commits = sorted({run.git_commit[:7] for run in runs})
            seeds = sorted({run.seed for run in runs})
            steps = sorted({int(run.records.record["steps"]) for run in runs if run.learned}) or [0]
            lines.append(
                (
                    f"[{name}](tables/{name}/results.md)",
                    "; ".join(data),
                    ", ".join(commits),
                    f"{seeds[0]} to {seeds[-1]}",
                    str(len(runs)),
                    " to ".join(str(number) for number in dict.fromkeys((steps[0], steps[-1]))),
                    _settled(runs),
                )
            )
        header = ("results file", "scored on (digest)", "commits", "seeds", "runs", "steps", "change in the last fifth")
        return _lines(header, lines, left=4)


class Rows(Mapping[str, Scores]):
    """Rows of one results file by name."""

    def __init__(self, file: Path, rows: Mapping[str, Scores]) -> None:
        self._file, self._rows = file, rows

    def __getitem__(self, name: str) -> Scores:
        if name not in self._rows:
            raise ConfigError(f"{self._file} has no row {name!r}; {nearest(name, self._rows)}")
        return self._rows[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def minus(self, starts: Iterable[str], first: str, second: str) -> dict[str, Differences]:
        """Differences of the rows ``start + first`` and ``start + second``, by start."""
        return {start: self[start + first] - self[start + second] for start in starts}

    def __len__(self) -> int:
        return len(self._rows)


def average(rows: Iterable[Scores]) -> Scores:
    """Mean of several rows, or of several differences, seed by seed, over the seeds that all of them have.

    Raises:
        ConfigError: the rows have no seed in common.
    """
    rows = list(rows)
    seeds = sorted(set.intersection(*({*row.by_seed} for row in rows)))
    if not seeds:
        raise ConfigError(f"rows {', '.join(repr(row.name) for row in rows)} have no seed in common")
    found = {seed: mean_scores(row.by_seed[seed] for row in rows) for seed in seeds}
    return type(rows[0])(f"mean of {', '.join(row.name for row in rows)}", found, rows[0].digits)


def below(rows: Iterable[Scores], metric: str, limit: float = 0.0) -> str:
    """Number of runs whose score is below a limit, or of pairs whose first run has the lower score: ``8 of 9``."""
    values = [value for row in rows for value in row.values(metric)]
    return f"{sum(value < limit for value in values)} of {len(values)}"


def table(
    name: str, rows: Mapping[str, Scores], *metrics: str, paper: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Markdown table of rows, or of differences.

    Args:
        name: heading of the first column.
        rows: rows by the names that the table gives them.
        metrics: metrics of the columns.
        paper: the paper's values by row, for as many columns as they are, which are the first ones.
    """
    paper = paper or {}
    known = max(map(len, paper.values()), default=0)
    header = (name, "n", *metrics, *(f"paper: {metric}" for metric in metrics[:known]))
    lines = []
    for title, row in rows.items():
        values = [*paper.get(title, ()), *[""] * known][:known]
        lines.append((title, str(row.n), *(row.text(metric) for metric in metrics), *values))
    return _lines(header, lines)


def write_page(template: str | Path, results: str | Path, out: str | Path | None = None) -> Path:
    """Write the page of a template.

    Args:
        template: file whose name ends with ``.j2``.
        results: folder of the results files.
        out: folder of the page; None for that of the template.

    Returns:
        the file that was written.

    Raises:
        ConfigError: no such template, an error in it (with its line), or a row, metric or file that does not exist.
    """
    from jinja2 import Environment, StrictUndefined, TemplateError, TemplateSyntaxError

    template = Path(template).expanduser()
    if template.suffix != ENDING or not template.stem:
        raise ConfigError(
            f"template={template} must be a file whose name ends with {ENDING}, page.md{ENDING} for example"
        )
    with errors_naming(template):
        text = template.read_text(encoding="utf-8")
    source = Results(results)
    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.globals.update(
        results=source.rows, folds=source.folds, sources=source.sources, average=average, below=below, table=table
    )
    try:
        page = environment.from_string(text).render()
    except TemplateSyntaxError as error:
        raise ConfigError(f"{template}, line {error.lineno}: {error.message}") from error
    except (TemplateError, TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        raise ConfigError(f"{template}, line {_line(error)}: {error}") from error
    file = Path(template.parent if out is None else out).expanduser() / template.stem
    write_file(file, page)
    return file


def _scores(run: EvaluatedRun) -> Mapping[str, float]:
    """The scores of a run, with the lowest validation score of its training."""
    log = _validations(run)
    return {**run.metrics, f"validation/{METRIC.partition('/')[2]}": min(log.values())} if log else run.metrics


def _require_name(file: Path, data: str | None, known: Iterable[str]) -> None:
    """Check that ``data`` names one of the known data sets; it may be None if there is one alone."""
    known = list(known)
    if (data is None and len(known) > 1) or (data is not None and data not in known):
        raise ConfigError(f"{file}: data must name one of its data sets, found {data}; {nearest(data or '', known)}")


def _by_unit(
    rows: Iterable[Row], digits: int, scores: Callable[[EvaluatedRun], Mapping[str, float]]
) -> dict[str, Scores]:
    return {row.name: Scores(row.name, {run.seed: scores(run) for run in row.runs}, digits) for row in rows}


def _validations(run: EvaluatedRun) -> Mapping[int, float]:
    """Validation scores of a run by training step; empty if it was not trained or its log cannot be read."""
    try:
        return validation_log(run.records, METRIC) if run.learned else {}
    except ConfigError:  # the learning curves of the report say what is wrong with this log
        return {}


def _settled(runs: Iterable[EvaluatedRun]) -> str:
    """Range over rows of the mean change of their validation scores in the last fifth of the training, in percent."""
    changes: dict[str, list[float]] = {}
    for run in runs:
        log = _validations(run)
        if log and (change := last_fifth(log)) is not None:
            changes.setdefault(run.row, []).append(100 * change)
    means = [statistics.fmean(values) for values in changes.values()]
    ends = (
        dict.fromkeys(f"{round(value, 1) + 0.0:.1f}" for value in (min(means), max(means))) if means else {}
    )  # no -0.0
    return f"{' to '.join(ends)} %" if ends else MISSING


def _line(error: Exception) -> int:
    """Line of a template at which an error was raised: that of the innermost frame in the template."""
    found, trace = 0, error.__traceback__
    while trace:
        if trace.tb_frame.f_code.co_filename == "<template>":
            found = trace.tb_lineno
        trace = trace.tb_next
    return found


def _lines(header: Sequence[str], lines: Iterable[Sequence[str]], left: int = 1) -> str:
    """A Markdown table whose cells may have links and emphasis."""
    rule = "|" + ":--|" * left + "--:|" * (len(header) - left)
    first, *rest = ("| " + " | ".join(line) + " |" for line in (header, *lines))
    return "\n".join([first, rule, *rest])


def _decimal(value: float, digits: int, sign: bool = False) -> str:
    """A number with fixed decimals and without a zero before the point: ``.013``, ``+.013``."""
    value = value if sign else round(value, digits) + 0.0  # no -.000 without a sign
    return re.sub(r"^([+-]?)0\.", r"\1.", f"{value:{'+' if sign else ''}.{digits}f}")
