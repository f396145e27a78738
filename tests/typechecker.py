"""Runtime checks of annotations: beartype, for which an int is a float wherever Python says so (PEP 484)."""

from __future__ import annotations

import inspect
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from beartype import BeartypeConf, beartype

CHECKS = 20
"""Number of checks of a function in a test: ten calls have twenty, of arguments and of results. Loops of solvers and
trainings, and examples of Hypothesis, repeat the same calls, and to check all takes a quarter of the time of such tests."""
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_CACHED: dict[tuple[Any, ...], Callable[..., Any]] = {}
_done: Counter[tuple[str, str]] = Counter()
_unchecked: list[Any] = []


def begin() -> None:
    """The start of a test: all functions are checked again."""
    for function in _unchecked:
        vars(function).pop("__no_type_check__", None)
    _unchecked.clear()
    _done.clear()


def _counted(function: Callable[..., Any]) -> Callable[..., Any]:
    """The checked function; its last check in a test makes jaxtyping leave out later ones."""
    checked, name = _beartype(function), (function.__module__, function.__qualname__)

    def count(*arguments: Any, **named: Any) -> Any:
        _done[name] += 1
        if _done[name] == CHECKS:
            for layer in _layers(*name):
                layer.__no_type_check__ = True
                _unchecked.append(layer)
        return checked(*arguments, **named)

    return count


def _layers(module: str, qualname: str) -> Iterator[Any]:
    """A function and all that its decorators have wrapped; nothing for a function within a function."""
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = inspect.getattr_static(found, part, None)
    while found is not None:
        if inspect.isfunction(found):
            yield found
        inner = (getattr(found, name, None) for name in ("__wrapped__", "__func__", "fget", "func"))
        found = next((one for one in inner if one is not None), None)


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with checked annotations.

    jaxtyping hands over stand-ins with the annotations of the function and without its body: one for the arguments, and one
    for the result, which takes it as another argument and would check all arguments again. A function within a function is
    defined anew at every call of the outer one; its checks are generated once, as that takes milliseconds.
    """
    annotations = function.__annotations__
    if any(re.fullmatch(r"ret\d+", name) for name in function.__code__.co_varnames) and function.__kwdefaults__ is None:
        function.__annotations__ = annotations = {name: hint for name, hint in annotations.items() if name == "return"}
    if "<locals>" not in function.__qualname__ or function.__defaults__ or function.__kwdefaults__:
        return _counted(function)
    hints = tuple((name, repr(hint)) for name, hint in annotations.items())
    key = (function.__module__, function.__qualname__, function.__code__.co_varnames, hints)
    if key not in _CACHED:
        _CACHED[key] = _counted(function)
    return _CACHED[key]
