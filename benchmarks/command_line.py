"""The command lines of benchmarks."""

from __future__ import annotations

import argparse


def parser_of(name: str, text: str | None) -> argparse.ArgumentParser:
    """A parser of ``python -m benchmarks.<name>``, whose help shows the text of the module line by line."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}", description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
