"""Points move with their frame; nothing happens to their depth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.points import SparsePoints, in_frame

sides = st.integers(1, 400)
shares = st.floats(0, 1, exclude_max=True, width=32)
places = st.lists(st.tuples(shares, shares), min_size=1, max_size=9)


def points(xy: list[tuple[float, float]], size: tuple[int, int]) -> SparsePoints:
    depth = torch.arange(1, len(xy) + 1, dtype=torch.float32)
    return SparsePoints(xy=torch.tensor(xy, dtype=torch.float32), depth=depth, size=size)


@given(sides, sides, sides, sides, places)
def test_resizing_moves_pixel_areas_and_not_pixel_centres_and_no_depth(
    height: int, width: int, h: int, w: int, pixels: list[tuple[float, float]]
) -> None:
    here = points([(u * width - 0.5, v * height - 0.5) for u, v in pixels], (height, width))
    there = here.resized(h, w)
    assert there.size == (h, w)
    assert torch.equal(there.depth, here.depth)
    expected = torch.tensor([(u * w - 0.5, v * h - 0.5) for u, v in pixels])
    torch.testing.assert_close(there.xy, expected, rtol=1e-5, atol=1e-4)


@given(sides, sides, places, st.integers(0, 98))
def test_off_the_grid_a_sample_is_bilinear_with_the_border_held(
    height: int, width: int, pixels: list[tuple[float, float]], seed: int
) -> None:
    dense = torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(seed))
    here = points([(u * width - 0.5, v * height - 0.5) for u, v in pixels], (height, width))
    grid = ((here.xy.double() + 0.5) / torch.tensor([width, height]) * 2 - 1)[None, None]
    expected = F.grid_sample(dense.double(), grid, padding_mode="border", align_corners=False)
    atol = 1e-6 * max(1, width / 4, height / 4)
    torch.testing.assert_close(here.sample(dense).double(), expected.flatten(), rtol=0, atol=atol)


def test_a_map_is_indexed_on_the_grid_resized_to_the_frame_and_infinity_has_no_part() -> None:
    assert points([(0, 1), (2, 0)], (2, 3)).sample(torch.arange(6.0).view(2, 3)).tolist() == [3, 2]
    here = points([(0, 0), (1, 0), (1.5, 0), (3, 1)], (2, 4))
    assert here.sample(torch.tensor([[[[1.0, 3.0]]]])).tolist() == [1.0, 1.5, 2.0, 3.0]
    dense = torch.tensor([[[[1.0, torch.inf, 5.0, 6.0], [torch.inf] * 4]]])
    here = points([(0, 0), (2.5, 0)], (2, 4))
    assert here.sample(dense).tolist() == [1.0, 5.5]  # not infinity times 0


def test_a_sample_is_differentiable_in_one_map() -> None:
    dense = torch.zeros(1, 1, 2, 3, requires_grad=True)
    points([(0.25, 0), (2, 1)], (2, 3)).sample(dense).sum().backward()
    assert dense.grad.flatten().tolist() == [0.75, 0.25, 0, 0, 0, 1]
    with pytest.raises(ValueError, match="one map"):
        points([(0, 0)], (2, 2)).sample(torch.zeros(1, 2, 2, 2))


@given(
    st.integers(1, 8),
    st.integers(1, 8),
    st.lists(st.tuples(shares, shares, st.floats(0.5, 80, width=32)), max_size=30),
)
def test_scattered_points_are_on_their_pixels_and_the_nearest_wins(
    height: int, width: int, pixels: list[tuple[float, float, float]]
) -> None:
    xy = torch.tensor([(u * width - 0.5, v * height - 0.5) for u, v, _ in pixels]).reshape(-1, 2)
    here = SparsePoints(xy=xy, depth=torch.tensor([d for *_, d in pixels]), size=(height, width))
    expected = torch.zeros(height, width)
    for (x, y), depth in zip(here.xy.round().tolist(), here.depth.tolist(), strict=True):
        row = min(max(int(y), 0), height - 1)
        column = min(max(int(x), 0), width - 1)
        now = float(expected[row, column])
        expected[row, column] = depth if now == 0 else min(now, depth)
    assert torch.equal(here.scatter(), expected[None, None])
    outside = points([(-0.6, 0), (0, -3), (width - 0.4, 0), (0, height - 0.3)], here.size)
    assert not outside.scatter().any()


def test_arrays_become_tensors_without_copy_and_follow_the_same_rules() -> None:
    xy = np.array([[0.1, 0.2], [7.3, 4.9], [8.5, 1]], np.float32)
    arrays = SparsePoints(xy=xy, depth=np.ones(3, np.float32), size=(6, 9), dropped={"far": 2})
    tensors = arrays.tensors()
    assert tensors.xy.data_ptr() == xy.ctypes.data
    assert tensors.dropped == {"far": 2}
    for change in (
        lambda points: points.resized(5, 7),
        lambda points: points.cropped(1, 2, 4, 5),
        lambda points: points.select([0, 2]),
    ):
        assert torch.equal(change(arrays).tensors().xy, change(tensors).xy)
        assert change(arrays).size == change(tensors).size


def test_a_frame_reaches_half_a_pixel_beyond_its_outermost_pixel_centres() -> None:
    xy = np.array([[-0.5, -0.5], [2.4, 1.4], [2.5, 0], [0, 1.5], [-0.6, 0], [np.nan, 0]])
    for array in (xy, torch.from_numpy(xy)):
        assert in_frame(array, (2, 3)).tolist() == [True, True, False, False, False, False]
        closed = in_frame(array, (2, 3), closed=True)
        assert closed.tolist() == [True, True, True, True, False, False]


def test_points_that_are_all_wanted_stay_the_same_object_and_others_are_left_out() -> None:
    xy = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
    points = SparsePoints(xy=xy, depth=torch.tensor([1.0, 2.0]), size=(4, 4))
    assert points.where(points.depth > 0) is points
    assert points.where(points.depth > 1).xy.tolist() == [[2.0, 3.0]]
