"""Base of the data classes: batches whose tensors are moved and indexed together."""

from __future__ import annotations

import dataclasses
import operator
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, SupportsIndex, TypeVar

import torch
from torch import Tensor

Some = TypeVar("Some", bound="Batch")


class Batch:
    """A data class of tensors that share their leading dimension B; they are moved and indexed together.

    Subclasses are made with ``repr=False``, so that they are printed as types and shapes, without numbers.
    """

    def __repr__(self) -> str:
        """The fields that are there, one per line, with types and shapes of their tensors."""
        values = {field.name: getattr(self, field.name, None) for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        lines = "\n".join(f"{name}={_described(value)}," for name, value in values.items() if value is not None)
        return f"{type(self).__name__}(\n{textwrap.indent(lines, '    ')}\n)"

    def map(self: Some, function: Callable[[Tensor], Tensor]) -> Some:
        """A copy with ``function`` applied to every tensor, also inside nested mappings, tuples and batches."""

        def visit(value: Any) -> Any:
            if isinstance(value, Tensor):
                return function(value)
            if isinstance(value, Batch):
                return value.map(function)
            if isinstance(value, Mapping):
                return {key: visit(entry) for key, entry in value.items()}
            if isinstance(value, tuple):
                return tuple(visit(entry) for entry in value)
            return value

        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return type(self)(**{field.name: visit(getattr(self, field.name)) for field in fields})

    def tensors(self) -> list[Tensor]:
        """All tensors, in the order in which :meth:`map` visits them."""
        found: list[Tensor] = []

        def collect(tensor: Tensor) -> Tensor:
            found.append(tensor)
            return tensor

        self.map(collect)
        return found

    @classmethod
    def concatenated(cls: type[Some], parts: Sequence[Some], dim: int = 0) -> Some:
        """Batches that have the same fields as one batch: their tensors one after the other along a dimension.

        Raises:
            ValueError: no batch, or batches of different fields, names or plain values; the message names the field.
        """
        if not parts:
            raise ValueError(f"no {cls.__name__} to concatenate")
        joined: Some = _joined(parts, dim, cls.__name__)
        return joined

    def to(self: Some, target: torch.device | torch.dtype | str) -> Some:
        """A copy on another device, or with its floating-point tensors in another precision."""
        if isinstance(target, torch.dtype):
            return self.map(lambda tensor: tensor.to(target) if tensor.is_floating_point() else tensor)
        return self.map(lambda tensor: tensor.to(target))

    def __getitem__(self: Some, index: Any) -> Some:
        """The chosen scenes of the batch; an integer keeps the batch dimension."""
        if _is_whole(index):
            index = [operator.index(index)]
        return self.map(lambda tensor: tensor[index])


def _is_whole(index: Any) -> bool:
    """Whether an index is one whole number, also of NumPy or PyTorch; Booleans are masks."""
    if isinstance(index, Tensor):
        return index.ndim == 0 and not index.is_floating_point() and index.dtype != torch.bool
    return isinstance(index, SupportsIndex) and not isinstance(index, bool) and getattr(index, "ndim", 0) == 0


def _described(value: Any) -> str:
    """Types and shapes of tensors, also of those in mappings and tuples; other values as they are."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key!r}: {_described(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(_described, value))})"
    return f"{type(value).__name__}{list(value.shape)}" if hasattr(value, "shape") else repr(value)


def _joined(values: Sequence[Any], dim: int, where: str) -> Any:
    """Tensors, or equal structures of them, one after the other along a dimension."""
    first = values[0]
    if all(isinstance(value, Tensor) for value in values):
        return torch.cat(list(values), dim)
    if all(isinstance(value, Batch) and type(value) is type(first) for value in values):
        names = [field.name for field in dataclasses.fields(first)]
        return type(first)(**{n: _joined([getattr(value, n) for value in values], dim, f"{where}.{n}") for n in names})
    if all(isinstance(value, Mapping) and value.keys() == first.keys() for value in values):
        return {key: _joined([value[key] for value in values], dim, f"{where}.{key}") for key in first}
    if all(isinstance(value, tuple) and len(value) == len(first) for value in values):
        return tuple(_joined(entries, dim, where) for entries in zip(*values, strict=True))
    if any(isinstance(value, Tensor | Batch | Mapping | tuple) or value != first for value in values):
        raise ValueError(
            f"{where} differs between the parts, which cannot be concatenated: {[_described(v) for v in values]}"
        )
    return first
