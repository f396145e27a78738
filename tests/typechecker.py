"""Runtime checks of annotations: beartype, for which an int is a float wherever Python says so (PEP 484)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_CHECKS: dict[tuple[Any, ...], Callable[..., Any]] = {}


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with checked annotations.

    jaxtyping hands over a stand-in with the annotations of the function and without its body. A function within a function
    is defined anew at every call of the outer one; its checks are generated once, as that takes milliseconds.
    """
    if "<locals>" not in function.__qualname__ or function.__defaults__ or function.__kwdefaults__:
        return _beartype(function)
    annotations = tuple((name, repr(hint)) for name, hint in function.__annotations__.items())
    key = (function.__module__, function.__qualname__, function.__code__.co_varnames, annotations)
    if key not in _CHECKS:
        _CHECKS[key] = _beartype(function)
    return _CHECKS[key]
