"""ONNX files as networks; here the table of the operators that depth networks use.

The functions register themselves with `@operator`, each as the standard defines it
(https://onnx.ai/onnx/operators). Every version of an operator from opset 7 on is covered: an
attribute that later became an input is read as either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

Inputs = list[Tensor]
"""The inputs of a node in order; `optional` reads those that may be absent or None."""

Operator = Callable[["Node", Inputs], "Tensor | tuple[Tensor, ...]"]

OPERATORS: dict[str, Operator] = {}

HOST_INPUTS: dict[str, tuple[int, ...]] = {}
"""Indices of an operator's inputs that are read as Python numbers; they stay on the CPU."""


ONLY: dict[str, int | str] = {
    "antialias": 0,
    "batch_dims": 0,
    "detect_negative": 1,
    "detect_positive": 1,
    "exclude_outside": 0,
    "keep_aspect_ratio_policy": "stretch",
    "noop_with_empty_axes": 0,
    "reduction": "none",
    "training_mode": 0,
}
"""Attributes that must have this value, the standard's default, if they are there."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A node of the graph; its name is unique there, and `outputs` counts those that are used."""

    name: str
    op: str
    opset: int
    outputs: int = 1
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def get(self, name: str, default: Any = None) -> Any:
        """Returns an attribute, or the standard's default for it."""
        return self.attributes.get(name, default)


def operator(*names: str, host: tuple[int, ...] = ()) -> Callable[[Operator], Operator]:
    """Registers the decorated function for these operators; `host` is as in `HOST_INPUTS`."""

    def enter(function: Operator) -> Operator:
        for name in names:
            OPERATORS[name], HOST_INPUTS[name] = function, host
        return function

    return enter


def register(functions: Mapping[str, Operator], host: tuple[int, ...] = ()) -> None:
    """Registers operators whose function is one expression; `host` is as in `HOST_INPUTS`."""
    for name, function in functions.items():
        operator(name, host=host)(function)


def optional(inputs: Inputs, index: int) -> Tensor | None:
    """Returns an input by its index; None if it is left out."""
    return inputs[index] if index < len(inputs) else None


def whole_numbers(values: Tensor) -> list[int]:
    """Returns the elements of an integer tensor as Python numbers."""
    return [int(v) for v in values.reshape(-1).tolist()]


def stated(node: Node, name: str, inputs: Inputs, index: int) -> list[int] | None:
    """Returns the numbers of an attribute, or of the input that later took its place."""
    if name not in node.attributes and optional(inputs, index) is not None:
        return whole_numbers(inputs[index])
    numbers: list[int] | None = node.get(name)
    return numbers
