"""The 3D view of a frame, packed for the HTML report: depths on one grid, not three clouds."""

from __future__ import annotations

import base64
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.io.colours import depth_scale
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.cloud import kept_pixels

LARGEST_VIEW = 200_000
"""Points of a cloud."""

_LARGEST_CODE = 65535
_RAY_NODES = 64
"""Nodes of the grid of directions along the longer side: exact to 1e-4 of it for strong lenses."""


def write_view(
    path: Path, image: NDArray[np.float32] | None, inputs: Inputs, frame: Refined
) -> None:
    """Writes the depth before and after, the ground truth if known, the colours and the camera.

    Every depth is cut at its edges, as a cloud is. An image of more pixels than `LARGEST_VIEW` is
    thinned to every n-th row and column.

    Args:
        path: A JSON file. Depths are base64 of uint16, 0 = unknown, else logarithmic over `range`.
        image: (H, W, 3) in 0…1, in the frame of the points. None without an image.
        inputs: The frame as it was read, with its camera.
        frame: The refined frame.

    Raises:
        OutputError: The file cannot be written.
    """
    assert inputs.camera is not None
    height, width = inputs.size
    stride = _stride((height, width))
    thinned = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    maps = {"before": frame.before, "after": frame.after}
    maps |= {} if inputs.gt is None else {"gt": inputs.gt}
    depths = {
        name: np.where(kept_pixels(depth, frame.valid if name == "after" else None), depth, 0)[
            thinned
        ]
        for name, depth in maps.items()
    }
    known = np.concatenate([depth[depth > 0] for depth in depths.values()])
    near, far = (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)
    far = max(far, near * 1.001)
    rays = _rays(inputs.camera.camera, (height, width))
    write_json(
        path,
        {
            "size": [depths["after"].shape[1], depths["after"].shape[0]],
            "whole": [width, height],
            "stride": stride,
            "range": [near, far],
            "middle": float(np.median(known)) if len(known) else 1.0,
            "farthest": far,
            "spacing": stride * float(np.ptp(rays[:, :, 0])) / max(width - 1, 1),
            "unit": inputs.unit,
            "rays": {"size": [rays.shape[1], rays.shape[0]], "values": _text(rays, "<f4")},
            "depths": {name: _text(_codes(d, near, far), "<u2") for name, d in depths.items()},
            "colours": _text(_colours(image, frame)[thinned], "|u1"),
        },
    )


def _stride(size: tuple[int, int]) -> int:
    """The least n for which every n-th row and column, from the n/2-th, are few enough pixels."""
    return next(
        n
        for n in itertools.count(1)
        if math.prod(len(range(n // 2, side, n)) for side in size) <= LARGEST_VIEW
    )


def _codes(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.float64]:
    """1…65535, logarithmic from near to far; 0 where unknown."""
    known = depth > 0
    position = np.log(np.where(known, depth, near) / near) / math.log(far / near)
    return np.where(known, 1 + np.rint(position * (_LARGEST_CODE - 1)), 0)


def _rays(camera: Camera, size: tuple[int, int]) -> NDArray[np.float64]:
    """(rows, columns, 2) x/z and y/z at the nodes of a grid from the first to the last pixel."""
    rows, columns = (np.linspace(0, n - 1, 2 + _RAY_NODES * (n - 1) // max(size)) for n in size)
    xy = np.stack(np.meshgrid(columns, rows), axis=-1)
    points = camera.unproject(xy.reshape(-1, 2), np.ones(xy.shape[0] * xy.shape[1]))
    return points[:, :2].reshape(xy.shape)


def _colours(image: NDArray[np.float32] | None, frame: Refined) -> NDArray[np.uint8]:
    """(H, W, 3) of the image, or of the depth where there is none."""
    if image is not None:
        return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return depth_scale(frame.after).paint(frame.after)


def _text(values: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")
