"""Names in code and annotations exist. Linters do not check this here, because they would take shapes for names."""

from __future__ import annotations

import ast
import builtins
import dataclasses
import dis
import importlib
import inspect
import pkgutil
import typing
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import pytest

import epo_lightning
from epo_lightning.registry import _HOMES, ConfigError, parts
from epo_lightning.schema import check_part, hints_of

MODULES = sorted(module.name for module in pkgutil.walk_packages(epo_lightning.__path__, "epo_lightning."))


def for_type_checkers(module: ModuleType) -> dict[str, Any]:
    """The names that a module imports for type checkers only."""
    names: dict[str, Any] = {}
    for node in ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), module.__name__, "exec"), names)
    return names


def annotated(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """Functions, classes and methods of a module."""
    for name, value in list(vars(module).items()):
        if getattr(value, "__module__", None) != module.__name__ or not (
            inspect.isclass(value) or inspect.isfunction(value)
        ):
            continue
        yield name, value
        for method, entry in vars(value).items() if inspect.isclass(value) else ():
            function = next((getattr(entry, of) for of in ("__func__", "fget", "func") if hasattr(entry, of)), entry)
            # Generated constructors have the annotations of other modules.
            generated = method == "__new__" or (method == "__init__" and dataclasses.is_dataclass(value))
            if inspect.isfunction(function) and not generated:
                yield f"{name}.{method}", function


def imported(name: str) -> ModuleType:
    """A module; the test is skipped if it needs a package of an extra that is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "epo_lightning":
            raise
        pytest.skip(f"{error.name} is not installed")


@pytest.mark.parametrize("name", MODULES)
def test_annotations_of_a_module_name_what_exists(name: str) -> None:
    module = imported(name)
    names = for_type_checkers(module)
    for what, value in annotated(module):
        try:
            typing.get_type_hints(value, localns=names)
        except NameError as error:
            pytest.fail(f"{name}: the annotations of {what}: {error}")


def globals_of(code: CodeType) -> Iterator[str]:
    """Names of globals that a function, and the functions in it, read."""
    yield from (step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"))
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from globals_of(inner)


@pytest.mark.parametrize("name", MODULES)
def test_code_of_a_module_reads_what_exists(name: str) -> None:
    module = imported(name)
    for what, value in annotated(module):
        function = inspect.unwrap(value)
        if inspect.isfunction(function) and function.__module__ == name:
            missing = {used for used in globals_of(function.__code__) if not hasattr(module, used)}
            assert not {used for used in missing if not hasattr(builtins, used)}, f"{name}.{what}"


@pytest.mark.parametrize(("group", "name"), [(group, name) for group in _HOMES for name in parts(group)])
def test_types_of_the_settings_of_every_part_are_known(group: str, name: str) -> None:
    assert hints_of(parts(group)[name]) is not None


def test_types_of_inherited_settings_are_checked() -> None:
    check_part("solver", {"name": "feedback", "steps": 20})
    with pytest.raises(ConfigError, match=r"solver\.steps must be a whole number, not 'many'"):
        check_part("solver", {"name": "feedback", "steps": "many"})
