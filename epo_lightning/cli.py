"""``epo <verb> [overrides]``: the command line.

Heavy packages are imported only when they are needed, so that help appears at once. A mistake in the command line or the
configuration gives one message and exit status 2; ``--traceback`` shows where it was raised.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from epo_lightning.arguments import SWEEP_USAGE, USAGE, VERBS, Arguments, parse
from epo_lightning.masking import mask
from epo_lightning.registry import ConfigError, nearest

if TYPE_CHECKING:
    from omegaconf import DictConfig

TERMINATED = 128 + signal.SIGTERM
"""Exit status of a program that was ended by SIGTERM."""


def main(words: Sequence[str] | None = None) -> None:
    """Run a command line and exit: 0 done, 1 failed, 2 a mistake in the command line, 130 interrupted, 143 terminated."""
    words = list(sys.argv[1:] if words is None else words)
    trace = "--traceback" in words
    try:
        with _termination(), nullcontext() if trace else _warnings_in_lines():
            _run([word for word in words if word != "--traceback"])
    except ConfigError as error:
        if trace:
            raise
        print(f"epo: {mask(str(error))}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:  # `epo config ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:
        if trace:
            raise
        where = f": {error.filename}" if error.filename else ""
        print(f"epo: {error.strerror or error}{where}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt as ending:
        print(_farewell("interrupted", words, ending), file=sys.stderr)
        raise SystemExit(130) from None
    except SystemExit as ending:
        if ending.code == TERMINATED:
            print(_farewell("terminated", words, ending), file=sys.stderr)
        raise


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Context in which a warning is printed as one line, without the line of code that raised it."""

    def line(message: Warning | str, category: type[Warning], *_: object, **__: object) -> str:
        kind = "warning" if issubclass(category, UserWarning) else category.__name__
        return f"epo: {kind}: {mask(str(message))}\n"

    usual, warnings.formatwarning = warnings.formatwarning, line
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _farewell(ended: str, words: Sequence[str], ending: BaseException) -> str:
    """The line that a command prints when a signal ended it: how it ended, and how to continue.

    Once it has a run folder, a training adds the command that continues it.
    """
    notes = getattr(ending, "__notes__", [])
    if "explore" in words:  # it is ended by Ctrl-C, and has nothing to continue
        return "epo: stopped"
    if "train" in words and {"-m", "--multirun"}.intersection(words):
        return f"epo: {ended}; the same command with existing=continue continues, and skips finished runs"
    if "train" in words and notes:
        return f"epo: {ended}; {'; '.join(notes)}"
    return f"epo: {ended}; no incomplete file was left; the same command continues"


@contextmanager
def _termination() -> Iterator[None]:
    """Context in which SIGTERM ends the program as Ctrl-C does: temporary files are deleted and locks released.

    An exception after the signal is one of its consequences, so it is replaced by the exit status of the signal: PyTorch,
    for example, fails at an assertion if the signal comes while it traces a program.

    During a training, :func:`epo_lightning.experiment.assembly.signals` handles SIGTERM instead.
    """
    program = os.getpid()
    told = False

    def end(number: int, _: object) -> None:
        nonlocal told
        if os.getpid() == program:
            told = True
            raise SystemExit(TERMINATED)
        signal.signal(number, signal.SIG_DFL)  # a forked worker process: end it by the default action
        os.kill(os.getpid(), number)

    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    if ours:
        signal.signal(signal.SIGTERM, end)
    try:
        yield
    except Exception as error:
        if told:
            raise SystemExit(TERMINATED) from error
        raise
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run(words: Sequence[str]) -> None:
    if "--version" in words:
        from importlib.metadata import version

        print(f"epo_lightning {version('epo_lightning')}")
        return
    arguments = parse(words)
    if not arguments.verb:
        print(USAGE, end="")
    elif arguments.help:
        _help(arguments)
    elif arguments.verb == "config":
        _config(arguments)
    elif arguments.verb == "sweep":
        _sweep(arguments)
    elif arguments.multirun:
        _multirun(arguments)
    else:
        _single(arguments)


def _help(arguments: Arguments) -> None:
    """Print the help of a verb: its configuration file, in which every line has a comment, and the options of groups."""
    from textwrap import fill

    from epo_lightning.experiment.config.compose import hydra, tree
    from epo_lightning.experiment.config.sources import HIGHWAYS, options_of

    if arguments.verb == "sweep":
        print(SWEEP_USAGE)
        _sweep(Arguments("sweep", extra=arguments.extra))
        return
    print(f"epo {arguments.verb} [-m] [key=value ...]: {VERBS[arguments.verb]}\n")
    if arguments.verb == "config":
        print(
            "  epo config [verb] [key=value ...]         print what `epo <verb>` would use; verb is train if left out"
        )
        print("  epo config check [verb] [key=value ...]   check it, without loading data or making a folder")
        return
    hidden = ("hydra:", "  output_subdir", "  run: {", "  sweep: {", "  - override hydra")
    for line in (tree() / "conf" / f"{arguments.verb}.yaml").read_text(encoding="utf-8").splitlines():
        if not line.startswith(hidden):
            print(f"  {line}")
    if arguments.verb in ("generate", "evaluate", "predict", "explore", "export"):
        with hydra(arguments.extra) as instance:
            print(f"  data=         {' | '.join(sorted(options_of(instance, 'data')))}")
    if arguments.verb == "train":
        with hydra(arguments.extra) as instance:
            for group in (
                "experiment",
                "budget",
                "task",
                "data",
                "backbone",
                "forecaster",
                "gate",
                "dynamics",
                "energy",
                "solver",
                "backward",
                "objective",
                "optimizer",
                "logger",
                "debug",
                "hydra/launcher",
                "sweeps",
            ):
                options = options_of(instance, group)
                if group == "experiment":  # list rows on highways once, not once per data set
                    options = [name for name in options if name.partition("/")[0] not in HIGHWAYS]
                words = " | ".join(options)
                print(fill(words, 120, initial_indent=f"  {group + '=':<16}", subsequent_indent=" " * 18))


def _config(arguments: Arguments) -> None:
    words = list(arguments.overrides)
    checking = bool(words) and words[0] == "check"
    words = words[1:] if checking else words
    verb = words.pop(0) if words and words[0] in VERBS and words[0] != "config" else "train"
    if words and "=" not in words[0] and not words[0].startswith("~"):
        raise ConfigError(f"epo config knows no {words[0]!r}: {nearest(words[0], ['check', *VERBS])}")
    from epo_lightning.experiment.config.compose import compose

    config = compose(verb, words, arguments.extra)
    if not checking:
        import yaml

        print(yaml.safe_dump(mask(config), sort_keys=False, default_flow_style=None, width=120), end="")
        return
    if verb != "train":
        from epo_lightning.experiment.verbs import check_settings

        check_settings(verb, config)
        print(f"{verb}: the configuration is valid")
        return
    from epo_lightning.experiment import assembly, train
    from epo_lightning.experiment.config.settings import Settings
    from epo_lightning.schema import read

    settings = read(Settings, config)
    data, model = assembly.check_buildable(settings, words)
    try:
        digest = data.digest
    except ConfigError as error:
        raise ConfigError(
            f"{settings.title}: the settings fit together, but the data cannot be used: {error}"
        ) from error
    run = train.folder_for(settings)
    print(f"{settings.title}: the configuration is valid")
    print(f"  parameters  {assembly.parameters(model)}")
    print(f"  data        {settings.data.get('dataset') or settings.data['name']}, digest {digest}")
    print(f"  run folder  {run.path}" + (" (exists)" if run.exists else ""))


def _single(arguments: Arguments) -> None:
    """Compose the configuration of a verb and run the verb (:data:`.experiment.verbs.RUN`)."""
    resumed = [word for word in arguments.overrides if word.startswith("resume=")]
    if arguments.verb == "train" and resumed:
        _resume(resumed[-1].partition("=")[2], [word for word in arguments.overrides if word not in resumed])
        return
    words = list(arguments.overrides)
    if arguments.verb == "train" and not words:  # the defaults would train a nameless row, for an hour
        raise ConfigError(
            "choose what to train: experiment=<row>, for example `epo train experiment=rpi/v_lstm_epo budget=short`; "
            "`epo train --help` lists rows and budgets"
        )
    if arguments.verb == "report" and words and "=" not in words[0]:
        words[0] = f"sweep={words[0]}"
    from epo_lightning.experiment.config.compose import compose

    config = compose(arguments.verb, words, arguments.extra)
    from epo_lightning.experiment import verbs

    verbs.RUN[arguments.verb](config, [*words, *_options(arguments)])


def _options(arguments: Arguments) -> list[str]:
    """The options of the command without which its words cannot be composed again, for the records of runs."""
    return [f"--config-dir={folder}" for folder in arguments.extra]


def _resume(folder: str, others: Sequence[str]) -> None:
    if others:
        raise ConfigError(
            f"a resumed run keeps its own configuration, so `{' '.join(others)}` cannot be changed: "
            f"leave it out, or begin a new run"
        )
    from epo_lightning.experiment import verbs
    from epo_lightning.run_folder import RunFolder

    verbs.resume_and_print(RunFolder.open(folder))


def _multirun(arguments: Arguments) -> None:
    """Check every training, then let Hydra launch them; data sets and evaluations are made one after the other."""
    if arguments.verb in ("generate", "evaluate"):
        _one_after_the_other(arguments)
        return
    if arguments.verb != "train":
        raise ConfigError(f"epo {arguments.verb} has no option -m: only epo generate, train and evaluate have it")
    from epo_lightning.experiment.config import compose

    listed = compose.jobs("train", arguments.overrides, arguments.extra)
    task = partial(job_of_sweep, options=_options(arguments))
    if listed:
        from epo_lightning.experiment import assembly, train
        from epo_lightning.experiment.config.settings import Settings
        from epo_lightning.schema import read

        for job in listed:
            settings = read(Settings, compose.compose("train", job, arguments.extra))
            data, _ = assembly.check_buildable(settings, job)
            train.refuse_occupied(settings, train.folder_for(settings), data.digest)
        print(f"{len(listed)} runs")
        for done in compose.launch("train", arguments.overrides, listed, task, arguments.extra):
            if isinstance(done._return_value, Exception):
                raise done._return_value  # Hydra's `done.return_value` would print the overrides before it raises
        return
    compose.multirun("train", arguments.overrides, task, arguments.extra)


def _one_after_the_other(arguments: Arguments) -> None:
    """Make the data sets, or the evaluations, of all combinations of the given values."""
    from epo_lightning.experiment.config import compose

    listed = compose.jobs(arguments.verb, arguments.overrides, arguments.extra)
    if not listed:
        raise ConfigError(f"epo {arguments.verb} -m takes lists of values: a sweeper that searches is for epo train")
    # The listed words are without those of Hydra itself, of which each data set needs its launcher.
    of_hydra = [word for word in arguments.overrides if word.startswith(("hydra/", "hydra."))]
    for words in listed:
        _single(Arguments(arguments.verb, [*words, *of_hydra], extra=arguments.extra))


def _sweep(arguments: Arguments) -> None:
    """Run, prepare, show or list sweeps, as ``SWEEP_USAGE`` describes."""
    from textwrap import fill

    from epo_lightning.experiment.sweeps import listing

    words = list(arguments.overrides)
    action = words.pop(0) if words[:1] in (["status"], ["generate"]) else "run"
    name = words.pop(0) if words and "=" not in words[0] else None
    if action == "status":
        listing.show(name, words)
        return
    known = listing.known(arguments.extra)
    if name is None:
        if words or action == "generate":
            command = " ".join(["epo sweep", *([action] if action == "generate" else []), "<name>", *words])
            raise ConfigError(f"the sweep's name is missing: `{command}`; known: {', '.join(known)}")
        width = max(map(len, known)) + 2
        for option, says in known.items():
            print(fill(says, 120, initial_indent=f"  {option:<{width}}", subsequent_indent=" " * (width + 2)))
        return
    if name not in known:
        raise ConfigError(listing.unknown(name, known))
    from epo_lightning.experiment.sweeps import sweeping

    if action == "generate":
        sweeping.generate(name, words, arguments.extra)
        return
    task = partial(job_of_sweep, options=_options(arguments))
    if not sweeping.run(name, words, arguments.extra, task, arguments.stop_on_failure):
        raise SystemExit(1)


def job_of_sweep(config: DictConfig, options: Sequence[str] = ()) -> float | None:
    """Train one run of a sweep or multirun. At module level, so that launchers can send it to other processes.

    Args:
        config: configuration of the run.
        options: options of the command line, which the run's record repeats.

    Returns:
        the best validation score, which a searching sweeper (Optuna) minimises.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from epo_lightning.experiment import verbs
    from epo_lightning.experiment.config.compose import resolve

    whole = OmegaConf.merge({"hydra": HydraConfig.get()}, config)
    OmegaConf.set_struct(whole, False)
    values, overrides = resolve(whole), list(HydraConfig.get().overrides.task)  # type: ignore[arg-type]
    if values.get("sweep"):
        from epo_lightning.experiment.sweeps.sweep import Sweep
        from epo_lightning.experiment.sweeps.work import work

        return work(Sweep(Path(values["sweep"])), values, overrides, options)
    return verbs.train_and_print(values, [*overrides, *options])


if __name__ == "__main__":
    main()
