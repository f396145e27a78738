"""Annotations are checked: arguments, results, and those of functions within functions, in the first calls of every test."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import jaxtyping
import pytest
import torch
import typechecker
from jaxtyping import Float, jaxtyped
from torch import Tensor
from typechecker import check

checked = jaxtyped(typechecker=check)


@checked
def rows(matrix: Float[Tensor, "n m"], count: int = 1) -> Float[Tensor, "{count} m"]:
    """The first row, which has the promised shape for a count of one alone."""
    return matrix[:1]


def within(result: object) -> Callable[..., object]:
    """A function that is defined anew at every call."""

    @checked
    def inner(vector: Float[Tensor, " n"], *, other: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return vector if result is None else result

    return inner


def test_arguments_and_results_are_checked() -> None:
    assert rows(torch.zeros(3, 2)).shape == (1, 2)
    for wrong in (torch.zeros(3), torch.zeros(3, 2, dtype=torch.long), [[0.0]]):
        with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
            rows(wrong)
    with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
        rows(torch.zeros(3, 2), "one")
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        rows(torch.zeros(3, 2), 2)


def test_functions_within_functions_are_checked_at_every_call() -> None:
    two, three = torch.zeros(2), torch.zeros(3)
    for _ in range(2):
        assert within(None)(two, other=two) is two
        assert within(three[:2])(two, other=two).shape == (2,)
        with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
            within(None)(two, other=three)
        with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
            within(three)(two, other=two)


def test_functions_without_annotations_are_left_as_they_are() -> None:
    @checked
    def free(value, other=1):  # type: ignore[no-untyped-def]
        return value

    assert free("x") == "x"
    assert free(torch.zeros(2), other=3).shape == (2,)


class Shape:
    """Methods of all kinds."""

    @property
    @checked
    def wide(self) -> Float[Tensor, " n"]:
        return torch.zeros(2, 2)

    @staticmethod
    @checked
    def of(vector: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return vector

    @classmethod
    @checked
    def made(cls, vector: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return vector


WRONG = {
    "function": lambda: rows(torch.zeros(3)),
    "property": lambda: Shape().wide,
    "static method": lambda: Shape.of(torch.zeros(())),
    "class method": lambda: Shape.made(torch.zeros(())),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG.keys())
def test_a_function_is_checked_a_number_of_times_in_every_test(
    monkeypatch: pytest.MonkeyPatch, wrong: Callable[[], object]
) -> None:
    monkeypatch.setattr(typechecker, "CHECKS", 4)
    for _ in range(2):
        typechecker.begin()
        with pytest.raises(jaxtyping.TypeCheckError):
            wrong()
        for _ in range(4):
            with contextlib.suppress(jaxtyping.TypeCheckError):
                wrong()
        wrong()
        with pytest.raises(jaxtyping.TypeCheckError):
            within(torch.zeros(3))(torch.zeros(2), other=torch.zeros(2))  # another function
