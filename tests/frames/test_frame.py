"""Frames in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.sensors.lens import pixels_of
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


@pytest.mark.parametrize(
    ("lens", "distortion"),
    [
        ("radial-tangential", ()),
        ("radial-tangential", (-0.2, 0.05, 0.01, -0.02, 0.01)),
        (
            "radial-tangential",
            (-0.2, 0.05, 0.01, -0.02, 0.01, 0, 0, 0, 0.01, 0.02, 0.03, -0.01, 0.02, -0.03),
        ),
        ("fisheye", (0.05, -0.01, 0.002, 0.001)),
    ],
)
def test_the_camera_of_a_mirrored_frame_sees_the_mirrored_scene(
    lens: str, distortion: tuple[float, ...]
) -> None:
    frame = frame_in_memory()
    _, width = frame.size
    intrinsics = np.array([[20.0, 0.5, 9.0], [0.0, 22.0, 7.0], [0.0, 0.0, 1.0]])
    camera = Camera(intrinsics=intrinsics, lens=lens, distortion=distortion, size=frame.size)
    scene = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (50, 3))
    x, y = pixels_of(camera, scene).T
    mirrored = replace(frame, camera=camera).mirrored()
    assert mirrored.camera is not None
    seen = pixels_of(mirrored.camera, scene * (-1, 1, 1))
    np.testing.assert_allclose(seen, np.column_stack([width - 1 - x, y]), atol=1e-9)
    twice = mirrored.mirrored().camera
    assert twice is not None
    np.testing.assert_allclose(twice.intrinsics, intrinsics)
