"""The ground truth of a frame: made of what its file holds, and compared with the sparse depth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.completion.two_depths import compare_depths
from pnpdepth_cli.dataset import arrays, stored_depth
from pnpdepth_cli.dataset.agreement import check_order, unit_warning
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions, inverse_factor
from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.dataset.scan_points import read_scan_points
from pnpdepth_cli.dataset.sparse_depth import SparseDepth
from pnpdepth_cli.dataset.stored_depth import StoredNumbers, StoredPoints
from pnpdepth_cli.dataset.stored_frame import NotedFile, StoredFrame, rgb_of_file
from pnpdepth_cli.errors import InputError, UsageError, unequal_sizes
from pnpdepth_cli.io.depth import depth_from_stored, describe_range
from pnpdepth_cli.io.formats import DepthFile, Reading, check_scale
from pnpdepth_cli.points import METRES, Size, SparsePoints
from pnpdepth_cli.sensors.projection import as_depth_image

_LEAK_FRACTION = 0.5
"""Fraction of the ground truth's pixels that are the sparse depth, from which there is a warning.
KITTI's ground truth holds the points of its own scan by design, which is less than half of it."""


class GroundTruth(NamedTuple):
    """The ground truth of a frame, interpreted."""

    values: NDArray[np.float32]
    """(H, W) metres, 0 = unknown."""
    reading: Reading
    source: NotedFile

    @property
    def size(self) -> Size:
        """(H, W)."""
        return self.values.shape[0], self.values.shape[1]


def read_ground_truth(
    files: FrameFiles, options: ReadOptions, stored: StoredFrame
) -> GroundTruth | None:
    """The ground truth, of the image's size: a projected scan, or a depth map."""
    if stored.truth is None:
        return None
    if isinstance(stored.truth, StoredPoints):
        truth = _truth_of_scan(files, options, stored, stored.truth.path)
    else:
        truth = _truth_of_map(files, options, stored, stored.truth)
    if stored.size is not None and stored.size != truth.size:
        raise unequal_sizes(f"ground truth {files.gt}", truth.size, "the image", stored.size)
    if not (truth.values > 0).any():
        raise InputError(
            f"ground truth {files.gt} has no pixel with known depth; give another one, or none"
        )
    return truth


def _truth_of_scan(
    files: FrameFiles, options: ReadOptions, stored: StoredFrame, path: Path
) -> GroundTruth:
    """The ground truth that the points of a scan are, projected into the image."""
    if files.kind_of_gt is not None:
        raise UsageError(f"{path} is a scan, so gt_kind does not apply; leave it out")
    stated = stored_depth.scale_of_truth(files, options, stored.sparse)
    scan = read_scan_points(
        path,
        options.scan.over(files),
        stored.size,
        files.image_file,
        rgb=rgb_of_file(files, stored),
        scale=stated.scale,
        of_integers=stated.of_integers,
    )
    notes = [note.replace("sparse:", "gt:", 1) for note in scan.notes]
    return GroundTruth(as_depth_image(scan.points), scan.reading, NotedFile(scan.record, notes))


def _truth_of_map(
    files: FrameFiles, options: ReadOptions, stored: StoredFrame, truth: StoredNumbers
) -> GroundTruth:
    """The ground truth of a depth map, in metres, without what masks and checks rule out."""
    # The numbers by their scale.
    stated = stored_depth.scale_of_truth(files, options, stored.sparse)
    scale = stated.scale
    depth = _map_by_scale(truth, scale)
    if options.depth_scale is not None and stored.sparse and stored_depth.is_float(stored.sparse):
        # The option is of the floats beside the map, unless the map has no scale of its own.
        by_layout = _map_by_scale(truth, files.gt_scale)
        if not by_layout.reading.assumed:
            depth = by_layout
    # Numbers of another kind than depth, as the user states.
    factor = inverse_factor("gt_kind", files.kind_of_gt)
    if factor is not None:
        depth = arrays.depth_of_inverse(depth, factor, scale)
        scale = None  # these are metres now
    # Pixels that a mask or the gate rules out are unknown.
    values = arrays.apply_masks(depth.values, files.masks)
    if files.gt_other_size and stored.size is not None and values.shape != stored.size:
        values = arrays.move_depth(truth.path, values, stored.size)
    option = "--depth-scale" if stored.sparse is None else _gt_scale_option(files)
    values, notes = plausible_map(
        values, depth.reading, "gt", option, scale, of_integers=stated.of_integers
    )
    described = describe_range(values, depth.reading, noun="pixels", option=option)
    record = arrays.record_of(truth.path, depth.reading)
    return GroundTruth(values, depth.reading, NotedFile(record, [f"gt: {described}", *notes]))


def _map_by_scale(stored: StoredNumbers, scale: float | None) -> DepthFile:
    """The map in metres, if its integers have this scale; None is the file's own."""
    check_scale(scale)
    return depth_from_stored(stored.path, stored.file, scale)


def compare_with_sparse(
    files: FrameFiles,
    options: ReadOptions,
    gt: NDArray[np.float32],
    reading: Reading,
    sparse: SparseDepth,
    points: SparsePoints,
) -> list[str]:
    """Warnings on ground truth and sparse depth that seem to be of two scales, or one."""
    if sparse.unit != METRES:
        raise UsageError(
            f"the ground truth {files.gt} is in metres but the sparse depth in {sparse.unit}; give"
            " --unit-scale, or leave out --gt"
        )
    if files.sparse is None:
        # No file beside the ground truth decides a scale that is assumed.
        if not reading.assumed:
            return []
        return [
            f"warning: the scale of the ground truth ({reading.source}) is assumed, and with it the"
            f" metres of all errors; --depth-scale 1000 if it holds millimetres, --depth-scale"
            f" {reading.scale:g} if it is right"
        ]
    notes = list[str]()
    depth = points.scatter()[0, 0].numpy()
    known = int((gt > 0).sum())
    leaked = int(((gt > 0) & (depth == gt)).sum())
    if leaked >= _LEAK_FRACTION * known:
        notes.append(
            f"warning: {leaked:,} of {known:,} pixels ({leaked / known:.1%}) of the ground truth"
            " are the sparse depth itself, so errors against it show nothing; give another --gt,"
            " or keep points out with --holdout"
        )
    # Their order, and then their ratio.
    both = f"the sparse depth and the ground truth {files.gt}"
    if (reversed_order := check_order(both, depth, gt)) is not None:
        if options.sparse_kind is files.kind_of_sparse is files.kind_of_gt is None:
            raise InputError(reversed_order)
        return [*notes, f"warning: {reversed_order}"]
    by_option = {"--depth-scale": sparse.reading, _gt_scale_option(files): reading}
    warning = unit_warning("sparse points", compare_depths(depth, gt), by_option)
    return notes if warning is None else [*notes, warning]


def _gt_scale_option(files: FrameFiles) -> str:
    """What sets the scale of ground truth beside sparse depth; `refine` names no frame."""
    return "gt_scale of a list" if files.name else "--depth-scale (of both files)"
