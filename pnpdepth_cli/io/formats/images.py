"""PNG, TIFF and OpenEXR: decoded by their libraries after what they claim is checked."""

from __future__ import annotations

import io
import math
import re
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged
from pnpdepth_cli.io.formats import SCALE_KEY, DepthFile, Reading, check_scale, no_depth

if TYPE_CHECKING:
    import OpenEXR
    import PIL.Image

_BYTES_OF_TYPE = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_BITS, _CHANNELS, _SAMPLE_FORMAT = 258, 277, 339
"""Tags of a TIFF's pixels."""
_FLOATS = 3  # of _SAMPLE_FORMAT
_POINTERS = (34665, 34853, 40965)  # to further tags: Exif, GPS and interoperability
IMAGE_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    LookupError,
    ArithmeticError,
    RuntimeError,  # of libheif
    struct.error,
    zlib.error,
)
"""What Pillow and its plugins raise on damaged files."""
_END_OF_PNG = b"\xaeB`\x82"
"""The checksum of the last chunk, which Pillow does not read."""

warnings.filterwarnings("ignore", module=r"PIL\.")  # of damaged files, which are errors here


def check_tags(data: bytes) -> None:
    """Checks the tags of all pages of a TIFF, or of EXIF, before a library copies them.

    Thousands of tags can share the same bytes, and so can pages.

    Raises:
        ValueError: The tags, or the pages, together claim more bytes than there are.
        struct.error: A page or a tag lies outside the data.
    """
    order = "<" if data[:2] == b"II" else ">"
    pages = list(struct.unpack_from(f"{order}I", data, 4))  # offsets, of which 0 is the end
    seen: set[int] = set()
    claimed_bytes = 0
    page_bytes = 0
    while pages:
        start = pages.pop()
        if start == 0 or start in seen:
            continue
        seen.add(start)
        # A page is the number of its tags, 12 bytes for each, and the offset of the next page.
        end = start + 2 + 12 * struct.unpack_from(f"{order}H", data, start)[0]
        pages += struct.unpack_from(f"{order}I", data, end)  # the list of tags is complete
        page_bytes += end - start
        if page_bytes > len(data):
            raise ValueError("its pages overlap")
        for tag, kind, number, value in struct.iter_unpack(f"{order}HHII", data[start + 2 : end]):
            claimed_bytes += number * _BYTES_OF_TYPE.get(kind, 1)
            if claimed_bytes > len(data):
                raise ValueError(f"its tags claim more than {len(data):,} bytes")
            if tag in _POINTERS:
                pages.append(value)


def check_exif(image: PIL.Image.Image) -> None:
    """Raises the errors of `check_tags` for an image's EXIF, which may end without a next page."""
    if exif := image.info.get("exif"):
        check_tags(exif.removeprefix(b"Exif\0\0") + bytes(4))


@contextmanager
def open_image(path: Path, data: bytes, kind: str) -> Iterator[PIL.Image.Image]:
    """Yields the image of a file, not yet decoded; errors inside the block become ours.

    The tags of a TIFF, the checksums of a PNG and the size that the header claims are checked. The
    kind is "PNG", "JPEG", "TIFF", "WEBP" or "HEIF".

    Raises:
        InputError: The file is damaged or cut short, or exceeds the budget.
    """
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # the budget limits them, which a user can raise
    stream = io.BytesIO(data)
    try:
        if kind == "TIFF":
            check_tags(data)
        if kind == "PNG":
            with Image.open(stream, formats=[kind]) as image:
                image.verify()
            if stream.read(4) != _END_OF_PNG:
                raise damaged(path, kind, f"is cut short after {len(data):,} bytes")
        with Image.open(stream, formats=[kind]) as image:
            # Pillow decodes three channels into four.
            channels = 1 if len(image.getbands()) == 1 else 4
            if image.mode in ("I", "F"):
                value_bytes = 4
            elif ";16" in raw_mode(image):
                value_bytes = 2
            else:
                value_bytes = 1
            pixel_bytes = channels * value_bytes
            check_pixel_count(path, *image.size, pixel_bytes=pixel_bytes, file_bytes=len(data))
            yield image
    except IMAGE_ERRORS as error:
        if kind == "TIFF" and (pixels := _float_pixels(data)) is not None:
            raise InputError(
                f"{path} is a TIFF of {pixels}, which is not read; save one channel of 32-bit"
                " floats"
            ) from error
        # Pillow names the in-memory buffer, which means nothing to a reader.
        is_unknown = "BytesIO" in str(error)
        raise damaged(
            path,
            kind,
            f"cannot be decoded ({'unknown content or type of pixels' if is_unknown else error})",
        ) from error


def _float_pixels(data: bytes) -> str | None:
    """The pixels of a TIFF of floats that Pillow does not read; None of others, and if damaged."""
    try:
        order = "<" if data[:2] == b"II" else ">"
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        entries = data[start + 2 : start + 2 + 12 * count]
        found = {
            tag: (number, value, field[8:])
            for field in (entries[at : at + 12] for at in range(0, len(entries), 12))
            for tag, _, number, value in [struct.unpack(f"{order}HHII", field)]
        }
        # Short numbers, of each channel: in the tag itself, or where it points to.
        first = dict[int, int]()
        for tag in (_BITS, _SAMPLE_FORMAT):
            number, value, own = found[tag]
            where = own if number <= 2 else data[value : value + 2]
            (first[tag],) = struct.unpack_from(f"{order}H", where)
        _, _, own = found[_CHANNELS]
        (channels,) = struct.unpack_from(f"{order}H", own)
    except (struct.error, KeyError):
        return None
    if first[_SAMPLE_FORMAT] != _FLOATS or (first[_BITS] == 32 and channels == 1):
        return None
    return f"{first[_BITS]}-bit floats of {channels} channel{'s' if channels != 1 else ''}"


def raw_mode(image: PIL.Image.Image) -> str:
    """Returns how a file that is not yet decoded stores its pixels, such as "RGB;16B"."""
    tiles = getattr(image, "tile", [])
    arguments = tiles[0][3] if tiles else ""  # no named tuple before Pillow 11
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def orientation_of(image: PIL.Image.Image) -> int:
    """Returns the EXIF orientation 1..8, or another number that means nothing."""
    from PIL.ExifTags import Base

    try:
        check_exif(image)
        return int(image.getexif().get(Base.Orientation, 1))
    except IMAGE_ERRORS:  # unreadable EXIF in a valid image says nothing of its rotation
        return 1


_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
"""Tags of GDAL's GeoTIFF driver: XML with scale and offset of a band, and the number of no data."""
_GDAL_ITEM = re.compile(r'<item\b[^>]*\brole="(scale|offset)"[^>]*>([^<]*)</item>')
_LOG_STEPS = 65533  # of MoGe's codes of log depth
_COMPRESSION_LEVEL = 4  # of zlib: a third of the time of its default 6, files 4 per cent larger


def read_png(path: Path, data: bytes) -> DepthFile:
    """Returns the codes of a 16-bit PNG of one channel, and the scale that it states.

    Codes that are logarithms of depth between two ends, as MoGe writes them, are returned as that
    depth.
    """
    with open_image(path, data, "PNG") as image:
        mode = raw_mode(image)
        if not mode.startswith("I;16"):
            raise no_depth(path, "a PNG of several channels" if ";16" in mode else "an 8-bit PNG")
        codes = np.asarray(image).astype(np.uint16, copy=False)
        stated = image.info.get(SCALE_KEY)
        ends = _log_ends(image)
    if ends is not None:
        near, far = ends
        share = (codes.astype(np.float64) - 1) / _LOG_STEPS
        depth = near * (far / near) ** share
        depth[(codes == 0) | (codes > _LOG_STEPS + 1)] = 0
        source = f"16-bit PNG of log depth from {near:.6g} to {far:.6g} (from the file)"
        return DepthFile(values=depth.astype(np.float32), reading=Reading(source))
    try:
        scale = None if stated is None else float(stated)
        check_scale(scale)
    except (ValueError, UsageError) as error:
        raise damaged(path, f"{SCALE_KEY}={str(stated)[:40]}", "is no scale") from error
    return DepthFile(values=codes, reading=Reading("16-bit PNG", scale))


def _log_ends(image: PIL.Image.Image) -> tuple[float, float] | None:
    """The depths of codes 1 and 65534 that a PNG states, as MoGe writes it; None for others.

    The codes in between divide the logarithm evenly. 0 is unknown, 65535 the sky.
    """
    try:
        near, far = (float(image.info[key]) for key in ("near", "far"))
        unit = float(image.info.get("unit", 1))
    except (KeyError, TypeError, ValueError):
        return None
    if not (0 < near < far < math.inf and 0 < unit < math.inf):
        return None
    return near * unit, far * unit


def write_png(file: Path, codes: NDArray[np.uint16], text: Mapping[str, str]) -> None:
    """Writes codes (H, W) and texts by their keys."""
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    for key, value in text.items():
        chunks.add_text(key, value)
    Image.fromarray(codes).save(file, "PNG", pnginfo=chunks, compress_level=_COMPRESSION_LEVEL)


def read_tiff(path: Path, data: bytes) -> DepthFile:
    """Returns the numbers of a TIFF of one channel, floats or 16-bit codes."""
    with open_image(path, data, "TIFF") as image:
        scale, offset, nothing = _gdal_tags(path, image)
        if image.mode == "F":
            values = np.asarray(image)
            source = "32-bit float TIFF"
            if nothing is not None:
                values = np.where(values == np.float32(nothing), np.float32(0), values)
            if (scale, offset) != (1.0, 0.0):
                values = np.where(values != 0, values * np.float32(scale) + np.float32(offset), 0)
                source += f" × {scale:g} + {offset:g} (from the file)"
            return DepthFile(values=values.astype(np.float32), reading=Reading(source))
        if image.mode.startswith("I;16"):
            codes = np.asarray(image).astype(np.uint16)
            if nothing is not None:
                codes = np.where(codes == nothing, np.uint16(0), codes)
            if offset:
                metres = np.where(codes > 0, codes * scale + offset, 0).astype(np.float32)
                source = f"16-bit TIFF × {scale:g} + {offset:g} (from the file)"
                return DepthFile(values=metres, reading=Reading(source))
            own = None if scale == 1 else float(f"{1 / scale:.9g}")
            return DepthFile(values=codes, reading=Reading("16-bit TIFF", own))
        raise no_depth(path, f"a TIFF of mode {image.mode}, not F or I;16")


class _GdalTags(NamedTuple):
    """What GDAL says of the numbers of a TIFF: metres = scale · number + offset."""

    scale: float  # 1 if it says nothing
    offset: float  # 0 if it says nothing
    nothing: float | None  # the number that stands for no data, if there is one


def _gdal_tags(path: Path, image: PIL.Image.Image) -> _GdalTags:
    """What the tags of GDAL say. Raises InputError if they are no numbers."""
    tags: Mapping[int, object] = getattr(image, "tag_v2", {})
    found = dict(_GDAL_ITEM.findall(str(tags.get(_GDAL_METADATA, "")).lower()))
    words = str(tags.get(_GDAL_NODATA, "")).strip("\0 \n")
    try:
        scale = float(found.get("scale", 1))
        offset = float(found.get("offset", 0))
        nothing = float(words) if words else None
    except ValueError as error:
        raise damaged(path, "TIFF", f"has tags of GDAL that are no numbers ({error})") from error
    if not (0 < scale < math.inf and math.isfinite(offset)):
        raise damaged(path, "TIFF", f"has a scale of {scale:g}")
    return _GdalTags(scale, offset, nothing)


def write_tiff(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes depth (H, W) as a TIFF of floats."""
    from PIL import Image

    encoded = io.BytesIO()  # libtiff prints to standard error when a disk is full
    Image.fromarray(metres).save(encoded, "TIFF", compression="tiff_adobe_deflate")
    file.write_bytes(encoded.getvalue())


_DEPTH_NAMES = frozenset({"z", "depth"})
_CHANNEL_LIST = re.compile(rb"channels\0chlist\0(.{4})", re.DOTALL)
_MOST_CHANNEL_BYTES = 1 << 19  # 20,000 channels; OpenEXR's time grows with the square
_EXR_LOCK = threading.Lock()  # standard output is redirected, by one thread at a time


def read_exr_channels(path: Path, data: bytes) -> dict[str, NDArray[np.generic]]:
    """Returns the channels by name: (H, W) arrays of float16, float32 or uint32.

    Raises:
        InputError: The file is damaged, or exceeds the budget; or it has several parts, or
            pixels that are deep, subsampled or cropped.
    """
    import OpenEXR

    # The size that the channels will have is checked before they are decoded.
    lists = [int.from_bytes(size, "little") for size in _CHANNEL_LIST.findall(data)]
    if sum(lists) > _MOST_CHANNEL_BYTES:
        raise InputError(f"{path} lists tens of thousands of channels; export the depth alone")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            _check_exr(path, file, len(data))
        # It prints why it cannot decode a part, which it leaves out.
        with (
            _EXR_LOCK,
            redirect_stdout(io.StringIO()),
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            channels = file.channels()
            return {name: np.asarray(channel.pixels) for name, channel in channels.items()}
    except (RuntimeError, ValueError, LookupError, OSError) as error:  # as the binding has it
        raise damaged(path, "EXR", f"cannot be read ({error})") from error


def _check_exr(path: Path, file: OpenEXR.File, file_bytes: int) -> None:
    """Raises InputError for what is not one flat image of whole channels in the budget."""
    header = file.header(0)
    channels = header["channels"]
    (left, top), (right, bottom) = np.array(header["dataWindow"]).tolist()
    check_pixel_count(
        path,
        right - left + 1,
        bottom - top + 1,
        pixel_bytes=4 * len(channels),
        file_bytes=file_bytes,
    )
    is_deep = "deep" in str(header.get("type", ""))
    is_cropped = not np.array_equal(header["dataWindow"], header["displayWindow"])
    is_sampled = any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels)
    if len(file.parts) > 1 or is_deep or is_cropped or is_sampled:
        raise InputError(
            f"{path} has several parts, or is deep, cropped or subsampled; export one flat image of"
            " its whole frame"
        )


def write_exr(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes depth (H, W) as an EXR of one channel Z, ZIP compressed."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channel = OpenEXR.Channel(metres)
    try:
        with OpenEXR.File(header, {"Z": channel}) as image:
            image.write(str(file))
    except RuntimeError as error:  # how the binding reports a full disk, say
        raise OSError(str(error)) from error


def read_exr(path: Path, data: bytes) -> DepthFile:
    """Returns the only channel, or the one named for depth, or R of a grey image in R, G, B."""
    channels = read_exr_channels(path, data)
    name = depth_channel(channels)
    if name is None:
        listing = ", ".join(channels)
        raise InputError(f"{path} has several channels ({listing}); export the depth alone")
    return DepthFile(values=channels[name], reading=Reading(f"EXR channel {name}"))


def depth_channel(channels: Mapping[str, NDArray[np.generic]]) -> str | None:
    """Returns the name of the channel that holds depth; None if it is not the only one."""
    names = [name for name in channels if name != "A"] or list(channels)
    named = [name for name in names if not _DEPTH_NAMES.isdisjoint(name.lower().split("."))]
    if sorted(names) == ["B", "G", "R"]:
        is_grey = all(np.array_equal(channels["R"], channels[c], equal_nan=True) for c in "GB")
        named = ["R"] if is_grey else []
    if len(names) == 1:
        return names[0]
    return named[0] if len(named) == 1 else None
