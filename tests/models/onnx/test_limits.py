"""The bound on the size of a result, for every function that makes more than it is given."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode

from pnpdepth_cli.models.onnx.limits import _GROWING, _PRODUCTS, SizeLimit, largest_activation
from pnpdepth_cli.models.onnx.table import Unsupported

X, W, AT = torch.ones(2, 3, 7, 6), torch.ones(3, 3, 3, 3), torch.zeros(5, dtype=torch.long)
X1, W1, X3, W3 = X[..., 0], W[..., 0], X[:, :, None], W[:, :, None]
DOUBLES, VECTORS = (X.double(), W.double()), (torch.ones(4, 3), torch.ones(3))
EMPTY, NONE = torch.ones(2, 0), AT[:0]
CALLS: dict[str, tuple[Callable[[], Tensor], float]] = {
    "conv1d": (lambda: F.conv1d(X1, W1, None, 1, [4], 1, 1), 2 * 3 * 15),
    "conv2d": (lambda: F.conv2d(X, W, None, 1, [1, 2], 1, 1), 2 * 3 * 9 * 10),
    "conv2d of doubles": (lambda: F.conv2d(*DOUBLES, None, 1, [1, 2], 1, 1), 2 * 27 * 9 * 10),
    "conv3d": (lambda: F.conv3d(X3, W3, None, 1, [0, 1, 2], 1, 1), 2 * 3 * 9 * 10),
    "conv_transpose1d": (
        lambda: F.conv_transpose1d(X1, W1, None, [5], 0, 0, 1, [2]),
        2 * 3 * (7 * 5 + 3 * 2),
    ),
    "conv_transpose2d": (
        lambda: F.conv_transpose2d(X, torch.ones(3, 2, 3, 4), None, [2, 3], 0, 0, 3, [2, 1]),
        2 * (2 * 3) * (7 * 2 + 3 * 2) * (6 * 3 + 4 * 1),
    ),
    "conv_transpose3d": (
        lambda: F.conv_transpose3d(X3, W3, None, [1, 2, 3], 0, 0, 1, [1, 1, 1]),
        2 * 3 * (1 + 1) * (7 * 2 + 3) * (6 * 3 + 3),
    ),
    "matmul": (lambda: torch.matmul(torch.ones(5, 1, 2, 3), torch.ones(4, 3, 6)), 5 * 4 * 2 * 6),
    "matmul of vectors": (lambda: torch.matmul(*VECTORS), 12),
    "__matmul__": (lambda: torch.ones(2, 1) @ torch.ones(1, 6), 12),
    "cat": (lambda: torch.cat([torch.ones(2, 3), torch.ones(4, 3)]), 18),
    "stack": (lambda: torch.stack([torch.ones(2, 3)] * 3), 18),
    "ones": (lambda: torch.ones(2, 3, dtype=torch.int8), 6),
    "zeros": (lambda: torch.zeros(4, 3), 12),
    "einsum": (lambda: torch.einsum("bi,bj->bij", torch.ones(2, 3), torch.ones(2, 5)), 30),
    "grid_sample": (lambda: F.grid_sample(X, torch.zeros(2, 4, 5, 2), align_corners=False), 480),
    "interpolate": (lambda: F.interpolate(X, (8, 9)), 2 * 3 * 8 * 9),
    "index_select": (lambda: X.index_select(2, AT), 2 * 3 * 6 * 5),
    "index_select of one": (lambda: X3.index_select(2, AT), X.numel() * 5),
    "index_select of nothing": (lambda: EMPTY.index_select(1, NONE), 0),
    "__getitem__": (lambda: X[AT[:, None], AT], 5 * 5 * 7 * 6),
    "__getitem__ of a part": (lambda: X[:, 1:], X.numel()),
    "expand": (lambda: torch.ones(3, 1).expand([2, 3, 4]), 24),
    "repeat": (lambda: X.repeat([2, 1, 3, 1]), X.numel() * 6),
    "repeat_interleave": (lambda: torch.ones(4).repeat_interleave(3), 12),
    "arange": (lambda: torch.arange(2, 9, 3), 7 / 3 + 1),
    "arange in ones": (lambda: torch.arange(2, 9), 8),
    "arange from 0": (lambda: torch.arange(5), 6),
    "pad": (lambda: F.pad(torch.ones(2, 3, 1), (1, 2, 5, 4, 1, 0)), 4 * 12 * 3),
    "add": (lambda: torch.ones(3, 1) + torch.ones(1, 2, 1, 4), 24),
}


class Counted(TorchFunctionMode):
    """Counts the functions that are run inside."""

    count = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", CALLS)
def test_a_result_is_refused_from_its_bound_on_before_it_is_computed(name: str) -> None:
    call, bound = CALLS[name]
    most = math.ceil(bound)
    assert call().numel() <= bound
    with Counted() as allowed, SizeLimit(most):
        call()
    with Counted() as refused, SizeLimit(most - 1), pytest.raises(Unsupported, match="a result of"):
        call()
    assert refused.count < allowed.count


SUMMED = {"conv1d": 9, "conv2d": 27, "conv3d": 27, "matmul": 3, "__matmul__": 1, "einsum": 10}
SUMMED |= {"conv_transpose1d": 9, "conv_transpose2d": 3 * 12, "conv_transpose3d": 27}
"""Products that are summed for an element of the result."""


@pytest.mark.parametrize("name", SUMMED)
def test_an_operation_is_refused_from_the_products_that_it_sums_on(name: str) -> None:
    call, bound = CALLS[name]
    with SizeLimit(9999, work=SUMMED[name] * bound + 500):  # elements that are read
        call()
    with SizeLimit(9999, work=SUMMED[name] * bound), pytest.raises(Unsupported, match="arithmetic"):
        call()


def test_every_growing_function_is_bounded_here() -> None:
    assert _GROWING.keys() <= CALLS.keys()
    assert _PRODUCTS.keys() == SUMMED.keys()


def test_all_results_together_are_bounded_and_views_count_nothing() -> None:
    x = torch.ones(6)
    with SizeLimit(6, in_all=12):
        for _ in range(2):
            (x + 1).reshape(2, 3)
        with pytest.raises(Unsupported):
            x[:1] + 1


def test_activations_may_grow_in_proportion_to_large_images() -> None:
    given = 1 << 30
    assert largest_activation(2 * given) == 2 * largest_activation(given) > 2 * given
