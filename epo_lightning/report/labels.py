"""Labels of rows that share a title: the title, and the settings in which they differ."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from epo_lightning.identity import differences, essence, leaves

MOST, LONGEST, DIGITS = 4, 24, 3
"""Largest number of settings in a label, largest length of a value's text, and number of its digits."""

PLAIN, OTHER = re.compile(r"[\w./-]+", re.ASCII), re.compile(r"[-\d._e]+|true|false|null|nan|inf", re.IGNORECASE)
"""Text that needs no quotes, and text that would be read as something else without them."""


def varying(configs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Settings of every configuration that differ between the configurations, without seeds.

    Returns:
        As many mappings from a setting's dotted key to its value, all with the same keys in the same order.
    """
    first, *others = configs
    found = [{key: (mine, theirs) for key, mine, theirs in differences(first, other)} for other in others]
    keys = sorted({key for entry in found for key in entry} - {"seed"})
    # Of a mapping that is empty in some configurations, the settings in it say enough.
    keys = [key for key in keys if not any(other.startswith(f"{key}.") for other in keys)]
    own = {key: next(entry[key][0] for entry in found if key in entry) for key in keys}
    return [own, *({key: entry[key][1] if key in entry else own[key] for key in keys} for entry in found)]


def short_keys(keys: Sequence[str], config: Mapping[str, Any]) -> dict[str, str]:
    """Shortest unambiguous ending of every key in the configuration: ``lr`` for ``optimizer.lr``."""
    known = {*(key for key, _ in leaves(essence(config))), *keys}
    return {key: next(ending for ending in _endings(key) if _is_alone(ending, known) or ending == key) for key in keys}


def labels(
    title: str, settings: Sequence[Mapping[str, Any]], config: Mapping[str, Any], rows: Sequence[str]
) -> list[str]:
    """Labels of rows that share a title: all settings in which they differ, or of many only the names of parts.

    Args:
        title: the shared title.
        settings: of every row, as :func:`varying` gives them.
        config: a resolved configuration of one of them.
        rows: identities of the rows, used if there are too many settings or they do not distinguish rows.
    """
    keys = short_keys(list(settings[0]), config)
    complete = {key: _long_union([own[key] for own in settings]) for key in keys}

    def parts(own: Mapping[str, Any], text: Callable[[Any], str]) -> Iterator[str]:
        for key, value in own.items():
            if not complete[key]:
                yield f"{keys[key].removesuffix('.name')}={text(value)}"
            elif lacking := [entry for entry in complete[key] if entry not in value]:
                yield f"{keys[key]} without {', '.join(lacking)}"

    def named(text: Callable[[Any], str]) -> list[str]:
        return [", ".join([title, *parts(own, text)]) for own in settings]

    names = named(shown)
    if len({*names}) < len(names):
        names = named(_shown)
    if len(keys) > MOST:
        settings = [{key: value for key, value in own.items() if key.endswith(".name")} for own in settings]
        names = named(_shown) if len(settings[0]) <= MOST else [title] * len(settings)
    return [name if names.count(name) == 1 else f"{name}, row {row[:8]}" for name, row in zip(names, rows, strict=True)]


def word(key: str, value: Any) -> str:
    """A setting as an override on a command line, quoted where a shell would need it."""
    return shlex.quote(f"{key}={value_text(value)}")


def value_text(value: Any) -> str:
    """A value in the notation of overrides, which is nearly that of JSON."""
    if isinstance(value, str):
        bare = PLAIN.fullmatch(value) and not OTHER.fullmatch(value)
        # Between quotes only those backslashes are special that stand before a quote.
        escaped = re.sub(r'(\\*)("|\Z)', lambda found: 2 * found[1] + found[2].replace('"', r"\""), value)
        return value if bare else f'"{escaped}"'
    if isinstance(value, list):
        return "[" + ",".join(map(value_text, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{value_text(entry)}" for key, entry in value.items()) + "}"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def natural(settings: Mapping[str, Any]) -> tuple[tuple[int, float, str], ...]:
    """Sort key of settings, with numbers in numeric order."""
    return tuple(
        (0, float(value), "") if isinstance(value, int | float) else (1, 0.0, value_text(value))
        for _, value in sorted(settings.items())
    )


def shown(value: Any) -> str:
    """The text of a value in a label: a number with few digits, since a search draws more than a label needs."""
    return _shown(float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value)


def _shown(value: Any) -> str:
    return shortened(value_text(value))


def shortened(text: str) -> str:
    """A text, or the beginning of a long one."""
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def _long_union(values: Sequence[Any]) -> list[str]:
    """The longest of several lists of names, if it is long and contains all the others; otherwise none."""
    if not all(isinstance(value, list) and all(isinstance(name, str) for name in value) for value in values):
        return []
    longest: list[str] = max(values, key=len)
    contained = all(set(value) <= set(longest) for value in values)
    return longest if contained and len(value_text(longest)) > LONGEST else []


def _endings(key: str) -> Iterator[str]:
    parts = key.split(".")
    return (".".join(parts[start:]) for start in range(len(parts) - 1, -1, -1))


def _is_alone(ending: str, keys: set[str]) -> bool:
    return sum(key == ending or key.endswith("." + ending) for key in keys) == 1
