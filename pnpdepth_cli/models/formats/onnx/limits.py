"""Keeps what a small ONNX file makes as small as a network is.

The functions that a model defines itself may call each other and, written out, become endless.
ConstantOfShape, Range, Expand, Concat of a value with itself and many other operators can turn a
few bytes into gigabytes; `FoldingBudget` knows the size of every result before it is allocated.
"""

from __future__ import annotations

import graphlib
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map_only

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.formats.onnx.operators import Unsupported

MAX_NODES = 100_000
"""Nodes of the graph with all functions written out. Depth networks have up to 10,000."""

MAX_BYTES = 1 << 28
"""Bytes of them, without the weights that lie in the graph itself."""


def inlined(model: Any, path: Path) -> Any:
    """Returns the model without functions of its own.

    Raises:
        ModelError: Functions call themselves, or become too large when they are written out.
    """
    if not model.functions:
        return model
    functions = {(f.domain, f.name, getattr(f, "overload", "")): f for f in model.functions}
    calls = {key: _calls(function) for key, function in functions.items()}
    try:
        order = [*graphlib.TopologicalSorter(calls).static_order()]
    except graphlib.CycleError as error:
        name = str(error.args[1][0][1])[:60]
        raise ModelError(f"ONNX file {path}: its function {name!r} calls itself") from None
    sizes: dict[Any, tuple[int, int]] = {}  # nodes and bytes when written out
    for key in order:
        if key in functions:
            inner = [sizes[call] for call in calls[key] if call in functions]
            sizes[key] = (
                len(calls[key]) + sum(count for count, _ in inner),
                functions[key].ByteSize() + sum(size for _, size in inner),
            )
    called = [sizes[call] for call in _calls(model.graph) if call in functions]
    nodes, size = (sum(some[part] for some in called) for part in (0, 1))
    if nodes > MAX_NODES or size > MAX_BYTES:
        raise ModelError(
            f"ONNX file {path}: its functions, written out, are more than {MAX_NODES:,} nodes or"
            f" {MAX_BYTES / 1e6:,.0f} MB"
        )
    from onnx import inliner

    return inliner.inline_local_functions(model)


def _calls(graph: Any) -> list[tuple[str, str, str]]:
    """What the nodes of a graph or function are, by which a function may be called."""
    return [(n.domain, n.op_type, getattr(n, "overload", "")) for n in _nodes(graph.node)]


def _nodes(nodes: Iterable[Any]) -> Iterable[Any]:
    """The nodes, and those in the graphs that are their attributes."""
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for graph in (*attribute.graphs, attribute.g):
                yield from _nodes(graph.node)


_ALWAYS_ALLOWED = 1 << 24
"""Elements of one constant."""

_GROWTH = 4
"""How many times the elements stored in the file one constant may have."""

_CONSTANTS = 4
"""How many constants of the largest size there may be."""

_ELEMENTWISE = frozenset(
    {
        *("add", "sub", "rsub", "mul", "div", "true_divide", "floor_divide", "pow", "remainder"),
        *("__add__", "__sub__", "__mul__", "__truediv__", "__pow__", "maximum", "minimum", "where"),
        *("to", "float", "long", "clone", "contiguous", "clamp", "neg", "abs", "sqrt", "exp"),
        *("reshape", "view", "permute", "transpose", "squeeze", "unsqueeze", "movedim"),
    }
)
"""Functions whose result has the elements of their tensors broadcast together."""


class FoldingBudget(TorchFunctionMode):
    """Inside, an operation whose result is too large raises Unsupported instead of being run.

    Args:
        stored: Number of elements that the file itself holds.
    """

    def __init__(self, stored: int) -> None:
        super().__init__()
        self._largest = max(_ALWAYS_ALLOWED, _GROWTH * stored)
        self._left = _CONSTANTS * self._largest

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs the operation if its result fits; see TorchFunctionMode."""
        kwargs = kwargs or {}
        self._refuse(_elements_at_most(func, args, kwargs, self._largest))
        result = func(*args, **kwargs)
        elements = sum(part.numel() for part in _tensors_in(result) if part._base is None)
        self._left -= elements
        self._refuse(elements)
        return result

    def _refuse(self, elements: float) -> None:
        if elements > self._largest or self._left < 0:
            raise Unsupported(f"a constant of {elements:.3g} elements")


def _elements_at_most(func: Any, args: Any, kwargs: dict[str, Any], largest: int) -> float:
    """An upper bound on the elements of the result.

    The product of all sizes and numbers bounds most results; each factor is at least 2, so that it
    bounds sums too, as of concatenation: a + b ≤ a·b for a, b ≥ 2. If it exceeds `largest`, the
    shape is inferred on the meta device instead.
    """
    name = getattr(func, "__name__", "")
    leaves = tree_flatten((args, kwargs))[0]
    sizes = [leaf.shape for leaf in leaves if isinstance(leaf, Tensor)]
    numbers = [abs(leaf) for leaf in leaves if isinstance(leaf, int | float)]
    if name in _ELEMENTWISE and sizes:
        return _broadcast(sizes)
    bound: float = math.prod(max(2, size.numel()) for size in sizes)
    bound *= math.prod(2 + number for number in numbers)
    if bound <= largest and name != "arange":  # whose result is larger the smaller its step
        return bound
    return _elements_on_meta(func, args, kwargs)


def _broadcast(sizes: list[torch.Size]) -> int:
    axes = max(map(len, sizes))
    padded = [(*(1 for _ in range(axes - len(size))), *size) for size in sizes]
    return math.prod(map(max, *padded)) if len(padded) > 1 else math.prod(padded[0])


def _elements_on_meta(func: Any, args: Any, kwargs: dict[str, Any]) -> int:
    """Elements of the largest result, found on the meta device, where nothing is allocated."""
    args, kwargs = tree_map_only(Tensor, _without_values, (args, kwargs))
    if kwargs.get("device") is not None:
        kwargs = {**kwargs, "device": "meta"}
    try:
        with torch.device("meta"):
            result = func(*args, **kwargs)
    except (RuntimeError, NotImplementedError):  # its size depends on values; it makes few of them
        return 0
    return max((part.numel() for part in _tensors_in(result)), default=0)


def _tensors_in(value: Any) -> list[Tensor]:
    return [leaf for leaf in tree_flatten(value)[0] if isinstance(leaf, Tensor)]


def _without_values(tensor: Tensor) -> Tensor:
    return torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device="meta")
