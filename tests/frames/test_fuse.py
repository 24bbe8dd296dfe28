"""What the network that takes a prior sees of a frame with few points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.fuse import MIRRORED_BELOW, Expert, split_frame, with_mirrored
from tests.frames.scenes import compact, depth_of_scene, frame_in_memory, opened


def seen_twice(frame: Frame, weight: float = 1.0) -> tuple[Expert, Expert]:
    """An expert of `compact`, before and after it sees the mirrored frame, if it does."""
    at = frame.points.depth[:0]
    with opened(compact()) as networks:
        whole = networks[0].refine(frame)
        expert = Expert(name="compact", at=at, updated=at, whole=whole, frame=frame)
        (again,) = with_mirrored(networks, [expert], {"compact": weight})
    return expert, again


def test_a_mirrored_frame_has_left_and_right_exchanged_and_mirrored_again_is_the_frame() -> None:
    frame = replace(frame_in_memory(), prior=depth_of_scene())
    mirrored, width = frame.mirrored(), frame.size[1]
    x, y = frame.points.xy.unbind(1)
    assert torch.equal(mirrored.points.xy, torch.stack([width - 1 - x, y], 1))
    assert torch.equal(mirrored.rgb[..., 0], frame.rgb[..., -1])
    assert torch.equal(mirrored.points.sample(mirrored.prior), frame.points.depth)
    twice = mirrored.mirrored()
    assert torch.equal(twice.points.xy, frame.points.xy)
    assert torch.equal(twice.rgb, frame.rgb)


def test_few_points_give_the_geometric_mean_of_the_frame_and_the_mirrored_one() -> None:
    frame = frame_in_memory(count=MIRRORED_BELOW - 1)
    split = split_frame(frame, depth_of_scene(), 0)
    once, twice = seen_twice(frame)
    turned, _ = seen_twice(frame.mirrored())
    left, right = once.whole.after.numpy(), turned.whole.after.numpy()[:, ::-1]
    assert np.abs(left - right).max() > 1e-3
    np.testing.assert_allclose(twice.dense(split), np.sqrt(left * right), rtol=1e-4)


@pytest.mark.parametrize(("count", "weight"), [(MIRRORED_BELOW, 1.0), (20, 0.0)])
def test_many_points_or_no_weight_show_an_expert_the_frame_alone(count: int, weight: float) -> None:
    once, twice = seen_twice(frame_in_memory(count), weight)
    assert twice is once
