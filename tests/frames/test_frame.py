"""Frames in memory."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pnpdepth_cli.frames.frame import Frame
from tests.frames.scenes import depth_of_scene, frame_in_memory


@pytest.mark.parametrize(
    "unmoved",
    [
        replace(frame_in_memory(), rgb=None, register="auto"),
        replace(frame_in_memory(), register=None),
    ],
    ids=["without an image", "registered already"],
)
def test_a_frame_that_cannot_be_moved_or_was_moved_stays_as_it_is(unmoved: Frame) -> None:
    assert unmoved.registered() is unmoved


def test_a_mirrored_frame_has_left_and_right_exchanged_and_mirrored_again_is_the_frame() -> None:
    frame = replace(frame_in_memory(), prior=depth_of_scene())
    mirrored = frame.mirrored()
    width = frame.size[1]
    x, y = frame.points.xy.unbind(1)
    assert torch.equal(mirrored.points.xy, torch.stack([width - 1 - x, y], 1))
    assert torch.equal(mirrored.rgb[..., 0], frame.rgb[..., -1])
    assert torch.equal(mirrored.points.sample(mirrored.prior), frame.points.depth)
    twice = mirrored.mirrored()
    assert torch.equal(twice.points.xy, frame.points.xy)
    assert torch.equal(twice.rgb, frame.rgb)
