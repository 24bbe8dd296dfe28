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
"""Bytes of a value of a TIFF tag, by the number of its type; those of all others have one."""
_TAG_BYTES = 12  # of a tag: its number, type, count of values, and the values or where they are
_FIRST_PAGE_AT = 4
"""Where a TIFF has the offset of its first page."""
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
    """Raises an error if tags of a TIFF, or of EXIF, claim more bytes than there are.

    It is called before a library copies the tags: thousands of tags can share the same bytes, and
    so can pages, so that a small file would take much memory.

    Args:
        data: TIFF, or EXIF, from its byte order on.

    Raises:
        ValueError: The tags, or the pages, together claim more bytes than there are.
        struct.error: A page or a tag lies outside the data.
    """
    # A TIFF begins with II or MM, its byte order, and has the offset of its first page at byte 4.
    order = "<" if data[:2] == b"II" else ">"
    page_offsets = list(struct.unpack_from(f"{order}I", data, _FIRST_PAGE_AT))
    checked_offsets = {0}  # which is no page
    claimed_bytes = 0
    page_bytes = 0
    while page_offsets:
        start = page_offsets.pop()
        if start in checked_offsets:
            continue
        checked_offsets.add(start)
        # A page is the number of its tags, the tags, and the offset of the next page.
        (tag_count,) = struct.unpack_from(f"{order}H", data, start)
        end = start + 2 + _TAG_BYTES * tag_count
        page_offsets += struct.unpack_from(f"{order}I", data, end)  # fails if tags are cut off
        page_bytes += end - start
        if page_bytes > len(data):
            raise ValueError("its pages overlap")
        # The value of some tags is the offset of a further page.
        for tag, kind, count, value in struct.iter_unpack(f"{order}HHII", data[start + 2 : end]):
            claimed_bytes += count * _BYTES_OF_TYPE.get(kind, 1)
            if claimed_bytes > len(data):
                raise ValueError(f"its tags claim more than {len(data):,} bytes")
            if tag in _POINTERS:
                page_offsets.append(value)


def check_exif(image: PIL.Image.Image) -> None:
    """Raises the errors of `check_tags` for the EXIF of an image, if it has any."""
    exif = image.info.get("exif")
    if exif:
        # Some programs leave out the offset of the next page at the end, which is 0.
        check_tags(exif.removeprefix(b"Exif\0\0") + bytes(4))


@contextmanager
def open_image(path: Path, data: bytes, kind: str) -> Iterator[PIL.Image.Image]:
    """Yields the image of a file, not yet decoded.

    The tags of a TIFF, the checksums of a PNG and the size that the header claims are checked
    before. What Pillow raises inside the block on a damaged file becomes an InputError.

    Args:
        path: The file, for messages.
        data: Content of the file.
        kind: Format of the file: "PNG", "JPEG", "TIFF", "WEBP" or "HEIF".

    Raises:
        InputError: The file is damaged or cut short, or exceeds the budget.
    """
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # the budget limits them, which a user can raise
    stream = io.BytesIO(data)
    try:
        # What Pillow does not check as it decodes.
        if kind == "TIFF":
            check_tags(data)
        if kind == "PNG":
            with Image.open(stream, formats=[kind]) as image:
                image.verify()  # which reads up to the last checksum
            if stream.read(4) != _END_OF_PNG:
                raise damaged(path, kind, f"is cut short after {len(data):,} bytes")
        with Image.open(stream, formats=[kind]) as image:
            # The memory that the pixels will take; Pillow decodes three channels into four.
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
        float_pixels = _unread_floats(data) if kind == "TIFF" else None
        if float_pixels is not None:
            raise InputError(
                f"{path} is a TIFF of {float_pixels}, which is not read; save one channel of 32-bit"
                " floats"
            ) from error
        reason = str(error)
        if "BytesIO" in reason:  # Pillow names the buffer in memory, which tells a user nothing
            reason = "unknown content or type of pixels"
        raise damaged(path, kind, f"cannot be decoded ({reason})") from error


def _unread_floats(data: bytes) -> str | None:
    """What the pixels of a TIFF are, such as "64-bit floats of 1 channel", if Pillow reads no such.

    None for a TIFF of other numbers, or of one channel of 32-bit floats, which Pillow reads, and
    for a damaged one.
    """
    order = "<" if data[:2] == b"II" else ">"
    try:
        (start,) = struct.unpack_from(f"{order}I", data, _FIRST_PAGE_AT)
        (tag_count,) = struct.unpack_from(f"{order}H", data, start)
        entries = data[start + 2 : start + 2 + _TAG_BYTES * tag_count]
        first_values = dict[int, int]()
        for begin in range(0, len(entries), _TAG_BYTES):
            entry = entries[begin : begin + _TAG_BYTES]
            tag, _, value_count, offset = struct.unpack(f"{order}HHII", entry)
            # Up to two short numbers are in the tag itself, more where its last 4 bytes point to.
            if tag in (_BITS, _SAMPLE_FORMAT, _CHANNELS):
                values = entry[8:] if value_count <= 2 else data[offset : offset + 2]
                (first_values[tag],) = struct.unpack_from(f"{order}H", values)
        bits, sample_format, channels = (
            first_values[tag] for tag in (_BITS, _SAMPLE_FORMAT, _CHANNELS)
        )
    except (struct.error, KeyError):  # a tag lies outside of the file, or is missing
        return None
    is_read = bits == 32 and channels == 1
    if sample_format != _FLOATS or is_read:
        return None
    return f"{bits}-bit floats of {channels} channel{'s' if channels != 1 else ''}"


def raw_mode(image: PIL.Image.Image) -> str:
    """Returns how a file that is not yet decoded stores its pixels, such as "RGB;16B".

    The text is Pillow's raw mode; it is empty for a format that has none.
    """
    # A tile is (decoder, box, offset, arguments), a named tuple from Pillow 11 on.
    tiles = getattr(image, "tile", [])
    arguments = tiles[0][3] if tiles else ""
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


def orientation_of(image: PIL.Image.Image) -> int:
    """Returns the EXIF orientation 1..8 of an image, 1 if it has none that can be read.

    Any other number is what the EXIF has, and means nothing.
    """
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
    """Returns the 16-bit codes (H, W) of a PNG, and the scale that it states, if any.

    MoGe writes codes that are logarithms of depth. These are returned as depth, float32 metres, 0
    where unknown.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, beyond the budget, or no PNG of one channel of 16 bits, or
            it states a scale that is no number above 0.
    """
    with open_image(path, data, "PNG") as image:
        mode = raw_mode(image)
        if not mode.startswith("I;16"):
            raise no_depth(path, "a PNG of several channels" if ";16" in mode else "an 8-bit PNG")
        codes = np.asarray(image).astype(np.uint16, copy=False)
        stated_scale = image.info.get(SCALE_KEY)
        log_ends = _log_ends(image)
    # Codes of log depth: 1 is the near end, 65534 the far one.
    if log_ends is not None:
        near, far = log_ends
        position = (codes.astype(np.float64) - 1) / _LOG_STEPS
        depth = near * (far / near) ** position
        depth[(codes == 0) | (codes > _LOG_STEPS + 1)] = 0
        source = f"16-bit PNG of log depth from {near:.6g} to {far:.6g} (from the file)"
        return DepthFile(values=depth.astype(np.float32), reading=Reading(source))
    # Codes of depth.
    try:
        scale = None if stated_scale is None else float(stated_scale)
        check_scale(scale)
    except (ValueError, UsageError) as error:
        raise damaged(path, f"{SCALE_KEY}={str(stated_scale)[:40]}", "is no scale") from error
    return DepthFile(values=codes, reading=Reading("16-bit PNG", scale))


def _log_ends(image: PIL.Image.Image) -> tuple[float, float] | None:
    """The depths in metres of codes 1 and 65534, as a PNG that MoGe wrote states them.

    The codes in between divide the logarithm evenly. 0 is unknown, 65535 the sky. None for a PNG
    that states no such depths.
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
    """Writes a 16-bit PNG.

    Args:
        file: The file, which is replaced.
        codes: (H, W) codes of depth, 0 where unknown.
        text: Texts that the file keeps, by their keys.

    Raises:
        OSError: The file cannot be written.
    """
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    for key, value in text.items():
        chunks.add_text(key, value)
    Image.fromarray(codes).save(file, "PNG", pnginfo=chunks, compress_level=_COMPRESSION_LEVEL)


def read_tiff(path: Path, data: bytes) -> DepthFile:
    """Returns the numbers (H, W) of a TIFF of one channel, float32 metres or 16-bit codes.

    What GDAL's tags state is applied: metres are scale · number + offset, and one number stands for
    no data. Depth is 0 where unknown. Codes with an offset become float32 metres.

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, beyond the budget, or of other pixels.
    """
    with open_image(path, data, "TIFF") as image:
        scale, offset, no_data = _gdal_tags(path, image)
        # Floats.
        if image.mode == "F":
            values = np.asarray(image)
            source = "32-bit float TIFF"
            if no_data is not None:
                values = np.where(values == np.float32(no_data), np.float32(0), values)
            if (scale, offset) != (1.0, 0.0):
                values = np.where(values != 0, values * np.float32(scale) + np.float32(offset), 0)
                source += f" × {scale:g} + {offset:g} (from the file)"
            return DepthFile(values=values.astype(np.float32), reading=Reading(source))
        # Codes, which stay codes if the file states nothing but metres per code.
        if image.mode.startswith("I;16"):
            codes = np.asarray(image).astype(np.uint16)
            if no_data is not None:
                codes = np.where(codes == no_data, np.uint16(0), codes)
            if offset:
                metres = np.where(codes > 0, codes * scale + offset, 0).astype(np.float32)
                source = f"16-bit TIFF × {scale:g} + {offset:g} (from the file)"
                return DepthFile(values=metres, reading=Reading(source))
            # Nine digits, so that 0.001 metres per code are 1000 codes per metre.
            codes_per_metre = None if scale == 1 else float(f"{1 / scale:.9g}")
            return DepthFile(values=codes, reading=Reading("16-bit TIFF", codes_per_metre))
        raise no_depth(path, f"a TIFF of mode {image.mode}, not F or I;16")


class _GdalTags(NamedTuple):
    """What GDAL says of the numbers of a TIFF: metres = scale · number + offset."""

    scale: float  # 1 if it says nothing
    offset: float  # 0 if it says nothing
    no_data: float | None  # the number that stands for unknown depth, if there is one


def _gdal_tags(path: Path, image: PIL.Image.Image) -> _GdalTags:
    """What the tags of GDAL say of a TIFF.

    Args:
        path: The file, for messages.
        image: The file, opened by Pillow.

    Raises:
        InputError: The tags hold no numbers, or a scale that is not above 0.
    """
    tags: Mapping[int, object] = getattr(image, "tag_v2", {})
    items = dict(_GDAL_ITEM.findall(str(tags.get(_GDAL_METADATA, "")).lower()))
    no_data_text = str(tags.get(_GDAL_NODATA, "")).strip("\0 \n")
    try:
        scale = float(items.get("scale", 1))
        offset = float(items.get("offset", 0))
        no_data = float(no_data_text) if no_data_text else None
    except ValueError as error:
        raise damaged(path, "TIFF", f"has tags of GDAL that are no numbers ({error})") from error
    if not (0 < scale < math.inf and math.isfinite(offset)):
        raise damaged(path, "TIFF", f"has a scale of {scale:g}")
    return _GdalTags(scale, offset, no_data)


def write_tiff(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes a TIFF of floats.

    Args:
        file: The file, which is replaced.
        metres: (H, W) depth, 0 where unknown.
        text: Texts by their keys, which the file does not keep.

    Raises:
        OSError: The file cannot be written.
    """
    from PIL import Image

    encoded = io.BytesIO()  # libtiff prints to standard error when a disk is full
    Image.fromarray(metres).save(encoded, "TIFF", compression="tiff_adobe_deflate")
    file.write_bytes(encoded.getvalue())


_DEPTH_NAMES = frozenset({"z", "depth"})
_CHANNEL_LIST = re.compile(rb"channels\0chlist\0(.{4})", re.DOTALL)
_MOST_CHANNEL_BYTES = 1 << 19  # 20,000 channels; OpenEXR's time grows with the square
_EXR_LOCK = threading.Lock()  # standard output is redirected, by one thread at a time


def read_exr_channels(path: Path, data: bytes) -> dict[str, NDArray[np.generic]]:
    """Returns the channels of an EXR by name, each (H, W) of float16, float32 or uint32.

    Args:
        path: The file, which OpenEXR reads itself.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, or exceeds the budget; or it has several parts, or
            pixels that are deep, subsampled or cropped.
    """
    import OpenEXR

    # The list of channels, and the size that they will have, are checked before they are decoded.
    list_bytes = [int.from_bytes(size, "little") for size in _CHANNEL_LIST.findall(data)]
    if sum(list_bytes) > _MOST_CHANNEL_BYTES:
        raise InputError(f"{path} lists tens of thousands of channels; export the depth alone")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            _check_exr(path, file, len(data))
        # OpenEXR prints why it cannot decode a part, and leaves it out.
        with (
            _EXR_LOCK,
            redirect_stdout(io.StringIO()),
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            channels = file.channels()
            return {name: np.asarray(channel.pixels) for name, channel in channels.items()}
    # OpenEXR's Python binding raises these on damaged files.
    except (RuntimeError, ValueError, LookupError, OSError) as error:
        raise damaged(path, "EXR", f"cannot be read ({error})") from error


def _check_exr(path: Path, file: OpenEXR.File, file_bytes: int) -> None:
    """Raises InputError unless an EXR holds one flat image of whole channels, in the budget.

    Args:
        path: The file, for messages.
        file: The file, of which the header is read.
        file_bytes: Size of the file.
    """
    # The size: corners of the window of pixels that are stored, both inside of it.
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
    # What makes it more, or less, than one image.
    is_deep = "deep" in str(header.get("type", ""))
    is_cropped = not np.array_equal(header["dataWindow"], header["displayWindow"])
    is_sampled = any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels)
    if len(file.parts) > 1 or is_deep or is_cropped or is_sampled:
        raise InputError(
            f"{path} has several parts, or is deep, cropped or subsampled; export one flat image of"
            " its whole frame"
        )


def write_exr(file: Path, metres: NDArray[np.float32], text: Mapping[str, str]) -> None:
    """Writes an EXR of one channel Z, ZIP compressed.

    Args:
        file: The file, which is replaced.
        metres: (H, W) depth, 0 where unknown.
        text: Texts by their keys, which the file does not keep.

    Raises:
        OSError: The file cannot be written.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channel = OpenEXR.Channel(metres)
    try:
        with OpenEXR.File(header, {"Z": channel}) as image:
            image.write(str(file))
    except RuntimeError as error:  # OpenEXR's Python binding raises it, as on a full disk
        raise OSError(str(error)) from error


def read_exr(path: Path, data: bytes) -> DepthFile:
    """Returns the numbers (H, W) of the channel of an EXR that holds depth.

    Args:
        path: The file, which OpenEXR reads itself.
        data: Content of the file.

    Raises:
        InputError: The file cannot be read as `read_exr_channels` reads it, or it has several
            channels and no one of them is named for depth.
    """
    channels = read_exr_channels(path, data)
    name = depth_channel(channels)
    if name is None:
        listing = ", ".join(channels)
        raise InputError(f"{path} has several channels ({listing}); export the depth alone")
    return DepthFile(values=channels[name], reading=Reading(f"EXR channel {name}"))


def depth_channel(channels: Mapping[str, NDArray[np.generic]]) -> str | None:
    """Returns the name of the channel that holds depth; None if that is not clear.

    It is the only channel, or the only one with Z or depth in its name, or R of a grey image in R,
    G and B. The opacity A does not count, unless it is alone.
    """
    names = [name for name in channels if name != "A"] or list(channels)
    if len(names) == 1:
        return names[0]
    if sorted(names) == ["B", "G", "R"]:
        is_grey = all(
            np.array_equal(channels["R"], channels[colour], equal_nan=True) for colour in "GB"
        )
        return "R" if is_grey else None
    # A channel of a layer has its name before its own: layer.Z.
    named = [name for name in names if not _DEPTH_NAMES.isdisjoint(name.lower().split("."))]
    return named[0] if len(named) == 1 else None
