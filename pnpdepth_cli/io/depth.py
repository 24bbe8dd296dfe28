"""Depth images in files of every format, and how their numbers become metres."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.choices import FORMATS
from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io import formats
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import check_pixel_count, read_bytes, read_json
from pnpdepth_cli.io.formats import KITTI_SCALE, DepthFile, Reading, images

PNG = formats.DepthFormat(
    name="PNG",
    suffixes=(".png",),
    magic=(b"\x89PNG\r\n\x1a\n",),
    read=images.read_png,
    write=images.write_png,
    integer=True,
)
EXR = formats.DepthFormat(
    name="EXR",
    suffixes=(".exr",),
    magic=(b"v/1\x01",),
    read=images.read_exr,
    write=images.write_exr,
)
NPY = formats.DepthFormat(
    name="NPY",
    suffixes=(".npy",),
    magic=(b"\x93NUMPY",),
    read=formats.read_npy,
    write=formats.write_npy,
)
NPZ = formats.DepthFormat(
    name="NPZ",
    suffixes=(".npz",),
    magic=(b"PK\3\4", b"PK\5\6"),  # an archive with an array, and an empty one
    read=formats.read_npz,
    write=formats.write_npz,
)
PFM = formats.DepthFormat(
    name="PFM",
    suffixes=(".pfm",),
    magic=(b"Pf",),
    read=formats.read_pfm,
    write=formats.write_pfm,
)
TIFF = formats.DepthFormat(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    magic=(b"II*\0", b"MM\0*"),
    read=images.read_tiff,
    write=images.write_tiff,
)

DEPTH_SUFFIXES: tuple[str, ...] = tuple(
    suffix for depth_format in FORMATS.values() for suffix in depth_format.suffixes
)
"""The suffixes that depth can be written to; PNG holds integer codes, the others float32 metres."""

_OPEN3D_FILE = "intrinsic.json"
_WIDE = 2.4  # width over height, above which an image is cut for driving
_MANY_CODES = 1000  # known pixels of a map, below which nothing tells the order of their bytes
_ROUGHER = 3.0  # times; of maps of four sets, exchanged bytes are 40 times rougher
_NEAR_END = 64_000  # code that a sensor does not exceed
_LEAST_NEAR_END = 0.001  # fraction of the codes above it, from which on a map was stretched
_SMALLEST_DEVIATION = 1e-9  # in codes; avoids a division by 0 where all codes are equal

_FARTHEST_INDOORS_M = 40.0
"""Below it, a map read by KITTI's scale may be a room in millimetres: 40 m are 10.2 m then."""
_OTHER_SIZE_SCALE = 1000.0
"""Codes per metre of a map of another size than its image: of phones, ARKitScenes and ScanNet."""


def read_depth(path: Path, *, scale: float | None = None) -> DepthFile:
    """Returns the depth image in a file, (H, W) float32 metres, 0 where unknown.

    Zero, NaN, infinite and negative values are unknown, and so is the largest 16-bit code.

    Args:
        path: A file of any of `choices.FORMATS`, which its content tells.
        scale: Codes per metre of an integer file. None: as the file says, else as is usual. Float
            files hold metres and ignore it.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth image.
        UsageError: The scale is not above 0.
    """
    formats.check_scale(scale)
    return depth_from_stored(path, load_stored(path), scale)


def load_stored(path: Path, *, is_mask: bool = False) -> DepthFile:
    """Returns the one array in a depth file, as stored and of whatever shape.

    Args:
        path: The file.
        is_mask: Whether the file is a mask, whose values may be true and false.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth file.
    """
    data = read_bytes(path)
    depth_format = formats.format_of_content(data)
    if depth_format is None:
        kind = formats.kind_of(data)
        if kind is not None:
            raise formats.no_depth(path, f"an 8-bit {kind}")
        names = ", ".join(depth_format.name for depth_format in FORMATS.values())
        raise InputError(f"{path} is no depth file; give one of {names}")
    stored = depth_format.read(path, data)
    # Integers whose scale the file itself does not state may have it in a file beside it.
    if stored.values.dtype.kind in "iu" and stored.reading.scale is None:
        scale = _scale_beside(path)
        if scale is not None:
            source = f"{stored.reading.source}, depth_scale of {_OPEN3D_FILE}"
            stored = replace(stored, reading=Reading(source, scale))
    if stored.values.dtype.kind == "b" and not is_mask:
        raise InputError(f"{path} holds bool values; depth is float or integer")
    return stored


def _scale_beside(path: Path) -> float | None:
    """Codes per metre of a depth image, as Open3D's recorder of RealSense cameras states them.

    The recorder writes `depth/NUMBER.png`, `color/NUMBER.jpg` and `intrinsic.json`, which has
    `depth_scale` and the matrix of the camera. None for an image that does not lie so.

    Raises:
        InputError: The file states no scale that depth can have.
    """
    sidecar = path.parent.parent / _OPEN3D_FILE
    if path.parent.name != "depth" or not sidecar.is_file():
        return None
    content = read_json(sidecar)
    if not {"intrinsic_matrix", "depth_scale"} <= set(content):
        return None  # a file of another program
    scale = content["depth_scale"]
    if not isinstance(scale, (int, float)) or not 0 < scale < math.inf:
        raise InputError(f"{sidecar}: depth_scale {scale!r} is no number above 0; correct it")
    return float(scale)


def holds_integers(stored: DepthFile, *, of_scale: float | None = None) -> bool:
    """Returns whether stored numbers are integer codes, to which a scale applies.

    Args:
        stored: Numbers, as `point_files.load_numbers` returns them.
        of_scale: Codes per metre. Only integers whose file states this scale, or none, count then.
            None: all integers count.
    """
    if stored.values.dtype.kind not in "iu":
        return False
    return of_scale is None or stored.reading.scale in (None, of_scale)


def depth_from_stored(
    path: Path, stored: DepthFile, scale: float | None, size: tuple[int, int] | None = None
) -> DepthFile:
    """Returns the stored numbers as a depth image (H, W), float32 metres, 0 where unknown.

    Args:
        path: The file, for messages.
        stored: Numbers, as `load_stored` returns them.
        scale: Codes per metre of integers. None: those that the file states, else KITTI's, or
            millimetres if the numbers are not of the size of their image.
        size: (H, W) of their image. None: it is not known.

    Raises:
        InputError: The numbers are no image of one channel, or exceed the budget.
    """
    values = without_single_axes(stored.values)
    if values.ndim != 2:
        raise InputError(f"{path} has the shape {stored.values.shape}; a depth image is (H, W)")
    check_pixel_count(path, values.shape[1], values.shape[0])
    source = stored.reading.source
    negative_count = int(np.count_nonzero(np.less(values, 0)))
    negatives = f", {negative_count:,} pixels below 0 taken as unknown" if negative_count else ""
    # Floats are metres.
    if values.dtype.kind == "f":
        return DepthFile(values=known_metres(values), reading=Reading(source + negatives))
    # Integers are codes, of which so many are a metre: as the caller says, else as the file does,
    # else as is usual.
    _check_codes(path, values, is_stated=scale is not None)
    scale_of_file = stored.reading.scale
    assumed_scale = KITTI_SCALE if size in (None, values.shape) else _OTHER_SIZE_SCALE
    if values.shape[1] > _WIDE * values.shape[0]:  # no phone or depth camera has such images
        assumed_scale = KITTI_SCALE
    divisor = scale or scale_of_file or assumed_scale
    source += f" ÷ {divisor:.12g}"
    if scale is None and scale_of_file is not None:
        source += " (from the file)"
    elif scale_of_file not in (None, divisor):
        source += f" (not {scale_of_file:.12g}, as the file says)"
    # The largest code is no depth.
    is_saturated = values == formats.SATURATED_CODE
    if values.dtype == np.uint16 and is_saturated.any():
        count = int(is_saturated.sum())
        source += f", {count:,} pixels of value {formats.SATURATED_CODE} taken as unknown"
        values = np.where(is_saturated, 0, values)
    is_assumed = scale is None and scale_of_file is None
    depth = known_metres(values.astype(np.float64) / divisor)
    reading = Reading(source + negatives, divisor, assumed=is_assumed)
    return DepthFile(values=depth, reading=reading)


def without_single_axes(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Returns the array as (H, W) if all its other axes, first or last, have length 1.

    Networks give depth as (1, H, W), (H, W, 1) or (1, 1, H, W). Any other array of more than two
    axes keeps some of them.
    """
    while values.ndim > 2 and 1 in (values.shape[0], values.shape[-1]):
        values = values[0] if len(values) == 1 else values[..., 0]
    return values


def _check_codes(path: Path, values: NDArray[np.generic], *, is_stated: bool) -> None:
    """Raises InputError for 16-bit codes whose bytes are exchanged, or that are normalised.

    Codes that reach the largest one without a gap were stretched to 16 bits, and are no depth
    unless a scale is stated.

    Args:
        path: The file, for messages.
        values: Integers (H, W), 0 where unknown.
        is_stated: Whether the caller states a scale.
    """
    check_byte_order(path, values)
    codes = _known_codes(values)
    if codes is None or is_stated:
        return
    # A sensor has a gap between its farthest depth and the largest code, which means unknown.
    near_end = int(np.count_nonzero(codes > _NEAR_END))
    at_end = int(np.count_nonzero(values == formats.SATURATED_CODE))
    if at_end and near_end >= max(at_end, _LEAST_NEAR_END * len(codes)):
        raise InputError(
            f"{path}: its numbers reach {formats.SATURATED_CODE} without a gap, as those of a map"
            " that was normalised to 16 bits; save metres × a scale, or give the scale with"
            " --depth-scale"
        )


def check_byte_order(path: Path, values: NDArray[np.generic]) -> None:
    """Raises InputError for 16-bit codes whose two bytes are exchanged.

    Neighbours in a row are nearly alike, but not if their bytes are exchanged. Other numbers, and
    maps of few known pixels, pass.

    Args:
        path: The file, for messages.
        values: Numbers (H, W), 0 where unknown.
    """
    codes = _known_codes(values)
    if codes is not None and _roughness(codes) > _ROUGHER * _roughness(codes.byteswap()):
        raise InputError(
            f"{path}: its numbers are far smoother with their two bytes exchanged, so they were"
            " stored in the wrong order; save array.byteswap()"
        )


def _known_codes(values: NDArray[np.generic]) -> NDArray[np.uint16] | None:
    """(N,) the 16-bit codes of known depth, row by row.

    None for numbers that are no 16-bit codes, and for too few to tell anything of them.
    """
    if values.dtype != np.uint16:
        return None
    is_known = np.greater(values, 0) & np.less(values, formats.SATURATED_CODE)
    if np.count_nonzero(is_known) < _MANY_CODES:
        return None
    return np.asarray(values[is_known], np.uint16)


def _roughness(codes: NDArray[np.uint16]) -> float:
    """Mean absolute difference of successive codes, over the standard deviation of all codes.

    It is 0 if all codes are equal.
    """
    values = codes.astype(np.float64)
    return float(np.abs(np.diff(values)).mean() / (values.std() + _SMALLEST_DEVIATION))


def known_metres(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Returns a copy in float32 in which all that is no finite depth above 0 is 0.

    Args:
        values: Depth in metres, of any shape.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        metres = np.array(values, dtype=np.float32, order="C")
        metres[~(np.isfinite(metres) & (metres > 0))] = 0
    return metres


def write_depth(path: Path, depth: NDArray[np.float32], *, scale: float = KITTI_SCALE) -> None:
    """Writes depth in the format that the suffix names.

    Args:
        path: The file; it is replaced.
        depth: (H, W) metres. What is not finite or not above 0 is written as 0, unknown.
        scale: Codes per metre of a PNG, which states them as text. Other formats hold metres.

    Raises:
        OutputError: The suffix is unknown, the file cannot be written, or a depth is too large for
            16 bits or so small that it would become 0.
        InputError: The depth is not (H, W).
    """
    depth_format = formats.format_of_suffix(path)
    if depth.ndim != 2 or 0 in depth.shape:
        raise InputError(f"{path}: depth of shape {depth.shape} is no image; give (H, W)")
    metres_or_0 = known_metres(depth)
    values: NDArray[np.generic] = metres_or_0
    text = dict[str, str]()
    if depth_format.integer:
        values = _codes(path, metres_or_0, scale)
        text[formats.SCALE_KEY] = repr(float(scale)).removesuffix(".0")
    with atomic_path(path) as temporary:
        depth_format.write(temporary, values, text)


def _codes(path: Path, metres: NDArray[np.float32], scale: float) -> NDArray[np.uint16]:
    """The 16-bit codes (H, W) of depth, 0 where unknown.

    Args:
        path: The file to write, for messages.
        metres: (H, W) depth, 0 where unknown.
        scale: Codes per metre.

    Raises:
        OutputError: A depth is too large for 16 bits, or so small that it would become 0.
        UsageError: The scale is not above 0.
    """
    formats.check_scale(scale)
    codes = np.rint(metres.astype(np.float64) * scale)
    if codes.max() > formats.LARGEST_CODE:
        raise OutputError(
            f"{path}: the largest depth, {metres.max():.6g} m, does not fit in 16 bits with"
            f" {scale:g} codes per metre; write .exr, .npy or .tiff"
        )
    is_lost = (metres > 0) & (codes == 0)
    if is_lost.any():
        raise OutputError(
            f"{path}: {int(is_lost.sum()):,} depths down to {metres[is_lost].min():.3g} m would be"
            f" unknown in 16 bits with {scale:g} codes per metre; write .exr, .npy or .tiff"
        )
    return codes.astype(np.uint16)


def describe_range(
    depth: NDArray[np.generic],
    reading: Reading,
    *,
    noun: str = "points",
    option: str = "--depth-scale",
    unit: str = "m",
) -> str:
    """Returns a line such as `1,842 points, 2.1–63.4 m (16-bit PNG ÷ 256)`.

    If the scale is assumed, the line names the option that changes it. Where KITTI's scale gives
    near depths only, it also has their range as millimetres.

    Args:
        depth: Depths of any shape in `unit`, 0 or not finite where unknown.
        reading: How they were read.
        noun: What the depths are of, in the plural with a final s.
        option: Option that states the scale.
        unit: Name of the unit.
    """
    all_depths = np.asarray(depth, dtype=np.float64)
    depths = all_depths[np.isfinite(all_depths) & (all_depths > 0)]
    hint = f"; {option} to change" if reading.assumed else ""
    if depths.size == 0:
        return f"no {noun} with known depth ({reading.source}{hint})"
    # Near depths by KITTI's scale may be millimetres of a room.
    nearest = float(depths.min())
    farthest = float(depths.max())
    is_by_kitti = reading.assumed and reading.source.endswith(f"÷ {KITTI_SCALE:g}")
    if is_by_kitti and farthest < _FARTHEST_INDOORS_M:
        low, high = (metres(end * KITTI_SCALE / 1000) for end in (nearest, farthest))
        hint = f" assumed; if it holds millimetres, {option} 1000 makes it {low}–{high} m"
    # How many there are, and from where to where.
    count = f"{depths.size:,} {noun.removesuffix('s') if depths.size == 1 else noun}"
    low = metres(nearest)
    high = metres(farthest)
    extent = low if low == high else f"{low}–{high}"
    return f"{count}, {extent} {unit} ({reading.source}{hint})"


def metres(value: float) -> str:
    """Returns metres as a person writes them: one decimal from 1 m on, two digits below.

    Powers of ten stand for what is too large or too small to be a depth.
    """
    if value >= 1e6 or (0 < value < 1e-3):
        return f"{value:.1e}"
    if value >= 0.95:  # which is rounded to 1.0
        return f"{value:,.1f}"
    return f"{value:.2g}"
