"""Image and ground truth of a frame, cropped to what its protocol uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array
from pnpdepth_cli.io.dataset.hdf5 import depth_of, rgb_of
from pnpdepth_cli.io.dataset.masks import masked
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb


def read_frame_image(frame: Frame) -> NDArray[np.float32]:
    """Returns (H, W, 3) float32 in 0..1. Raises InputError if the frame has no image."""
    if frame.image is None:
        raise InputError(f"frame {frame.name} has no image")
    source = frame.image
    rgb = rgb_of(source) if isinstance(source, Hdf5Array) else read_rgb(source).values
    return np.ascontiguousarray(frame.protocol.apply(rgb))


def read_frame_ground_truth(frame: Frame) -> NDArray[np.float32]:
    """Returns (H, W) metres, 0 where unknown. Raises InputError if there is no ground truth."""
    if frame.gt is None:
        raise InputError(f"frame {frame.name} has no ground truth")
    if isinstance(frame.gt, Hdf5Array):
        depth = depth_of(frame.gt)
    else:
        depth = read_depth(frame.gt, scale=frame.gt_scale).values
    depth = masked(depth, frame.masks)
    return np.ascontiguousarray(frame.protocol.apply(depth))
