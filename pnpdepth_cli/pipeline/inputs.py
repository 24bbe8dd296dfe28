"""What a frame is made of on disk, read and checked against each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnpdepth_cli.core.points import SparsePoints
from pnpdepth_cli.errors import InputError, NoPointsError, SizeError
from pnpdepth_cli.io.depth import DepthImage, describe_range, implausible, read_depth, read_sparse
from pnpdepth_cli.io.record import sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.pipeline.request import RefineRequest
from pnpdepth_cli.pipeline.scans import read_scan_points


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """One frame in memory.

    rgb: (H, W, 3) float32 in 0..1, or None without an image. points: in the image's frame.
    gt: (H, W) float32 metres, 0 = unknown, or None. sparse_scale: of an integer sparse file.
    """

    rgb: NDArray[np.float32] | None
    points: SparsePoints
    gt: NDArray[np.float32] | None
    sparse_scale: float | None
    record: dict[str, Any]
    notes: tuple[str, ...]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the image frame."""
        return self.points.size

    def rgb_tensor(self) -> Tensor | None:
        """(1, 3, H, W) float32 in 0..1."""
        if self.rgb is None:
            return None
        return torch.from_numpy(np.ascontiguousarray(self.rgb.transpose(2, 0, 1)))[None]


def read_inputs(files: RefineRequest) -> Inputs:
    """The frame of these files. InputError if one cannot be used or they do not fit together."""
    notes: list[str] = []
    record: dict[str, Any] = {}
    rgb = None
    if files.image is not None:
        image = read_rgb(files.image)
        rgb = image.values
        record["image"] = _file_record(files.image)
        notes += [f"image: {image.note}"] if image.note else []
    image_size = None if rgb is None else (rgb.shape[0], rgb.shape[1])
    is_scan = files.scan.describes(files.sparse)
    sparse = _read_scan(files, image_size) if is_scan else _read_points(files, image_size)
    record["sparse"] = sparse.record
    notes += sparse.notes
    gt = None
    if files.gt is not None:
        truth = read_depth(
            files.gt, scale=files.gt_scale or files.depth_scale, channel=files.channel
        )
        gt = _checked_gt(files.gt, truth, sparse.points.size)
        record["gt"] = _file_record(files.gt) | {"read_as": truth.source}
        assumed = truth.assumed_scale
        said = describe_range(truth.values, truth.source, assumed_scale=assumed, noun="pixels")
        notes.append(f"gt: {said}")
    return Inputs(
        rgb=rgb,
        points=sparse.points,
        gt=gt,
        sparse_scale=sparse.scale,
        record=record,
        notes=tuple(notes),
    )


def _file_record(path: Path) -> dict[str, Any]:
    return {"path": str(path), "sha256": sha256_of(path)}


@dataclass(frozen=True, kw_only=True)
class _Sparse:
    """Points in the image's frame, the scale of their integer file, and what is said of them."""

    points: SparsePoints
    scale: float | None
    record: dict[str, Any]
    notes: tuple[str, ...]


def _read_scan(files: RefineRequest, image_size: tuple[int, int] | None) -> _Sparse:
    scan = read_scan_points(files.sparse, files.scan, image_size, files.image)
    points = SparsePoints(
        xy=torch.from_numpy(scan.points.xy),
        depth=torch.from_numpy(scan.points.depth),
        size=scan.points.size,
    )
    return _Sparse(points=points, scale=None, record=scan.record, notes=scan.notes)


def _read_points(files: RefineRequest, image_size: tuple[int, int] | None) -> _Sparse:
    sparse = read_sparse(files.sparse, scale=files.depth_scale, channel=files.channel)
    size = image_size or sparse.size
    if size is None:
        raise SizeError(
            f"{files.sparse} is a list of points, which needs an image to say the frame's size"
        )
    points = _points_in_image(files, sparse.xy, sparse.depth, sparse.size, size)
    notes = [
        f"sparse: {describe_range(sparse.depth, sparse.source, assumed_scale=sparse.assumed_scale)}"
    ]
    if len(points) < len(sparse.depth):
        notes.append(f"sparse: {len(sparse.depth) - len(points):,} points outside the image")
    notes += [f"warning: {text}" for text in [implausible(sparse.depth, sparse.scale)] if text]
    return _Sparse(
        points=points,
        scale=sparse.scale,
        record=_file_record(files.sparse) | {"read_as": sparse.source},
        notes=tuple(notes),
    )


def _points_in_image(
    files: RefineRequest,
    xy: NDArray[np.float32],
    depth: NDArray[np.float32],
    sparse_size: tuple[int, int] | None,
    size: tuple[int, int],
) -> SparsePoints:
    sparse_size = sparse_size or size
    if sparse_size != size and not files.sparse_size_ok:
        raise SizeError(
            f"{files.sparse} is {sparse_size[1]}×{sparse_size[0]} but {files.image} is"
            f" {size[1]}×{size[0]}; --sparse-size-ok maps the points if both show the same view"
        )
    points = SparsePoints(
        xy=torch.from_numpy(xy), depth=torch.from_numpy(depth), size=sparse_size
    ).in_frame(*size)
    x, y = points.xy[:, 0], points.xy[:, 1]
    inside = (x >= -0.5) & (x < size[1] - 0.5) & (y >= -0.5) & (y < size[0] - 0.5)
    if not bool(inside.any()):
        raise NoPointsError(f"{files.sparse}: none of its {len(points)} points lies in the image")
    return points.select(inside)


def _checked_gt(path: Path, truth: DepthImage, size: tuple[int, int]) -> NDArray[np.float32]:
    if truth.values.shape != size:
        height, width = truth.values.shape
        raise SizeError(
            f"ground truth {path} is {width}×{height} but the image is {size[1]}×{size[0]}"
        )
    if not bool((truth.values > 0).any()):
        raise InputError(f"ground truth {path} has no pixel with known depth")
    return truth.values
