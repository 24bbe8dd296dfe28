"""Depth images in every format: float32 metres inside, 0 where depth is unknown."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.arrays import parse_npy, parse_npz
from pnpdepth_cli.io.file_bytes import (
    check_pixel_count,
    damaged,
    decode_with_opencv,
    kind_of,
    read_bytes,
)
from pnpdepth_cli.io.pfm import parse_pfm
from pnpdepth_cli.io.png import GREY, PALETTE, RGB, read_png_facts
from pnpdepth_cli.io.tiff import read_tiff_facts

KITTI_SCALE = 256.0
"""Codes per metre in the KITTI depth files, taken for integers that do not say their own."""

SCALE_KEY = "pnpdepth:scale"
"""Where our own 16-bit files keep codes per metre."""

SATURATED_CODE = 65535
"""The largest 16-bit code: what a sensor gives beyond its range, so never a measurement."""

_DEPTH_NAMES = frozenset({"z", "depth"})


@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """(H, W) float32 metres, 0 where unknown.

    `source` describes the file for a person. `scale` is the codes per metre that integers
    were divided by, None for a float file; `assumed_scale` says that nobody gave it.
    """

    values: NDArray[np.float32]
    source: str
    assumed_scale: bool
    scale: float | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W), True where depth is known."""
        return self.values > 0


@dataclass(frozen=True, kw_only=True)
class StoredArray:
    """Numbers as the file has them; `scale` is the codes per metre the file itself gives.

    `what` names the format for a person. `shaped` is False for NPY and NPZ, whose arrays need
    not be images.
    """

    values: NDArray[Any]
    what: str
    shaped: bool = True
    scale: float | None = None


def read_depth(path: Path, *, scale: float | None = None, channel: str | None = None) -> DepthImage:
    """The depth image in a 16-bit PNG, EXR, NPY, NPZ, PFM or TIFF file.

    `scale` is codes per metre of an integer file; float files hold metres and ignore it.
    `channel` names the EXR channel or NPZ array; other formats have no choice and ignore it.
    Zero, NaN, infinite and negative values are unknown, and so is the largest 16-bit code.
    """
    check_scale(scale)
    return depth_from_stored(path, load_stored(path, channel), scale)


def check_scale(scale: float | None) -> None:
    """Raises UsageError unless the scale is None or a finite number above 0."""
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UsageError(f"--depth-scale must be a finite number above 0, not {scale:g}")


def load_stored(path: Path, channel: str | None) -> StoredArray:
    """The one array of numbers in the file that can be depth, of whatever shape."""
    data = read_bytes(path)
    kind = kind_of(data)
    if kind == "PNG":
        return _load_png(path, data)
    if kind == "TIFF":
        return _load_tiff(path, data)
    if kind == "EXR":
        return _load_exr(path, data, channel)
    if kind == "PFM":
        values, factor = parse_pfm(path, data)
        aside = "" if factor == 1 else f", scale factor {factor:g} of its header not applied"
        return StoredArray(values=values, what=f"PFM{aside}")
    if kind == "NPY":
        array = parse_npy(path, data)
        return StoredArray(values=array, what=f"{array.dtype} NPY", shaped=False)
    if kind == "NPZ":
        name, array = parse_npz(path, data, channel)
        return StoredArray(values=array, what=f"{array.dtype} NPZ array {name}", shaped=False)
    if kind in ("JPEG", "WEBP"):
        raise _eight_bits(path, kind)
    raise FileFormatError(
        f"{path} is not a depth file; give a 16-bit PNG, EXR, NPY, NPZ, PFM or TIFF"
    )


def depth_from_stored(path: Path, stored: StoredArray, scale: float | None) -> DepthImage:
    """The stored numbers as a depth image: one channel, metres, unknown made 0."""
    values = _as_image(path, stored.values)
    check_pixel_count(path, values.shape[1], values.shape[0])
    if values.dtype.kind == "f":
        return DepthImage(values=known_metres(values), source=stored.what, assumed_scale=False)
    divisor = scale or stored.scale or KITTI_SCALE
    assumed = scale is None and stored.scale is None
    source = f"{stored.what} ÷ {divisor:.12g}"
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
    """float32 of the same shape in which everything but a finite depth above 0 is 0."""
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


def _eight_bits(path: Path, kind: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is an 8-bit {kind}; 8 bits cannot hold depth and it is probably a picture of a "
        "depth map, give the 16-bit PNG, EXR or NPY"
    )


def _load_png(path: Path, data: bytes) -> StoredArray:
    facts = read_png_facts(path, data)
    if facts.bit_depth != 16 and facts.colour_type != PALETTE:
        raise _eight_bits(path, "PNG")
    if facts.colour_type not in (GREY, RGB):
        raise _not_grey(path, "a palette" if facts.colour_type == PALETTE else "several channels")
    codes = decode_with_opencv(path, data, "PNG")
    what = "16-bit PNG"
    if facts.colour_type == RGB:
        codes = _equal_channel(path, codes)
        what += " of three equal channels"
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise damaged(path, "PNG", "cannot be decoded as 16-bit grey")
    own = _scale_in(path, f"{SCALE_KEY}={facts.text.get(SCALE_KEY, '')}")
    return StoredArray(values=codes, what=what, scale=own)


def _equal_channel(path: Path, codes: NDArray[Any]) -> NDArray[Any]:
    """(H, W) of a picture whose three colours are equal, as SYNTHIA's depth is stored."""
    if codes.ndim != 3 or codes.shape[2] < 3:
        raise damaged(path, "PNG", "cannot be decoded as 16-bit colour")
    first = codes[:, :, 0]
    # where the file makes one colour transparent, OpenCV adds a fourth channel
    if not all(np.array_equal(first, codes[:, :, k]) for k in (1, 2)):
        raise _not_grey(path, "several channels")
    return np.ascontiguousarray(first)


def _not_grey(path: Path, colours: str) -> FileFormatError:
    return FileFormatError(
        f"{path} is a PNG with {colours}; depth is one 16-bit grey channel, save it so"
    )


def _load_tiff(path: Path, data: bytes) -> StoredArray:
    facts = read_tiff_facts(path, data)
    if facts.samples != 1:
        raise FileFormatError(
            f"{path} is a TIFF with {facts.samples} channels; depth is one channel, save it so"
        )
    if (facts.number, facts.bits) not in (("uint", 16), ("float", 32), ("float", 64)):
        if facts.bits <= 8:
            raise _eight_bits(path, "TIFF")
        raise FileFormatError(
            f"{path} is a {facts.bits}-bit {facts.number} TIFF; save depth as float32 or uint16"
        )
    values = decode_with_opencv(path, data, "TIFF")
    if values.ndim != 2 or values.dtype.itemsize * 8 != facts.bits:
        raise damaged(path, "TIFF", "cannot be decoded as one channel")
    what = f"{facts.bits}-bit {'float ' if facts.number == 'float' else ''}TIFF"
    return StoredArray(values=values, what=what, scale=_scale_in(path, facts.description))


def _scale_in(path: Path, text: str) -> float | None:
    match = re.search(re.escape(SCALE_KEY) + r"=(\S+)", text)
    if match is None:
        return None
    try:
        scale = float(match[1])
    except ValueError:
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        raise FileFormatError(
            f"{path} says {SCALE_KEY}={match[1][:40]}, which is no scale; write the file again"
        )
    return scale


def _load_exr(path: Path, data: bytes, channel: str | None) -> StoredArray:
    # OpenEXR takes 60 ms to import; most depth files are not EXR.
    from pnpdepth_cli.io.exr import read_exr_channels

    channels = read_exr_channels(path, data)
    name = channel if channel is not None else _depth_channel(path, channels)
    if name not in channels:
        listing = ", ".join(channels)
        raise UsageError(f"{path} has no channel {name!r}; --channel can be one of: {listing}")
    return StoredArray(values=channels[name], what=f"EXR channel {name}")


def _depth_channel(path: Path, channels: dict[str, NDArray[Any]]) -> str:
    """The only channel, or the only one named for depth, or R of a grey picture in R, G, B."""
    names = [name for name in channels if name != "A"] or list(channels)
    if len(names) == 1:
        return names[0]
    named = [name for name in names if not _DEPTH_NAMES.isdisjoint(name.lower().split("."))]
    if len(named) == 1:
        return named[0]
    if sorted(names) == ["B", "G", "R"]:
        first = channels["R"]
        if all(np.array_equal(first, channels[k], equal_nan=True) for k in "GB"):
            return "R"
    raise FileFormatError(
        f"{path} has several channels ({', '.join(channels)}); choose one with --channel"
    )
