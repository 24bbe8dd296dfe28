"""The sparse depth of a frame as it was read, whatever it was read from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.arrays import check_same_view, read_levels
from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.formats import Reading
from pnpdepth_cli.points import METRES, SparsePoints
from pnpdepth_cli.protocols import FramePart
from pnpdepth_cli.sensors.pixels import Points, pixel_index

_FEW_LEVELS = 4  # of confidence; their counts are listed


@dataclass(frozen=True, kw_only=True)
class SparseDepth:
    """The sparse depth of a frame, as it was read."""

    points: Points
    """The points in the image."""
    record: FileRecord
    notes: tuple[str, ...]
    reading: Reading
    """How the file was read; its scale is integers per unit, None if the file holds none."""
    unit: str = METRES
    calibrated: bool = False
    """Whether a calibration, or the pose in a model, says where the image shows the points."""
    camera: Camera | None = None
    """The camera of the whole image, where it came with the points."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's coordinates to the world's, in `unit`. None: unknown."""

    def confident(self, path: Path, least: float | None) -> SparseDepth:
        """Returns the points whose confidence in a file is `least` or more, above 0 for None.

        Raises:
            InputError: The file holds no confidence of this view.
            NoPointsError: No point is left.
        """
        levels = read_levels(path)
        size = (levels.shape[0], levels.shape[1])
        check_same_view(str(path), size, self.points.size)
        pixel = pixel_index(self.points.resized(*size).xy, (size[0], size[1]))
        own = levels.ravel()[pixel.clip(0, levels.size - 1)]
        kept = own > 0 if least is None else own >= least
        values, counts = np.unique(own, return_counts=True)
        listing = ", ".join(f"{n:,} of {v:g}" for v, n in zip(values, counts, strict=True))
        fact = (
            f"{np.count_nonzero(kept):,} of {len(own):,} points have a confidence"
            f" {'above 0' if least is None else f'of {least:g} or more'} in {path}"
            + (f" ({listing})" if len(values) <= _FEW_LEVELS else "")
        )
        if not kept.any():
            raise NoPointsError(f"{fact}; lower --min-confidence")
        dropped = self.record.dropped | {"of low confidence": int((~kept).sum())}
        record = replace(self.record, mask=str(path), least=least, dropped=dropped)
        notes = (*self.notes, f"sparse: {fact}")
        return replace(self, points=self.points.select(kept), record=record, notes=notes)

    def in_part(self, part: FramePart) -> SparseDepth:
        """Returns the points in a part of the frame. Raises NoPointsError if there is none."""
        whole = self.points
        # an array of the image's size that takes no memory, to find the size of the part
        size = part.apply(np.broadcast_to(np.False_, whole.size)).shape
        if size == whole.size:
            return self
        xy = part.in_crop(whole.xy, whole.size)
        moved = SparsePoints(xy=xy, depth=whole.depth, size=(size[0], size[1]))
        points = moved.cropped(0, 0, *moved.size)
        if not len(points):
            raise NoPointsError(
                f"{self.record.path}: none of its {len(whole)} points lies in the image"
            )
        return replace(self, points=points)
