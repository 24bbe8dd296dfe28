"""One frame in memory, and what refinement makes of it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Literal, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.alignment import Alignment
from pnpdepth_cli.completion.image_registration import ImageRegistration, estimate_registration
from pnpdepth_cli.completion.registration_evidence import Evidence, evidence
from pnpdepth_cli.errors import DivergedError, UsageError
from pnpdepth_cli.models.definition import DENSE_SPACING
from pnpdepth_cli.points import METRES, SparsePoints
from pnpdepth_cli.settings import ClosedSettings, Settings

DepthMap = NDArray[np.float32]
Registration = str | tuple[float, float, float]
"""How the user wants images moved: "auto", "off", or zoom, and shift in pixels right and down."""
Register = ImageRegistration | Literal["auto"] | None
"""How an image is to be moved to its points. "auto": as its points tell. None: it is not moved."""
AnyFrame = TypeVar("AnyFrame", bound="Frame")
"""A frame, or a frame as it was read."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An image and its sparse depth: what a method needs."""

    rgb: Tensor | None  # (3, H, W) float32 in 0…1. None without an image.
    points: SparsePoints  # sparse depth at pixel coordinates of the image, on the CPU
    of_matches: bool = False  # whether the points are of matched images, as of a COLMAP model
    unit: str = METRES  # of all depths: "m", or "model units" of a COLMAP model without scale
    register: Register = None  # how `rgb` is to be moved to the points
    one_view: bool = False
    """Whether image and points are stated to be of one view, so that this is not checked."""
    outliers: SparsePoints | None = None
    """Outliers, which are not in `points`; for networks that weigh their points."""
    predicted: tuple[Tensor, ...] = ()
    """Depth maps of networks, (H, W) float32 each, in the networks' own numbers; NaN = unknown."""
    prior: Tensor | None = None
    """(H, W) metres, 0 = unknown: another network's depth, aligned with the points, for networks
    that take one. None without."""
    registration: ImageRegistration | None = None
    """How `rgb` was moved to the points. None: it was not."""
    camera: Camera | None = None
    """The camera in pixels of the image. None: unknown."""
    notes: tuple[str, ...] = ()
    """What a person should know of the inputs, a line each."""

    def __repr__(self) -> str:
        height, width = self.size
        return f"Frame({width}×{height}, {len(self.points):,} points)"

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the image."""
        return self.points.size

    @property
    def image(self) -> NDArray[np.float32] | None:
        """(H, W, 3) float32 in 0…1. None without an image."""
        return None if self.rgb is None else np.ascontiguousarray(self.rgb.permute(1, 2, 0))

    @functools.cached_property
    def evidence_of_registration(self) -> Evidence | None:
        """What image and points tell of how the image is moved to them; None: they tell nothing."""
        image = self.image
        return None if image is None else evidence(image, self.points)

    @functools.cached_property
    def _registration_of_points(self) -> ImageRegistration | None:
        """How the points tell that the image is to be moved; None: it is not, or they do not tell.

        It is kept, because most frames need it twice.
        """
        return estimate_registration([self.evidence_of_registration])

    def registered(self: AnyFrame) -> AnyFrame:
        """Returns the frame with its image moved to its points; itself if that is not to be done.

        `register` says how the image is moved, and is None afterwards. Depth maps of networks move
        with the image, and the points stay.
        """
        image = self.image
        if image is None or self.register is None:
            return self
        registration = self._registration_of_points if self.register == "auto" else self.register
        if registration is None:  # the points tell that the image stays
            return replace(self, register=None)
        predicted = [
            torch.from_numpy(registration.apply_to(depth_map.numpy()))
            for depth_map in self.predicted
        ]
        return replace(
            self,
            rgb=tensor_of(registration.apply_to(image)),
            predicted=tuple(predicted),
            register=None,
            registration=registration,
        )

    def mirrored(self) -> Frame:
        """Returns the frame with left and right of image, points and prior exchanged.

        The outliers and the camera are mirrored with them. Depth maps in `predicted` are not: a
        network that takes a prior, which alone sees mirrored frames, does not take them.
        """
        _, width = self.size
        return replace(
            self,
            rgb=None if self.rgb is None else self.rgb.flip(-1),
            points=self.points.mirrored(),
            outliers=None if self.outliers is None else self.outliers.mirrored(),
            prior=None if self.prior is None else self.prior.flip(-1),
            camera=None if self.camera is None else self.camera.mirrored(width),
        )

    def without(self, outliers: Tensor) -> Frame:
        """Returns the frame with some of its points moved from `points` to `outliers`.

        Args:
            outliers: (N,) bool, which of the frame's N points are moved.
        """
        if not bool(outliers.any()):
            return self  # so that what is kept of it is not computed again
        left_out = self.points.select(outliers)
        if self.outliers is not None:
            left_out = self.outliers.joined(left_out)
        return replace(self, points=self.points.select(~outliers), outliers=left_out)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What one network gives for a frame, at the image's size."""

    aligned: Tensor  # (H, W) metres, 0 = unknown: of z as the network computes it
    updated: Tensor  # (H, W) metres, 0 = unknown: of the updated z
    losses: tuple[float, ...]  # at the points, before the first update of z and after each
    step: float  # α of the updates as a number; 0 without updates
    diverged: DivergedError | None  # why the updates ended early. None if they did not
    alignment: Alignment | None  # the network's output fitted to the points. None: it is in metres
    notes: tuple[str, ...]  # what a person should know of the output and its fit, a text each

    @property
    def updates(self) -> int:
        """Number of updates of z."""
        return len(self.losses) - 1


class Saver(Protocol):
    """What writes a refined frame; made above this package, which knows no files."""

    def __call__(self, refined: Refined, path: Path, *, overwrite: bool) -> None:
        """Writes the frame's depth to a file, and its record beside that; see `Refined.save`."""


@dataclass(frozen=True, kw_only=True)
class UsedNetwork:
    """A network as it was used, with the layer and the settings that were decided."""

    name: str
    layer: str
    """The layer whose output z was updated."""
    settings: ClosedSettings
    """How its output was aligned and z updated."""
    output_kind: str
    """What its output is, of `choices.OutputKind`."""
    normalise: str | None
    """Name of the RGB range of its input. None: it has none, or another one."""
    device: str
    is_map: bool
    """Whether it is a depth map that takes the place of a network."""
    checkpoint: Path | None
    """File of its weights. None: they are not of a file."""


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A refined frame; maps have the image's size."""

    before: DepthMap
    """(H, W) metres, 0 = unknown: the network's depth, aligned with the points, not refined."""
    depth: DepthMap
    """(H, W) metres, 0 = unknown: the refined depth."""
    used: SparsePoints
    """The points that the depth was fitted to."""
    losses: tuple[float, ...]
    """Loss of the network at the points before the first update of z and after each update."""
    step: float
    """Step size of the updates as a number."""
    diverged: DivergedError | None
    """Why the updates of z stopped early. None if they did not. `refine` raises it, with this frame
    as its `last_good`."""
    alignment: Alignment | None = None
    """Alignment of the network's output with the points. None where the output is in metres."""
    propagation: str
    """How the residual at the points was propagated: "gp", "local", …, or "none"."""
    notes: tuple[str, ...] = ()
    """Lines for a person; a warning begins with "warning"."""
    sigma: DepthMap | None = None
    """(H, W) metres, standard deviation of `depth`. None if it was not asked for."""
    valid: NDArray[np.bool_] | None = None
    """(H, W), where points support `depth`. None without `sigma`."""
    stages: Mapping[str, DepthMap] = field(default_factory=dict)
    """(H, W) metres after each step, by name. Empty if they were not asked for."""
    validation: Validation | None = None
    """The stages and the result at validation points. None where nothing was validated."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """Weights of the experts in the result, by name; their sum is 1."""
    registration: ImageRegistration | None = None
    """How the image was moved to the points. None: it was not."""
    asked: Settings = field(default_factory=Settings)
    """The settings that were asked for."""
    networks: tuple[UsedNetwork, ...] = ()
    """The networks with their settings, the user's first."""
    camera: Camera | None = None
    """The camera of the frame. None: unknown."""
    saver: Saver | None = field(default=None, repr=False, compare=False)
    """What `save` writes with. None for a frame that no Refiner made."""

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Writes the depth, and beside it the record that the command line writes.

        The suffix names the format: .png has 16-bit codes and their scale, .exr, .npy, .npz, .pfm
        and .tiff have float32 metres. NAME.json is the record of NAME_depth.png and of NAME.png.
        With `uncertainty`, NAME_sigma.png and NAME_valid.png are written too. All files are
        written, or none.

        Args:
            path: The depth file; its folder is made.
            overwrite: Whether files that exist are replaced.

        Raises:
            UsageError: A file exists, cannot be written, or has no suffix of a depth file.
        """
        if self.saver is None:
            raise UsageError("only a frame that `refine` or a Refiner returned can be saved")
        self.saver(self, Path(path), overwrite=overwrite)

    def __repr__(self) -> str:
        height, width = self.depth.shape
        weights = "".join(f", {name} {weight:.2f}" for name, weight in self.weights.items())
        return f"Refined({width}×{height}, {len(self.used):,} points{weights})"


@dataclass(frozen=True, kw_only=True)
class ValidationPoints:
    """Points that predictions from the other points are compared with."""

    points: SparsePoints  # the M validation points; none of a frame with few points
    weights: Tensor  # (M,) 0…1, how consistent each is with its neighbours

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.points):,} points)"

    def error(self, predicted: Tensor) -> float:
        """Returns the weighted mean absolute error in metres of a prediction of the points.

        A point without prediction counts as if a depth of 0 were predicted.

        Args:
            predicted: (M,) metres, 0 = unknown: depth of each validation point.
        """
        errors = (predicted - self.points.depth).abs()
        return float((errors * self.weights).sum() / self.weights.sum())


@dataclass(frozen=True, kw_only=True, repr=False)
class Validation(ValidationPoints):
    """Depth at validation points, predicted from the other points."""

    kept: SparsePoints  # all other points that were given
    network: Tensor  # (H, W) metres, 0 = unknown: the user's network, aligned with the other points
    predicted: Mapping[str, Tensor]
    """(M,) metres at the validation points, by stage; also linear interpolation and the result."""


def registration_to_make(registration: Registration, settings: Settings) -> Register:
    """Returns how images are to be moved to their points; None if they are not.

    The paper's method moves none unless numbers are given.

    Args:
        registration: How the user wants images moved.
        settings: The settings, which say whether the method is the paper's.

    Raises:
        UsageError: There is no such registration.
    """
    if not isinstance(registration, str):
        zoom, right, down = registration
        return ImageRegistration(zoom=zoom, right=right, down=down)
    if registration not in ("auto", "off"):
        raise UsageError(f"registration must be auto, off or three numbers, got {registration!r}")
    if registration == "off" or settings.is_paper:
        return None
    return "auto"


def tensor_of(image: NDArray[np.float32]) -> Tensor:
    """Returns an image (H, W, 3) as a tensor (3, H, W) of the same values."""
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


def is_dense(points: SparsePoints) -> bool:
    """Returns whether the mean spacing of the points is below `DENSE_SPACING` pixels."""
    height, width = points.size
    return height * width < DENSE_SPACING**2 * len(points)
