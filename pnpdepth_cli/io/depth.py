"""Depth images in every format, float32 metres inside, 0 where unknown; and their range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, OutputError, SizeError, UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.file_bytes import check_pixel_count, read_bytes
from pnpdepth_cli.io.formats import (
    DEPTH_SUFFIXES,
    KITTI_SCALE,
    SATURATED_CODE,
    StoredArray,
    WriteOptions,
    check_scale,
    depth_formats,
    format_of_content,
    format_of_suffix,
    kind_of,
)
from pnpdepth_cli.io.formats.png import eight_bits

_SHORTEST_M, _LONGEST_M = 0.02, 1000.0
_COMMON_M = (0.2, 200.0)
_FARTHEST_INDOORS_M = 40.0
"""Below it, a map read by KITTI's scale may be a room in millimetres: 40 m are 10.2 m then."""
# Codes per metre in use, most likely first: millimetres, KITTI, TUM RGB-D, centimetres.
_COMMON_SCALES = (1000.0, 256.0, 5000.0, 100.0, 10.0, 1.0)
_SCALE_FACTORS = {"1000/256": 1000 / 256, "5000/1000": 5.0, "1000": 1000.0}
_NEAR_FACTOR = 1.1  # ratio to one of these factors that noise explains
_OTHER_SCALE = 1.5  # ratio of two depths of a frame that no noise explains
_MIN_COMPARED = 10  # fewer pixels decide nothing


@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """A depth image as read from a file."""

    values: NDArray[np.float32]
    """(H, W) metres, 0 where unknown."""
    source: str
    """What was read, for a person."""
    assumed_scale: bool
    """True if neither the file nor the user gave the scale."""
    scale: float | None = None
    """Codes per metre that integers were divided by; None for a float file."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W), true where depth is known."""
        return self.values > 0


def read_depth(path: Path, *, scale: float | None = None, channel: str | None = None) -> DepthImage:
    """Returns the depth image in a file of any of `choices.FORMATS`.

    Zero, NaN, infinite and negative values are unknown, and so is the largest 16-bit code. The
    content tells the format. `scale` is in codes per metre; float files hold metres and ignore it.
    `channel` is the EXR channel or NPZ array to read; other formats ignore it.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth image.
        UsageError: The scale is not above 0, or there is no such channel.
    """
    check_scale(scale)
    return depth_from_stored(path, load_stored(path, channel), scale)


def load_stored(path: Path, channel: str | None) -> StoredArray:
    """Returns the one array of numbers in the file that can be depth, of whatever shape.

    The EXR channel or NPZ array is `channel`; None if there is one candidate.

    Raises:
        InputError: The file is missing, damaged, beyond the budget, or not a depth file.
    """
    data = read_bytes(path)
    depth_format = format_of_content(data)
    if depth_format is not None:
        return depth_format.read(path, data, channel)
    kind = kind_of(data)
    if kind is not None:
        raise eight_bits(path, kind)
    names = [each.name for each in depth_formats() if each.name != "PNG"]
    raise FileFormatError(
        f"{path} is not a depth file; give a 16-bit PNG, {', '.join(names[:-1])} or {names[-1]}"
    )


def depth_from_stored(path: Path, stored: StoredArray, scale: float | None) -> DepthImage:
    """Returns the stored numbers as a depth image: one channel, metres, 0 where unknown.

    Without a scale, integers have the file's own, or KITTI's.

    Raises:
        FileFormatError: The numbers are no image of one channel, or exceed the budget.
    """
    values = _as_image(path, stored.values)
    check_pixel_count(path, values.shape[1], values.shape[0])
    if values.dtype.kind == "f":
        return DepthImage(
            values=known_metres(values), source=stored.description, assumed_scale=False
        )
    divisor = scale or stored.scale or KITTI_SCALE
    assumed = scale is None and stored.scale is None
    source = f"{stored.description} ÷ {divisor:.12g}"
    if scale is None and stored.scale is not None:
        source += " (from the file)"
    saturated = (values == SATURATED_CODE) & (values.dtype == np.uint16)
    if saturated.any():
        count = int(saturated.sum())
        source += f", {count:,} pixels of value {SATURATED_CODE} taken as unknown"
        values = np.where(saturated, 0, values)
    metres = values.astype(np.float64) / divisor
    return DepthImage(
        values=known_metres(metres), source=source, assumed_scale=assumed, scale=divisor
    )


def known_metres(values: NDArray[Any]) -> NDArray[np.float32]:
    """Returns float32 of the same shape with 0 for everything but a finite depth above 0."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        metres = np.array(values, dtype=np.float32)
        metres[~(np.isfinite(metres) & (metres > 0))] = 0
    return metres


def _as_image(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    shape = values.shape
    if len(shape) == 4 and shape[0] == 1:  # a batch of one, as networks give it
        return _as_image(path, values[0])
    if len(shape) == 3 and 1 in (shape[0], shape[2]):
        return values.reshape(shape[1:] if shape[0] == 1 else shape[:2])
    if len(shape) == 2:
        return values
    listing = "x".join(str(length) for length in shape) or "a single number"
    raise FileFormatError(
        f"{path} holds an array of shape {listing}; a depth image is (H, W), save one channel"
    )


def write_depth(
    path: Path,
    depth: NDArray[np.float32],
    *,
    scale: float = KITTI_SCALE,
    text: Mapping[str, str] | None = None,
) -> None:
    """Writes depth in the format that the suffix names; not finite or <= 0 becomes 0, unknown.

    Depth is (H, W) metres. A PNG has `scale` codes per metre, which it keeps as text, as `text`.

    Raises:
        OutputError: The suffix is unknown, the file cannot be written, or a depth is too large for
            16 bits or so small that it would become 0.
        SizeError: The depth is not (H, W).
    """
    depth_format = format_of_suffix(path.suffix)
    if depth_format is None:
        raise OutputError(
            f"{path}: depth cannot be written as {path.suffix or 'a file without suffix'!r}; "
            f"use one of {', '.join(DEPTH_SUFFIXES)}"
        )
    if depth.ndim != 2 or 0 in depth.shape:
        raise SizeError(f"{path}: depth of shape {depth.shape} is no image; give (H, W)")
    metres = known_metres(depth)
    with atomic_path(path) as temporary:
        options = WriteOptions(path=path, scale=scale, text=text or {})
        depth_format.write(temporary, metres, options)


def describe_range(
    depth: NDArray[Any],
    source: str,
    *,
    assumed_scale: bool = False,
    noun: str = "points",
    option: str = "--depth-scale",
    unit: str = "m",
) -> str:
    """Returns a line such as `1,842 points, 2.1–63.4 m (16-bit PNG ÷ 256)`.

    An assumed scale adds the option that changes it and, where KITTI's scale gives near depths
    only, their range if they are millimetres. Unknown depth is 0 or not finite.
    """
    known = _known(depth)
    hint = f"; {option} to change" if assumed_scale else ""
    if known.size == 0:
        return f"no {noun} with known depth ({source}{hint})"
    by_kitti = assumed_scale and source.endswith(f"÷ {KITTI_SCALE:g}")
    if by_kitti and float(known.max()) < _FARTHEST_INDOORS_M:
        low, high = (metres(float(end) * KITTI_SCALE / 1000) for end in (known.min(), known.max()))
        hint = f" assumed; if it holds millimetres, {option} 1000 makes it {low}–{high} m"
    count = f"{known.size:,} {noun[:-1] if known.size == 1 else noun}"
    low, high = metres(float(known.min())), metres(float(known.max()))
    extent = low if low == high else f"{low}–{high}"
    return f"{count}, {extent} {unit} ({source}{hint})"


def implausible(depth: NDArray[Any], scale: float | None = None) -> str | None:
    """Returns a warning if half of the known depths cannot be metres, else None.

    `scale` is that of integers, in codes per metre; None for a float file.
    """
    known = _known(depth)
    if known.size == 0:
        return None
    median = float(np.median(known))
    if _SHORTEST_M <= median <= _LONGEST_M:
        return None
    fact = f"median depth {metres(median)} m is implausible, the scale is probably wrong"
    if scale is None:
        divisor = next((s for s in (1000.0, 100.0) if _is_common(median / s)), None)
        advice = (
            f"; divided by {divisor:g} it would be {metres(median / divisor)} m" if divisor else ""
        )
        return f"{fact}: a float file must hold metres{advice}"
    better = next((s for s in _COMMON_SCALES if _is_common(median * scale / s)), None)
    if better is None:
        return f"{fact}: give codes per metre with --depth-scale (now {scale:g})"
    return (
        f"{fact}: --depth-scale {better:g} (now {scale:g}) "
        f"would make it {metres(median * scale / better)} m"
    )


def check_same_scale(
    truth: NDArray[np.float32], other: NDArray[np.float32], what: str, options: str
) -> list[str]:
    """Returns a warning if ground truth and other depth differ by a factor where both are known.

    Args:
        truth: (H, W) ground truth, 0 = unknown.
        other: (H, W) depth of the same frame, such as sparse depth or a prediction.
        what: What the other depth is, such as "the sparse depth".
        options: The options that set the scales of both.

    Raises:
        UsageError: The factor is about that between two scales in use, such as 1000 / 256.
    """
    both = (truth > 0) & (other > 0)
    count = int(both.sum())
    if count < _MIN_COMPARED:
        return []
    ratio = float(np.median(truth[both] / other[both]))
    if 1 / _OTHER_SCALE <= ratio <= _OTHER_SCALE:
        return []
    fact = (
        f"the ground truth is {ratio:.3g} times {what} where both are known (median of"
        f" {count:,} pixels)"
    )
    for name, factor in _SCALE_FACTORS.items():
        if 1 / _NEAR_FACTOR <= max(ratio, 1 / ratio) / factor <= _NEAR_FACTOR:
            raise UsageError(f"{fact}, about {name}: one file is read by a wrong scale; {options}")
    return [f"warning: {fact}, so one of their scales is wrong; {options}"]


def metres(value: float) -> str:
    """Returns the number as a person writes it: one decimal from 1 m on, two digits below."""
    if value >= 1e6 or (0 < value < 1e-3):
        return f"{value:.1e}"
    return f"{value:,.1f}" if value >= 0.95 else f"{value:.2g}"


def _is_common(median: float) -> bool:
    return _COMMON_M[0] <= median <= _COMMON_M[1]


def _known(depth: NDArray[Any]) -> NDArray[np.float64]:
    values = np.asarray(depth, dtype=np.float64)
    return values[np.isfinite(values) & (values > 0)]
