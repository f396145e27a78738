"""The command lines of benchmarks."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from epo_lightning.registry import ConfigError

PYTHON = "python -m "
"""Start of the command line of a benchmark, before the name of its module."""


def parser_of(name: str, text: str | None) -> argparse.ArgumentParser:
    """A parser of ``python -m benchmarks.<name>``, whose help shows the text of the module line by line."""
    return argparse.ArgumentParser(
        prog=f"{PYTHON}benchmarks.{name}", description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )


@contextmanager
def measuring(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Context of a measurement with one thread and without hints of Lightning.

    Raises:
        SystemExit: a foreseeable mistake. The message begins with the module of the parser, such as ``benchmarks.turning``.
    """
    # Lightning is large, and the processes of `benchmarks.generation`, whose memory is measured, import this module too.
    from epo_lightning.experiment import assembly

    torch.set_num_threads(1)
    assembly.quiet()
    try:
        yield
    except ConfigError as error:
        raise SystemExit(f"{parser.prog.removeprefix(PYTHON)}: {error}") from None
