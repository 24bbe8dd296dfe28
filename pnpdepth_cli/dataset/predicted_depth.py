"""Depth maps that networks predicted, as their files hold them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset.arrays import record_of
from pnpdepth_cli.errors import InputError, unequal_sizes
from pnpdepth_cli.file_record import FileRecord


@dataclass(frozen=True, kw_only=True)
class PredictedDepth:
    """A network's depth map, in its own numbers."""

    values: NDArray[np.float32]
    """(H, W), NaN where unknown."""
    source: FileRecord
    notes: tuple[str, ...] = ()


def read_predicted_depth(
    path: Path, size: tuple[int, int] | None, image: NDArray[np.float32] | None = None
) -> PredictedDepth:
    """Returns the depth map of a NumPy file, in the network's own numbers.

    Args:
        path: The file.
        size: (H, W) of the image. None: the map's own.
        image: (H, W, 3) in 0…1, or None.

    Raises:
        InputError: It holds no such map.
    """
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"depth map {path} is no NumPy array: {error}") from error
    values = np.squeeze(values).astype(np.float32)
    if values.ndim != 2 or not np.isfinite(values).any():
        raise InputError(f"depth map {path} is no map (H, W) with finite values")
    if size is not None and values.shape != size:
        raise unequal_sizes(f"depth map {path}", values.shape, "the image", size)
    known = np.isfinite(values)
    return PredictedDepth(values=np.where(known, values, np.nan), source=record_of(path))
