"""Composition of configurations by Hydra; each of its errors becomes one sentence.

The configuration tree lies beside the package in a checkout and inside it in an installed wheel. A configuration is
composed and checked before anything else happens, so that a misspelt word is reported at once and leaves no folder.
"""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from epo_lightning.experiment.config.messages import one_sentence, refuse_merged, sentence
from epo_lightning.experiment.config.replaced import SECTIONS, keys_of_sweep, refuse_replaced, replaced
from epo_lightning.experiment.config.sources import GROUP, file_of, options_of, recorded_name
from epo_lightning.identity import canonical, essence, of_row
from epo_lightning.registry import ConfigError, parts

if TYPE_CHECKING:
    from hydra._internal.hydra import Hydra
    from hydra.core.utils import JobReturn
    from omegaconf import DictConfig

PACKAGE = Path(__file__).resolve().parents[2]
TITLED = ("backbone", "forecaster")
"""Parts that titles of experiments name: "V-LSTM + EPO"."""
OF_GAMES = ("energy", "solver", "backward", "objective")
"""Parts that forecasters without games do not take. (Their losses are their own.)"""


def tree() -> Path:
    """The folder that holds ``conf/`` and ``sweeps/``: the package of a wheel, the root of a checkout."""
    for folder in (PACKAGE, PACKAGE.parent):
        if (folder / "conf" / "train.yaml").is_file():
            return folder
    raise ConfigError(
        f"the configuration tree is missing: no conf/train.yaml in {PACKAGE} or {PACKAGE.parent}; reinstall"
    )


@contextmanager
def hydra(extra: Sequence[str] = ()) -> Iterator[Hydra]:
    """Hydra with this project's tree on its search path, and ``extra`` folders before it.

    Raises:
        ConfigError: one of the ``extra`` folders does not exist, or has no group.
    """
    from hydra import version
    from hydra._internal.hydra import Hydra
    from hydra._internal.sources_registry import SourcesRegistry
    from hydra._internal.utils import create_config_search_path
    from hydra.core.config_search_path import SearchPathQuery
    from hydra.core.global_hydra import GlobalHydra

    from epo_lightning.experiment.config.sources import SweepsSource, TreeSource

    version.setbase("1.3")
    root = tree()
    for source in (TreeSource, SweepsSource):
        SourcesRegistry.instance().register(source)
    path = create_config_search_path(f"tree://{root / 'conf'}")
    # The folder `sweeps` lies beside conf/, because users look for the tables of the paper there.
    path.append("sweeps", f"beside://{root}", SearchPathQuery(provider="main"))
    for folder in reversed(extra):
        if not Path(folder).is_dir():
            raise ConfigError(f"--config-dir {folder}: the folder does not exist")
        groups = [entry.name for entry in (root / "conf").iterdir()] + [GROUP]
        if not any((Path(folder) / group).exists() for group in groups):
            raise ConfigError(
                f"--config-dir {folder} has no configurations: expected a folder that contains groups, such as {GROUP}/, "
                "experiment/ or data/"
            )
        address = f"tree://{Path(folder).resolve()}"
        path.prepend("command-line", address, SearchPathQuery(provider="main"))
    GlobalHydra.instance().clear()
    try:
        yield Hydra.create_main_hydra2("epo", path)
    finally:
        GlobalHydra.instance().clear()


def compose(name: str, overrides: Sequence[str] = (), extra: Sequence[str] = ()) -> dict[str, Any]:
    """The configuration ``name`` with ``overrides``, resolved to plain Python values.

    Raises:
        ConfigError: an unknown key, an unknown option of a group, or an override that cannot be read.
    """
    with hydra(extra) as instance:
        return resolve(_composed(instance, name, overrides))


def resolve(config: DictConfig) -> dict[str, Any]:
    """A configuration as plain Python values, with every interpolation replaced and without the section ``hydra``.

    Adds ``experiment`` and, for `epo train`, ``variant``. ``variant`` is empty if all settings that decide on the result
    have the values of the experiment's file and the budget's file. Otherwise it is six digits of a hash of those settings,
    without the seed. A title from the experiment's file gets the names of backbone and forecaster where they differ from it.

    Raises:
        ConfigError: an interpolation of a key that does not exist, a value that is still missing, settings of a part that
            the forecaster does not take, or a setting of a file that the budget replaces.
    """
    from hydra.core.global_hydra import GlobalHydra

    choices = dict(config.hydra.runtime.choices) if "hydra" in config else {}
    values = _plain_values(config)
    if "trainer" in values and "hydra" in config:
        _refuse_ignored(values, config.hydra.overrides.task)
    if choices.get("experiment"):
        choices["experiment"] = recorded_name(choices["experiment"], choices.get("data", ""))
        values["experiment"] = choices["experiment"]
    if "trainer" in values:
        own = canonical(essence(of_row(values)))
        words = tuple(f"{group}={choices[group]}" for group in ("experiment", "budget") if choices.get(group))
        entries = GlobalHydra.instance().config_loader().get_search_path().get_path()
        search_path = tuple(entry.path for entry in entries)
        written = _as_written(words, search_path)
        same = written is not None and own == canonical(essence(of_row(written)))
        values["variant"] = "" if same else hashlib.sha256(own.encode()).hexdigest()[:6]
        if written is not None and choices.get("experiment"):
            values["title"] = _true_title(values, written)
        # A budget for trials is small whatever else is written.
        words += tuple(f"{group}={choices[group]}" for group in SECTIONS if choices.get(group))
        if "hydra" in config and choices.get("budget") != "smoke" and (found := replaced(words, search_path)):
            of_sweep = keys_of_sweep(choices.get(GROUP))
            refuse_replaced(values, [*config.hydra.overrides.task, *of_sweep], found)
    return values


def _refuse_ignored(values: Mapping[str, Any], overrides: Iterable[str]) -> None:
    """Refuse settings of :data:`OF_GAMES` for a forecaster that takes no such part and would silently ignore them.

    Without this check, a table would have rows "power=1" and "power=2" with equal scores. The implementation of a solver,
    ``solver.backend``, may be chosen for all rows of a sweep.

    Raises:
        ConfigError: an override sets or chooses a part, and the forecaster takes none.
    """
    settings = re.compile(rf"[+~]*((?!solver\.backend=)({'|'.join(OF_GAMES)})(?:[.=].*)?)")
    given = [match for word in overrides if (match := settings.fullmatch(word))]
    if not given:  # nothing to check, so that Lightning, which takes seconds, is not imported
        return
    name = str(_name(values, "forecaster"))
    chosen = parts("forecaster").get(name)
    if chosen is None:
        return
    own, section = inspect.signature(chosen).parameters, values["forecaster"]
    given = [match for match in given if match.group(2) not in own]
    if not given:
        return
    part = given[0].group(2)
    key, _, value = given[0].group(1).removeprefix("objective.").partition("=")
    known = {"weights": "loss_weights"}.get(key.partition(".")[0], key.partition(".")[0])
    if part == "objective" and known in own:
        place = ".".join(["forecaster", known, *key.split(".")[1:]])
        there = f"write {'' if known in section else '+'}{place}={value}"
    else:
        there = "leave it out"
    how = " as conf/experiment/rpi/*_squared.yaml do" if part == "objective" else " for those that take one"
    raise ConfigError(
        f"{given[0].group()} has no effect on forecaster={name}, which takes no {part}: {there}; in a sweep over several "
        f"forecasters, write it into experiment files{how}"
    )


def _true_title(values: Mapping[str, Any], written: Mapping[str, Any]) -> Any:
    """The title of a run; where it is that of the experiment's file, with the names of parts that differ from this file."""
    if values["title"] != written["title"]:
        return values["title"]
    names = {part: _name(values, part) for part in TITLED if _name(values, part) != _name(written, part)}
    return ", ".join([str(values["title"]), *(f"{part}={name}" for part, name in names.items())])


def _name(values: Mapping[str, Any], part: str) -> Any:
    """The name of a part; None where its section is missing, which the schema refuses later."""
    section = values.get(part)
    return section.get("name") if isinstance(section, Mapping) else None


@cache
def _as_written(words: tuple[str, ...], search_path: tuple[str, ...]) -> dict[str, Any] | None:
    """The configuration with the overrides ``words`` only; None if it cannot be composed with these alone."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode

    loader = GlobalHydra.instance().config_loader()
    try:
        config = loader.load_configuration("train", list(words), run_mode=RunMode.RUN)
        return _plain_values(config)
    except Exception:  # a mandatory value is missing: only the other overrides of the run give it
        return None


def _plain_values(config: DictConfig) -> dict[str, Any]:
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    plain = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    try:
        values = OmegaConf.to_container(plain, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        key = error.full_key
        value = (
            "<run folder>, or a run that ships with the package (run=rpi/v_lstm_epo)," if key == "run" else "<value>"
        )
        raise ConfigError(f"{key}={value} is needed: it has no default") from error
    except OmegaConfBaseException as error:
        raise ConfigError(sentence(error)) from error
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def jobs(name: str, overrides: Sequence[str], extra: Sequence[str] = ()) -> list[list[str]]:
    """The overrides of every job that Hydra's basic sweeper would launch; empty for sweepers that search (Optuna).

    Raises:
        ConfigError: as :func:`compose`, the file of a sweep has no runs, or a glob or range stands for no value.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf import OmegaConf

    with hydra(extra) as instance:
        config = _composed(instance, name, overrides, multirun=True)
        sweeper = config.hydra.sweeper
        if not str(sweeper.get("_target_", "")).endswith("BasicSweeper"):
            return []
        params = _params(instance, config)
        # Not resolved here: run_dir=one-${seed} must be resolved in each job, with the job's own seed.
        task = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
        assert isinstance(task, list)
        sweep = config.hydra.runtime.choices.get(GROUP)
        if sweep and not params and not any(word.startswith("experiment=") for word in task):
            raise ConfigError(
                f"{file_of(instance, GROUP, sweep)} has no runs: hydra.sweeper.params lists nothing, and the command "
                "chooses no experiment. List what the runs are, for example `experiment: rpi/v_lstm_epo` and `seed: 0,1`"
            )
        arguments = [*params, *task]
        parsed = OverridesParser.create(config_loader=instance.config_loader).parse_overrides(arguments)
        for one in parsed:
            if one.is_sweep_override() and not any(True for _ in one.sweep_string_iterator()):
                raise ConfigError(
                    f"{one.input_line} matches nothing, so that there is nothing to run: correct it; "
                    "`epo train --help` lists the options of all groups"
                )
        batches = BasicSweeper.split_arguments(parsed, None)
        return [[str(text) for text in job] for batch in batches for job in batch]


def fixed_choices(name: str, sweep: str, extra: Sequence[str] = ()) -> dict[str, str]:
    """The groups of which the file of a sweep chooses one option for all runs, and the overrides that choose it.

    Args:
        name: configuration of which the sweep has runs.
        sweep: name of the file in ``sweeps/``.
        extra: folders that are searched for configurations first.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    with hydra(extra) as instance:
        params = _params(instance, _composed(instance, name, [f"sweeps={sweep}"], multirun=True))
        words = [word for word in params if options_of(instance, word.partition("=")[0])]
        parsed = OverridesParser.create(config_loader=instance.config_loader).parse_overrides(words)
        return {one.key_or_group: str(one.input_line) for one in parsed if not one.is_sweep_override()}


def _params(instance: Hydra, config: DictConfig) -> list[str]:
    """The values that a sweep's file lists in ``hydra.sweeper.params``, as overrides.

    Raises:
        ConfigError: settings of a section that are not written as dotted keys, or a value that cannot be read.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import DictConfig

    parser = OverridesParser.create(config_loader=instance.config_loader)
    file = f"{file_of(instance, GROUP, str(config.hydra.runtime.choices.get(GROUP)))}, hydra.sweeper.params"
    words = []
    for key, value in (config.hydra.sweeper.get("params") or {}).items():
        if isinstance(value, DictConfig):
            inner, first = next(((str(own), given) for own, given in value.items()), ("<key>", "<values>"))
            raise ConfigError(
                f"{file}: {key} is a section, expected dotted keys with their values: write `{key}.{inner}: {first}`"
            )
        word = f"{key}={value}"
        try:
            parser.parse_override(word)
        except HydraException as error:
            raise ConfigError(
                f"{file}: cannot read `{key}: {value}`, expected a value, or several with commas between them: "
                f"`{key}: a,b`; a value with other than plain letters, digits and ._-/ needs quotes of its own, \"'value'\""
            ) from error
        refuse_merged(instance, word, f"{file}: ")
        words.append(word)
    return words


def trials(name: str, overrides: Sequence[str], extra: Sequence[str] = ()) -> int | None:
    """Number of runs that a searching sweeper makes (``n_trials``); None for sweepers without that setting."""
    with hydra(extra) as instance:
        return _composed(instance, name, overrides, multirun=True).hydra.sweeper.get("n_trials")


def launch(
    name: str,
    overrides: Sequence[str],
    jobs: Sequence[list[str]],
    task: Callable[[DictConfig], Any],
    extra: Sequence[str],
) -> Sequence[JobReturn]:
    """Hand these jobs to the launcher that the configuration chooses.

    Unlike Hydra's sweeper, this function writes no multirun.yaml, which would contain passwords of the command line.

    Returns:
        one entry per job, with its result or the exception that it raised.

    Raises:
        ConfigError: a mistake in the configuration, or a package of the launcher that is not installed.
    """
    from hydra._internal.callbacks import Callbacks
    from hydra.core.plugins import Plugins
    from hydra.types import HydraContext

    with hydra(extra) as instance, one_sentence(instance, name, overrides):
        config = _composed(instance, name, overrides, multirun=True)
        callbacks = Callbacks(config)
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(config_loader=instance.config_loader, callbacks=callbacks),
            task_function=task,
            config=config,
        )
        callbacks.on_multirun_start(config=config, config_name=name)
        try:
            done = launcher.launch(jobs, initial_job_idx=0)
        except ModuleNotFoundError as error:  # those of a job are in the job's entry
            raise ConfigError(
                f"the launcher needs a package that is not installed ({error}): install it, or leave out hydra/launcher"
            ) from error
        callbacks.on_multirun_end(config=config, config_name=name)
    return done


def multirun(name: str, overrides: Sequence[str], task: Callable[[DictConfig], Any], extra: Sequence[str] = ()) -> Any:
    """Hand the sweep to Hydra's own sweeper and launcher."""
    with hydra(extra) as instance, one_sentence(instance, name, overrides):
        return instance.multirun(config_name=name, task_function=task, overrides=list(overrides))


def _composed(instance: Hydra, name: str, overrides: Sequence[str], multirun: bool = False) -> DictConfig:
    from hydra.types import RunMode

    for word in overrides:
        if re.search(r"\$\{\s*oc\.env\s*:", word):
            raise ConfigError(
                f"{word}: environment variables are not resolved in overrides, because run folders would keep their values; "
                'let the shell replace them, key="$NAME", or write the interpolation into a file of the configuration tree'
            )
        if "=[" in word:
            refuse_merged(instance, word)
    with one_sentence(instance, name, overrides):
        return instance.compose_config(
            config_name=name,
            overrides=list(overrides),
            run_mode=RunMode.MULTIRUN if multirun else RunMode.RUN,
            with_log_configuration=False,
        )
