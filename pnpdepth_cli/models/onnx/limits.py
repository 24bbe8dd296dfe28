"""Keeps what a small ONNX file makes as small as a network is.

The functions that a model defines itself may call each other and, written out, become endless.
ConstantOfShape, Tile, Pad, Expand and many other operators can turn a few bytes into gigabytes;
`SizeLimit` knows the size of every result before it is allocated.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map_only

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.onnx.table import Unsupported

_MAX_WRITTEN_OUT = 1 << 28  # bytes
_NODE_BYTES = 1 << 12  # that a node takes in memory at least; depth networks have up to 10,000


def inlined(model: Any, path: Path) -> Any:
    """Returns the model without functions of its own.

    Raises:
        ModelError: Functions call themselves, or become too large when they are written out.
    """
    if not model.functions:
        return model
    functions = {(f.domain, f.name, getattr(f, "overload", "")): f for f in model.functions}

    @functools.cache
    def written_out(key: tuple[str, str, str]) -> int:
        return int(functions[key].ByteSize()) + size(functions[key])

    def size(graph: Any) -> int:
        calls = [(n.domain, n.op_type, getattr(n, "overload", "")) for n in _nodes(graph.node)]
        return sum(written_out(call) if call in functions else _NODE_BYTES for call in calls)

    try:
        too_large = size(model.graph) > _MAX_WRITTEN_OUT
    except RecursionError:
        raise ModelError(f"ONNX file {path}: its functions call each other without end") from None
    if too_large:
        raise ModelError(
            f"ONNX file {path}: its functions, written out, are more than"
            f" {_MAX_WRITTEN_OUT / 1e6:,.0f} MB"
        )
    from onnx import inliner

    return inliner.inline_local_functions(model)


def _nodes(nodes: Iterable[Any]) -> Iterable[Any]:
    """The nodes, and those in the graphs that are their attributes."""
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for graph in (*attribute.graphs, attribute.g):
                yield from _nodes(graph.node)


class SizeLimit(TorchFunctionMode):
    """Inside, an operation with a result of too many elements raises Unsupported without being run.

    Args:
        largest: Elements of one result.
        in_all: Elements of all results together, or no limit.
    """

    def __init__(self, largest: int, in_all: float = math.inf) -> None:
        super().__init__()
        self._largest, self._left = largest, in_all

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs the operation if its result fits; see TorchFunctionMode."""
        kwargs = kwargs or {}
        if getattr(func, "__name__", "") not in _READS_VALUES:
            self._refuse(_elements_in(_without_values(func, args, kwargs)))
        result = func(*args, **kwargs)
        elements = sum(part.numel() for part in _tensors_in(result) if part._base is None)
        self._left -= elements
        self._refuse(elements)
        return result

    def _refuse(self, elements: int) -> None:
        if elements > self._largest or self._left < 0:
            raise Unsupported(f"a result of {elements:.3g} elements")


_READS_VALUES = ("to", "item", "tolist", "__bool__")
"""Methods that need the values of their tensor, and make none that is larger."""


def _without_values(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """What the operation returns, as tensors of the meta device, which have no memory."""
    args, kwargs = tree_map_only(Tensor, lambda tensor: tensor.to("meta"), (args, kwargs))
    if "device" in kwargs or getattr(func, "__name__", "") in ("arange", "ones", "zeros"):
        kwargs["device"] = "meta"
    return func(*args, **kwargs)


def _elements_in(value: Any) -> int:
    return max((tensor.numel() for tensor in _tensors_in(value)), default=0)


def _tensors_in(value: Any) -> list[Tensor]:
    return [leaf for leaf in tree_flatten(value)[0] if isinstance(leaf, Tensor)]
