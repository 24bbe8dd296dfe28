"""PNG, TIFF and OpenEXR: decoded by their libraries after what they claim is checked."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import FileFormatError, UsageError
from pnpdepth_cli.io.decoding import (
    IMAGE_ERRORS,
    check_tags,
    decode_with_opencv,
    open_image,
    raw_mode,
    silence,
)
from pnpdepth_cli.io.file_bytes import check_pixel_count, check_value_count, damaged
from pnpdepth_cli.io.formats import (
    SCALE_KEY,
    DepthFile,
    DepthFormat,
    Reading,
    check_scale,
    eight_bits,
)

_COMPRESSION_LEVEL = 4  # of zlib: a third of the time of its default 6, files 4 per cent larger


def _read_png(path: Path, data: bytes) -> DepthFile:
    with open_image(path, data, "PNG") as image:
        mode, palette = raw_mode(image), image.mode == "P"
        if not palette and ";16" not in mode:
            raise eight_bits(path, "PNG")
        if palette or not mode.startswith(("I;16", "RGB;16")):
            raise _not_grey(path, "PNG", "a palette" if palette else "several channels")
        description = "16-bit PNG"
        if mode.startswith("I"):
            codes = np.asarray(image).astype(np.uint16, copy=False)
        else:  # as SYNTHIA's depth is stored; Pillow would cut it to 8 bits
            colours = decode_with_opencv(path, data, "PNG")
            codes = np.ascontiguousarray(colours[:, :, 0])
            if not all(np.array_equal(codes, colours[:, :, k]) for k in (1, 2)):
                raise _not_grey(path, "PNG", "several channels")
            description += " of three equal channels"
        stated = image.info.get(SCALE_KEY)
    return DepthFile(values=codes, reading=Reading(description, _stated_scale(path, stated)))


def _stated_scale(path: Path, text: str | None) -> float | None:
    """The codes per metre that a file states. Raises FileFormatError for another text."""
    if text is None:
        return None
    try:
        check_scale(scale := float(text))
    except (ValueError, UsageError) as error:
        raise damaged(path, f"{SCALE_KEY}={text[:40]}", "is no scale") from error
    return scale


def _not_grey(path: Path, kind: str, colours: str) -> FileFormatError:
    return FileFormatError(f"{path} is a {kind} with {colours}; save depth as one grey channel")


def _write_png(file: Path, codes: NDArray[np.uint16], text: Mapping[str, str]) -> None:
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    for key, value in text.items():
        chunks.add_text(key, value)
    Image.fromarray(codes).save(file, "PNG", pnginfo=chunks, compress_level=_COMPRESSION_LEVEL)


PNG = DepthFormat(
    name="PNG",
    suffixes=(".png",),
    magic=(b"\x89PNG\r\n\x1a\n",),
    read=_read_png,
    write=_write_png,
    integer=True,
)


_WIDTH, _HEIGHT, _BITS, _DESCRIPTION, _SAMPLES, _SAMPLE_FORMAT = 256, 257, 258, 270, 277, 339
_BLOCK_TAGS = ((273, 279), (324, 325))  # offsets and byte counts, of strips or of tiles
_NUMBERS = {2: "int", 3: "float"}


class TiffFacts(NamedTuple):
    """Tags of the first page: bits of a sample, "uint", "int" or "float", channels, description."""

    bits: int
    number: str
    samples: int
    description: str


def read_tiff_facts(path: Path, data: bytes) -> TiffFacts:
    """Returns the tags of the first page, also of pixels that Pillow does not open.

    Raises:
        FileFormatError: Tags or pixels lie outside the file, or the image exceeds the budget.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        check_tags(data)
        with silence():
            tags: Any = ImageFileDirectory_v2(data[:8])
            stream = io.BytesIO(data)
            stream.seek(tags.next)
            tags.load(stream)
        width, height, samples = tags[_WIDTH], tags[_HEIGHT], tags.get(_SAMPLES, 1)
        bits, number = (tags.get(tag, (1,))[0] for tag in (_BITS, _SAMPLE_FORMAT))
        blocks = [zip(tags[a], tags[b], strict=True) for a, b in _BLOCK_TAGS if a in tags]
        end = max(sum(block) for of_kind in blocks for block in of_kind)
        description = str(tags.get(_DESCRIPTION, ""))
        if end > len(data):
            raise damaged(path, "TIFF", f"is cut short: {len(data):,} of {end:,} bytes")
        check_pixel_count(
            path, int(width), int(height), channels=int(samples),
            value_bytes=max(1, int(bits) // 8), file_bytes=len(data),
        )  # fmt: skip
    except (*IMAGE_ERRORS, TypeError) as error:  # TypeError: a tag has several values
        raise damaged(path, "TIFF", f"is cut short or corrupt ({error})") from error
    return TiffFacts(int(bits), _NUMBERS.get(number, "uint"), int(samples), description)


def _read_tiff(path: Path, data: bytes) -> DepthFile:
    facts = read_tiff_facts(path, data)
    if facts.samples != 1:
        raise _not_grey(path, "TIFF", f"{facts.samples} channels")
    if (facts.number, facts.bits) not in (("uint", 16), ("float", 32), ("float", 64)):
        if facts.bits <= 8:
            raise eight_bits(path, "TIFF")
        raise FileFormatError(
            f"{path} is a {facts.bits}-bit {facts.number} TIFF; save depth as float32 or uint16"
        )
    values = decode_with_opencv(path, data, "TIFF")  # Pillow has no 64-bit floats
    if values.ndim != 2 or values.dtype.itemsize * 8 != facts.bits:
        raise damaged(path, "TIFF", "cannot be decoded as one channel")
    description = f"{facts.bits}-bit {'float ' if facts.number == 'float' else ''}TIFF"
    stated = re.search(re.escape(SCALE_KEY) + r"=(\S+)", facts.description)
    scale = _stated_scale(path, None if stated is None else stated[1])
    return DepthFile(values=values, reading=Reading(description, scale))


def _write_tiff(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    from PIL import Image

    encoded = io.BytesIO()  # libtiff prints to standard error when a disk is full
    Image.fromarray(metres).save(encoded, "TIFF", compression="tiff_adobe_deflate")
    file.write_bytes(encoded.getvalue())


TIFF = DepthFormat(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    magic=(b"II*\x00", b"MM\x00*"),
    read=_read_tiff,
    write=_write_tiff,
)


_DEPTH_NAMES = frozenset({"z", "depth"})
_CHANNEL_LIST = re.compile(rb"channels\0chlist\0(.{4})", re.DOTALL)
_MOST_CHANNEL_BYTES = 1 << 19  # 20,000 channels; OpenEXR's time grows with the square


def read_exr_channels(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    """Returns the channels by name: (H, W) arrays of float16, float32 or uint32.

    Channels of a file with several parts are called `part.channel`. Pixels of the display
    window outside the data window are 0.

    Raises:
        FileFormatError: The file is damaged, deep or subsampled, or exceeds the budget.
    """
    import OpenEXR

    # The size that the channels will have is checked before they are decoded.
    lists = [int.from_bytes(size, "little") for size in _CHANNEL_LIST.findall(data)]
    if sum(lists) > _MOST_CHANNEL_BYTES:
        raise FileFormatError(f"{path} lists tens of thousands of channels; export the depth alone")
    try:
        with silence():
            with OpenEXR.File(str(path), header_only=True) as file:
                count = len(file.parts)
                claimed = sum(
                    _claimed_bytes(path, file.header(index), len(data)) for index in range(count)
                )
            check_value_count(path, 1, value_bytes=claimed, what=f"{count} parts")
            with OpenEXR.File(str(path), separate_channels=True) as file:
                parts = [_part_channels(part) for part in file.parts]
                names = [str(part.name()) for part in file.parts]
    except (RuntimeError, ValueError, LookupError, OSError) as error:  # as the binding has it
        raise damaged(path, "EXR", f"cannot be read ({error})") from error
    # All parts must have been decoded.
    if len(parts) != count:  # the binding leaves out a part that it cannot decode
        raise damaged(path, "EXR", "cannot be decoded")
    # Names of several parts begin with the part's.
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


def _write_exr(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """One float32 channel Z, ZIP compressed."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channel = OpenEXR.Channel(metres)
    try:
        with OpenEXR.File(header, {"Z": channel}) as image:
            image.write(str(file))
    except RuntimeError as error:  # how the binding reports a full disk, say
        raise OSError(str(error)) from error


def _claimed_bytes(path: Path, header: dict[str, Any], file_bytes: int) -> int:
    """Number of bytes that a part is decoded to. FileFormatError if it cannot be read."""
    claimed = 0
    if "deep" in str(header.get("type", "")):
        raise FileFormatError(f"{path} is a deep EXR; export it flattened")
    for window in ("dataWindow", "displayWindow"):
        low, high = header[window]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        channels = len(header["channels"])
        check_pixel_count(
            path, width, height, channels=channels, value_bytes=4, file_bytes=file_bytes
        )
        claimed = max(claimed, 4 * channels * width * height)
    for channel in header["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise FileFormatError(f"{path}: channel {channel.name} is subsampled; export it whole")
    return claimed


def _part_channels(part: Any) -> dict[str, NDArray[Any]]:
    """The channels of a part in its display window."""
    data, display = (np.asarray(part.header[key]) for key in ("dataWindow", "displayWindow"))
    channels = {name: np.asarray(channel.pixels) for name, channel in part.channels.items()}
    if np.array_equal(data, display):
        return channels
    # The pixels from low to below high lie in both windows.
    low = np.maximum(data[0], display[0])
    high = np.maximum(np.minimum(data[1], display[1]) + 1, low)
    of_data, of_display = (
        tuple(map(slice, (low - start)[::-1], (high - start)[::-1]))
        for start in (data[0], display[0])
    )
    placed = {}
    for name, pixels in channels.items():
        placed[name] = np.zeros((display[1] - display[0] + 1)[::-1], pixels.dtype)
        placed[name][of_display] = pixels[of_data]
    return placed


def _read_exr(path: Path, data: bytes) -> DepthFile:
    channels = read_exr_channels(path, data)
    name = _depth_channel(path, channels)
    return DepthFile(values=channels[name], reading=Reading(f"EXR channel {name}"))


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
        f"{path} has several channels ({', '.join(channels)}); export the depth alone"
    )


EXR = DepthFormat(
    name="EXR", suffixes=(".exr",), magic=(b"v/1\x01",), read=_read_exr, write=_write_exr
)
