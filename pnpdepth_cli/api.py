"""The public Python API: arrays in, arrays out. Import its names from `pnpdepth_cli`."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from pnpdepth_cli.core.metrics import DELTA_THRESHOLDS, Scores
from pnpdepth_cli.core.metrics import score as score_tensors
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import DivergedError, InputError, NoPointsError, SizeError
from pnpdepth_cli.models import network as networks
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, registration_of
from pnpdepth_cli.pipeline.refinement.load_refiner import refiner_of
from pnpdepth_cli.pipeline.refinement.refiner import Opened
from pnpdepth_cli.pipeline.refinement.refiner import Refiner as FrameRefiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_definition
from pnpdepth_cli.points import SparsePoints

if TYPE_CHECKING:
    from typing_extensions import Unpack

FULL_SCALE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}
"""Value of white by the type of an image's integers."""


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A refined frame, in the frame of its image."""

    depth: NDArray[np.float32]
    """Refined depth (H, W), metres; 0 where unknown."""
    before: NDArray[np.float32]
    """Depth (H, W) before refinement, metres; 0 where unknown."""
    sigma: NDArray[np.float32] | None
    """Standard deviation of `depth` (H, W), metres; None unless asked for."""
    losses: tuple[float, ...]
    """Loss at the points before the first update and after each update."""
    notes: tuple[str, ...]
    """What was assumed or decided, and warnings."""


def load_network(
    spec: str = "compact",
    checkpoint: str | Path | None = None,
    *,
    device: str = "cpu",
    precision: str = "fp32",
) -> Network:
    """Returns a network in eval mode with its weights.

    Args:
        spec: A name of `pnpdepth models`, an ONNX or torch.export file, a Hugging Face folder, or a
            Python file (which is run), as `--model` of the command line.
        checkpoint: Weights. None takes those of the network's definition.
        device: torch device, such as "cpu" or "cuda:1".
        precision: "fp32", "bf16" or "fp16" for convolutions and matrix products.

    Raises:
        ModelError: There is no such network, or it cannot be built.
        CheckpointError: The weights cannot be read or do not fit.
        DeviceError: The device cannot be used.
    """
    path = None if checkpoint is None else Path(checkpoint)
    return networks.load_network(spec, path, device, precision=precision)


class RefinerOptions(TypedDict, total=False):
    """The options of `Refiner`, each by keyword."""

    layer: str | None
    """Layer to cut at. None takes the one that fits the spacing of the points."""
    settings: RefineSettings | None
    """What is updated and how. None takes the network's defaults for the target."""
    target: str
    """"given", or "masked" to update weights by points hidden from the network's input."""
    propagate: str | None
    """Propagation of the residuals at the points: "none", "gp" or "diffusion". None is "none" with
    another option of the method, which is `layer`, `settings`, `target` or `tile`."""
    uncertainty: bool
    """Also estimate the standard deviation of the depth."""
    tile: int | None
    """Refine larger frames in tiles of this side length, pixels."""
    seed: int
    """Of the hidden points and the masks."""
    registration: str | tuple[float, float, float]
    """Whether the image is moved into the frame of the points: "auto", if their depth edges show
    that it is not registered; "off"; or by (zoom, right, down), pixels."""


class Refiner:
    """Refines frames with one network, which stays cut open from frame to frame.

    A context manager; the network is as before when it closes. What the definition of the network
    leaves open (such as the RGB range of an ONNX file) is decided by the first frame.

    Args:
        network: From `load_network`.
        **options: See `RefinerOptions`.

    Raises:
        TypeError: There is no option of this name.
    """

    def __init__(self, network: Network, **options: Unpack[RefinerOptions]) -> None:
        if unknown := options.keys() - RefinerOptions.__annotations__.keys():
            raise TypeError(f"a Refiner has no options {', '.join(sorted(unknown))}")
        self._network = network
        self._settings = options.pop("settings", None)
        if self._settings is not None:
            options.setdefault("propagate", "none")  # an option of the method fixes it
        self._request = RefineRequest.from_fields(**options)
        self._open = ExitStack()
        self._opened: tuple[FrameRefiner, Opened] | None = None

    def __enter__(self) -> Refiner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Restores the network."""
        self._opened = None
        self._open.close()

    def refine(self, image: ArrayLike | None, sparse: ArrayLike | SparsePoints) -> Refined:
        """Returns the refined depth of one frame.

        Args:
            image: RGB (H, W, 3), uint8, uint16, or float in 0..1. None for a network that takes
                sparse depth only.
            sparse: Depth map (H, W) in metres with 0 for unknown, rows (N, 3) of x, y and depth
                (pixel centres at whole numbers), or SparsePoints.

        Raises:
            InputError: Image or points cannot be used.
            DivergedError: The loss became non-finite; `last_good` is the Refined before that.
        """
        inputs = replace(_inputs(image, sparse), registration=registration_of(self._request))
        if self._opened is None:
            refiner = self._resolve(inputs)
            opened = refiner.opened()
            self._open.enter_context(opened)
            self._opened = refiner, opened
        refiner, opened = self._opened
        frame = refiner.refine(opened, inputs)
        refined = Refined(
            depth=frame.after,
            before=frame.before,
            sigma=frame.sigma,
            losses=frame.refinement.losses,
            notes=tuple(note for note in (*refiner.network.notes, *frame.notes) if note),
        )
        if frame.diverged is not None:
            raise DivergedError(str(frame.diverged), refined)
        return refined

    def _resolve(self, inputs: Inputs) -> FrameRefiner:
        network = resolve_definition(self._network, inputs.frame(), self._request.network)
        return refiner_of(self._request, [network], inputs, settings=self._settings)


def refine(
    network: Network,
    image: ArrayLike | None,
    sparse: ArrayLike | SparsePoints,
    **options: Unpack[RefinerOptions],
) -> Refined:
    """Returns the refined depth of one frame.

    Args:
        network: From `load_network`.
        image: As of `Refiner.refine`.
        sparse: As of `Refiner.refine`.
        **options: As of `Refiner`.

    Raises:
        InputError: Image or points cannot be used.
        DivergedError: As of `Refiner.refine`.
    """
    with Refiner(network, **options) as refiner:
        return refiner.refine(image, sparse)


def score(
    depth: ArrayLike,
    ground_truth: ArrayLike,
    *,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
) -> Scores:
    """Returns the errors of a depth map at all pixels with known ground truth and known depth.

    Args:
        depth: Predicted depth, any shape, metres.
        ground_truth: Ground truth of the same shape, metres. Zero, negative and non-finite values
            are unknown, in both.
        thresholds: Of δ1, δ2 and δ3.

    Raises:
        SizeError: The shapes differ.
    """
    arrays = [np.asarray(values, dtype=np.float32) for values in (depth, ground_truth)]
    if arrays[0].shape != arrays[1].shape:
        raise SizeError(f"depth is {arrays[0].shape} but ground truth is {arrays[1].shape}")
    predicted, known = (torch.from_numpy(values) for values in arrays)
    return score_tensors(predicted, known, thresholds)


def _inputs(image: ArrayLike | None, sparse: ArrayLike | SparsePoints) -> Inputs:
    """Returns the frame as the pipeline has it after reading its files."""
    rgb = None if image is None else _rgb(image)
    size = None if rgb is None else (rgb.shape[0], rgb.shape[1])
    points = _points(sparse, size).resized(*size) if size else _points(sparse, None)
    inside = points.cropped(0, 0, *points.size)
    if not len(inside):
        raise NoPointsError(f"none of the {len(points)} sparse points lies in the image")
    return Inputs(rgb=rgb, points=inside, gt=None, sparse_scale=None, record={}, notes=())


def _rgb(image: ArrayLike) -> NDArray[np.float32]:
    values = np.asarray(image)
    if values.ndim != 3 or values.shape[2] != 3:
        raise InputError(f"an image has shape (H, W, 3), not {values.shape}")
    if values.dtype in FULL_SCALE:
        return (values / FULL_SCALE[values.dtype]).astype(np.float32)
    if values.dtype.kind != "f" or not (values >= 0).all() or not (values <= 1).all():
        raise InputError(
            f"an image is uint8, uint16 or float in 0..1; this one is {values.dtype} in"
            f" {values.min()}..{values.max()}"
        )
    return values.astype(np.float32)


def _points(sparse: ArrayLike | SparsePoints, size: tuple[int, int] | None) -> SparsePoints:
    """Returns the points in their own frame, which is the image's for rows of x, y, depth."""
    if isinstance(sparse, SparsePoints):
        return sparse.tensors()
    values = np.asarray(sparse, dtype=np.float32)
    if values.ndim != 2:
        raise InputError(f"sparse depth has shape (H, W) or (N, 3), not {values.shape}")
    if values.shape[1] == 3 and values.shape != size:
        if size is None:
            raise SizeError("rows of x, y and depth need an image for the size of the frame")
        known = np.isfinite(values).all(axis=1) & (values[:, 2] > 0)
        xy, depth = values[known, :2], values[known, 2]
    else:
        if size is not None and values.shape != size:
            raise SizeError(f"the sparse depth map is {values.shape} but the image is {size}")
        size = (values.shape[0], values.shape[1])
        rows, columns = np.nonzero(np.isfinite(values) & (values > 0))
        xy = np.stack([columns, rows], axis=1).astype(np.float32)
        depth = values[rows, columns]
    if not len(depth):
        raise NoPointsError("the sparse depth has no value above 0")
    return SparsePoints(xy=xy, depth=depth, size=size).tensors()
