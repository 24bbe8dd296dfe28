"""Codes per metre of an integer file."""

from __future__ import annotations

import pytest
import torch

from pnpdepth_cli.dataset.depth_files import integer_scale
from pnpdepth_cli.points import SparsePoints


@pytest.mark.parametrize(
    ("nearest", "farthest", "stated", "expected"),
    [
        (0.4, 80.0, None, 256),
        (0.4, 80.0, 1000.0, 1000),
        (900.0, 3000.0, None, 10),
        (0.005, 0.02, None, 1_000_000),
        (0.005, 80.0, None, 256),
    ],
)
def test_the_scale_is_the_sparse_files_else_one_that_holds_the_points(
    nearest: float, farthest: float, stated: float | None, expected: float
) -> None:
    depth = torch.tensor([nearest, farthest])
    points = SparsePoints(xy=torch.eye(2), depth=depth, size=(2, 2))
    assert integer_scale(points, stated) == expected
