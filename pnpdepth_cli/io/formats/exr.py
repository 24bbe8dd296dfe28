"""OpenEXR: the flat channels of a file, in the frame of its display window."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.decoding import silence
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import DepthFormat, StoredArray

_DEPTH_NAMES = frozenset({"z", "depth"})


def read_exr_channels(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    """Returns the channels by name: (H, W) arrays of float16, float32 or uint32.

    Channels of a file with several parts are called `part.channel`. Pixels of the display
    window outside the data window are 0.

    Raises:
        FileFormatError: The file is damaged, deep or subsampled, or exceeds the budget.
    """
    import OpenEXR

    try:
        with silence():
            with OpenEXR.File(str(path), header_only=True) as file:
                count = len(file.parts)
                for index in range(count):
                    _check_header(path, file.header(index), len(data))
            with OpenEXR.File(str(path), separate_channels=True) as file:
                parts = [_part_channels(part) for part in file.parts]
                names = [str(part.name()) for part in file.parts]
    except FileFormatError:
        raise
    except Exception as error:  # the binding raises many kinds, UnicodeDecodeError among them
        raise damaged(path, "EXR", f"cannot be read ({error})") from error
    if len(parts) != count:  # the binding leaves out a part that it cannot decode
        raise damaged(path, "EXR", "cannot be decoded")
    if count == 1:
        channels = parts[0]
    else:
        channels = {
            f"{name}.{channel}": pixels
            for name, part in zip(names, parts, strict=True)
            for channel, pixels in part.items()
        }
    if not channels:
        raise FileFormatError(f"{path} holds no channel; export the depth again")
    return channels


def _write(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """One float32 channel Z, ZIP compressed."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channel = OpenEXR.Channel(metres)
    try:
        with OpenEXR.File(header, {"Z": channel}) as image:
            image.write(str(file))
    except RuntimeError as error:  # how the binding reports a full disk, say
        raise OSError(str(error)) from error


def _check_header(path: Path, header: dict[str, Any], file_bytes: int) -> None:
    if "deep" in str(header.get("type", "")):
        raise FileFormatError(f"{path} is a deep EXR; export it flattened")
    for window in ("dataWindow", "displayWindow"):
        low, high = header[window]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        channels = len(header["channels"])
        check_pixel_count(
            path, width, height, channels=channels, value_bytes=4, file_bytes=file_bytes
        )
    for channel in header["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise FileFormatError(
                f"{path}: channel {channel.name} is subsampled; export it at full resolution"
            )


def _part_channels(part: Any) -> dict[str, NDArray[Any]]:
    data, display = (np.asarray(part.header[key]) for key in ("dataWindow", "displayWindow"))
    channels = {name: np.asarray(channel.pixels) for name, channel in part.channels.items()}
    if np.array_equal(data, display):
        return channels
    size = display[1] - display[0] + 1
    low, high = ((end - display[0]).clip(0, size) for end in (data[0], data[1] + 1))
    shift = display[0] - data[0]  # of a pixel of the display window
    placed = {}
    for name, pixels in channels.items():
        whole = placed[name] = np.zeros(size[::-1], pixels.dtype)
        inside = pixels[max(shift[1], 0) :, max(shift[0], 0) :]
        there = whole[low[1] : high[1], low[0] : high[0]]
        there[:] = inside[: there.shape[0], : there.shape[1]]
    return placed


def _read(path: Path, data: bytes, channel: str | None) -> StoredArray:
    channels = read_exr_channels(path, data)
    name = channel if channel is not None else _depth_channel(path, channels)
    if name not in channels:
        listing = ", ".join(channels)
        raise UsageError(f"{path} has no channel {name!r}; --channel can be one of: {listing}")
    return StoredArray(values=channels[name], description=f"EXR channel {name}")


def _depth_channel(path: Path, channels: dict[str, NDArray[Any]]) -> str:
    """The only channel, or the only one named for depth, or R of a grey image in R, G, B."""
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


FORMAT = DepthFormat(name="EXR", suffixes=(".exr",), magic=(b"v/1\x01",), read=_read, write=_write)
