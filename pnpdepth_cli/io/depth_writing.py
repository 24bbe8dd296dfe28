"""Depth images into every format, so that reading them back gives the same metres."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import OutputError, SizeError
from pnpdepth_cli.io.arrays import npy_bytes, npz_bytes
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.depth_reading import (
    KITTI_SCALE,
    SATURATED_CODE,
    SCALE_KEY,
    check_scale,
    known_metres,
)
from pnpdepth_cli.io.pfm import pfm_bytes

DEPTH_SUFFIXES = (".png", ".exr", ".npy", ".npz", ".pfm", ".tif", ".tiff")
"""What `write_depth` can write; the first holds whole codes, the others float32 metres."""

_LEVEL = 4  # of zlib: a third of the time of its usual 6, files 4 per cent larger


def write_depth(
    path: Path,
    depth: NDArray[np.float32],
    *,
    scale: float = KITTI_SCALE,
    text: Mapping[str, str] | None = None,
) -> None:
    """`path` holds the (H, W) metres in the format of its suffix; not finite or <= 0 is 0.

    `scale` is the codes per metre of a PNG, which keeps it and `text` in the file. Raises
    OutputError when a depth is too large for 16 bits or so small that it would become 0, unknown.
    """
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise OutputError(
            f"{path}: depth cannot be written as {suffix or 'a file without suffix'!r}; "
            f"use one of {', '.join(DEPTH_SUFFIXES)}"
        )
    if depth.ndim != 2 or 0 in depth.shape:
        raise SizeError(f"{path}: depth of shape {depth.shape} is no image; give (H, W)")
    metres = known_metres(depth)
    if suffix == ".exr":
        from pnpdepth_cli.io.exr import write_exr_channel

        with atomic_path(path) as temporary:
            write_exr_channel(temporary, "Z", metres)
        return
    content = _encode(path, suffix, metres, scale, text or {})
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _encode(
    path: Path, suffix: str, metres: NDArray[np.float32], scale: float, text: Mapping[str, str]
) -> bytes:
    if suffix == ".npy":
        return npy_bytes(metres)
    if suffix == ".npz":
        return npz_bytes("depth", metres)
    if suffix == ".pfm":
        return pfm_bytes(metres)
    if suffix == ".png":
        key_scale = repr(float(scale)).removesuffix(".0")
        return _png_bytes(_codes(path, metres, scale), {SCALE_KEY: key_scale, **text})
    return _tiff_bytes(metres)


def _codes(path: Path, metres: NDArray[np.float32], scale: float) -> NDArray[np.uint16]:
    check_scale(scale)
    codes = np.rint(metres.astype(np.float64) * scale)
    if codes.max() >= SATURATED_CODE:
        raise OutputError(
            f"{path}: the largest depth, {metres.max():.6g} m, does not fit a 16-bit PNG with "
            f"{scale:g} codes per metre (at most {(SATURATED_CODE - 1) / scale:.6g} m); "
            "write .exr, .npy or .tiff"
        )
    lost = (metres > 0) & (codes == 0)
    if lost.any():
        raise OutputError(
            f"{path}: {int(lost.sum()):,} depths down to {metres[lost].min():.3g} m would become "
            f"0 (unknown) in a 16-bit PNG with {scale:g} codes per metre; write .exr, .npy or .tiff"
        )
    return codes.astype(np.uint16)


def _png_bytes(codes: NDArray[np.uint16], text: Mapping[str, str]) -> bytes:
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    for key, value in text.items():
        chunks.add_text(key, value)
    buffer = io.BytesIO()
    Image.fromarray(codes).save(buffer, "PNG", pnginfo=chunks, compress_level=_LEVEL)
    return buffer.getvalue()


def _tiff_bytes(metres: NDArray[np.float32]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(metres).save(buffer, "TIFF", compression="tiff_adobe_deflate")
    return buffer.getvalue()
