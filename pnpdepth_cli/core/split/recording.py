"""What the learning pass has found out about a network that is cut; immutable."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from pnpdepth_cli.core.split.saved import SavedTensors
from pnpdepth_cli.core.split.structure import map_tensors, tensors_in


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedCall:
    """One call of a submodule that every pass makes."""

    module: nn.Module
    """The submodule."""
    cached: bool
    """Whether later passes return its saved output instead of running it."""
    copied: bool = False
    """Whether the network changes that output in place."""
    unread: frozenset[tuple[str, ...]] = frozenset()
    """Paths of the output's tensors whose values nobody reads; only their shapes are saved."""

    def save(self, output: Any) -> SavedTensors:
        """Returns the output as it is to be saved; of unread tensors only one number."""

        def kept(path: tuple[str, ...], tensor: Tensor) -> Tensor:
            if path in self.unread:
                return tensor.new_empty(()).expand(tensor.shape)
            return tensor.clone() if self.copied else tensor

        return SavedTensors(map_tensors(output, kept), self.copied)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """The calls of a pass in their order, up to the cut or to the end."""

    calls: tuple[RecordedCall, ...] = ()
    """The calls that are cached, or that contain the cut or calls of their own."""
    cut: int | None = None
    """Index of the call that is the cut; None before it was reached."""
    path: tuple[str, ...] = ()
    """Path of z in the output of that call."""
    shapes: Any = None
    """Shapes and other properties of the arguments for which this holds."""
    static_graph: bool = False
    """Whether it holds for all arguments of these shapes."""
    complete: bool = False
    """Whether the calls behind the cut are in it, too."""

    def index(self, module: nn.Module, count: int) -> int | None:
        """Returns the index of the module's call after `count` earlier ones of a pass."""
        indices = self._indices.get(module, ())
        return indices[count] if count < len(indices) else None

    def holds_for(self, arguments: Sequence[Any]) -> bool:
        """Whether a pass with these arguments makes the same calls."""
        return self.complete and self.static_graph and self.shapes == shapes_of(arguments)

    def intercepted(self) -> set[nn.Module]:
        """Returns the submodules whose calls later passes must intercept."""
        return {
            call.module for index, call in enumerate(self.calls) if call.cached or index == self.cut
        }

    @functools.cached_property
    def _indices(self) -> dict[nn.Module, list[int]]:
        indices: dict[nn.Module, list[int]] = {}
        for index, call in enumerate(self.calls):
            indices.setdefault(call.module, []).append(index)
        return indices


def shapes_of(arguments: Sequence[Any]) -> Any:
    """Returns what arguments must share for a network without branches to treat them alike."""
    tensors = [(t.shape, t.dtype, t.device) for _, t in tensors_in(tuple(arguments))]
    return tensors, repr(map_tensors(tuple(arguments), lambda _, t: t.new_empty(0)))
