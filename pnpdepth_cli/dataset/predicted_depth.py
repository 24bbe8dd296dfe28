"""A depth map that a network, a camera or a program stored, from any file that can hold one.

It is read as numbers. What they mean, depth or disparity, metric or not, is decided by the sparse
points (`pnpdepth_cli.completion.alignment`). What is decided here is which pixels are unknown, and
that the map is one, of the image's view.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.completion.image_registration import better_orientation
from pnpdepth_cli.completion.registration_evidence import evidence
from pnpdepth_cli.dataset.arrays import same_aspect_ratio
from pnpdepth_cli.dataset.plausible import named
from pnpdepth_cli.dataset.unknown_pixels import SAVE_RAW, STEPS_OF_8_BITS, Map, without_unknown
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.file_record import FileRecord, file_and_part
from pnpdepth_cli.io import formats
from pnpdepth_cli.io.colmap_dense import is_dense_map, read_dense_map
from pnpdepth_cli.io.depth import check_byte_order, load_stored, without_single_axes
from pnpdepth_cli.io.file_bytes import check_pixel_count, fingerprint, one_line, read_bytes
from pnpdepth_cli.io.formats import ArrayKind, DepthFile, Reading, images
from pnpdepth_cli.io.rgb import VIDEO_BRANDS, read_rgb
from pnpdepth_cli.points import Size, SparsePoints

_LIST_SUFFIXES = (".csv", ".txt")

# Arrays of an archive.
_DEPTH_WORDS = re.compile("depth|disp|pred|inverse|inv_")
"""In names of arrays that are depth."""
_OTHER_WORDS = re.compile(
    "conf|mask(?!ed)|valid(?!_depth)|sigma|uncert|std|_var|variance|label|seg|sky|normal(?!i)|flow"
    "|intrin|extrin|pose|fov|focal"
)
"""In names of arrays that are other maps or matrices beside depth."""
_LARGEST_MATRIX = 4
"""Rows or columns of a camera's matrix or pose, at most."""

# What numbers are none of depth.
_GREY = 2
"""Levels of 255 by which the channels of a grey picture may differ; compression makes some."""
_FEW_NUMBERS = 20
"""Different numbers; fewer are of labels."""
_MANY_PIXELS = 1000
"""Pixels, of which few different numbers tell something."""

_SAMPLED = 2000
"""Pixels that stand for all of a map: their depths are compared with the image's edges."""
_LEAST_WEIGHT = 0.5 - 1e-6
"""Sum of the weights of known pixels, from which an interpolated one is known: half of all, but for
rounding."""


@dataclass(frozen=True, kw_only=True)
class PredictedDepth:
    """A depth map from a file, in the file's own numbers."""

    values: Map
    """(H, W), of any meaning: depth, disparity, logarithms; NaN where unknown."""
    source: FileRecord
    """The file, and how it was read."""
    notes: tuple[str, ...]
    """Lines for a person; the more important ones begin with "warning: "."""


def read_predicted_depth(
    path: Path, size: Size | None, image: NDArray[np.float32] | None = None
) -> PredictedDepth:
    """Returns the depth map in a file, at the size of its image.

    Zero, numbers that are not finite, clipped codes, and one extreme value for many pixels are
    unknown. Where the format itself states a scale, it is applied, and nothing else is.

    Args:
        path: A file of any depth format, a grey picture, or a dense map of COLMAP. FILE:PART names
            an array of an NPZ, or a channel of an EXR.
        size: (H, W) of the image, to which a map of the same view is resized. None: its own size.
        image: The image (H, W, 3) in 0…1. With it, a map that is mirrored or turned is noticed.

    Raises:
        InputError: The file is missing, damaged, or no depth map; or it shows another view.
    """
    # The numbers in the file.
    file, part = file_and_part(path)
    stored = _load(file, part)
    codes = _one_channel(path, stored, size)
    # Those that are unknown.
    values, notes = without_unknown(codes, stored.reading.scale)
    notes += _check_variety(path, values, is_float=codes.dtype.kind == "f")
    # The size of the image.
    if size is not None and values.shape != size:
        notes.append(_check_view(path, values.shape, size))
        values = resize_known(values, size)
    if image is not None and image.shape[:2] == values.shape:
        notes += _orientation_warning(values, image)
    source = FileRecord(
        path=str(path),
        kind="depth",
        sha256=fingerprint(file).sha256,
        read_as=stored.reading.source,
        scale=stored.reading.scale,
    )
    return PredictedDepth(
        values=values, source=source, notes=tuple(named(str(path), note) for note in notes)
    )


def _load(path: Path, part: str) -> DepthFile:
    """The numbers in a file, or in one part of it, as they are stored.

    A grey picture of 8 or 16 bits may be depth, too.

    Args:
        path: The file.
        part: Name of an array of an NPZ, or of a channel of an EXR. Empty: the one that is depth.

    Raises:
        InputError: The file holds no such part, or no depth.
    """
    # Files whose arrays or channels have names.
    data = read_bytes(path)
    kind = formats.kind_of(data)
    if kind == "NPZ":
        arrays = formats.list_npz(path, data)
        if part and part not in arrays:
            raise InputError(f"{path} has no array {part!r}; it has {one_line(', '.join(arrays))}")
        return formats.read_npz_array(path, data, part or _choose_array(path, arrays))
    if kind == "EXR":
        return _load_exr(path, data, part)
    if part:
        raise InputError(
            f"{path} has no part {part!r}; only arrays of an NPZ and channels of an EXR have names"
        )
    # A depth map of COLMAP, and what is no map at all.
    if is_dense_map(data):
        return read_dense_map(path, data)
    if _is_video(data):
        raise InputError(f"{path} is a video; save the depth of the image's frame, as NPY")
    if kind is None and path.suffix.lower() in _LIST_SUFFIXES:
        raise InputError(f"{path} is a text, as of a list of points; {SAVE_RAW}")
    # Pictures, and all other depth files.
    if kind in ("JPEG", "WEBP") or data[4:8] == b"ftyp":  # HEIC, which `kind_of` does not know
        return _load_grey_picture(path, kind or "HEIC")
    if kind in ("PNG", "TIFF") and not _holds_depth(path, data, kind):
        return _load_grey_picture(path, kind)
    return load_stored(path)


def _choose_array(path: Path, arrays: dict[str, ArrayKind]) -> str:
    """The name of the array of an archive that is depth.

    It is the only map named as depth; else the only map; else the only array named as depth; else
    the only array. An array named as something else, such as a mask, is none of these.

    Args:
        path: The archive, for messages.
        arrays: Shape and type of its arrays, by name.

    Raises:
        InputError: No array is depth, or several are.
    """
    listed = one_line(", ".join(f"{name} {array.shape}" for name, array in arrays.items()))
    # Arrays that are not named as something else; of these, those that are named as depth, and
    # those that are maps.
    eligible = [name for name in arrays if not _OTHER_WORDS.search(name.lower())]
    named_depth = [name for name in eligible if _DEPTH_WORDS.search(name.lower())]
    maps = list[str]()
    for name in eligible:
        shape, dtype = arrays[name]
        sides = [side for side in shape if side != 1]
        if len(sides) == 2 and min(sides) > _LARGEST_MATRIX and dtype.kind in "fiu":
            maps.append(name)
    maps_named_depth = [name for name in maps if name in named_depth]
    # Without a map, an array that is named as depth, or the only one, is chosen, too: it is a stack
    # of maps, say, which is refused later with its shape.
    only_one = eligible if len(arrays) == 1 else []
    candidates = maps_named_depth or maps or named_depth or only_one
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        raise InputError(f"{path} has no depth map among its arrays ({listed}); {SAVE_RAW}")
    names = " and ".join(candidates)
    raise InputError(f"{path} has several maps, {names}; name one as {path.name}:{candidates[0]}")


def _load_exr(path: Path, data: bytes, part: str) -> DepthFile:
    """The channel (H, W) of an EXR that has a name, or that holds depth if the name is empty.

    Args:
        path: The file, for messages.
        data: Its content.
        part: Name of the channel. Empty: the one that holds depth.

    Raises:
        InputError: There is no such channel, or several may hold depth.
    """
    channels = images.read_exr_channels(path, data)
    listed = one_line(", ".join(channels))
    name = part or images.depth_channel(channels)
    if name is None:
        raise InputError(
            f"{path} has several channels ({listed}); name that of depth, as in"
            f" {path.name}:{next(iter(channels))}"
        )
    if name not in channels:
        raise InputError(f"{path} has no channel {name!r}; it has {listed}")
    return DepthFile(values=channels[name], reading=Reading(f"EXR channel {name}"))


def _is_video(data: bytes) -> bool:
    """Whether the content of a file is that of a video: MP4, AVI, Matroska or WebM."""
    is_mp4 = data[4:8] == b"ftyp" and data[8:11] in VIDEO_BRANDS
    is_avi = data[:4] == b"RIFF" and data[8:11] == b"AVI"
    return is_mp4 or is_avi or data.startswith(b"\x1aE\xdf\xa3")  # Matroska and WebM


def _holds_depth(path: Path, data: bytes, kind: str) -> bool:
    """Whether a PNG or TIFF has one channel of 16 bits or floats, not a picture's pixels.

    Args:
        path: The file, for messages.
        data: Its content.
        kind: "PNG" or "TIFF".
    """
    with images.open_image(path, data, kind) as image:
        mode = images.raw_mode(image) if kind == "PNG" else image.mode
        return mode.startswith("I;16") or (kind == "TIFF" and mode in ("F", "I"))


def _load_grey_picture(path: Path, kind: str) -> DepthFile:
    """The levels (H, W) of a grey picture, of 8 or 16 bits.

    Args:
        path: The file.
        kind: Format of the file, such as "JPEG".

    Raises:
        InputError: The picture is in colour.
    """
    picture = read_rgb(path)
    levels = np.rint(picture.values * picture.white)
    bits = 8 if picture.white == STEPS_OF_8_BITS - 1 else 16
    difference = np.ptp(levels, axis=2)  # (H, W) of the largest and the smallest channel
    if difference.max() > _GREY * picture.white / (STEPS_OF_8_BITS - 1):
        raise InputError(
            f"{path} is a {kind} in colour, a photo or depth drawn with a colour map, which is no"
            f" number; {SAVE_RAW}"
        )
    grey = np.median(levels, axis=2)
    source = f"{bits}-bit grey {kind}"
    if kind in ("JPEG", "WEBP"):
        source += ", whose compression changes numbers"
    if picture.note is not None:
        source += f", {picture.note}"
    dtype = np.uint8 if bits == 8 else np.uint16
    return DepthFile(values=grey.astype(dtype), reading=Reading(source))


def _one_channel(path: Path, stored: DepthFile, size: Size | None) -> NDArray[np.generic]:
    """The stored numbers as (H, W), without axes of length 1 and equal channels.

    Args:
        path: The file, for messages.
        stored: Its numbers, as they are stored.
        size: (H, W) of the image, by which a map of three columns is no list of points. None:
            there is no image.

    Raises:
        InputError: They are no numbers, or not one map.
    """
    shape = stored.values.shape
    values = without_single_axes(stored.values)
    if values.dtype.kind not in "fiu":
        raise InputError(f"{path} holds {values.dtype} values; depth is float or integer")
    if 0 in shape:
        raise InputError(f"{path} has the shape {shape}, without a number; save it again")
    if values.ndim == 3 and values.shape[-1] in (2, 3, 4):
        values = _equal_channels(path, values)
    if values.ndim == 3:
        raise InputError(
            f"{path} has {len(values)} maps, of the shape {shape}; save the one of this image"
        )
    if values.ndim != 2:
        raise InputError(f"{path} has the shape {shape}; a depth map is (H, W)")
    if not stored.is_image and values.shape[1] == 3 and values.shape != size:
        raise InputError(f"{path} has the shape {shape}, as a list of points has; give (H, W)")
    check_pixel_count(path, values.shape[1], values.shape[0])
    check_byte_order(path, values)
    return values


def _equal_channels(path: Path, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """The first channel (H, W) of (H, W, C). InputError unless the others are copies of it."""
    first = values[..., 0]
    others = range(1, values.shape[-1])
    if all(np.array_equal(first, values[..., channel]) for channel in others):
        return first
    raise InputError(
        f"{path} has {values.shape[-1]} channels that differ, as of colours, points or normals,"
        f" and depth has one; {SAVE_RAW}"
    )


def _check_variety(path: Path, values: Map, *, is_float: bool) -> list[str]:
    """Lines on a map of few different numbers, which may be none of depth.

    Args:
        path: The file, for messages.
        values: (H, W), NaN where unknown.
        is_float: Whether the file holds floats.

    Raises:
        InputError: No number is known, or all are one.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        raise InputError(
            f"{path} has no known depth: every number is 0, NaN, infinite or clipped; give another"
            " map"
        )
    if known.min() == known.max():
        raise InputError(
            f"{path} is {known[0]:g} at all of its {known.size:,} known pixels, as a mask is; give"
            " the depth map"
        )
    # Most maps show by a sample that they have more.
    sample = known[:: max(1, known.size // _SAMPLED)]
    if known.size < _MANY_PIXELS or len(np.unique(sample)) > STEPS_OF_8_BITS:
        return []
    different = len(np.unique(known))
    if different > STEPS_OF_8_BITS:
        return []
    if different < _FEW_NUMBERS:
        return [f"warning: {different} different numbers only, as of labels or a drawing"]
    if not is_float:  # steps of a sensor, or those of 8 bits, which are said already
        return []
    return [f"{different} different numbers only, as of a map that had 8 bits, or a coarse type"]


def _orientation_warning(values: Map, image: NDArray[np.float32]) -> list[str]:
    """A warning if the image's edges meet the jumps of a map better mirrored or turned, else none.

    Of 34 stored predictions none gets a warning as it is. Of 102 that are mirrored, upside down, or
    turned by 180°, 85 get the right one.

    Args:
        values: (H, W) of any meaning, NaN where unknown.
        image: (H, W, 3) in 0…1.
    """
    # A sample of the known pixels stands for the map; the seed is fixed, so that it is always one.
    rows, columns = np.nonzero(np.isfinite(values))
    chosen = np.random.default_rng(0).choice(
        len(rows), min(_SAMPLED, len(rows)), replace=False, shuffle=False
    )
    rows, columns = rows[chosen], columns[chosen]
    numbers = values[rows, columns].astype(np.float64)
    # Changes of the logarithm are compared, which are those of depth or of disparity alike.
    # Numbers that are not all above 0 are taken for logarithms, whose middle 96 % then span 2.
    if numbers.min() <= 0:
        low, high = np.quantile(numbers, (0.02, 0.98))
        numbers = np.exp(2 * (numbers - low) / max(float(high - low), 1e-9))
    points = SparsePoints(
        xy=np.column_stack([columns, rows]).astype(np.float32),
        depth=numbers.astype(np.float32),
        size=(values.shape[0], values.shape[1]),
    )
    edges = evidence(np.ascontiguousarray(image), points.tensors())
    turned = None if edges is None else better_orientation([edges])
    if turned is None:
        return []
    return [
        f"warning: the image's edges meet it better if it is {turned}; give both as they are"
        " stored, or both turned"
    ]


def _check_view(path: Path, map_size: tuple[int, ...], size: Size) -> str:
    """A line on how a map is resized.

    Args:
        path: The file of the map, for messages.
        map_size: (H, W) of the map.
        size: (H, W) of the image.

    Raises:
        InputError: Their aspect ratios differ, so that the map is not of the image's view.
    """
    sizes = f"{map_size[1]}×{map_size[0]} and the image {size[1]}×{size[0]}"
    # By how many pixels one side or the other is off; one is rounding.
    columns = abs(map_size[1] - map_size[0] * size[1] / size[0])
    rows = abs(map_size[0] - map_size[1] * size[0] / size[1])
    if min(columns, rows) > 1 and not same_aspect_ratio(map_size, size):
        if same_aspect_ratio(map_size[::-1], size):
            raise InputError(
                f"{path} is {sizes}, so one is turned by 90°; turn it back with numpy.rot90, or"
                " give the image as it was given to the network"
            )
        raise InputError(
            f"{path} is {sizes}, another aspect ratio: cropped, padded or stretched; save it as it"
            " covers the image, at the image's size"
        )
    note = f"{sizes}; it is resized by linear interpolation"
    if min(columns, rows) > 1:
        stretch = abs(map_size[1] * size[0] / (map_size[0] * size[1]) - 1)
        note += f" and stretched by {stretch:.1%}"
    return note


def resize_known(values: Map, size: Size) -> Map:
    """Returns a map (h, w) at the size (H, W), interpolated linearly between known pixels.

    A pixel is NaN, unknown, where unknown ones have most of its weight. Elsewhere they have none.
    """
    height, width = size
    is_known = np.isfinite(values)
    weighted_sum = cv2.resize(np.where(is_known, values, np.float32(0)), (width, height))
    if is_known.all():
        return np.asarray(weighted_sum, np.float32)
    weight = cv2.resize(is_known.astype(np.float32), (width, height))
    resized = np.full(size, np.nan, np.float32)
    np.divide(weighted_sum, weight, out=resized, where=weight >= _LEAST_WEIGHT)
    return resized
