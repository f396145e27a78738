"""The page `reference/configuration.md`, made from the configuration tree: groups, options, keys, defaults, comments."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parents[1]
VERBS = ("train", "generate", "evaluate", "predict", "explore", "export", "drive", "report")
LISTED = ("experiment", "sweeps")
"""Groups with many files that set little: their options are listed by name and first comment."""
INTRODUCTION = """\
# Configuration

This page is made from the files in `conf/` and `sweeps/` when the site is built. `epo <verb> --help` prints a verb's own
settings, and `epo config experiment=<row>` prints everything that a run would use.

- A setting is changed by `key=value`, a nested one by `group.key=value` (`solver.steps=4`); an option of a group is chosen
  by `group=option` (`solver=newton`). Later words win.
- An option that *builds on* another one has all of its settings, with those in its table changed.
- An unknown key or option is an error that names the nearest known one.
"""


class Setting(NamedTuple):
    """One key of a file with its default as written and the comment on its line; a group of keys has no default."""

    key: str
    default: str | None
    comment: str


def settings(text: str) -> Iterator[Setting]:
    """All keys of a YAML file in order, nested ones with dots, without the defaults list and Hydra's own settings."""
    lines = text.splitlines()

    def comment(line: int, column: int) -> str:
        return re.sub(r"^#\s*", "", lines[line][column:].strip()) if line < len(lines) else ""

    def visit(node: yaml.MappingNode, prefix: str) -> Iterator[Setting]:
        for key, value in node.value:
            name = prefix + key.value
            if not prefix and name in ("defaults", "hydra"):
                continue
            if isinstance(value, yaml.MappingNode) and not value.flow_style:
                yield Setting(name, None, comment(key.end_mark.line, key.end_mark.column + 1))
                yield from visit(value, f"{name}.")
            else:
                written = text[value.start_mark.index : value.end_mark.index].strip()
                end = value.end_mark if written else key.end_mark
                said = comment(end.line, end.column + (not written)) or ("registered name" if name == "name" else "")
                yield Setting(name, " ".join(written.split()), said)

    root = yaml.compose(text)
    if isinstance(root, yaml.MappingNode):
        yield from visit(root, "")


def introduction(text: str) -> list[str]:
    """The comment at the head of a file, line by line, without Hydra's package directive."""
    head = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        head.append(line.removeprefix("#").removeprefix(" "))
    return [line for line in head if not line.startswith("@package")]


def parents(text: str) -> list[str]:
    """The options of the same group that a file builds on, and those of other groups that it chooses."""
    entries = (yaml.safe_load(text) or {}).get("defaults", [])
    named = [entry if isinstance(entry, str) else "=".join(next(iter(entry.items()))) for entry in entries]
    return [entry.removeprefix("override ").removeprefix("/") for entry in named if entry != "_self_"]


def cell(text: str) -> str:
    """Text that a cell of a Markdown table takes as it stands; code spans stay code."""
    return "".join(
        code(part) if odd else re.sub(r"([|<>*_\[\]`$\\{}])", r"\\\1", part)
        for part, odd in zip(text.split("`"), itertools.cycle((False, True)), strict=False)
    )


def code(text: str) -> str:
    """A code span in a table; those with a backtick do not occur in YAML."""
    return "`" + text.replace("|", r"\|") + "`"


def prose(lines: list[str]) -> str:
    """A comment as Markdown: lines with examples, which are indented, stay as they are."""
    out: list[str] = []
    example = False
    for line in lines:
        if line.startswith("  ") != example:
            example = not example
            out.append("```" if not example else "```text")
        out.append(line.strip() if example else cell(line))
    return "\n".join([*out, *(["```"] if example else [])])


def table(rows: list[Setting], prefix: str) -> str:
    """The keys of a file, called as on the command line."""
    body = [
        f"| {code(prefix + row.key)} | {'' if row.default is None else code(row.default)} | {cell(row.comment)} |"
        for row in rows
    ]
    return "\n".join(["| key | default | meaning |", "|:--|:--|:--|", *body])


def option(group: str, name: str, text: str) -> str:
    """One option of a group."""
    whole = "@package _global_" in text
    rows = list(settings(text))
    parts = [f"### {group}={name}", prose(introduction(text))]
    if built := parents(text):
        parts.append("Builds on " + ", ".join(f"`{entry}`" for entry in built) + ".")
    if rows:
        parts.append(table(rows, "" if whole else group.replace("/", ".") + "."))
    return "\n\n".join(parts)


def listed(group: str, folder: Path) -> str:
    """A group as a list of its options with their first comments."""
    rows = []
    for file in sorted(folder.rglob("*.yaml")):
        name = file.relative_to(folder).with_suffix("").as_posix()
        first = " ".join(introduction(file.read_text(encoding="utf-8")))
        rows.append(f"| {code(f'{group}={name}' if group != 'sweeps' else f'epo sweep {name}')} | {cell(first)} |")
    return "\n".join(["| option | |", "|:--|:--|", *rows])


def page() -> str:
    """The whole page."""
    conf = ROOT / "conf"
    train = (conf / "train.yaml").read_text(encoding="utf-8")
    purpose = dict(re.findall(r"^  - (\w+): .*?# (.*)$", train, re.MULTILINE))
    out = [INTRODUCTION]
    for verb in VERBS:
        text = (conf / f"{verb}.yaml").read_text(encoding="utf-8")
        out += [f"## epo {verb}", prose(introduction(text)), table(list(settings(text)), "")]
    groups = sorted(folder for folder in conf.iterdir() if folder.is_dir() and folder.name != "hydra")
    for folder in [*groups, conf / "hydra" / "launcher", ROOT / "sweeps"]:
        group = folder.relative_to(ROOT if folder.name == "sweeps" else conf).as_posix()
        out += [f"## {group}", cell(purpose.get(group, "")).capitalize()]
        if group in LISTED:
            out.append(listed(group, folder))
            continue
        for file in sorted(folder.rglob("*.yaml")):
            name = file.relative_to(folder).with_suffix("").as_posix()
            out.append(option(group, name, file.read_text(encoding="utf-8")))
    return "\n\n".join(part for part in out if part) + "\n"


def write(path: Path) -> None:
    """Write the page where it has changed, so that an unchanged one is not read again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = page()
    if not path.exists() or path.read_text(encoding="utf-8") != new:
        path.write_text(new, encoding="utf-8")
