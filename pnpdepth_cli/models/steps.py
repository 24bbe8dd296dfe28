"""The steps of a graph that was read from a file, run one after another without endless memory.

ConstantOfShape, Tile, Pad, Expand and many other operators can turn a few bytes of a file into
gigabytes; `SizeLimit` knows the size of every result before it is allocated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only
from torch.utils.flop_counter import flop_registry

from pnpdepth_cli.errors import ModelError

_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH = 1 << 28, 64
"""One activation may have so many elements (1 GB), or so many times those of input and weights."""

_NUMBERS = ("item", "_local_scalar_dense", "equal")
"""Operators of torch whose result is a Python number."""


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
    arguments: Sequence[object]
    keywords: Mapping[str, object] = field(default_factory=dict)
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

    def run(self, values: dict[str, object], sizes: tuple[torch.Size, ...]) -> None:
        """Adds the results to the values, which begin with inputs of these sizes and weights.

        Raises:
            ModelError: A result is too large, or all at a time are.
        """
        if sizes in self._allowed:
            for _ in self._run(values):
                pass
            return
        given = self._stored + _elements(values)
        largest = max(_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH * given)
        with SizeLimit(largest):
            for step in self._run(values):
                if _elements(values) > 2 * largest:
                    raise ModelError(
                        f"{self._kind} {step.name!r}: more than {2 * largest:,} elements at a time,"
                        " far more than image and weights have"
                    )
        self._allowed.add(sizes)

    def _run(self, values: dict[str, object]) -> Iterator[Step]:
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


def hold(module: nn.Module, name: str, value: Tensor) -> None:
    """Adds a weight or another constant to a module, without gradient."""
    if value.is_floating_point():
        module.register_parameter(name, nn.Parameter(value, requires_grad=False))
    else:
        module.register_buffer(name, value)


def _resolve(argument: object, values: Mapping[str, object]) -> Any:
    """The argument, or the list, with the values that it names."""
    if isinstance(argument, Value):
        return values[argument.name]
    if isinstance(argument, list | tuple):
        return [_resolve(one, values) for one in argument]
    return argument


def _elements(values: dict[str, object]) -> int:
    return sum(value.numel() for value in values.values() if isinstance(value, Tensor))


class SizeLimit(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Inside, an operation with a result of too many elements raises Unsupported without being run.

    Args:
        largest: Elements of one result.
        in_all: Elements of all results together, or no limit.
        work: Elements read and products summed by all operations together, or no limit.
    """

    def __init__(self, largest: int, in_all: float = math.inf, work: float = math.inf) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._largest, self._left, self._work = largest, in_all, work

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs the operation if its result fits; see TorchDispatchMode."""
        kwargs = kwargs or {}
        expected = _shaped_result(func, args, kwargs)
        elements = [each.numel() for each in _tensors_in(expected)]
        in_place_or_view = any(each.alias_info is not None for each in func._schema.returns)
        self._left -= 0 if in_place_or_view else sum(elements)
        if max(elements, default=0) > self._largest or self._left < 0:
            raise Unsupported(f"a result of {sum(elements):.3g} elements")
        self._work -= sum(map(torch.numel, _tensors_in((args, kwargs))))
        if elements and func.overloadpacket in flop_registry:
            self._work -= flop_registry[func.overloadpacket](*args, **kwargs, out_val=expected) / 2
        if self._work < 0:
            raise Unsupported("far more arithmetic on constants than networks have")
        return func(*args, **kwargs)


def _shaped_result(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Tensors without memory that are at least as large as the operation's results."""
    without = {"device": "meta"} if "device" in kwargs or not _tensors_in((args, kwargs)) else {}
    args, kwargs = tree_map_only(Tensor, lambda tensor: tensor.to("meta"), (args, kwargs))
    try:
        return func(*args, **kwargs | without)
    except NotImplementedError:
        if func._opname not in _NUMBERS:
            raise Unsupported("a result of a size that only its values tell") from None
        return None
    except (RuntimeError, ValueError, TypeError, IndexError):  # running it says what is wrong
        return None


def _tensors_in(value: object) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]
