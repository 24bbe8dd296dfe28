"""RGB images of PNG, JPEG, TIFF, WebP, HEIC, EXR and videos, and the focal length in EXIF."""

from __future__ import annotations

import functools
import math
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import check_pixel_count, damaged, read_bytes, size_of_regular_file
from pnpdepth_cli.io.formats import images, kind_of

VIDEO_BRANDS = (b"iso", b"mp4", b"qt ", b"M4V", b"avc", b"3gp")
"""Beginnings of the brand, bytes 8 to 11 of an MP4 or MOV file, by which videos are known."""
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_PLAUSIBLE = (0.2, 50.0)
"""Focal length as a multiple of the image's longer side: fields of view of 136° to 1°."""
_WHITE = 65535  # of 16 bits
_BITS = (8, 10, 12, 14)  # of the numbers of cameras' sensors
_BRIGHTEST_LIGHT = 1e9  # taken for infinite light in an EXR; white is 1
_ON_ITS_SIDE = (5, 6, 7, 8)  # EXIF orientations of images whose rows and columns are exchanged
_PNG_HEAD = 512  # bytes, in which a PNG states its bits
_FRAMES_IN_MEMORY = 8
"""Frames of a video that are kept, as threads ask for them slightly out of order."""
_VIDEO_LOCK = threading.Lock()

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class RgbImage:
    """An upright image."""

    values: NDArray[np.float32]  # (H, W, 3) in 0..1, sRGB-encoded
    note: str | None  # what was assumed or changed, for a person; None if nothing was
    white: float = 255.0  # the stored number that became 1; without meaning for an EXR


def read_rgb(path: Path, *, upright: bool = True) -> RgbImage:
    """Returns the image in a file; grey is repeated, alpha dropped, EXIF rotation applied.

    Args:
        path: The file, whose content tells its format.
        upright: Whether EXIF rotation is applied. COLMAP reads photos without it.

    Raises:
        InputError: The file is missing, damaged, cut short, beyond the budget, or no image.
    """
    data = read_bytes(path)
    kind = _kind_of_image(path, data)
    if kind == "EXR":
        return _from_linear_light(path, data)
    # Its numbers, in 0…1, and the EXIF orientation that is still to be applied.
    note = None
    white = 255.0
    with images.open_image(path, data, kind) as image:
        if kind == "TIFF" and image.mode in ("I", "F"):
            raise InputError(f"{path} is no image; save it with 8 or 16 bits, none below 0")
        has_16_bits = ";16" in images.raw_mode(image)
        image.load()  # which applies the orientation of a TIFF
        orientation = images.orientation_of(image)
        if has_16_bits:
            values, white = _decode_16_bit(path, data, kind)
            if white < _WHITE:
                bits = int(white).bit_length()
                note = f"16-bit numbers up to {white:.0f} are read as of {bits} bits"
            if kind == "TIFF":  # OpenCV applies the orientation of a TIFF, not that of a PNG
                orientation = 1
        else:
            frames = 1 if kind == "JPEG" else getattr(image, "n_frames", 1)  # a JPEG has previews
            note = f"first of {frames} images" if frames > 1 else None
            image.seek(0)  # the first of several
            pixels = np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
            values = np.divide(pixels, np.float32(255), dtype=np.float32)
    # How the camera was held.
    if upright:
        values = _turn_upright(values, orientation)
    elif orientation in range(2, 9):
        note = "EXIF rotation not applied, as COLMAP reads the photo"
    return RgbImage(values=np.ascontiguousarray(values), note=note, white=white)


def _kind_of_image(path: Path, data: bytes) -> str:
    """The format of an image by its content: "PNG", "JPEG", "TIFF", "WEBP", "HEIF" or "EXR".

    Args:
        path: The file, for messages.
        data: Content of the file.

    Raises:
        InputError: The file is no image, or none that can be read here.
    """
    # HEIF and videos have one kind of container, which says at byte 8 what it holds.
    if data[4:8] == b"ftyp":
        if data[8:11] in VIDEO_BRANDS:
            raise InputError(f"{path} is a video; `batch` takes videos, with depth of their frames")
        if data[8:12] in (b"avif", b"avis") or not _reads_heic():
            raise InputError(
                f"{path} is a HEIC or AVIF photo; pip install 'pnpdepth[heic]' reads HEIC, or save"
                " it as JPEG"
            )
        return "HEIF"
    kind = kind_of(data)
    if kind not in ("PNG", "JPEG", "TIFF", "WEBP", "EXR"):
        raise InputError(f"{path} is not an image; give a PNG, JPEG, TIFF, WebP or EXR file")
    return kind


@functools.cache
def _reads_heic() -> bool:
    """Whether pillow-heif is installed; if so, Pillow reads HEIC, upright, from now on."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def sizes_of(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns (H, W) of an upright image, and (H, W) of its pixels as they are stored.

    Raises:
        InputError: The file is missing or no image.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            width, height = image.size
            is_on_its_side = images.orientation_of(image) in _ON_ITS_SIDE
            upright = (width, height) if is_on_its_side else (height, width)
            return upright, (height, width)
    except (OSError, Image.DecompressionBombError):  # Pillow does not read it, such as an EXR
        height, width, _ = read_rgb(path).values.shape
        return (height, width), (height, width)


def orientation_in(path: Path) -> int:
    """Returns the EXIF orientation 1…8 of an image's file; 1 where it has none."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            orientation = images.orientation_of(image)
    except (OSError, Image.DecompressionBombError):  # Pillow does not read it, such as an EXR
        return 1
    return orientation if orientation in range(1, 9) else 1


def _decode_16_bit(path: Path, data: bytes, kind: str) -> tuple[NDArray[np.float32], float]:
    """(H, W, 3) in 0..1 of a PNG or TIFF of 16 bits, and the stored number that became 1.

    OpenCV decodes the file, as Pillow cuts colours to 8 bits. EXIF rotation is not applied.

    Args:
        path: The file, for messages.
        data: Content of the file.
        kind: "PNG" or "TIFF".

    Raises:
        InputError: The file cannot be decoded.
    """
    import cv2

    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if pixels is None:
        raise damaged(path, kind, "cannot be decoded")
    rgb = pixels[:, :, ::-1]  # OpenCV has B, G, R
    # White is not 65535 where a camera stored fewer bits.
    white = _white_of(data, kind, int(rgb.max()))
    return np.asarray(np.divide(rgb, np.float32(white), dtype=np.float32)), float(white)


def _white_of(data: bytes, kind: str, largest: int) -> float:
    """The stored number that is white in an image of 16 bits.

    Cameras store 10, 12 or 14 bits in 16, and such images would be nearly black if white was 65535.
    White is the largest number of the bits that a PNG states, else of the bits that are used.

    Args:
        data: Content of the file.
        kind: "PNG" or "TIFF".
        largest: Largest number in the image.
    """
    # The chunk sBIT of a PNG states the significant bits of each channel after its name. Without
    # it, the fewest bits that hold the largest number are tried.
    at = data.find(b"sBIT", 0, _PNG_HEAD) if kind == "PNG" else -1
    bits_to_try = _BITS if at < 0 else (data[at + 4],)
    for bits in bits_to_try:
        # Numbers beyond these bits were scaled to 16; 0 and 1 alone tell nothing.
        if 1 < largest < 2**bits <= _WHITE:
            return float(2**bits - 1)
    return float(_WHITE)


def _turn_upright(values: NDArray[np.float32], orientation: int) -> NDArray[np.float32]:
    """The image (H, W, 3) after EXIF orientation 1..8 (TIFF 6.0, tag 274) is applied.

    Any other number means that the image is upright already.
    """
    # Rows and columns are exchanged, then the rows reversed, then the columns.
    if orientation in _ON_ITS_SIDE:
        values = values.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    return values


def _from_linear_light(path: Path, data: bytes) -> RgbImage:
    """The image of an EXR, whose linear light is converted to sRGB.

    Light beyond 0…1 is clipped, and the image's note says of how many pixels.

    Args:
        path: The file, which OpenEXR reads itself.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, beyond the budget, or holds no or several images.
    """
    linear = read_exr_colour(path, data).astype(np.float32)
    np.nan_to_num(linear, copy=False, nan=0.0, posinf=_BRIGHTEST_LIGHT, neginf=0.0)
    outside = float(((linear > 1) | (linear < 0)).any(axis=2).mean())
    note = "EXR linear light, converted with the sRGB curve"
    if outside > 0:
        note += f"; {100 * outside:.2g} % of pixels lay outside 0..1 and were clipped"
    # The curve of IEC 61966-2-1, row by row: in float32 white would come out just below 1.
    for row in linear.clip(0, 1, out=linear):
        light = row.astype(np.float64)
        curve = 1.055 * np.power(light, 1 / 2.4) - 0.055
        row[:] = np.where(light <= 0.0031308, 12.92 * light, curve)
    return RgbImage(values=linear, note=note)


def read_exr_colour(path: Path, data: bytes) -> NDArray[np.generic]:
    """Returns R, G and B (H, W, 3) as an EXR stores them; a single channel is repeated.

    Args:
        path: The file, which OpenEXR reads itself.
        data: Content of the file.

    Raises:
        InputError: The file is damaged, beyond the budget, or holds no or several images.
    """
    channels = images.read_exr_channels(path, data)
    # Channels of a layer have its name and a dot before their own.
    reds = [name for name in channels if name.rpartition(".")[2] == "R"]
    layer = reds[0].removesuffix("R") if len(reds) == 1 else ""
    names = [layer + letter for letter in "RGB"]
    # Grey is one channel of any name, without the channel A of opacity.
    without_alpha = [name for name in channels if name != "A"]
    if len(without_alpha) == 1:
        names = without_alpha * 3
    if not set(names) <= channels.keys():
        raise InputError(f"{path} has no one image in ({', '.join(channels)}); export R, G and B")
    return np.stack([channels[name] for name in names], axis=2)


def read_focal_length(path: Path, size: tuple[int, int]) -> tuple[float, str] | None:
    """Returns the focal length in pixels by an image's EXIF, and what gave it, for a person.

    It is computed from the focal length in 35 mm film: the field of view along the diagonal is
    equal, as CIPA DCG-001 has it. None if the file states none, or none that a camera can have.

    Args:
        path: The image.
        size: (H, W) at which the image is used, in whose pixels the focal length is.
    """
    from PIL import Image
    from PIL.ExifTags import IFD, Base

    try:
        with Image.open(path) as image:
            images.check_exif(image)
            film_mm = float(image.getexif().get_ifd(IFD.Exif).get(Base.FocalLengthIn35mmFilm, 0))
    except (*images.IMAGE_ERRORS, TypeError):  # damaged EXIF gives no focal length
        return None
    focal_px = film_mm / _FILM_DIAGONAL_MM * math.hypot(*size)
    least, most = _PLAUSIBLE
    if not least <= focal_px / max(size) <= most:
        return None
    return focal_px, f"EXIF, equivalent to {film_mm:g} mm on film"


def read_video_frame(path: Path, index: int) -> NDArray[np.float32]:
    """Returns a frame of a video, (H, W, 3) float32 in 0..1, as it is stored: not turned.

    Frames are decoded from the first on, and the last `_FRAMES_IN_MEMORY` decoded ones stay in
    memory. So frames that are read in order are decoded once.

    Args:
        path: The video, an MP4 or MOV file.
        index: Number of the frame, from 0.

    Raises:
        InputError: There is no such file, it is no MP4 or MOV file, cannot be decoded, exceeds the
            budget, or is shorter.
    """
    size_of_regular_file(path)
    mtime_ns = path.stat().st_mtime_ns
    with _VIDEO_LOCK:
        # Pairs of number and pixels: of frames still to be decoded, and of those in memory.
        frames, decoded = _open_video(path, mtime_ns)
        # An earlier frame than those in memory is decoded from the beginning again.
        if decoded and index < decoded[0][0]:
            _open_video.cache_clear()
            frames, decoded = _open_video(path, mtime_ns)
        while index not in dict(decoded):
            next_frame = next(frames, None)
            if next_frame is None:
                raise InputError(f"{path} has no frame {index:,}; it ends before, or is cut short")
            decoded.append(next_frame)
        bgr = dict(decoded)[index]
    return np.divide(bgr[:, :, ::-1], np.float32(255), dtype=np.float32)


@functools.lru_cache(maxsize=1)
def _open_video(
    path: Path, mtime_ns: int
) -> tuple[Iterator[tuple[int, Pixels]], deque[tuple[int, Pixels]]]:
    """The frames of an open video that are still to be decoded, and the last that were.

    Both give number, from 0, and pixels of a frame. The caller adds what it decodes to the second.
    The cache keeps one video open, until another one is opened.

    Args:
        path: The video.
        mtime_ns: Time of its last change, by which a newer one is told.
    """
    return enumerate(_decode_video(path)), deque(maxlen=_FRAMES_IN_MEMORY)


def _decode_video(path: Path) -> Iterator[Pixels]:
    """Yields the frames (H, W, 3) of blue, green and red, from the first on.

    None is skipped, because OpenCV finds a frame by its time, as if all were equally far apart.

    Raises:
        InputError: The file is no MP4 or MOV video, cannot be decoded, or exceeds the budget.
    """
    import cv2

    # Other files are refused, as FFmpeg would follow the addresses in a playlist.
    with path.open("rb") as file:
        if file.read(8)[4:] != b"ftyp":
            raise InputError(f"{path} is not an MP4 or MOV video; convert it")
    # The size is checked before a frame is decoded.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise damaged(path, "video", "cannot be decoded")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    sides = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    width, height = (int(capture.get(side)) for side in sides)
    check_pixel_count(path, width, height, pixel_bytes=3)
    while True:
        is_read, frame = capture.read()
        if not is_read:
            return
        yield np.asarray(frame, np.uint8)
