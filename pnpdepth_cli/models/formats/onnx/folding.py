"""Keeps the constants that a small ONNX file makes as small as the constants of a network are.

ConstantOfShape, Range, Expand, Concat of a value with itself and many other operators can turn a
few bytes into gigabytes. `FoldingBudget` knows the size of every result before it is allocated.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

from pnpdepth_cli.models.formats.onnx.operators import Unsupported

_ALWAYS_ALLOWED = 1 << 24
"""Elements of one constant."""

_GROWTH = 4
"""How many times the elements stored in the file one constant may have."""

_CONSTANTS = 4
"""How many constants of the largest size there may be."""


class FoldingBudget(TorchDispatchMode):
    """Inside, an operation whose result is too large raises Unsupported instead of being run.

    Args:
        stored: Number of elements that the file itself holds.
    """

    def __init__(self, stored: int) -> None:
        super().__init__()
        self._largest = max(_ALWAYS_ALLOWED, _GROWTH * stored)
        self._left = _CONSTANTS * self._largest

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs the operation if its result fits; see TorchDispatchMode."""
        kwargs = kwargs or {}
        for elements in _result_sizes(func, args, kwargs):
            self._left -= elements
            if elements > self._largest or self._left < 0:
                raise Unsupported(f"a constant of {elements:.3g} elements")
        return func(*args, **kwargs)


def _result_sizes(func: Any, args: Any, kwargs: dict[str, Any]) -> list[int]:
    """Elements of each result, found on the meta device, where nothing is allocated."""
    args, kwargs = tree_map_only(Tensor, _without_values, (args, kwargs))
    if kwargs.get("device") is not None:
        kwargs = {**kwargs, "device": torch.device("meta")}
    try:
        results = tree_flatten(func(*args, **kwargs))[0]
    except (RuntimeError, NotImplementedError):  # its size depends on values; it makes few of them
        return []
    return [result.numel() for result in results if isinstance(result, Tensor)]


def _without_values(tensor: Tensor) -> Tensor:
    return torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device="meta")
