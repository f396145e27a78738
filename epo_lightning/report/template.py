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

``folds("urban_folds")`` has the same rows with the test split of a cross-validation as the unit, instead of the seed, and
``transfer("transfer", "us101", "dut")`` those that were trained on one data set and scored on another one.
:mod:`epo_lightning.report.scores` has the names of metrics, and everything that rows can be asked for.

``driven("rpi", "plays")`` has what planners did in closed loop (:mod:`epo_lightning.report.closed_loop`), from
``drive/rpi.json`` in the folder of the results files, a ``results.json`` of ``epo drive``.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from epo_lightning.files import errors_naming, write_file
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.report.closed_loop import ClosedLoop, read_closed_loop
from epo_lightning.report.columns import MISSING
from epo_lightning.report.costs import last_fifth
from epo_lightning.report.curves import METRIC, validation_log
from epo_lightning.report.render import markdown
from epo_lightning.report.results import read_results
from epo_lightning.report.rows import Row, plain_rows
from epo_lightning.report.runs import EvaluatedRun, read_other, read_parts
from epo_lightning.report.scores import Differences, Scores, average, below, table
from epo_lightning.report.tables import build_tables, over_folds

ENDING = ".j2"
"""Ending of the name of a template; its page has the same name without it."""


class Results:
    """Rows of the results files in a folder, and the record of which files were used.

    Args:
        folder: folder of the results files.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        self.used: dict[str, list[EvaluatedRun]] = {}
        self._elsewhere: dict[str, list[EvaluatedRun]] = {}

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

    def transfer(self, name: str, trained: str, tested: str, digits: int = 3) -> Rows:
        """The rows that were trained on one data set, by their scores on another one, or on the test split of their own.

        Args:
            name: name of the file without ``.json``.
            trained, tested: names of the data sets.
            digits: number of decimals in texts of these rows.

        Raises:
            ConfigError: no such file or data set, or a damaged file.
        """
        file = self.folder / f"{name}.json"
        if name not in self._elsewhere:  # a page asks for many pairs of data sets
            own = self._read(name)[1]
            self._elsewhere[name] = [*own, *(one for run in read_results(file).runs for one, _ in read_other(run))]
        runs = self._elsewhere[name]
        _require_name(file, trained, dict.fromkeys(run.trained_data for run in runs))
        runs = [run for run in runs if run.trained_data == trained]
        _require_name(file, tested, dict.fromkeys(run.data for run in runs))
        # Of the scores of one run on the same data, the ones that were written last count.
        last = {run.path: run for run in runs if run.data == tested}
        return Rows(file, _by_unit(plain_rows(last.values()), digits, _scores))

    def driven(self, name: str, others: str) -> ClosedLoop:
        """Measures of planners in closed loop.

        Args:
            name: name of the file in the folder ``drive``, without ``.json``.
            others: kind of the others.

        Raises:
            ConfigError: no such file or kind of others, or a damaged file.
        """
        return read_closed_loop(_existing(self.folder / "drive", name), others)

    def _read(self, name: str) -> tuple[Path, list[EvaluatedRun]]:
        """A results file and its runs, scored on the test split, or on the one split that the file has."""
        file = _existing(self.folder, name)
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
            commits = sorted({run.git_commit[:7] + "+" * run.git_commit.endswith("+") for run in runs})
            seeds = sorted({run.seed for run in runs})
            steps = sorted({int(run.records.record["steps"]) for run in runs if run.learned}) or [0]
            lines.append(
                (
                    f"[{name}](tables/{name}/results.md)",
                    "; ".join(data),
                    ", ".join(commits),
                    " to ".join(str(seed) for seed in dict.fromkeys((seeds[0], seeds[-1]))),
                    str(len(runs)),
                    " to ".join(str(number) for number in dict.fromkeys((steps[0], steps[-1]))),
                    _settled(runs),
                )
            )
        header = ("results file", "scored on (digest)", "commits", "seeds", "runs", "steps", "change in the last fifth")
        return markdown(header, lines, left=4)


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
        results=source.rows,
        folds=source.folds,
        transfer=source.transfer,
        driven=source.driven,
        sources=source.sources,
        average=average,
        below=below,
        table=table,
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


def _existing(folder: Path, name: str) -> Path:
    """The file of a name in a folder of results."""
    file = folder / f"{name}.json"
    if not file.exists():
        raise ConfigError(f"no results file {file}; {nearest(name, (path.stem for path in folder.glob('*.json')))}")
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
