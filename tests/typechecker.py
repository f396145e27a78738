"""Runtime checks of annotations: beartype, for which an int is a float wherever Python says so (PEP 484)."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import config

DISABLED = config.jaxtyping_disable
"""Whether the environment turns checks off."""
CHECKS = 4_000
"""Number of checks in a test; a training step of V-LSTM + EPO has about 300. Loops of solvers and of trainings repeat the
same calls, and checking all of them took a third of the time of the tests."""
_left = CHECKS
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_CACHED: dict[tuple[Any, ...], Callable[..., Any]] = {}


def begin() -> None:
    """The start of a test: checks are on again."""
    global _left
    _left = CHECKS
    config.update("jaxtyping_disable", DISABLED)


def _counted(function: Callable[..., Any]) -> Callable[..., Any]:
    """The checked function, which turns checks off at the last one of a test."""
    checked = _beartype(function)

    def count(*arguments: Any, **named: Any) -> Any:
        global _left
        _left -= 1
        if _left == 0:
            config.update("jaxtyping_disable", True)
        return checked(*arguments, **named)

    return count


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
