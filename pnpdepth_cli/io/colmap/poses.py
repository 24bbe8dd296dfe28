"""Poses and points of a model from their numbers, checked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.colmap.parts import ColmapImage, ColmapPoints, Floats
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.rotation import rotation_of

_NO_POINT = -1


def image_of(
    path: Path, name: str, camera: int, pose: Sequence[float], points: NDArray[np.int64]
) -> ColmapImage:
    """Returns the image with this pose.

    Args:
        path: Named in messages.
        name: Of the image.
        camera: Its number.
        pose: qw qx qy qz tx ty tz from the model's frame to the camera's.
        points: (K,) numbers of the points at its keypoints, -1 for none.

    Raises:
        FileFormatError: The numbers are no pose.
    """
    values = np.array(pose, np.float64)
    length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all() or not 1e-6 < length < 1e6:
        raise FileFormatError(
            f"{path}: the pose of {one_line(name)!r} is not made of finite numbers; create the"
            " model again"
        )
    return ColmapImage(
        camera=camera,
        rotation=rotation_of(values[:4]),
        translation=values[4:],
        points=np.unique(points[points != _NO_POINT]),
    )


def points_of(
    path: Path, number: NDArray[np.int64], rows: Floats, track: NDArray[np.int64]
) -> ColmapPoints:
    """Returns the points, sorted by number.

    Args:
        path: Named in messages.
        number: (N,).
        rows: (N, 4) x y z and reprojection error.
        track: (N,) lengths.

    Raises:
        FileFormatError: A coordinate is not finite.
    """
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise FileFormatError(
            f"{path}: {int(bad.sum()):,} of {len(rows):,} points have no finite coordinates;"
            " create the model again"
        )
    order = np.argsort(number, kind="stable")
    return ColmapPoints(
        number=number[order], xyz=rows[order, :3], error=rows[order, 3], track=track[order]
    )
