"""Measured pixels are kept exactly, or how many of them are changed is said."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.measured import with_measured, with_note_on_measured
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings
from tests.frames.scenes import Brightness, frame_in_memory, member

SIZE = (6, 8)


def refined_with(xy: list[list[float]], depth: list[float]) -> Refined:
    """A result of 2 m everywhere, with these points."""
    points = SparsePoints(xy=torch.tensor(xy), depth=torch.tensor(depth), size=SIZE)
    everywhere = np.full(SIZE, 2, np.float32)
    return Refined(
        before=everywhere,
        depth=everywhere,
        used=points,
        losses=(0.0,),
        step=0.01,
        diverged=None,
        propagation="none",
    )


def map_of(depth: float, count: int) -> Refined:
    """The same with the points of a depth map, of which the first have this depth."""
    xy = [[float(x), float(y)] for y in range(SIZE[0]) for x in range(SIZE[1])]
    return refined_with(xy, [depth] * count + [2.0] * (len(xy) - count))


def test_points_at_pixels_are_kept_exactly_the_nearest_of_several_and_no_other_pixel_changes() -> (
    None
):
    result = with_measured(refined_with([[1, 2], [3, 4], [3, 4]], [1.2345, 1.7, 1.6]))
    expected = np.full(SIZE, 2, np.float32)
    expected[2, 1] = np.float32(1.2345)
    expected[4, 3] = np.float32(1.6)
    assert np.array_equal(result.depth, expected)
    assert result.depth.dtype == np.float32
    assert len(result.notes) == 1


def test_points_between_pixels_are_counted_and_refused_if_all_are() -> None:
    result = with_measured(refined_with([[1, 2], [3.5, 4], [3, 4.25]], [1.0, 1.0, 1.0]))
    assert int((result.depth == 1).sum()) == 1
    assert len(result.notes) == 1
    assert "2 of 3" in result.notes[0]
    with pytest.raises(UsageError):
        with_measured(refined_with([[0.5, 1.0]], [1.0]))


@pytest.mark.parametrize(("depth", "noted"), [(2.0, False), (2.001, False), (2.01, True)])
def test_measured_pixels_of_a_map_that_are_changed_are_counted(depth: float, noted: bool) -> None:
    result = with_note_on_measured(map_of(depth, 7))
    assert np.array_equal(result.depth, map_of(depth, 7).depth)
    assert len(result.notes) == noted
    if noted:
        assert "7 of 48" in result.notes[0]


def test_of_few_points_no_pixels_are_counted() -> None:
    assert with_note_on_measured(refined_with([[1, 2], [3, 4]], [1.0, 1.0])).notes == ()


@pytest.mark.parametrize("method", ["fused", "alone", "paper"])
def test_a_method_keeps_measured_pixels_if_it_is_asked_to(method: str) -> None:
    frame = frame_in_memory(60)
    asked = Settings(method=method)
    networks = [member(Brightness).network]
    with Method(networks, asked, frame, uncertainty=True, keep_measured=True) as kept:
        result = kept.refine(frame)
    with Method(networks, asked, frame, uncertainty=True) as plain:
        without = plain.refine(frame)
    depth = torch.from_numpy(result.depth)
    assert torch.equal(result.used.sample(depth), result.used.depth)
    others = result.used.scatter()[0, 0].numpy() == 0
    assert np.array_equal(result.depth[others], without.depth[others])
    assert not np.array_equal(result.depth, without.depth)
