"""Watching a pass of a network operation by operation, for `Split`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from pnpdepth_cli.core.structure import is_transparent, map_tensors, tensors_in


@dataclass(eq=False)
class Call:
    """One call of a submodule that every later pass makes too.

    `kept` is true where the pass hands back `output` instead of running the submodule; `copied`
    where the network changes that output in place, so that each pass needs a copy of its own.
    """

    module: nn.Module
    kept: bool = False
    output: Any = None
    copied: bool = False

    def hand_back(self) -> Any:
        return map_tensors(self.output, lambda _, t: t.clone() if self.copied else t)


class Watch(TorchDispatchMode):
    """Sees every tensor operation of a pass.

    It marks what depends on z by its storage, counts the operations that touch such a storage,
    notes where a value (not a shape) that depends on z steers Python, and gives a remembered
    output its own copy just before an operation would change it in place.
    """

    def __init__(self, remembered: Iterable[Call]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.touched = 0
        self.data_dependent = False
        self._marked: set[int] = set()
        self._protected: dict[int, list[Call]] = {}
        for call in remembered:
            self.protect(call)

    def touch(self, tensor: Tensor) -> None:
        """Mark a tensor as depending on z."""
        self.touched += 1
        self._marked.add(_storage(tensor))

    def is_touched(self, output: Any) -> bool:
        """True if something in a module's output depends on z, or may."""
        return bool(self._marked) and not (
            is_transparent(output)
            and all(_storage(tensor) not in self._marked for _, tensor in tensors_in(output))
        )

    def protect(self, call: Call) -> None:
        """Save this call's output from in-place operations."""
        for _, tensor in tensors_in(call.output):
            self._protected.setdefault(_storage(tensor), []).append(call)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func._schema.is_mutable:
            for argument, value in zip(func._schema.arguments, args, strict=False):
                if argument.alias_info is not None and argument.alias_info.is_write:
                    for tensor in _tensors(value):
                        self._before_write(tensor)
        marked = any(
            _storage(tensor) in self._marked
            for value in (*args, *kwargs.values())
            for tensor in _tensors(value)
        )
        result = func(*args, **kwargs)
        if marked:
            self.touched += 1
            self._marked.update(_storage(tensor) for tensor in _tensors(result))
            if func._schema.is_mutable:
                written = (_tensors(value) for value in (*args, *kwargs.values()))
                self._marked.update(_storage(tensor) for group in written for tensor in group)
            tags = func.tags
            if torch.Tag.data_dependent_output in tags or torch.Tag.dynamic_output_shape in tags:
                self.data_dependent = True
        elif self._marked and not func._schema.is_mutable:
            # A storage seen before may have been freed and its address given out again.
            self._marked.difference_update(_storage(tensor) for tensor in _tensors(result))
        return result

    def _before_write(self, tensor: Tensor) -> None:
        for call in self._protected.pop(_storage(tensor), []):
            call.output = map_tensors(call.output, lambda _, t: t.clone())
            call.copied = True


def _storage(tensor: Tensor) -> int:
    return int(tensor.untyped_storage()._cdata)


def _tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, list | tuple):
        return [tensor for item in value for tensor in _tensors(item)]
    return []
