"""The rgb range that an ONNX graph expects, read from the arithmetic at its start.

A graph that normalises its own input begins with operations by constants: a subtraction of the
mean, a division by the standard deviation or by 255. In the range that the graph was made for they
leave black at or below 0, white above 0, and the two some 1 to 255 apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.models.definition import Normalisation

BYTES = 255.0
_SPAN = (0.3, 300.0)
"""White minus black: 1 of 0…1, 4.4 after ImageNet's normalisation, 255 of bytes."""
_MOST_CONSTANTS = 1024  # elements; a larger operand is no mean or deviation
_PASSED = frozenset({"Cast", "Identity", "Transpose", "Squeeze", "Unsqueeze"})

Constants = Mapping[str, NDArray[np.float64]]


def stated_input_range(model: Any) -> tuple[Normalisation, str] | None:
    """Returns the normalisation that the graph leaves to do, and its range in words.

    Args:
        model: An onnx.ModelProto with one image input.

    Returns:
        Identity and "0…1", or times 255 and "0…255". None if the graph does not normalise its
        input, or in no such range.
    """
    factor, black = _first_arithmetic(model) or (0.0, 0.0)
    for white, words in ((1.0, "0…1"), (BYTES, "0…255")):
        span = factor * white
        if _SPAN[0] <= span <= _SPAN[1] and -0.9 * span <= black <= 0.1 * span:
            return Normalisation(std=(1 / white,) * 3), words
    return None


def _first_arithmetic(model: Any) -> tuple[float, float] | None:
    """Factor and offset, means over channels, of the operations on the input; None without any."""
    graph = model.graph
    constants = _constants(graph)
    (name,) = (each.name for each in graph.input if each.name not in constants)
    factor, offset, has_operation = 1.0, 0.0, False
    while True:
        consumers = [node for node in graph.node if name in node.input]
        if len(consumers) != 1 or len(consumers[0].output) != 1:
            break
        node = consumers[0]
        if node.op_type not in _PASSED:
            operand = _operand(node, name, constants)
            if operand is None:
                break
            match node.op_type:
                case "Mul" | "Div":
                    scale = float((operand if node.op_type == "Mul" else 1 / operand).mean())
                    factor, offset = factor * scale, offset * scale
                case "Add":
                    offset += float(operand.mean())
                case "Sub":
                    offset -= float(operand.mean())
            has_operation = True
        name = node.output[0]
    return (factor, offset) if has_operation else None


def _operand(node: Any, name: str, constants: Constants) -> NDArray[np.float64] | None:
    """The constant that the node adds, subtracts, multiplies or divides by; None for any other."""
    if node.op_type not in ("Add", "Sub", "Mul", "Div") or len(node.input) != 2:
        return None
    is_first = node.input[0] == name
    operand = constants.get(node.input[1 if is_first else 0])
    if operand is None or (node.op_type in ("Sub", "Div") and not is_first):
        return None
    usable = operand.size and bool(np.isfinite(operand).all())
    scaling = node.op_type in ("Mul", "Div")
    return operand if usable and not (scaling and bool((operand == 0).any())) else None


def _constants(graph: Any) -> Constants:
    """The small constants of the graph by name."""
    tensors = {each.name: each for each in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            values = [a.t for a in node.attribute if a.name == "value"]
            tensors |= dict(zip(node.output, values, strict=False))
    return {name: _constant(tensor) for name, tensor in tensors.items()}


def _constant(tensor: Any) -> NDArray[np.float64]:
    """The values of a small constant; none of one that is large, elsewhere or damaged."""
    from onnx import numpy_helper

    if math.prod(tensor.dims) > _MOST_CONSTANTS or tensor.external_data:
        return np.empty(0)
    try:
        return np.asarray(numpy_helper.to_array(tensor), np.float64)
    except Exception:  # onnx raises many kinds; the graph's own reader names the tensor
        return np.empty(0)
