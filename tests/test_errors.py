"""Errors of the package can be pickled, so that worker processes can return them."""

from __future__ import annotations

import inspect
import pickle
import pkgutil
from collections.abc import Iterator
from importlib import import_module

import pytest

import epo_lightning


def errors() -> Iterator[type[BaseException]]:
    """All exception classes that a module of the package defines."""
    for module in pkgutil.walk_packages(epo_lightning.__path__, "epo_lightning."):
        if module.name.endswith((".kernel.build", ".__main__")):  # a program of the build
            continue
        for _, found in inspect.getmembers(import_module(module.name), inspect.isclass):
            if issubclass(found, BaseException) and found.__module__ == module.name:
                yield found


def example(error: type[BaseException]) -> BaseException:
    """An error with an argument for every parameter of its constructor."""
    if "__init__" not in vars(error):
        return error("a file: what is wrong with it")
    names = list(inspect.signature(error).parameters)
    return error(*(f"the {name}" for name in names))


@pytest.mark.parametrize("error", sorted(set(errors()), key=lambda error: error.__qualname__), ids=lambda e: e.__name__)
def test_errors_survive_pickling(error: type[BaseException]) -> None:
    sent = example(error)
    received = pickle.loads(pickle.dumps(sent))
    assert type(received) is error
    assert str(received) == str(sent)
    assert vars(received) == vars(sent)


def test_the_errors_of_data_and_of_configurations_are_among_them() -> None:
    assert {"ConfigError", "CacheError", "RecordingError", "Diverged"} <= {error.__name__ for error in errors()}
