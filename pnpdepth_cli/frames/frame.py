"""One frame in memory, and what refinement makes of it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.alignment import Alignment
from pnpdepth_cli.completion.image_registration import ImageRegistration, estimated, evidence
from pnpdepth_cli.core.refine import Refinement
from pnpdepth_cli.errors import DivergedError, InputError, NoPointsError, SizeError, UsageError
from pnpdepth_cli.models.definition import DENSE_SPACING
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

METRES = "m"
DepthMap = NDArray[np.float32]
Registration = str | tuple[float, float, float]
"""What the user says of the registration: "auto", "off", or zoom, right and down in pixels."""
Register = ImageRegistration | Literal["auto"] | None
"""How an image is to be moved to its points. "auto": as the points say."""
FULL_SCALE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}
"""Value of white by the type of an image's integers."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An image and its sparse depth."""

    rgb: Tensor | None  # (3, H, W) float32 in 0…1. None without an image.
    points: SparsePoints  # sparse depth in the image frame, on the CPU
    gt: DepthMap | None = None  # (H, W) metres, 0 = unknown. None without ground truth.
    held_out: SparsePoints | None = None  # points that are kept out, to score at
    unit: str = METRES  # of all depths: "m", or "model units" of a COLMAP model without scale
    register: Register = None  # how `rgb` is to be moved into the frame of the points
    one_view: bool = False
    """Whether image and points are stated to be of one view, so that the image is not doubted."""
    outliers: SparsePoints | None = None
    """Points that were left out as outliers, for networks that weigh their points."""
    prior: Tensor | None = None
    """(H, W) metres, 0 = unknown: another network's depth, aligned with the points, for networks
    that take one. None without."""
    registration: ImageRegistration | None = None
    """How `rgb` was moved into the frame of the points. None: it was not."""
    given: SparsePoints | None = None
    """All points of the frame's own files, also those held out. None: `points`."""
    camera: Camera | None = None
    """The camera in pixels of the image frame. None: unknown."""
    pose: NDArray[np.float64] | None = None
    """(3, 4) from the camera's frame to the world's, in `unit`. None: unknown."""
    depth_scale: float | None = None
    """Integers per metre of the file of the sparse depth. None if it holds metres."""
    sources: Mapping[str, Any] = field(default_factory=dict)
    """Path, digest and reading of each file, by its part, for a record."""
    assumed: tuple[str, ...] = ()
    """Files whose scale is assumed, and how they were read."""
    notes: tuple[str, ...] = ()

    @property
    def own(self) -> SparsePoints:
        """All points of the frame's own files, also those held out."""
        return self.points if self.given is None else self.given

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the image frame."""
        return self.points.size

    @property
    def image(self) -> NDArray[np.float32] | None:
        """(H, W, 3) float32 in 0…1. None without an image."""
        return None if self.rgb is None else np.ascontiguousarray(self.rgb.permute(1, 2, 0))

    @functools.cached_property
    def _registration_of_points(self) -> Register:
        """What the points say of the registration: asked for more than once of most frames."""
        assert self.image is not None
        return estimated([evidence(self.image, self.points)])

    def registered(self) -> Frame:
        """Returns the frame with its image moved into the frame of the points, if it has to be."""
        image, how = self.image, self.register
        if image is None or how is None:
            return self
        how = self._registration_of_points if how == "auto" else how
        if how is None or isinstance(how, str):
            return replace(self, register=None)
        return replace(self, rgb=tensor_of(how.applied(image)), register=None, registration=how)

    def with_points(self, points: SparsePoints) -> Frame:
        """Returns the same image with other sparse depth."""
        return replace(self, points=points)

    def without(self, outliers: Tensor) -> Frame:
        """Returns the frame with those points, of (N,) bool, added to the outliers left out."""
        if not bool(outliers.any()):
            return self
        left_out = self.points.select(outliers)
        if self.outliers is not None:
            left_out = self.outliers.joined(left_out)
        return replace(self, points=self.points.select(~outliers), outliers=left_out)


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A refined frame, all in the image frame."""

    before: DepthMap
    """(H, W) metres, 0 = unknown: the network's depth before refinement."""
    after: DepthMap
    """(H, W) metres, 0 = unknown: the refined depth."""
    used: SparsePoints
    """The points that the depth was fitted to."""
    held_out: SparsePoints
    refinement: Refinement
    diverged: DivergedError | None
    """Why the refinement stopped early. None if it did not."""
    alignment: Alignment | None = None
    """Alignment of the network's output with the points. None where the output is in metres."""
    notes: tuple[str, ...] = ()
    sigma: DepthMap | None = None
    """(H, W) metres, standard deviation of `after`. None if it was not asked for."""
    valid: NDArray[np.bool_] | None = None
    """(H, W), where points support `after`. None without `sigma`."""
    stages: Mapping[str, DepthMap] = field(default_factory=dict)
    """(H, W) metres of stages of the default method, by name; of a frame with ground truth."""
    validation: Validation | None = None
    """The stages and the result at validation points. None where nothing was validated."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """Weights of the experts of the default method, by name; their sum is 1."""
    registration: ImageRegistration | None = None
    """How the image was moved into the frame of the points. None: it was not."""

    @property
    def depth(self) -> DepthMap:
        """The refined depth, `after`."""
        return self.after

    @property
    def losses(self) -> tuple[float, ...]:
        """Loss at the points before the first update and after each update."""
        return self.refinement.losses


@dataclass(frozen=True, kw_only=True)
class ValidationPoints:
    """Points that predictions from the other points are compared with."""

    points: SparsePoints  # the M validation points; none of a frame with few points
    weights: Tensor  # (M,) 0…1, how consistent each is with its neighbours

    def error(self, at: Tensor) -> float:
        """Returns the weighted mean absolute error in metres of a prediction (M,).

        A point without prediction counts as far off as a depth of 0 is.
        """
        error = (at - self.points.depth).abs()
        return float((error * self.weights).sum() / self.weights.sum())


@dataclass(frozen=True, kw_only=True)
class Validation(ValidationPoints):
    """Depth at validation points, predicted from the other points.

    Networks that take points predict without updates of z.
    """

    kept: SparsePoints  # all other points that were given
    network: Tensor  # (H, W) metres, 0 = unknown: the user's network, aligned with the other points
    predicted: Mapping[str, Tensor]
    """(M,) metres at the validation points, by stage; also linear interpolation and the result."""


def registration_to_make(registration: Registration, settings: Settings) -> Register:
    """Returns how images are to be moved. The paper's preset moves none unless numbers are given.

    Raises:
        UsageError: There is no such registration.
    """
    if not isinstance(registration, str):
        zoom, right, down = registration
        return ImageRegistration(zoom=zoom, right=right, down=down)
    if registration not in ("auto", "off"):
        raise UsageError(f"registration must be auto, off or three numbers, got {registration!r}")
    return "auto" if registration == "auto" and settings.preset is None else None


def tensor_of(image: NDArray[np.float32]) -> Tensor:
    """Returns an image (H, W, 3) as a tensor (3, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


def is_dense(points: SparsePoints) -> bool:
    """Returns whether the mean spacing of the points is below `DENSE_SPACING` pixels."""
    height, width = points.size
    return height * width < DENSE_SPACING**2 * len(points)


def no_points(points: SparsePoints) -> SparsePoints:
    """Returns an empty selection of the points."""
    return points.select(torch.zeros(len(points), dtype=torch.bool))


Unit = Literal["m", "mm"]
UNITS = {"m": 1.0, "mm": 1000.0}
"""Units of depth, so many to the metre."""

FARTHEST_MEDIAN_M = 200.0
"""No frame has half of its depths farther than this; a larger median is in another unit."""


def in_metres(depth: ArrayLike, what: str, unit: Unit | None = None) -> NDArray[np.float32]:
    """Returns depth as float32 metres; not finite or <= 0 is unknown.

    Args:
        depth: Of any shape.
        what: What it is, for messages.
        unit: Of the depth; needed for integers, and for depth that is too large for metres.

    Raises:
        InputError: The unit is needed.
        UsageError: There is no such unit.
    """
    values = _numbers(depth, what)
    if unit is not None:
        if unit not in UNITS:
            raise UsageError(f"unit must be one of {', '.join(UNITS)}, got {unit!r}")
        return (values / UNITS[unit]).astype(np.float32)
    known = values[np.isfinite(values) & (values > 0)]
    if values.dtype.kind in "iu":
        fact = f"of {values.dtype}"
    elif known.size and np.median(known) > FARTHEST_MEDIAN_M:
        fact = f"{np.median(known):,.0f} in the median, which is too far for metres"
    else:
        return values.astype(np.float32)
    raise InputError(f'{what} is {fact}; give its unit, such as unit="mm" or unit="m"')


def _numbers(values: ArrayLike, what: str) -> NDArray[Any]:
    """The array, of real numbers. InputError if it is none."""
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:  # ragged rows, a tensor on a GPU
        raise InputError(f"{what} cannot be made an array: {error}") from None
    if array.dtype.kind not in "buif":
        raise InputError(f"{what} must be an array of numbers, not {type(values).__name__}")
    return array


def frame_of_arrays(
    image: ArrayLike | None,
    sparse: ArrayLike | SparsePoints,
    register: Register = None,
    unit: Unit | None = None,
) -> Frame:
    """Returns the frame of an image and its sparse depth; see `Refiner.refine`.

    Raises:
        InputError: Image or points cannot be used.
    """
    rgb = None if image is None else _rgb(image)
    size = None if rgb is None else (rgb.shape[0], rgb.shape[1])
    points, unknown = _points(sparse, size, unit)
    points = points.resized(*size) if size else points
    inside = points.cropped(0, 0, *points.size)
    if not len(inside):
        raise NoPointsError(f"none of the {len(points)} sparse points lies in the image")
    lost = {"outside the image": len(points) - len(inside), "without a depth above 0": unknown}
    return Frame(
        rgb=None if rgb is None else tensor_of(rgb),
        points=inside,
        register=register,
        one_view=register is None,
        notes=tuple(f"sparse: {n:,} points {why} are not used" for why, n in lost.items() if n),
    )


_CHANNELS = (1, 3, 4)  # grey, RGB, RGBA
_OVERSHOOT = 2.0
"""An image in 0..1 that was resized may exceed 1, but not this; one in 0..255 does."""


def _rgb(image: ArrayLike) -> NDArray[np.float32]:
    values = _numbers(image, "an image")
    shape = values.shape
    if values.ndim == 4 and shape[0] == 1:
        values = values[0]
    if values.ndim == 2:
        values = values[:, :, None]
    if values.ndim == 3 and values.shape[2] not in _CHANNELS and values.shape[0] in _CHANNELS:
        values = values.transpose(1, 2, 0)
    if values.ndim != 3 or values.shape[2] not in _CHANNELS or not values.size:
        raise InputError(
            "an image has shape (H, W), (H, W, C) or (C, H, W) with 1, 3 or 4 channels, not"
            f" {shape}"
        )
    values = values[:, :, :3].repeat(3 if values.shape[2] == 1 else 1, axis=2)
    if values.dtype in FULL_SCALE and (values.dtype == np.uint8 or values.max() > 255):
        return (values / FULL_SCALE[values.dtype]).astype(np.float32)
    if values.min() >= 0 and _OVERSHOOT < values.max() <= 255:
        return (values / 255).astype(np.float32)
    if values.dtype.kind != "f" or not (values >= 0).all() or not (values <= 1).all():
        raise InputError(
            f"an image is uint8, uint16, or in 0..1 or 0..255; this one is {values.dtype} in"
            f" {values.min()}..{values.max()}"
        )
    return values.astype(np.float32)


def _points(
    sparse: ArrayLike | SparsePoints, size: tuple[int, int] | None, unit: Unit | None
) -> tuple[SparsePoints, int]:
    """The points in their own frame, which is the image's for rows of x, y, depth; and how many
    rows are none."""
    unknown = 0
    if isinstance(sparse, SparsePoints):
        return sparse.tensors(), unknown
    values = _numbers(sparse, "sparse depth")
    shape = values.shape
    if values.ndim in (3, 4):
        values = values.reshape([side for side in shape if side != 1])
    if values.ndim != 2:
        raise InputError(f"sparse depth has shape (H, W) or (N, 3), not {shape}")
    if values.shape[1] == 3 and values.shape != size:
        if size is None:
            raise SizeError("rows of x, y and depth need an image for the size of the frame")
        column = in_metres(values[:, 2], "the sparse depth", unit)
        known = np.isfinite(values).all(axis=1) & (column > 0)
        xy, depth = values[known, :2].astype(np.float32), column[known]
        unknown = int(np.count_nonzero(~known))
    else:
        if size is not None and values.shape != size:
            raise SizeError(f"the sparse depth map is {values.shape} but the image is {size}")
        size, values = (
            (values.shape[0], values.shape[1]),
            in_metres(values, "the sparse depth", unit),
        )
        rows, columns = np.nonzero(np.isfinite(values) & (values > 0))
        xy = np.stack([columns, rows], axis=1).astype(np.float32)
        depth = values[rows, columns]
    if not len(depth):
        raise NoPointsError("the sparse depth has no value above 0")
    return SparsePoints(xy=xy, depth=depth, size=size).tensors(), unknown
