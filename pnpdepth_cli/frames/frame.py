"""One frame in memory."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.image_registration import (
    ImageRegistration,
    estimate_registration,
    evidence,
)
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.models.definition import DENSE_SPACING
from pnpdepth_cli.points import METRES, SparsePoints
from pnpdepth_cli.settings import Settings

DepthMap = NDArray[np.float32]
Registration = str | tuple[float, float, float]
"""What the user says of the registration: "auto", "off", or zoom, right and down in pixels."""
Register = ImageRegistration | Literal["auto"] | None
"""How an image is to be moved to its points. "auto": as the points say."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An image and its sparse depth."""

    rgb: Tensor | None  # (3, H, W) float32 in 0…1. None without an image.
    points: SparsePoints  # sparse depth at pixel coordinates of the image, on the CPU
    gt: DepthMap | None = None  # (H, W) metres, 0 = unknown. None without ground truth.
    held_out: SparsePoints | None = None  # points that nothing uses, to score at
    unit: str = METRES  # of all depths: "m", or "model units" of a COLMAP model without scale
    register: Register = None  # how `rgb` is to be moved to the points
    one_view: bool = False
    """Whether image and points are stated to be of one view, so that this is not checked."""
    outliers: SparsePoints | None = None
    """Outliers, which are not in `points`; for networks that weigh their points."""
    prior: Tensor | None = None
    """(H, W) metres, 0 = unknown: another network's depth, aligned with the points, for networks
    that take one. None without."""
    registration: ImageRegistration | None = None
    """How `rgb` was moved to the points. None: it was not."""
    given: SparsePoints | None = None
    """All points of the frame's own files, also those held out. None: `points`."""
    camera: Camera | None = None
    """The camera in pixels of the image. None: unknown."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's coordinates to the world's, in `unit`. None: unknown."""
    depth_scale: float | None = None
    """Integers per metre of the file of the sparse depth. None if it holds metres."""
    sources: Mapping[str, FileRecord] = field(default_factory=dict)
    """What a record keeps of each file, by its part."""
    neighbours: tuple[FileRecord, ...] = ()
    """Files of neighbouring frames, whose points are among `points`."""
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        height, width = self.size
        return f"Frame({width}×{height}, {len(self.points):,} points)"

    @property
    def own(self) -> SparsePoints:
        """All points of the frame's own files, also those held out."""
        return self.points if self.given is None else self.given

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the image."""
        return self.points.size

    @property
    def image(self) -> NDArray[np.float32] | None:
        """(H, W, 3) float32 in 0…1. None without an image."""
        return None if self.rgb is None else np.ascontiguousarray(self.rgb.permute(1, 2, 0))

    @functools.cached_property
    def _registration_of_points(self) -> Register:
        """The registration that the points tell; kept, because most frames need it twice."""
        assert self.image is not None
        return estimate_registration([evidence(self.image, self.points)])

    def registered(self) -> Frame:
        """Returns the frame with its image moved to the points, if it has to be."""
        image, how = self.image, self.register
        if image is None or how is None:
            return self
        how = self._registration_of_points if how == "auto" else how
        if how is None or isinstance(how, str):
            return replace(self, register=None)
        return replace(self, rgb=tensor_of(how.apply_to(image)), register=None, registration=how)

    def with_points(self, points: SparsePoints) -> Frame:
        """Returns the same image with other sparse depth."""
        return replace(self, points=points)

    def without(self, outliers: Tensor) -> Frame:
        """Returns the frame with some of its points, (N,) bool, moved to its outliers."""
        if not bool(outliers.any()):
            return self
        left_out = self.points.select(outliers)
        if self.outliers is not None:
            left_out = self.outliers.joined(left_out)
        return replace(self, points=self.points.select(~outliers), outliers=left_out)


def registration_to_make(registration: Registration, settings: Settings) -> Register:
    """Returns how images are to be moved. The paper's method moves none unless numbers are given.

    Raises:
        UsageError: There is no such registration.
    """
    if not isinstance(registration, str):
        zoom, right, down = registration
        return ImageRegistration(zoom=zoom, right=right, down=down)
    if registration not in ("auto", "off"):
        raise UsageError(f"registration must be auto, off or three numbers, got {registration!r}")
    return "auto" if registration == "auto" and not settings.is_paper else None


def tensor_of(image: NDArray[np.float32]) -> Tensor:
    """Returns an image (H, W, 3) as a tensor (3, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


def is_dense(points: SparsePoints) -> bool:
    """Returns whether the mean spacing of the points is below `DENSE_SPACING` pixels."""
    height, width = points.size
    return height * width < DENSE_SPACING**2 * len(points)
