"""The pages of the documentation, taken apart: code blocks, commands and links."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("", "bash", "console")
PROGRAMS = ("epo", "make", "pip", "python", "pytest", "tensorboard", "mlflow", "wandb", "docker")


class Block(NamedTuple):
    """A fenced code block: its language and its text."""

    language: str
    text: str


def blocks(page: Path) -> list[Block]:
    """The fenced code blocks of a page, in order."""
    found = re.findall(r"^```([^\n`]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [Block(language.strip(), text) for language, text in found]


def lines(text: str) -> Iterator[str]:
    """The commands of a shell block, one by one, without comments; what a command prints is left out."""
    text = text.replace("\\\n", " ")
    prompted = "$ " in text[:2]
    for line in text.splitlines():
        if prompted and not line.startswith("$ "):
            continue
        line = re.split(r"(?:^|\s)#\s", line.removeprefix("$ "))[0].strip()
        yield from (part for part in (part.strip() for part in line.split("&&")) if part)


def is_command(line: str) -> bool:
    """Whether a code span is a command that a reader would type, and not the name of one, such as `epo evaluate`."""
    program, *words = line.split()
    return program in PROGRAMS and bool(words) and (program != "epo" or len(words) > 1)


def commands(page: Path) -> list[str]:
    """All commands of a page: those of shell blocks, and those in code spans within sentences and tables."""
    text = page.read_text(encoding="utf-8")
    in_blocks = [line for block in blocks(page) if block.language in SHELL for line in lines(block.text)]
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    spans = [" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose)]
    # Tables escape vertical bars; a span with <placeholders> or three dots is a pattern.
    in_text = [span.replace("\\|", "|") for span in spans if is_command(span) and not re.search(r"<.*>|\.\.\.", span)]
    return list(dict.fromkeys([line for line in in_blocks if line.split(" ")[0] in PROGRAMS] + in_text))


def unknown(page: Path) -> list[str]:
    """Lines of shell blocks that begin with no known program."""
    found = [line for block in blocks(page) if block.language in ("bash", "console") for line in lines(block.text)]
    return [line for line in found if line.split(" ")[0] not in PROGRAMS]
