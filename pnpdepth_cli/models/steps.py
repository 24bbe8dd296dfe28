"""The steps of a graph that was read from a file, run one after another without endless memory.

ConstantOfShape, Tile, Pad, Expand and many other operators can turn a few bytes of a file into
gigabytes; `SizeLimit` knows the size of every result before it is allocated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

from pnpdepth_cli.errors import ModelError

_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH = 1 << 28, 64


class Unsupported(Exception):
    """An operator is used in a way that is not covered; the message says which."""


@dataclass(frozen=True)
class Value:
    """Stands for a value of the graph among the arguments of a step."""

    name: str


@dataclass(frozen=True, kw_only=True)
class Step:
    """One call; arguments may be lists. outputs: name of its result, or names of its parts.

    last_read: values that no later step reads.
    """

    run: Callable[..., Any]
    arguments: Sequence[Any]
    keywords: Mapping[str, Any] = field(default_factory=dict)
    outputs: str | Sequence[str | None]
    name: str = ""  # for messages
    last_read: frozenset[str] = frozenset()

    def names(self) -> set[str]:
        """Returns the values that the step reads or gives."""
        given = [self.outputs] if isinstance(self.outputs, str) else self.outputs
        read = tree_leaves([self.arguments, *self.keywords.values()])
        return {*filter(None, given), *(one.name for one in read if isinstance(one, Value))}


class Steps:
    """Steps that are run for inputs of any size.

    The first run for inputs of a size gives no result far larger than inputs and weights.

    Args:
        steps: Steps in their order.
        outputs: Names of the values that are wanted at the end.
        kind: Name of a step in messages.
        stored: Elements of the weights that are no values.
    """

    def __init__(
        self, steps: Sequence[Step], outputs: Sequence[str], *, kind: str, stored: int = 0
    ) -> None:
        last = {name: at for at, step in enumerate(steps) for name in step.names()}
        self._steps = [
            replace(
                step, last_read=frozenset(n for n in step.names() - {*outputs} if last[n] == at)
            )
            for at, step in enumerate(steps)
        ]
        self._kind, self._stored = kind, stored
        self._allowed: set[tuple[torch.Size, ...]] = set()

    def run(self, values: dict[str, Any], sizes: tuple[torch.Size, ...]) -> None:
        """Adds the results to the values, which begin with inputs of these sizes and weights.

        Raises:
            ModelError: A result is too large, or all at a time are.
        """
        if sizes in self._allowed:
            for _ in self._run(values):
                pass
            return
        largest = largest_activation(self._stored + _elements(values))
        with SizeLimit(largest):
            for step in self._run(values):
                if _elements(values) > 2 * largest:
                    raise ModelError(
                        f"{self._kind} {step.name!r}: more than {2 * largest:,} elements at a time,"
                        " far more than image and weights have"
                    )
        self._allowed.add(sizes)

    def _run(self, values: dict[str, Any]) -> Iterator[Step]:
        """Adds the results; yields each step before what ends there is removed."""
        for step in self._steps:
            keywords = {name: _resolve(value, values) for name, value in step.keywords.items()}
            result = step.run(*_resolve(step.arguments, values), **keywords)
            if isinstance(step.outputs, str):
                values[step.outputs] = result
            else:
                values.update((n, r) for n, r in zip(step.outputs, result, strict=False) if n)
            yield step
            for name in step.last_read:
                values.pop(name, None)


def _resolve(argument: Any, values: Mapping[str, Any]) -> Any:
    """The argument, or the list, with the values that it names."""
    if isinstance(argument, Value):
        return values[argument.name]
    is_list = isinstance(argument, list | tuple)
    return [_resolve(one, values) for one in argument] if is_list else argument


def _elements(values: dict[str, Any]) -> int:
    return sum(value.numel() for value in values.values() if isinstance(value, Tensor))


def largest_activation(given: int) -> int:
    """Returns how many elements one activation may have: 2²⁸ (1 GB), or 64 times those given.

    Args:
        given: Elements of input and weights.
    """
    return max(_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH * given)


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
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]
