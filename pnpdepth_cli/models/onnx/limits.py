"""Keeps what a small ONNX file or .pt2 archive makes as small as a network is.

The functions that an ONNX model defines may call each other and, written out, become endless.
ConstantOfShape, Tile, Pad, Expand and many other operators can turn a few bytes into gigabytes;
`SizeLimit` knows the size of every result before it is allocated. Tensors can share the bytes of
the files beside the model.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map_only

from pnpdepth_cli.budget import budget, check_claim
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.onnx.table import Unsupported
from pnpdepth_cli.models.steps import Step, run_steps

_MAX_WRITTEN_OUT = 1 << 28  # bytes
_NODE_BYTES = 1 << 12  # that a node takes in memory at least; depth networks have up to 10,000
_SHARED = 2  # tensors that may have the same bytes of a file beside the model
_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH = 1 << 28, 64


def largest_activation(given: int) -> int:
    """Returns how many elements one activation may have: 2²⁸ (1 GB), or 64 times those given.

    Args:
        given: Elements of input and weights.
    """
    return max(_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH * given)


def run_first(steps: Sequence[Step], values: dict[str, Any], stored: int, kind: str) -> None:
    """Adds the results of the steps to the values, none of them far larger than image and weights.

    Args:
        steps: Steps of a graph.
        values: The inputs, by name; what other values they have is stored, too.
        stored: Elements of the weights in the file.
        kind: Name of a step in messages.

    Raises:
        ModelError: A result is too large, or all at a time are.
    """
    largest = largest_activation(stored + _elements(values))
    with SizeLimit(largest):
        for step in run_steps(steps, values):
            if _elements(values) > 2 * largest:
                raise ModelError(
                    f"{kind} {step.name!r}: more than {2 * largest:,} elements at a time, far more"
                    " than image and weights have"
                )


def _elements(values: dict[str, Any]) -> int:
    return sum(value.numel() for value in values.values() if isinstance(value, Tensor))


def load_external(model: Any, folder: Path) -> None:
    """Reads the tensors that lie in files beside the model into it.

    Raises:
        ValueError: They claim more than these files have, or more than memory holds.
    """
    from onnx import external_data_helper as external

    claims = [
        external.ExternalDataInfo(tensor)
        for tensor in external._get_all_tensors(model)
        if external.uses_external_data(tensor)
    ]
    sizes = {claim.location: (folder / claim.location).stat().st_size for claim in claims}
    claimed = sum(claim.length or sizes[claim.location] for claim in claims)
    most = min(_SHARED * sum(sizes.values()), budget().max_decoded_bytes)
    check_claim(
        f"its tensors have {claimed:,} bytes in other files", claimed, most, error=ValueError
    )
    external.load_external_data_for_model(model, str(folder))


def inline(model: Any, path: Path) -> Any:
    """Returns the model without functions of its own.

    Raises:
        ModelError: Functions call themselves, or become too large when they are written out.
    """
    if not model.functions:
        return model
    functions = {(f.domain, f.name, getattr(f, "overload", "")): f for f in model.functions}

    @functools.cache
    def size_of_function(key: tuple[str, str, str]) -> int:
        return int(functions[key].ByteSize()) + size(functions[key])

    def size(graph: Any) -> int:
        calls = [(n.domain, n.op_type, getattr(n, "overload", "")) for n in nodes_in(graph.node)]
        return sum(size_of_function(call) if call in functions else _NODE_BYTES for call in calls)

    try:
        claimed = size(model.graph)
    except RecursionError:
        raise ModelError(f"ONNX file {path}: its functions call each other without end") from None
    claim = f"ONNX file {path}: its functions, written out, are {claimed:,} bytes"
    check_claim(claim, claimed, _MAX_WRITTEN_OUT, error=ModelError)
    from onnx import inliner

    return inliner.inline_local_functions(model)


def nodes_in(nodes: Iterable[Any]) -> Iterable[Any]:
    """Yields the nodes, and those in the graphs that are their attributes."""
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for graph in (*attribute.graphs, attribute.g):
                yield from nodes_in(graph.node)


class SizeLimit(TorchFunctionMode):
    """Inside, an operation with a result of too many elements raises Unsupported without being run.

    Args:
        largest: Elements of one result.
        in_all: Elements of all results together, or no limit.
        work: Elements read and products summed by all operations together, or no limit.
    """

    def __init__(self, largest: int, in_all: float = math.inf, work: float = math.inf) -> None:
        super().__init__()
        self._largest, self._left, self._work = largest, in_all, work

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs the operation if its result fits; see TorchFunctionMode."""
        kwargs = kwargs or {}
        most = _elements_at_most(func, args, kwargs)
        self._refuse(most)
        if self._work < math.inf:
            products = _PRODUCTS.get(getattr(func, "__name__", ""))
            self._work -= most * products(*args) if products else 0
            self._work -= sum(map(torch.numel, _tensors_in((args, kwargs))))
            if self._work < 0:
                raise Unsupported("far more arithmetic on constants than networks have")
        result = func(*args, **kwargs)
        elements = sum(part.numel() for part in _tensors_in(result) if part._base is None)
        self._left -= elements
        self._refuse(elements)
        return result

    def _refuse(self, elements: float) -> None:
        if elements > self._largest or self._left < 0:
            raise Unsupported(f"a result of {elements:.3g} elements")


def _elements_at_most(func: Any, args: Any, kwargs: dict[str, Any]) -> float:
    """An upper bound on the elements of the result.

    Most functions give no more than their tensors broadcast together; `_GROWING` has the others
    that operators call.
    """
    if isinstance(func, torch._ops.OpOverload):
        return _of_operator(func, args, kwargs)
    growing = _GROWING.get(getattr(func, "__name__", ""))
    if growing is not None:
        return growing(*args, **kwargs)
    return _broadcast([tensor.shape for tensor in _tensors_in((args, kwargs))])


def _of_operator(operator: Any, args: Any, kwargs: dict[str, Any]) -> float:
    """Elements of an operator's results, from the shapes alone: on a device without memory."""
    without = {"device": "meta"} if "device" in kwargs or not _tensors_in((args, kwargs)) else {}
    args, kwargs = tree_map_only(Tensor, lambda tensor: tensor.to("meta"), (args, kwargs))
    try:
        with torch.no_grad():
            result = operator(*args, **kwargs | without)
    except NotImplementedError:
        if operator._opname not in _BY_VALUES:
            raise Unsupported("a result of a size that only its values tell") from None
        return sum(each.numel() * max(1, each.ndim) for each in _tensors_in((args, kwargs)))
    except (RuntimeError, ValueError, TypeError, IndexError):  # running it says what is wrong
        return 0
    return max((each.numel() for each in _tensors_in(result)), default=0)


def _broadcast(shapes: list[torch.Size]) -> int:
    sides = itertools.zip_longest(*(reversed(shape) for shape in shapes), fillvalue=1)
    return math.prod(max(along) for along in sides)


def _of_convolution(
    x: Tensor, weight: Tensor, bias: Any, stride: Any, padding: list[int], *_: Any
) -> int:
    sides = [n + 2 * p for n, p in zip(x.shape[2:], padding, strict=True)]
    # Only float32 is computed without a copy of the pixels below each position of the kernel.
    copied = 1 if x.dtype == torch.float32 else weight[0].numel()
    return len(x) * max(len(weight), copied) * math.prod(sides)


def _of_transposed(x: Tensor, weight: Tensor, bias: Any, stride: list[int], *rest: Any) -> int:
    *_, groups, dilation = rest
    parts = zip(x.shape[2:], stride, weight.shape[2:], dilation, strict=True)
    sides = [int(n * s + k * d) for n, s, k, d in parts]
    return len(x) * weight.shape[1] * int(groups) * math.prod(sides)


def _of_product(a: Tensor, b: Tensor) -> int:
    if min(a.ndim, b.ndim) < 2:
        return max(a.numel(), b.numel())
    return _broadcast([a.shape[:-2], b.shape[:-2]]) * a.shape[-2] * b.shape[-1]


def _of_range(start: float, end: float, step: float = 1) -> float:
    return abs((end - start) / step) + 1 if step else math.inf


def _of_item(x: Tensor, index: Any) -> int:
    parts = index if isinstance(index, tuple) else (index,)
    if not all(isinstance(part, Tensor) for part in parts):
        return x.numel()
    return _broadcast([part.shape for part in parts]) * x.shape[len(parts) :].numel()


_GROWING: dict[str, Callable[..., float]] = {
    **{f"conv{axes}d": _of_convolution for axes in (1, 2, 3)},
    **{f"conv_transpose{axes}d": _of_transposed for axes in (1, 2, 3)},
    **dict.fromkeys(("matmul", "__matmul__"), _of_product),
    **dict.fromkeys(("cat", "stack"), lambda tensors, *_, **__: sum(map(torch.numel, tensors))),
    **dict.fromkeys(("ones", "zeros"), lambda *sides, **_: math.prod(sides)),
    "einsum": lambda by, *tensors: torch.einsum(by, *(t.to("meta") for t in tensors)).numel(),
    "grid_sample": lambda x, grid, **_: x.shape[:2].numel() * grid.numel(),
    "interpolate": lambda x, size, **_: x.shape[:2].numel() * math.prod(size),
    "index_select": lambda x, axis, at: x.numel() // max(1, x.shape[axis]) * at.numel(),
    "__getitem__": _of_item,
    "expand": lambda _, *sizes: math.prod(sizes[0] if len(sizes) == 1 else sizes),
    "repeat": lambda x, times: x.numel() * math.prod(times),
    "repeat_interleave": lambda x, times: x.numel() * times,
    "arange": lambda *ends, **_: _of_range(*(ends if len(ends) > 1 else (0, *ends))),
    "pad": lambda x, pads, **_: math.prod(
        n + sum(pads[2 * at : 2 * at + 2]) for at, n in enumerate(reversed(x.shape))
    ),
}
"""Functions whose result may be far larger than their tensors."""


_BY_VALUES = ("nonzero", "masked_select", "index", "item", "_local_scalar_dense", "equal")
"""Operators of torch whose result has as many elements as their tensors' values say, at most as
many coordinates as the tensors have."""

_PRODUCTS: dict[str, Callable[..., int]] = {
    **{f"conv{axes}d": lambda _, weight, *__: weight[0].numel() for axes in (1, 2, 3)},
    **{f"conv_transpose{n}d": lambda _, weight, *__: weight[:, :1].numel() for n in (1, 2, 3)},
    **dict.fromkeys(("matmul", "__matmul__"), lambda a, _: a.shape[-1]),
    "einsum": lambda _, *tensors: max(map(torch.numel, tensors)),
}
"""At most how many products of elements are summed for an element of the result."""


def _tensors_in(value: Any) -> list[Tensor]:
    return [leaf for leaf in tree_flatten(value)[0] if isinstance(leaf, Tensor)]
