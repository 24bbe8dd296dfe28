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
from pnpdepth_cli.points import METRES, Size
from pnpdepth_cli.sensors.projection import as_depth_image

_LEAK_FRACTION = 0.5
"""Fraction of the ground truth's pixels that are the sparse depth, from which there is a warning.
KITTI's ground truth holds the points of its own scan by design, which is less than half of it."""


class GroundTruth(NamedTuple):
    """The ground truth of a whole frame, interpreted."""

    depth: NDArray[np.float32]
    """(H, W) metres, 0 = unknown."""
    reading: Reading
    """How its file was read."""
    source: NotedFile
    """What a record keeps of its file, and lines on it."""

    @property
    def size(self) -> Size:
        """(H, W)."""
        return self.depth.shape[0], self.depth.shape[1]


def read_ground_truth(
    files: FrameFiles, options: ReadOptions, stored: StoredFrame
) -> GroundTruth | None:
    """Returns the ground truth, of the image's size: a projected scan, or a depth map.

    Args:
        files: The files of the frame.
        options: Options of reading, such as scales.
        stored: What the files hold.

    Returns:
        None without ground truth.

    Raises:
        InputError: It has no known depth, implausible depth, or another size than the image.
        UsageError: An option does not apply to its file.
    """
    if stored.truth is None:
        return None
    if isinstance(stored.truth, StoredPoints):
        truth = _truth_of_scan(files, options, stored, stored.truth.path)
    else:
        truth = _truth_of_map(files, options, stored, stored.truth)
    if stored.size is not None and stored.size != truth.size:
        raise unequal_sizes(f"ground truth {files.gt}", truth.size, "the image", stored.size)
    if not (truth.depth > 0).any():
        raise InputError(
            f"ground truth {files.gt} has no pixel with known depth; give another one, or none"
        )
    return truth


def _truth_of_scan(
    files: FrameFiles, options: ReadOptions, stored: StoredFrame, path: Path
) -> GroundTruth:
    """The ground truth that the points of a scan are, projected into the image.

    Args:
        files: The files of the frame.
        options: Options of reading, with the calibration.
        stored: What the files hold.
        path: The scan.
    """
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
    # A scan's lines call it sparse depth.
    notes = [note.replace("sparse:", "gt:", 1) for note in scan.notes]
    return GroundTruth(as_depth_image(scan.points), scan.reading, NotedFile(scan.record, notes))


def _truth_of_map(
    files: FrameFiles, options: ReadOptions, stored: StoredFrame, truth: StoredNumbers
) -> GroundTruth:
    """The ground truth of a depth map, in metres, 0 where masks and checks rule it out.

    Args:
        files: The files of the frame, with the kind and the masks of the map.
        options: Options of reading, such as scales.
        stored: What the files hold.
        truth: The map, as it is stored.
    """
    # The numbers by their scale.
    stated = stored_depth.scale_of_truth(files, options, stored.sparse)
    scale = stated.scale
    map_file = _map_by_scale(truth, scale)
    if options.depth_scale is not None and stored.sparse and stored_depth.is_float(stored.sparse):
        # `--depth-scale` is of both files, unless the map's own file or the data set states another
        # scale for the map: then it is of the floats of the sparse depth.
        by_layout = _map_by_scale(truth, files.gt_scale)
        if not by_layout.reading.assumed:
            map_file = by_layout
    # Numbers of another kind than depth, as the user states.
    factor = inverse_factor("gt_kind", files.kind_of_gt)
    if factor is not None:
        map_file = arrays.depth_of_inverse(map_file, factor, scale)
        scale = None  # the numbers are metres by now
    # Pixels that a mask or the checks of `plausible_map` rule out are unknown. Where the data set
    # says that depth has another size than the image, it goes to the image's pixels.
    depth = arrays.apply_masks(map_file.values, files.masks)
    if files.gt_other_size and stored.size is not None and depth.shape != stored.size:
        depth = arrays.move_depth(truth.path, depth, stored.size)
    option = "--depth-scale" if stored.sparse is None else _gt_scale_option(files)
    depth, notes = plausible_map(
        depth, map_file.reading, "gt", option, scale, of_integers=stated.of_integers
    )
    described = describe_range(depth, map_file.reading, noun="pixels", option=option)
    record = arrays.record_of(truth.path, map_file.reading)
    source = NotedFile(record, [f"gt: {described}", *notes])
    return GroundTruth(depth, map_file.reading, source)


def _map_by_scale(stored: StoredNumbers, scale: float | None) -> DepthFile:
    """The depth map (H, W) of a file in metres, 0 where unknown.

    Args:
        stored: The file, and the numbers in it.
        scale: Codes per metre of its integers. None: those that the file states, else usual ones.
            Floats are metres.
    """
    check_scale(scale)
    return depth_from_stored(stored.path, stored.file, scale)


def compare_with_sparse(
    files: FrameFiles,
    options: ReadOptions,
    gt: NDArray[np.float32],
    reading: Reading,
    sparse: SparseDepth,
) -> list[str]:
    """Returns warnings if ground truth and sparse depth contradict each other, or are the same.

    Args:
        files: The files of the frame.
        options: Options of reading. If the kind of a file is stated, such as disparity, opposite
            orders are a warning and no error.
        gt: (H, W) metres, 0 = unknown: the ground truth of the part of the frame that is used.
        reading: How the ground truth was read.
        sparse: The sparse depth of that part.

    Raises:
        InputError: Their orders are opposite, or their ratio is that of two units.
        UsageError: The sparse depth is not in metres.
    """
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
    # Whether the ground truth is the sparse depth itself.
    notes = list[str]()
    sparse_map = sparse.points.tensors().scatter()[0, 0].numpy()  # (H, W), 0 where no point is
    known = int((gt > 0).sum())
    leaked = int(((gt > 0) & (sparse_map == gt)).sum())
    if leaked >= _LEAK_FRACTION * known:
        notes.append(
            f"warning: {leaked:,} of {known:,} pixels ({leaked / known:.1%}) of the ground truth"
            " are the sparse depth itself, so errors against it show nothing; give another --gt,"
            " or keep points out with --holdout"
        )
    # Their order, and then their ratio.
    both = f"the sparse depth and the ground truth {files.gt}"
    reversed_order = check_order(both, sparse_map, gt)
    if reversed_order is not None:
        kinds = (options.sparse_kind, files.kind_of_sparse, files.kind_of_gt)
        if all(kind is None for kind in kinds):
            raise InputError(reversed_order)
        return [*notes, f"warning: {reversed_order}"]
    by_option = {"--depth-scale": sparse.reading, _gt_scale_option(files): reading}
    warning = unit_warning("sparse points", compare_depths(sparse_map, gt), by_option)
    if warning is not None:
        notes.append(warning)
    return notes


def _gt_scale_option(files: FrameFiles) -> str:
    """What sets the scale of ground truth beside sparse depth: a list's column or an option.

    A frame of `refine` has no name, and no list.
    """
    return "gt_scale of a list" if files.name else "--depth-scale (of both files)"
