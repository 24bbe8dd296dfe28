"""A depth map that a network, a camera or a program stored, from any file that can hold one.

It is read as numbers. What they mean, depth or disparity, metric or not, is decided by the sparse
points (`pnpdepth_cli.completion.alignment`). What is decided here is which pixels are unknown, and
that the map is one, of the image's view.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.completion.image_registration import better_orientation
from pnpdepth_cli.completion.registration_evidence import evidence
from pnpdepth_cli.dataset.arrays import same_aspect_ratio
from pnpdepth_cli.dataset.plausible import named
from pnpdepth_cli.dataset.range_ends import far_end, near_end, repeated_ends
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.file_record import FileRecord, file_and_part
from pnpdepth_cli.io import formats
from pnpdepth_cli.io.colmap_dense import is_dense_map, read_dense_map
from pnpdepth_cli.io.depth import check_byte_order, load_stored, without_single_axes
from pnpdepth_cli.io.file_bytes import check_pixel_count, fingerprint, one_line, read_bytes
from pnpdepth_cli.io.formats import ArrayKind, DepthFile, Reading, images
from pnpdepth_cli.io.rgb import VIDEO_BRANDS, read_rgb
from pnpdepth_cli.points import Size, SparsePoints

Map = NDArray[np.float32]

_RAW = "save the raw array as NPY (numpy.save), or as a 16-bit PNG"
_LIST_SUFFIXES = (".csv", ".txt")
_DEPTH_WORDS = re.compile("depth|disp|pred|inverse|inv_")
_OTHER_WORDS = re.compile(
    "conf|mask(?!ed)|valid(?!_depth)|sigma|uncert|std|_var|variance|label|seg|sky|normal(?!i)|flow"
    "|intrin|extrin|pose|fov|focal"
)
"""Words in names of arrays that are depth, and that are maps beside it."""
_MATRIX = 4
"""Rows or columns of a camera's matrix or pose, at most."""
_GREY = 2
"""Levels of 255 between the channels of a grey picture; compression makes some."""
_STEPS = 256
"""Numbers of 8 bits."""
_FEW = 20
"""Different numbers; fewer are of labels."""
_MANY = 1000
"""Pixels, of which few different numbers tell something."""
_FILLED = 0.005
"""Of the pixels; so many zeros in the middle of a range stand for unknown."""
_MORE = 3
"""Times as many as any other number."""
_SAMPLED = 2000
"""Pixels, whose neighbours are compared with the image's edges."""
_KNOWN = 0.5 - 1e-6
"""Weight of known pixels, from which an interpolated one is known."""


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
    values, notes = _without_unknown(codes, stored.reading.scale)
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
    """The numbers in the file, or in this part of it, as they are stored."""
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
    if is_dense_map(data):
        return read_dense_map(path, data)
    if _is_video(data):
        raise InputError(f"{path} is a video; save the depth of the image's frame, as NPY")
    if kind is None and path.suffix.lower() in _LIST_SUFFIXES:
        raise InputError(f"{path} is a text, as of a list of points; {_RAW}")
    if kind in ("JPEG", "WEBP") or data[4:8] == b"ftyp":
        return _load_picture(path, kind or "HEIC")
    if kind in ("PNG", "TIFF") and not _holds_depth(path, data, kind):
        return _load_picture(path, kind)
    return load_stored(path)


def _choose_array(path: Path, arrays: dict[str, ArrayKind]) -> str:
    """The array of an archive that is depth: the only map, or the only one named so."""
    listed = one_line(", ".join(f"{name} {array.shape}" for name, array in arrays.items()))
    maps = list[str]()
    for name, (shape, dtype) in arrays.items():
        sides = [side for side in shape if side != 1]
        is_map = len(sides) == 2 and min(sides) > _MATRIX and dtype.kind in "fiu"
        if is_map and not _OTHER_WORDS.search(name.lower()):
            maps.append(name)
    by_name = [name for name in maps if _DEPTH_WORDS.search(name.lower())]
    # A stack of maps, which is refused with its shape, is named so, too.
    stacks = [
        name
        for name in arrays
        if _DEPTH_WORDS.search(name.lower()) and not _OTHER_WORDS.search(name.lower())
    ]
    # The only array is refused for what it is, unless for its name.
    alone = [name for name in arrays if len(arrays) == 1 and not _OTHER_WORDS.search(name.lower())]
    found = by_name or maps or stacks or alone
    if len(found) == 1:
        return found[0]
    if not found:
        raise InputError(f"{path} has no depth map among its arrays ({listed}); {_RAW}")
    names = " and ".join(found)
    raise InputError(f"{path} has several maps, {names}; name one as {path.name}:{found[0]}")


def _load_exr(path: Path, data: bytes, part: str) -> DepthFile:
    """The channel of this name, or the one that holds depth."""
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
    """Whether the content of a file is that of a video."""
    is_mp4 = data[4:8] == b"ftyp" and data[8:11] in VIDEO_BRANDS
    is_avi = data[:4] == b"RIFF" and data[8:11] == b"AVI"
    return is_mp4 or is_avi or data.startswith(b"\x1aE\xdf\xa3")  # Matroska and WebM


def _holds_depth(path: Path, data: bytes, kind: str) -> bool:
    """Whether a PNG or TIFF has one channel of 16 bits or floats, not a picture's pixels."""
    with images.open_image(path, data, kind) as image:
        mode = images.raw_mode(image) if kind == "PNG" else image.mode
        return mode.startswith("I;16") or (kind == "TIFF" and mode in ("F", "I"))


def _load_picture(path: Path, kind: str) -> DepthFile:
    """The levels (H, W) of a grey picture, of 8 or 16 bits; a picture in colour is refused."""
    picture = read_rgb(path)
    levels = np.rint(picture.values * picture.white)
    bits = 8 if picture.white == _STEPS - 1 else 16
    spread = np.ptp(levels, axis=2)
    if spread.max() > _GREY * picture.white / (_STEPS - 1):
        raise InputError(
            f"{path} is a {kind} in colour, a photo or depth drawn with a colour map, which is no"
            f" number; {_RAW}"
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
    """The stored numbers as (H, W). InputError if they are no one map."""
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
    """The first channel of (H, W, C), of which the others are copies."""
    first = values[..., 0]
    others = range(1, values.shape[-1])
    if all(np.array_equal(first, values[..., channel]) for channel in others):
        return first
    raise InputError(
        f"{path} has {values.shape[-1]} channels that differ, as of colours, points or normals,"
        f" and depth has one; {_RAW}"
    )


class _Unknown:
    """Which pixels of a map are unknown, and a line on each reason."""

    def __init__(self, values: Map) -> None:
        self._values = values
        self.mask = np.zeros(values.shape, bool)
        self.notes = list[str]()

    @property
    def others(self) -> Map:
        """The numbers (N,) of all other pixels."""
        return self._values[~self.mask]

    def add(self, found: NDArray[np.bool_], what: str) -> None:
        """Adds pixels (H, W), and a line on those that are new."""
        found = found & ~self.mask
        count = int(np.count_nonzero(found))
        if count:
            verb = "is" if count == 1 else "are"
            self.notes.append(f"{count:,} of {found.size:,} pixels {verb} {what}; taken as unknown")
            self.mask |= found


def _without_unknown(codes: NDArray[Any], scale: float | None) -> tuple[Map, list[str]]:
    """The numbers (H, W) as float32, NaN where unknown; and lines that count those.

    Args:
        codes: (H, W) numbers as stored.
        scale: Codes per unit that the file states; None for none.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        values = np.array(codes if scale is None else codes / scale, dtype=np.float32)
    unknown = _Unknown(values)
    unknown.add(~np.isfinite(values), "NaN or infinite")
    if _is_8_bit(codes):
        _add_8_bit_ends(unknown, codes)
    else:
        _add_ends_of_codes(unknown, codes)
        _add_marks(unknown, values)
        _add_ends(unknown, values)
    values[unknown.mask] = np.nan
    return values, unknown.notes


def _add_8_bit_ends(unknown: _Unknown, codes: NDArray[Any]) -> None:
    """0 and 255, beyond which a picture of depth is clipped, and a warning that it has steps."""
    lowest = codes == 0
    highest = codes == _STEPS - 1
    levels = len(np.unique(codes[np.isfinite(codes)]))
    unknown.notes.append(
        f"warning: 8 bits have 256 steps, of which {levels} are used;"
        f" {np.count_nonzero(lowest):,} of {codes.size:,} pixels are 0 and"
        f" {np.count_nonzero(highest):,} are 255, where it is clipped, and taken as unknown;"
        f" better {_RAW}"
    )
    unknown.mask |= lowest | highest


def _add_ends_of_codes(unknown: _Unknown, codes: NDArray[Any]) -> None:
    """The largest code of an integer type, and the smallest below 0: what no sensor measures."""
    if codes.dtype.kind not in "iu":
        return
    limits = np.iinfo(codes.dtype)
    unknown.add(codes == limits.max, f"{limits.max}, the largest code")
    if limits.min < 0:
        unknown.add(codes == limits.min, f"{limits.min}, the smallest code")


def _add_marks(unknown: _Unknown, values: Map) -> None:
    """The only number below 0; and 0, unless it is one of many numbers of both signs."""
    others = unknown.others
    below = np.unique(others[others < 0])
    if len(below) == 1 and others.max(initial=0) > 0:
        unknown.add(values == below[0], f"{below[0]:.6g}, the only number below 0")
    others = unknown.others
    zeros = int(np.count_nonzero(others == 0))
    if zeros and others.min() < 0 < others.max():
        counts = np.unique(others[others != 0], return_counts=True)[1]
        if zeros < max(_FILLED * values.size, _MORE * int(counts.max())):
            return
    unknown.add(values == 0, "0")


def _add_ends(unknown: _Unknown, values: Map) -> None:
    """Extreme values that many pixels have: the sky, a far plane, a clip, also of 1/disparity."""
    # About one value, far from all others and mixed with them at its edges.
    known = unknown.others.astype(np.float64)
    if known.min(initial=np.inf) > 0:
        place = ~unknown.mask
        for end, reach in (
            (far_end(known), "98 % of the others are at most"),
            (near_end(known), "98 % of the others are at least"),
        ):
            found = np.zeros(values.shape, bool)
            found[place] = end.is_none
            unknown.add(found, f"about {end.value:.6g}, where {reach} {end.rest:.4g}")
    # Exactly one value.
    for value, _ in repeated_ends(unknown.others):
        name = "smallest" if value <= float(unknown.others.min()) else "largest"
        unknown.add(values == np.float32(value), f"{value:.6g} exactly, the {name} value")


def _is_8_bit(codes: NDArray[Any]) -> bool:
    """Whether the numbers are 0…255 as of 8 bits, whatever type they have."""
    if codes.dtype == np.uint8:
        return True
    finite = codes[np.isfinite(codes)] if codes.dtype.kind == "f" else codes
    if not finite.size or finite.min() < 0 or finite.max() != _STEPS - 1:
        return False
    return bool((np.rint(finite) == finite).all())


def _check_variety(path: Path, values: Map, *, is_float: bool) -> list[str]:
    """Lines on a map of few different numbers. InputError for one of none, or of one number."""
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
    if known.size < _MANY or len(np.unique(sample)) > _STEPS:
        return []
    different = len(np.unique(known))
    if different > _STEPS:
        return []
    if different < _FEW:
        return [f"warning: {different} different numbers only, as of labels or a drawing"]
    if not is_float:  # steps of a sensor, or those of 8 bits, which are said already
        return []
    return [f"{different} different numbers only, as of a map that had 8 bits, or a coarse type"]


def _orientation_warning(values: Map, image: NDArray[np.float32]) -> list[str]:
    """A warning if the image's edges meet the jumps of a map better mirrored or turned.

    Of 34 stored predictions none gets it as it is, and 85 get the right one of 102 that are
    mirrored, upside down, or turned by 180°.
    """
    rows, columns = np.nonzero(np.isfinite(values))
    chosen = np.random.default_rng(0).choice(
        len(rows), min(_SAMPLED, len(rows)), replace=False, shuffle=False
    )
    rows, columns = rows[chosen], columns[chosen]
    numbers = values[rows, columns].astype(np.float64)
    # Changes of the logarithm are compared, which are those of depth or of disparity alike.
    if numbers.min() <= 0:
        low, high = np.quantile(numbers, (0.02, 0.98))
        numbers = np.exp(2 * (numbers - low) / max(float(high - low), 1e-9))
    points = SparsePoints(
        xy=np.column_stack([columns, rows]).astype(np.float32),
        depth=numbers.astype(np.float32),
        size=(values.shape[0], values.shape[1]),
    )
    found = evidence(np.ascontiguousarray(image), points.tensors())
    turned = None if found is None else better_orientation([found])
    if turned is None:
        return []
    return [
        f"warning: the image's edges meet it better if it is {turned}; give both as they are"
        " stored, or both turned"
    ]


def _check_view(path: Path, own: tuple[int, ...], size: Size) -> str:
    """A line on how a map (H, W) is resized. InputError if it cannot be of the image's view."""
    sizes = f"{own[1]}×{own[0]} and the image {size[1]}×{size[0]}"
    # A pixel's rounding of one side or the other.
    columns = abs(own[1] - own[0] * size[1] / size[0])
    rows = abs(own[0] - own[1] * size[0] / size[1])
    if min(columns, rows) > 1 and not same_aspect_ratio(own, size):
        if same_aspect_ratio(own[::-1], size):
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
        stretch = abs(own[1] * size[0] / (own[0] * size[1]) - 1)
        note += f" and stretched by {stretch:.1%}"
    return note


def resize_known(values: Map, size: Size) -> Map:
    """Returns a map (h, w) at the size (H, W), interpolated linearly between known pixels.

    A pixel is NaN, unknown, where unknown ones have most of its weight. Elsewhere they have none.
    """
    height, width = size
    known = np.isfinite(values)
    total = cv2.resize(np.where(known, values, np.float32(0)), (width, height))
    if known.all():
        return np.asarray(total, np.float32)
    weight = cv2.resize(known.astype(np.float32), (width, height))
    resized = np.full(size, np.nan, np.float32)
    np.divide(total, weight, out=resized, where=weight >= _KNOWN)
    return resized
