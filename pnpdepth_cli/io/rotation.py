"""Rotation matrices of quaternions in files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rotation_of(wxyz: Floats) -> Floats:
    """Returns the (3, 3) rotation of a quaternion w x y z of any length but 0, which gives NaN."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = wxyz / float(np.linalg.norm(wxyz))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
