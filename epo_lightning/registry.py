"""Registry of named parts: backbones, energies, solvers, forecasters and others are chosen by name in the configuration.

Metrics are not chosen: all of them are computed.

A part is registered where it is written::

    @register("backbone", "v_lstm")
    class VLSTM(nn.Module): ...

It is built from a mapping (a section of the configuration): ``name`` selects the part, and the other keys are the
arguments of its constructor. Other packages add parts through the entry-point group ``epo_lightning.parts``: an entry
point names a module, and importing that module registers its parts.
"""

from __future__ import annotations

import difflib
import inspect
import pkgutil
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, TypeVar

Part = TypeVar("Part", bound=Callable[..., Any])

_PARTS: dict[str, dict[str, Callable[..., Any]]] = {}


class ConfigError(ValueError):
    """A configuration that cannot work: the message names the key or value, what was expected and what to do."""


def one_line(error: object, most: int | None = None) -> str:
    """The message of an error in one line, cut after ``most`` characters."""
    return " ".join(str(error).split())[:most]


def kind_and_message(error: BaseException, most: int | None = None) -> str:
    """Kind and message of an error in one line, ``ValueError: the message``, cut after ``most`` characters."""
    return one_line(f"{type(error).__name__}: {error}", most)


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint for a misspelt ``word``: the nearest of the ``known`` names, then all of them."""
    known = sorted(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return (f"did you mean {close[0]!r}? " if close else "") + "known: " + (", ".join(known) or "none")


def place(part: Any) -> str:
    """File and line where a class or function is defined; the name of its module where these are unknown."""
    try:
        return f"{inspect.getsourcefile(part)}:{inspect.getsourcelines(part)[1]}"
    except (OSError, TypeError):
        return str(getattr(part, "__module__", type(part).__module__))


def failing_place(error: BaseException, part: Any) -> str:
    """File and line of a class's or function's own file at which an exception came from a call of it.

    The place of its definition if the exception did not pass through this file.
    """
    part = getattr(part, "func", part)  # of functools.partial
    with suppress(OSError, TypeError):
        own = inspect.getsourcefile(part)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
        if lines:
            return f"{own}:{lines[-1]}"
    return place(part)


def register(group: str, name: str) -> Callable[[Part], Part]:
    """Make a class or function available as the part ``name`` of a ``group`` (``"backbone"``, ``"solver"``, ...).

    A part that is defined again, as by a cell of a notebook that runs twice, replaces the one before.

    Raises:
        ConfigError: an unknown group, a name that is no text, or one that another part of the group has.
    """
    if group not in _HOMES:
        raise ConfigError(f"@register({group!r}, {name!r}): unknown group of parts {group!r}: {nearest(group, _HOMES)}")

    if not isinstance(name, str) or not name:
        raise ConfigError(f"@register({group!r}, {name!r}): the name of a part must be a text that is not empty")

    def add(part: Part) -> Part:
        known = _PARTS.setdefault(group, {})
        taken = known.get(name, part)
        if taken is not part and _origin(taken) != _origin(part):
            raise ConfigError(
                f"two parts of the group {group!r} are called {name!r}, in {place(taken)} and {place(part)}: rename one"
            )
        known[name] = part
        return part

    return add


_HOMES = {
    "backbone": "backbones",
    "backward": "solvers",
    "data": "data",
    "dynamics": "game",
    "energy": "game",
    "format": "data.recorded.formats",
    "forecaster": "forecasters",
    "gate": "decoders",
    "metric": "metrics",
    "objective": "objectives",
    "optimizer": "optimizers",
    "solver": "solvers",
}
"""Module or folder of this package that holds the parts of each group. New files in a folder are found automatically."""

_OF_AN_EXTRA = "epo_lightning.solvers.gauss_newton.fused_kernel."
"""Modules that import the package of an extra at once. They register no part, and are not imported by a look-up."""


def _origin(part: Callable[..., Any]) -> tuple[Any, ...]:
    """Module and name of a part; what has no name, as the result of ``functools.partial``, is a part of its own."""
    return getattr(part, "__module__", None), getattr(part, "__qualname__", id(part))


@contextmanager
def _importing(module: str) -> Iterator[None]:
    """Context of the import of a module that may register parts.

    Raises:
        ConfigError: it imports something that does not exist, or fails in another way.
    """
    try:
        yield
    except ConfigError:
        raise
    except ImportError as error:
        ours = (error.name or "").startswith("epo_lightning")
        advice = "check the spelling" if ours else "install the package, or import it inside the function that needs it"
        raise ConfigError(f"the module {module} cannot be imported, and no part is found: {error}; {advice}") from error
    except SyntaxError as error:
        raise ConfigError(f"{error.filename}:{error.lineno} is not Python: {error.msg}") from error
    except Exception as error:
        raise ConfigError(
            f"the module {module} fails when it is imported: {kind_and_message(error)}; --traceback shows where"
        ) from error


@cache
def _load(group: str) -> None:
    """Import all modules that may register parts of a group; called before the first look-up of a part of this group."""
    if group in _HOMES:
        home = import_module(f"epo_lightning.{_HOMES[group]}")
        for module in pkgutil.walk_packages(getattr(home, "__path__", []), f"{home.__name__}."):
            if not module.name.startswith(_OF_AN_EXTRA):
                with _importing(module.name):
                    import_module(module.name)
    for entry in entry_points(group="epo_lightning.parts"):
        with _importing(entry.value):
            entry.load()


def parts(group: str) -> Mapping[str, Callable[..., Any]]:
    """All parts of a group, by name."""
    _load(group)
    return dict(sorted(_PARTS.get(group, {}).items()))


def lookup(group: str, name: str) -> Callable[..., Any]:
    """The part registered as ``name``.

    Raises:
        ConfigError: no such part; the message names the nearest one.
    """
    _load(group)
    parts = _PARTS.get(group, {})
    if name not in parts:
        hint = nearest(str(name), parts)
        new = f'. A new one has @register("{group}", "{name}") above it, in {_home(group)}'
        raise ConfigError(f"unknown {group} {name!r}: {hint}{'' if hint.startswith('did you mean') else new}")
    return parts[name]


def _home(group: str) -> str:
    """Place of a group's parts, in words."""
    home = import_module(f"epo_lightning.{_HOMES[group]}")
    path = f"epo_lightning/{_HOMES[group].replace('.', '/')}"
    here = f"a file of {path}" if hasattr(home, "__path__") else f"{path}.py"
    return f"{here}, or in a module that an entry point of an installed package names (pip install -e <folder>)"


def check_keys(group: str, config: Mapping[str, Any], supplied: Iterable[str] = (), where: str | None = None) -> None:
    """Compare a part's configuration with its constructor's signature, without building it.

    Args:
        group: the group of part, which is also the name of its configuration group.
        config: ``name`` and the part's keyword arguments.
        supplied: arguments that the caller hands over in code and a configuration must not set.
        where: place of the arguments in the configuration, for messages; by default the group.

    Raises:
        ConfigError: a missing ``name``, an unknown part, one whose parameters have no names, an unknown key (with the
            nearest known one) or a missing key.
    """
    if not config.get("name"):
        _load(group)
        raise ConfigError(f"{group}.name is missing: {nearest('', _PARTS.get(group, {}))}")
    part, where = lookup(group, config["name"]), where or group
    schema = inspect.signature(part).parameters
    unnamed = [str(one) for one in schema.values() if one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD)]
    if unnamed:
        raise ConfigError(
            f"{group} {config['name']!r} ({place(part)}) takes {', '.join(unnamed)}, but the signature of a part is the "
            "schema of its configuration: name all its parameters, also those that it hands to its base class"
        )
    keys = set(config) - {"name"}
    known = set(schema) - set(supplied)
    for key in sorted(keys - known):
        raise ConfigError(f"unknown key {where}.{key} for {group} {config['name']!r}: {nearest(key, known)}")
    required = {key for key, argument in schema.items() if argument.default is argument.empty}
    for key in sorted(required - keys - set(supplied)):
        raise ConfigError(f"missing key {where}.{key} for {group} {config['name']!r}")


def build(group: str, config: Mapping[str, Any], **supplied: Any) -> Any:
    """Build the part that ``config["name"]`` selects.

    Args:
        group: the group of part.
        config: ``name`` and the part's keyword arguments.
        supplied: further arguments; the constructor gets those that are in its signature.

    Raises:
        ConfigError: as :func:`check_keys`, or a value that the part refuses.
    """
    check_keys(group, config, supplied)
    part = lookup(group, config["name"])
    arguments = {key: value for key, value in config.items() if key != "name"}
    arguments |= {key: value for key, value in supplied.items() if key in inspect.signature(part).parameters}
    try:
        return part(**arguments)
    except ConfigError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{group} {config['name']!r}: {error}") from error
