"""Depth in files: images of every format, and lists of `x y depth` rows, which lose nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.choices import FORMATS
from pnpdepth_cli.errors import InputError, NoPointsError, OutputError
from pnpdepth_cli.io import formats
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import PIXELS, check_pixel_count, read_bytes, read_json, read_rows
from pnpdepth_cli.io.formats import KITTI_SCALE, DepthFile, Reading, images
from pnpdepth_cli.points import SparsePoints

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

DEPTH_SUFFIXES: tuple[str, ...] = tuple(s for kind in FORMATS.values() for s in kind.suffixes)
"""The suffixes that depth can be written to; PNG holds integer codes, the others float32 metres."""

SPARSE_SUFFIXES = (*DEPTH_SUFFIXES, ".csv")
"""What `write_sparse` can write; .csv keeps coordinates between pixel centres."""

Points = SparsePoints[NDArray[np.float32]]

_TEXT_SUFFIXES = (".csv", ".txt")
_OPEN3D_FILE = "intrinsic.json"
_WIDE = 2.4  # widths over heights, of images that are cut for driving
_MANY_CODES = 1000  # of a map; fewer tell nothing of their order
_ROUGHER = 3.0  # times; of maps of four sets, exchanged bytes are 40 times rougher
_NEAR_END, _LEAST_AT_END = 64_000, 0.001  # codes, and of the codes, that a sensor does not reach
_MOST_COLUMNS = 8  # of a scan; a wider array is a depth map
_MANY_ROWS = 200  # of so few columns, which no depth map has
_BELOW_ZERO = 0.1  # of the rows
_LARGEST_IMAGE_PX = 65_535  # side of an image, in PNG, JPEG and TIFF of every program
_LARGEST_RELATIVE = 2.0  # smaller coordinates are relative to an image, and share its first pixels
_OWN_PIXEL = 0.5  # of the points of a list have a pixel that no other has

_FARTHEST_INDOORS_M = 40.0
"""Below it, a map read by KITTI's scale may be a room in millimetres: 40 m are 10.2 m then."""
_OTHER_SIZE_SCALE = 1000.0
"""Codes per metre of a map of another size than its image: of phones, ARKitScenes and ScanNet."""


def read_depth(path: Path, *, scale: float | None = None) -> DepthFile:
    """Returns the depth image in a file of any of `choices.FORMATS`.

    Zero, NaN, infinite and negative values are unknown, and so is the largest 16-bit code. The
    content tells the format. `scale` is in codes per metre; float files hold metres and ignore it.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth image.
        UsageError: The scale is not above 0.
    """
    formats.check_scale(scale)
    return depth_from_stored(path, load_stored(path), scale)


def load_stored(path: Path, *, is_mask: bool = False) -> DepthFile:
    """Returns the one array in the file, of whatever shape; of truth values only if it is a mask.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth file.
    """
    data = read_bytes(path)
    depth_format = formats.format_of_content(data)
    if depth_format is None:
        if (kind := formats.kind_of(data)) is not None:
            raise formats.no_depth(path, f"an 8-bit {kind}")
        raise InputError(f"{path} is no depth file; give a 16-bit PNG, EXR, NPY, NPZ or PFM")
    stored = depth_format.read(path, data)
    if stored.values.dtype.kind in "iu" and stored.reading.scale is None:
        beside = _scale_beside(path)
        if beside is not None:
            source = f"{stored.reading.source}, depth_scale of {_OPEN3D_FILE}"
            stored = replace(stored, reading=Reading(source, beside))
    if stored.values.dtype.kind == "b" and not is_mask:
        raise InputError(f"{path} holds bool values; depth is float or integer")
    return stored


def _scale_beside(path: Path) -> float | None:
    """The scale of a depth image that Open3D's recorder of RealSense cameras states beside it.

    It writes `depth/NUMBER.png`, `color/NUMBER.jpg` and `intrinsic.json`, with `depth_scale` codes
    per metre, and a matrix of the camera.

    Raises:
        InputError: The file states no scale that depth can have.
    """
    sidecar = path.parent.parent / _OPEN3D_FILE
    if path.parent.name != "depth" or not sidecar.is_file():
        return None
    content = read_json(sidecar)
    if not {"intrinsic_matrix", "depth_scale"} <= set(content):
        return None
    scale = content["depth_scale"]
    if not isinstance(scale, (int, float)) or not 0 < scale < math.inf:
        raise InputError(f"{sidecar}: depth_scale {scale!r} is no number above 0; correct it")
    return float(scale)


def holds_integers(stored: DepthFile, *, of_scale: float | None = None) -> bool:
    """Returns whether stored numbers are depth as integers, which need a scale.

    Args:
        stored: The numbers, as `load_numbers` returns them.
        of_scale: A scale that is stated. Integers of another one that their file states need none.
    """
    own = stored.reading.scale
    return stored.values.dtype.kind in "iu" and (of_scale is None or own in (None, of_scale))


def depth_from_stored(
    path: Path, stored: DepthFile, scale: float | None, size: tuple[int, int] | None = None
) -> DepthFile:
    """Returns the stored numbers as one channel of float32 metres, 0 where unknown.

    Without a scale, integers have the file's own, else KITTI's, or millimetres if they are
    not of the size (H, W) of their image.

    Raises:
        InputError: The numbers are no image of one channel, or exceed the budget.
    """
    values = without_single_axes(stored.values)
    if values.ndim != 2:
        raise InputError(f"{path} has the shape {stored.values.shape}; a depth image is (H, W)")
    check_pixel_count(path, values.shape[1], values.shape[0])
    source = stored.reading.source
    below = int(np.count_nonzero(np.less(values, 0)))
    lost = f", {below:,} pixels below 0 taken as unknown" if below else ""
    # Floats are metres.
    if values.dtype.kind == "f":
        return DepthFile(values=known_metres(values), reading=Reading(source + lost))
    # Integers are codes, of which so many are a metre: as stated, by the file, or as is usual.
    _check_codes(path, values, is_stated=scale is not None)
    of_file = stored.reading.scale
    assumed = KITTI_SCALE if size in (None, values.shape) else _OTHER_SIZE_SCALE
    if values.shape[1] > _WIDE * values.shape[0]:  # of no phone or depth camera
        assumed = KITTI_SCALE
    divisor = scale or of_file or assumed
    source += f" ÷ {divisor:.12g}"
    if scale is None and of_file is not None:
        source += " (from the file)"
    elif of_file not in (None, divisor):
        source += f" (not {of_file:.12g}, as the file says)"
    # The largest code is no depth.
    saturated = (values == formats.SATURATED_CODE) & (values.dtype == np.uint16)
    if saturated.any():
        count = int(saturated.sum())
        source += f", {count:,} pixels of value {formats.SATURATED_CODE} taken as unknown"
        values = np.where(saturated, 0, values)
    metres = values.astype(np.float64) / divisor
    reading = Reading(source + lost, divisor, assumed=scale is None and of_file is None)
    return DepthFile(values=known_metres(metres), reading=reading)


def without_single_axes(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Returns an array of (1, H, W), (H, W, 1), (1, 1, H, W), as networks give it, as (H, W)."""
    while values.ndim > 2 and 1 in (values.shape[0], values.shape[-1]):
        values = values[0] if len(values) == 1 else values[..., 0]
    return values


def _check_codes(path: Path, values: NDArray[np.generic], *, is_stated: bool) -> None:
    """Raises InputError for 16-bit codes whose bytes are exchanged, or that are normalised.

    Codes that reach the largest one without a gap were stretched to 16 bits, and are no depth
    unless a scale is stated.
    """
    check_byte_order(path, values)
    codes = _known_codes(values)
    if codes is None:
        return
    near_end = int(np.count_nonzero(codes > _NEAR_END))
    at_end = int(np.count_nonzero(values == formats.SATURATED_CODE))
    if not is_stated and at_end and near_end >= max(at_end, _LEAST_AT_END * len(codes)):
        raise InputError(
            f"{path}: its numbers reach {formats.SATURATED_CODE} without a gap, as those of a map"
            " that was normalised to 16 bits; save metres × a scale, or give the scale with"
            " --depth-scale"
        )


def check_byte_order(path: Path, values: NDArray[np.generic]) -> None:
    """Raises InputError for 16-bit codes whose bytes are exchanged.

    Neighbours in a row are nearly alike, but not if their bytes are exchanged.
    """
    codes = _known_codes(values)
    if codes is not None and _roughness(codes) > _ROUGHER * _roughness(codes.byteswap()):
        raise InputError(
            f"{path}: its numbers are far smoother with their two bytes exchanged, so they were"
            " stored in the wrong order; save array.byteswap()"
        )


def _known_codes(values: NDArray[np.generic]) -> NDArray[np.uint16] | None:
    """The 16-bit codes of known depth, in their order; None of other numbers, and of few."""
    if values.dtype != np.uint16:
        return None
    known = np.greater(values, 0) & np.less(values, formats.SATURATED_CODE)
    if np.count_nonzero(known) < _MANY_CODES:
        return None
    return np.asarray(values[known], np.uint16)


def _roughness(codes: NDArray[np.uint16]) -> float:
    """Mean difference of neighbours in units of the standard deviation; 0 of equal codes."""
    values = codes.astype(np.float64)
    return float(np.abs(np.diff(values)).mean() / (values.std() + 1e-9))


def known_metres(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Returns float32 of the same shape with 0 for everything but a finite depth above 0."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        metres = np.array(values, dtype=np.float32, order="C")
        metres[~(np.isfinite(metres) & (metres > 0))] = 0
    return metres


def write_depth(path: Path, depth: NDArray[np.float32], *, scale: float = KITTI_SCALE) -> None:
    """Writes depth in the format that the suffix names; not finite or <= 0 becomes 0, unknown.

    Depth is (H, W) metres. A PNG has `scale` codes per metre, which it keeps as text.

    Raises:
        OutputError: The suffix is unknown, the file cannot be written, or a depth is too large for
            16 bits or so small that it would become 0.
        InputError: The depth is not (H, W).
    """
    depth_format = formats.format_of_suffix(path)
    if depth.ndim != 2 or 0 in depth.shape:
        raise InputError(f"{path}: depth of shape {depth.shape} is no image; give (H, W)")
    values: NDArray[np.generic] = known_metres(depth)
    text = dict[str, str]()
    if depth_format.integer:
        values = _codes(path, known_metres(depth), scale)
        text[formats.SCALE_KEY] = repr(float(scale)).removesuffix(".0")
    with atomic_path(path) as temporary:
        depth_format.write(temporary, values, text)


def _codes(path: Path, metres: NDArray[np.float32], scale: float) -> NDArray[np.uint16]:
    """The codes of 16 bits of depth (H, W). OutputError if they cannot hold it."""
    formats.check_scale(scale)
    codes = np.rint(metres.astype(np.float64) * scale)
    if codes.max() > formats.LARGEST_CODE:
        raise OutputError(
            f"{path}: the largest depth, {metres.max():.6g} m, does not fit in 16 bits with"
            f" {scale:g} codes per metre; write .exr, .npy or .tiff"
        )
    lost = (metres > 0) & (codes == 0)
    if lost.any():
        raise OutputError(
            f"{path}: {int(lost.sum()):,} depths down to {metres[lost].min():.3g} m would be"
            f" unknown in 16 bits with {scale:g} codes per metre; write .exr, .npy or .tiff"
        )
    return codes.astype(np.uint16)


def read_sparse(
    path: Path, *, size: tuple[int, int] | None = None, scale: float | None = None
) -> tuple[Points, Reading]:
    """Returns the points with known depth of a depth image or a point list, and how it was read.

    See `points_from_stored`.

    Raises:
        NoPointsError: No depth is known.
        InputError: The file cannot be read, or is a list, and no size was given.
    """
    formats.check_scale(scale)
    return points_from_stored(path, load_numbers(path), size=size, scale=scale)


def load_numbers(path: Path) -> DepthFile:
    """Returns the numbers that a file stores: an array of whatever shape, or the rows of a text.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or holds no numbers.
    """
    data = read_bytes(path)
    if path.suffix.lower() not in _TEXT_SUFFIXES or formats.kind_of(data) is not None:
        return load_stored(path)
    rows, header = read_rows(path, data)
    return DepthFile(values=rows, reading=Reading("text"), is_image=False, header=tuple(header))


def points_from_stored(
    path: Path,
    stored: DepthFile,
    *,
    size: tuple[int, int] | None = None,
    scale: float | None = None,
) -> tuple[Points, Reading]:
    """Returns the points with known depth of the numbers of a file, and how they are read.

    Points of an image are in row-major order. A list is a float array of shape (N, 3) in NPY or
    NPZ, or text with one `x y depth` per line (.csv, .txt), in metres; its order is kept.

    Args:
        path: The file, for messages.
        stored: Its numbers, as `load_numbers` returns them.
        size: (H, W) of the frame that a list belongs to. An image has its own; where they differ,
            integers are millimetres unless a scale is known.
        scale: Codes per metre of an integer image.

    Raises:
        NoPointsError: No depth is known.
        InputError: The file is a list, and no size was given.
        UsageError: The scale is not above 0.
    """
    formats.check_scale(scale)
    # A list: a text, or an array with few columns and many rows.
    if stored.header is not None:
        return _from_rows(path, stored.values, "point list", size)
    shape = stored.values.shape
    columns = 0 if stored.is_image or len(shape) != 2 else shape[1]
    if columns == 3 or (3 < columns <= _MOST_COLUMNS and shape[0] > _MANY_ROWS):
        return _from_rows(path, stored.values, f"point list, {stored.reading.source}", size)
    # Anything else is an image.
    image = depth_from_stored(path, stored, scale, size)
    known = image.values > 0
    yx = np.argwhere(known)
    if not len(yx):
        raise NoPointsError(f"{path} holds no depth above 0; give a file with sparse depth")
    height, width = image.values.shape
    points = SparsePoints(
        xy=yx[:, ::-1].astype(np.float32), depth=image.values[known], size=(height, width)
    )
    return points, image.reading


def _from_rows(
    path: Path, rows: NDArray[np.floating], source: str, size: tuple[int, int] | None
) -> tuple[Points, Reading]:
    """The points of rows x, y, depth; those without depth or pixel are left out and counted."""
    if rows.dtype.kind != "f":
        raise InputError(f"{path} is a list of {rows.dtype}; save x, y, depth as floats")
    if rows.shape[1] != 3:
        raise InputError(
            f"{path}: {rows.shape[1]} numbers a row are not x, y and depth; if they are x y z of a"
            " scan, give --calib"
        )
    depth = known_metres(rows[:, 2])
    known = (depth > 0) & np.isfinite(rows[:, :2]).all(axis=1)
    if not known.any():
        raise NoPointsError(f"{path} holds no depth above 0; give a file with sparse depth")
    if size is None:
        raise InputError(f"{path} is a list of points, which needs an image for the frame's size")
    lost = len(rows) - int(np.count_nonzero(known))
    if lost:
        source += f", without {lost:,} rows that have no depth above 0 or no pixel"
    xy = rows[known, :2].astype(np.float32)
    return SparsePoints(xy=xy, depth=depth[known], size=size), Reading(source)


def holds_scan(stored: DepthFile, *, is_stated: bool = False) -> bool:
    """Returns whether the numbers of a list are x y z of a scan, not x y depth of pixels.

    By its header or by more than three numbers a row, or as stated; else many x or y are no pixels:
    far below 0, beyond the largest image, or several points share most of them.

    Args:
        stored: The numbers of the list.
        is_stated: Whether the user states of the list what only a scan has.
    """
    rows = stored.values
    if stored.header:
        return list(stored.header[:3]) != PIXELS
    if stored.is_image or rows.ndim != 2 or rows.dtype.kind != "f":
        return False
    if not 3 <= rows.shape[1] <= _MOST_COLUMNS:
        return False
    if rows.shape[1] > 3 or is_stated:
        return True
    xy = rows[np.isfinite(rows).all(axis=1), :2]
    if not len(xy):
        return False
    no_pixel = ((xy < -0.5) | (xy > _LARGEST_IMAGE_PX)).any(axis=1)
    if np.count_nonzero(no_pixel) > _BELOW_ZERO * len(rows):
        return True
    pixels = len(np.unique(np.rint(xy), axis=0))
    return bool(xy.max() > _LARGEST_RELATIVE and pixels < _OWN_PIXEL * len(xy))


def write_sparse(
    path: Path, xy: NDArray[np.float32], depth: NDArray[np.float32], image: NDArray[np.float32]
) -> None:
    """Writes N points, of pixels (N, 2) and metres (N,), in the format that the suffix names.

    Every format but .csv holds the image, the same points as (H, W) metres.
    """
    if path.suffix.lower() != ".csv":
        write_depth(path, image)
        return
    rows = np.column_stack([xy, depth])
    with atomic_path(path) as temporary:
        np.savetxt(temporary, rows, "%.9g", ",", header="x,y,depth", comments="")


def describe_range(
    depth: NDArray[np.generic],
    reading: Reading,
    *,
    noun: str = "points",
    option: str = "--depth-scale",
    unit: str = "m",
) -> str:
    """Returns a line such as `1,842 points, 2.1–63.4 m (16-bit PNG ÷ 256)`.

    An assumed scale adds the option that changes it and, where KITTI's scale gives near depths
    only, their range if they are millimetres. Unknown depth is 0 or not finite.
    """
    values = np.asarray(depth, dtype=np.float64)
    known = values[np.isfinite(values) & (values > 0)]
    hint = f"; {option} to change" if reading.assumed else ""
    if known.size == 0:
        return f"no {noun} with known depth ({reading.source}{hint})"
    # Near depths by KITTI's scale may be millimetres of a room.
    by_kitti = reading.assumed and reading.source.endswith(f"÷ {KITTI_SCALE:g}")
    if by_kitti and float(known.max()) < _FARTHEST_INDOORS_M:
        low, high = (metres(float(end) * KITTI_SCALE / 1000) for end in (known.min(), known.max()))
        hint = f" assumed; if it holds millimetres, {option} 1000 makes it {low}–{high} m"
    # How many there are, and from where to where.
    count = f"{known.size:,} {noun[:-1] if known.size == 1 else noun}"
    low = metres(float(known.min()))
    high = metres(float(known.max()))
    extent = low if low == high else f"{low}–{high}"
    return f"{count}, {extent} {unit} ({reading.source}{hint})"


def metres(value: float) -> str:
    """Returns the number as a person writes it: one decimal from 1 m on, two digits below."""
    if value >= 1e6 or (0 < value < 1e-3):
        return f"{value:.1e}"
    return f"{value:,.1f}" if value >= 0.95 else f"{value:.2g}"
