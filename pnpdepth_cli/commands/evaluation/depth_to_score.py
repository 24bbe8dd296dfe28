"""Reads what is scored: ground truth, prediction, and the pixels of the sparse depth of a frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.commands.shared.results import ResultFrame
from pnpdepth_cli.dataset.arrays import (
    apply_masks,
    camera_of_file,
    depth_of_inverse,
    raw_depth,
    read_image,
)
from pnpdepth_cli.dataset.frame_files import FrameFiles, inverse_factor
from pnpdepth_cli.dataset.plausible import OF_DATA_SET, plausible_map
from pnpdepth_cli.errors import InputError, unequal_sizes
from pnpdepth_cli.io.depth import depth_from_stored, known_metres, load_stored
from pnpdepth_cli.io.formats import DepthFile, Reading
from pnpdepth_cli.io.point_files import read_sparse
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.lens import rays_of_image
from pnpdepth_cli.sensors.projection import pixel_index
from pnpdepth_cli.sensors.simulation import sample_points

Depth = NDArray[np.float32]
"""(H, W) metres, 0 where unknown, unless said otherwise."""
Mask = NDArray[np.bool_]
"""(H, W)."""
Size = tuple[int, ...]
"""(H, W)."""

_LEAST_WEIGHT = 0.5
"""Weight of known pixels in a resized pixel above which that one is known: more than half."""


class DepthToScore(NamedTuple):
    """A depth map that was read to be scored."""

    values: Depth  # (H, W) metres, 0 = unknown; of a relative prediction in its own numbers
    reading: Reading  # format of the file, and the scale of its integers
    notes: list[str]  # lines for a person
    added: float = 0.0
    """What was added to all numbers to make them positive, which the fit of a shift removes."""


def read_truth(frame: FrameFiles, result: ResultFrame, request: EvalRequest) -> DepthToScore:
    """Returns the ground truth (H, W) in metres, in the part of the frame that is used.

    Args:
        frame: The files of the frame, and how a data set says that they are read.
        result: The frame's prediction, whose record may hold the camera.
        request: What the user says of the ground truth, over what the data set says.

    Raises:
        InputError: There is no ground truth, it is implausible, or its camera is not known.
    """
    if frame.gt is None:
        raise InputError(f"frame {frame.name} has no ground truth to score against; add it")
    # Its numbers: of a file without a header, which its length tells, or of any other format.
    scale = frame.gt_scale if request.gt_scale is None else request.gt_scale
    file = raw_depth(frame.gt, frame.image)
    if file is None:
        file = _read_depth(frame.gt, scale, request)
    # Disparity or 1/depth, if the user or the data set says so, becomes metres without a scale.
    kind = request.gt_kind or frame.kind_of_gt
    factor = inverse_factor("--gt-kind", kind)
    if factor is not None:
        file = depth_of_inverse(file, factor, scale)
        scale = None
    # Depth in metres, which `plausible_map` checks; then the part that is used.
    reading = file.reading
    masked = apply_masks(file.values, frame.masks)
    # A scale that only the layout knows may not be of these very numbers.
    is_scale_of_layout = request.gt_scale is None and not frame.scales_stated
    depth, notes = plausible_map(
        masked,
        reading,
        "gt",
        "--gt-scale",
        scale,
        of_integers=OF_DATA_SET if is_scale_of_layout else "",
    )
    gt = np.ascontiguousarray(frame.part.apply(depth))
    if request.gt_range:
        gt = _depth_of_distances(gt, frame, result, (depth.shape[0], depth.shape[1]))
        reading = reading._replace(source=f"{reading.source}, distances")
    return DepthToScore(gt, reading, notes)


def _depth_of_distances(
    distances: Depth, files: FrameFiles, result: ResultFrame, whole: tuple[int, int]
) -> Depth:
    """The depth z (H, W) of points at these distances from the camera, 0 where unknown.

    The camera is that of the data set, else of the prediction's record.

    Args:
        distances: (H, W) metres in the part of the frame that is used, 0 where unknown.
        files: The files of the frame, with its calibration if there is one.
        result: The frame's prediction.
        whole: (H, W) of the whole frame, to which a calibration belongs.

    Raises:
        InputError: Neither data set nor record has a camera, or the record's is of another size.
    """
    # A calibration is of the whole frame. A record's camera is of the prediction's pixels, so it
    # fits only ground truth of that size.
    size = (distances.shape[0], distances.shape[1])
    camera = None
    if files.calib is not None:
        camera_of_whole, _ = camera_of_file(files.calib, files.camera, whole, files.image_file)
        camera = files.part.camera_in_crop(camera_of_whole, whole)
    elif result.size == size:
        camera, _ = result.camera_and_pose
    if camera is None:
        raise InputError(
            f"--gt-range needs a camera, but frame {files.name} has none in the data set or the"
            " record beside the prediction; add the column calib to a list"
        )
    # A pixel's point is z · (x, y, 1) for its ray (x, y), so its distance is z · √(x² + y² + 1).
    rays = rays_of_image(camera, size)
    return known_metres(distances / np.sqrt(1 + (rays**2).sum(axis=2)))


def read_prediction(path: Path, size: Size, request: EvalRequest) -> DepthToScore:
    """Returns the prediction at the ground truth's size, 0 where unknown.

    Args:
        path: The depth file.
        size: (H, W) of the ground truth.
        request: What the user says of predictions: their scale, and whether they are resized.

    Raises:
        InputError: It has another size, and is not to be resized.
    """
    file = _read_depth(path, request.pred_scale, request)
    values = file.values
    notes = list[str]()
    # In a prediction that is known up to scale and shift, numbers below 0 are values. They are made
    # positive, as 0 stands for unknown.
    added = 0.0
    stored = load_stored(path).values
    if request.scale_by.startswith("affine") and stored.shape == values.shape:
        is_number = np.isfinite(stored)
        least = float(stored[is_number].min(initial=0))
        if least < 0:
            added = 1 - least
            values = np.where(is_number, stored + added, 0).astype(np.float32)
            notes.append(f"{path}: numbers of 0 and below are values, as --scale-by fits a shift")
    # Integers are divided by the scale already; floats, whose file has none, are divided here.
    if file.reading.scale is None and request.pred_scale is not None:
        values = values / np.float32(request.pred_scale)
        source = f"{file.reading.source} ÷ {request.pred_scale:g}"
        file = replace(file, reading=file.reading._replace(source=source))
    # The ground truth's size.
    if values.shape != size and not request.resize:
        raise unequal_sizes(
            f"prediction {path}",
            values.shape,
            "the ground truth",
            size,
            "; --resize scales predictions if both show the same view",
        )
    if values.shape != size:
        # Only known pixels count: the interpolated depth, in which unknown ones are 0, is divided
        # by the interpolated fraction of known ones.
        is_known = (values > 0).astype(np.float32)
        total, weight = (cv2.resize(image, (size[1], size[0])) for image in (values, is_known))
        values = np.where(
            weight > _LEAST_WEIGHT, total / np.maximum(weight, _LEAST_WEIGHT), np.float32(0)
        )
    return DepthToScore(values, file.reading, notes, added)


def _read_depth(path: Path, scale: float | None, request: EvalRequest) -> DepthFile:
    """The depth (H, W) in a file, 0 where unknown.

    Args:
        path: The depth file.
        scale: Codes per metre of integers that the user or the data set states. None: the file's
            own, else the protocol's.
        request: The rules.
    """
    stored = load_stored(path)
    is_integer = stored.values.dtype.kind != "f"
    is_assumed = scale is None and stored.reading.scale is None and is_integer
    image = depth_from_stored(path, stored, request.rules.scale if is_assumed else scale)
    if request.is_devkit and image.reading.scale is not None and stored.values.ndim == 2:
        # the development kit reads every code but 0 as a depth, the largest too
        image = replace(image, values=known_metres(stored.values / image.reading.scale))
    return replace(image, reading=image.reading._replace(assumed=is_assumed))


def pixels_with_points(frame: FrameFiles, result: ResultFrame, gt: Depth) -> Mask:
    """Returns (H, W) true at the pixels of the sparse depth that the network was given.

    Args:
        frame: The files of the frame, with its sparse depth if that is a file.
        result: The prediction, whose record says if the points were drawn from the ground truth.
        gt: (H, W) the ground truth.

    Raises:
        PnpDepthError: These points are not known, or are of another size.
    """
    size = (gt.shape[0], gt.shape[1])
    sparse = result.record.inputs.get("sparse")
    pattern = None if sparse is None else sparse.sampled
    # Points that were drawn from ground truth of this size are drawn again, with the same seed.
    if pattern is not None and result.size == size:
        image = None
        if pattern.kind == "features" and frame.image is not None:
            image = frame.part.apply(read_image(frame.image))
        xy = sample_points(gt, pattern, pattern.seed or 0, image=image).xy
    # Else they are in a file; one of the whole frame is cut to the part of it that is scored.
    elif frame.sparse is not None:
        points, _ = read_sparse(frame.sparse, size=size, scale=frame.sparse_scale)
        size_of_file = points.size
        if size_of_file != size:
            points = frame.part.points_in_crop(points)
        if points.size != size:
            raise unequal_sizes(
                f"sparse depth {frame.sparse}", size_of_file, "the ground truth", size
            )
        xy = points.xy
    else:
        raise InputError(
            f"frame {frame.name} has no sparse depth file to exclude in the data set or the record"
            " beside the prediction; add it, or score without excluding it"
        )
    mask = np.zeros(size, bool)
    mask.flat[pixel_index(xy[in_frame(xy, size)], size)] = True
    return mask
