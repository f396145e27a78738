"""The examples in the docstrings of the metrics, run."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest

MODULES = {
    "forecast": 1,
    "functional.calibration": 1,
    "functional.displacement": 1,
    "functional.marginal": 1,
    "functional.overlap": 1,
}
"""Modules with examples, and how many docstrings of each have some at least."""


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_give_the_printed_output(name: str) -> None:
    module = import_module(f"epo_lightning.metrics.{name}")
    tests = [test for test in doctest.DocTestFinder(exclude_empty=True).find(module) if test.examples]
    assert len(tests) >= MODULES[name]
    for test in tests:
        assert doctest.DocTestRunner().run(test).failed == 0, test.name
