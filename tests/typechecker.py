"""Runtime checks of annotations: beartype, for which an int is a float wherever Python says so (PEP 484)."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_CHECKS: dict[tuple[Any, ...], Callable[..., Any]] = {}


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
        return _beartype(function)
    hints = tuple((name, repr(hint)) for name, hint in annotations.items())
    key = (function.__module__, function.__qualname__, function.__code__.co_varnames, hints)
    if key not in _CHECKS:
        _CHECKS[key] = _beartype(function)
    return _CHECKS[key]
