"""Between image and network: points stay where they are seen, depth comes back to its pixels."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pnpdepth_cli.models.definition import Fixed, Multiple, Near
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.points import SparsePoints

sides = st.integers(1, 70)
policies = st.one_of(
    st.builds(Multiple, st.integers(1, 33), st.one_of(st.none(), st.integers(8, 60))),
    st.builds(Fixed, st.integers(1, 40), st.integers(1, 40), st.sampled_from(["stretch", "crop"])),
)


def ramps(height: int, width: int) -> Tensor:
    """(1, 3, H, W): column, row, and one, of every pixel."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)]).float()[None]


@given(policies, sides, sides)
def test_any_image_fits_and_comes_back(policy: Fixed | Multiple, height: int, width: int) -> None:
    frame = FrameMap.fit(policy, height, width)
    resized = frame.rgb_to_network(torch.rand(1, 3, height, width))
    assert tuple(resized.shape) == (1, 3, *frame.network)
    if isinstance(policy, Multiple):
        assert [side % policy.of for side in frame.network] == [0, 0]
        assert max(frame.resized) <= (policy.longest or max(height, width))
    else:
        assert frame.network == (policy.height, policy.width)
    for divisor in (1, 2, 3):
        h, w = (max(1, side // divisor) for side in frame.network)
        depth = frame.depth_to_image(torch.full((1, 1, h, w), 2.5))
        assert tuple(depth.shape) == (height, width)
        top, left, rows, columns = frame.crop
        inside = torch.zeros(height, width)
        inside[top : top + rows, left : left + columns] = 2.5
        torch.testing.assert_close(depth, inside)


@pytest.mark.parametrize("size", [(48, 64), (24, 20)])
@pytest.mark.parametrize(
    "policy", [Fixed(30, 40), Fixed(30, 40, "crop"), Multiple(32, longest=40), Near(of=8, width=40)]
)
def test_points_stay_at_their_pixel(policy: Fixed | Multiple | Near, size: tuple[int, int]) -> None:
    frame = FrameMap.fit(policy, *size)
    network = frame.rgb_to_network(ramps(*size))
    xy = ramps(*size)[0, :2].flatten(1).t().contiguous()
    every = SparsePoints(xy=xy, depth=torch.arange(1.0, len(xy) + 1), size=size)
    there = frame.points_to_network(every)
    assert there.size == frame.network
    assert len(there) == math.prod(frame.crop[2:])  # those outside the crop are dropped
    last = torch.tensor(frame.resized[::-1]) - 3
    points = there.select((there.xy > 2).all(1) & (there.xy < last).all(1))  # not at edges
    pixel = points.depth - 1
    for axis, expected in enumerate((pixel % size[1], pixel // size[1])):
        read = points.sample(network[:, axis : axis + 1])
        torch.testing.assert_close(read, expected, atol=0.1, rtol=0)
    assert len(points) > 50


@pytest.mark.parametrize(
    ("size", "height", "width", "crop"),
    [
        (Fixed(30, 40, "crop"), 60, 100, (0, 10, 60, 80)),
        (Fixed(10, 1000, "crop"), 1, 50, (0, 0, 1, 50)),  # of one pixel
    ],
)
def test_a_fixed_shape_is_cropped_in_the_middle(
    size: Fixed, height: int, width: int, crop: tuple[int, ...]
) -> None:
    assert FrameMap.fit(size, height, width).crop == crop


def test_an_image_is_shrunk_to_the_longest_side_but_never_enlarged() -> None:
    assert FrameMap.fit(Multiple(32, longest=640), 1000, 2000).resized == (320, 640)
    assert FrameMap.fit(Multiple(32, longest=640), 100, 200).resized == (100, 200)


def test_near_sizes_are_the_multiples_that_transformers_chooses() -> None:
    assert FrameMap.fit(Near(of=14, height=518, width=518), 480, 640).network == (518, 686)
    assert FrameMap.fit(Near(of=32), 375, 1242).network == (384, 1248)


@pytest.mark.parametrize("size", [Multiple(32), Fixed(20, 30), Fixed(20, 30, "crop"), Near(of=16)])
def test_a_prior_stays_but_beside_the_unknown_and_padding(size: Fixed | Multiple | Near) -> None:
    frame = FrameMap.fit(size, 50, 70)
    prior = torch.full((1, 1, 50, 70), 3.0)
    whole = frame.prior_to_network(prior)
    expected = torch.zeros(1, 1, *frame.network)
    expected[..., : frame.resized[0], : frame.resized[1]] = 3.0
    torch.testing.assert_close(whole, expected)
    prior[..., 20:30, 20:30] = 0.0
    partly = frame.prior_to_network(prior)
    unknown = partly == 0
    torch.testing.assert_close(partly, whole.masked_fill(unknown, 0.0))
    assert 0 < int(unknown.sum() - (whole == 0).sum()) < partly.numel() / 4
