"""What an operator is given, and the table that operators enter themselves into."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

Given = list[Tensor]
"""The inputs of a node in order. Optional ones may be absent or None, so `at` reads those."""

Operator = Callable[["Node", Given], "Tensor | tuple[Tensor, ...]"]

OPERATORS: dict[str, Operator] = {}


class Unsupported(Exception):
    """An operator is used in a way that is not covered; the message says which."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A node of the graph: name, operator, version of the operator set, attributes as Python."""

    name: str
    op: str
    opset: int
    outputs: int = 1
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def get(self, name: str, default: Any = None) -> Any:
        """An attribute, or the standard's default for it."""
        return self.attributes.get(name, default)


def operator(*names: str) -> Callable[[Operator], Operator]:
    """The decorated function computes these operators."""

    def enter(function: Operator) -> Operator:
        for name in names:
            OPERATORS[name] = function
        return function

    return enter


def at(given: Given, place: int) -> Tensor | None:
    """The input at a place, None where it is left out."""
    return given[place] if place < len(given) else None


def whole_numbers(values: Tensor) -> list[int]:
    """An integer tensor as Python numbers."""
    return [int(v) for v in values.reshape(-1).tolist()]
