"""Values from YAML, checked against the type annotations of data classes and of the constructors of parts."""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

from epo_lightning.registry import ConfigError, check_keys, lookup, nearest

Section = typing.TypeVar("Section")


def read(schema: type[Section], values: Mapping[str, Any], where: str = "") -> Section:
    """An instance of the data class ``schema`` from a section of the configuration.

    Raises:
        ConfigError: an unknown key (with the nearest known one), a missing key or a value of another type.
    """
    hints = typing.get_type_hints(schema)
    prefix = f"{where}." if where else ""
    for key in values:
        if key not in hints:
            raise ConfigError(f"unknown key {prefix}{key}: {nearest(str(key), hints)}")
    for entry in dataclasses.fields(schema):  # type: ignore[arg-type]
        required = entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
        if required and entry.name not in values:
            raise ConfigError(f"missing key {prefix}{entry.name}")
    return schema(**{key: _read(hints[key], value, prefix + key) for key, value in values.items()})


def _read(hint: Any, value: Any, where: str) -> Any:
    for option in typing.get_args(hint) or (hint,):
        if dataclasses.is_dataclass(option) and isinstance(value, Mapping):
            return read(typing.cast(type[Any], option), value, where)
    if not fits(value, hint):
        raise _unfit(where, value, hint)
    return value


def _unfit(key: str, value: Any, hint: Any) -> ConfigError:
    """The error for a value of another type; a list of values that would fit is meant as a run of each."""
    message = f"{key} must be {describe(hint)}, not {'null' if value is None else repr(value)}"
    if isinstance(value, list) and value and all(fits(entry, hint) for entry in value):
        each = ",".join(map(str, value))
        message += f": for a run of each, write {each} without brackets, in a sweep or with the option -m"
    return ConfigError(message)


def fits(value: Any, hint: Any) -> bool:
    """Whether a value read from YAML matches a type annotation. Types that YAML cannot express always match."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, option) for option in arguments)
    if origin is Literal:
        return value in arguments and type(value) in {type(option) for option in arguments}
    if hint in (None, type(None)):
        return value is None
    if hint is bool:
        return isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and value == value  # not nan
    if hint is str:
        return isinstance(value, str)
    base = origin or hint
    if isinstance(base, type) and issubclass(base, Mapping):
        entry = arguments[1] if len(arguments) == 2 else Any
        return isinstance(value, Mapping) and all(fits(item, entry) for item in value.values())
    if base is tuple and arguments and arguments[-1] is not Ellipsis:
        many = isinstance(value, list | tuple) and len(value) == len(arguments)
        return many and all(map(fits, value, arguments))
    if isinstance(base, type) and issubclass(base, Sequence):
        entry = arguments[0] if arguments else Any
        return isinstance(value, Sequence) and not isinstance(value, str) and all(fits(item, entry) for item in value)
    return True


def describe(hint: Any) -> str:
    """Description of a type for messages about YAML files, such as ``a whole number``."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        options = list(dict.fromkeys(map(describe, arguments)))
        return (", or " if any("," in option for option in options) else " or ").join(options)
    if origin is Literal:
        return "one of " + ", ".join(str(option) for option in arguments)
    names = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "null"}
    if hint in names:
        return names[hint]
    base = origin or hint
    if isinstance(base, type) and issubclass(base, Mapping):
        named = len(arguments) == 2 and arguments[1] is not Any
        return "a mapping" + (f" of names to {describe(arguments[1])}" if named else "")
    if isinstance(base, type) and issubclass(base, Sequence):
        if arguments and typing.get_origin(arguments[0]) is Literal:
            return "a list with any of " + ", ".join(map(str, typing.get_args(arguments[0])))
        several = {int: "whole numbers", float: "numbers", str: "texts"}
        return "a list" + (f" of {several.get(arguments[0]) or describe(arguments[0])}" if arguments else "")
    return str(getattr(base, "__name__", base))


def check_part(group: str, values: Any, supplied: Sequence[str] = (), where: str | None = None) -> None:
    """Check the section of a part: its keys (:func:`registry.check_keys`), and the types of its values by the constructor.

    Raises:
        ConfigError: as :func:`registry.check_keys`, or a value of another type.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{group} must be a mapping with a name, not {values!r}")
    check_keys(group, values, supplied, where)
    part = lookup(group, values["name"])
    try:
        hints = hints_of(part)
    except (NameError, TypeError, SyntaxError):  # annotations of a user's part that exist for type checkers only
        return
    defaults = {name: argument.default for name, argument in inspect.signature(part).parameters.items()}
    for key, value in values.items():
        if key in hints and not fits(value, hints[key]) and not (value is None and defaults.get(key, 0) is None):
            raise _unfit(f"{where or group}.{key}", value, hints[key])


def hints_of(part: Callable[..., Any]) -> dict[str, Any]:
    """The types of the settings of a part.

    Those of a dataclass are read from its fields: its generated constructor resolves inherited annotations in the wrong
    module.
    """
    if isinstance(part, type) and not dataclasses.is_dataclass(part):
        part = part.__init__  # type: ignore[misc]
    return typing.get_type_hints(part)
