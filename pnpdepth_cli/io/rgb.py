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
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_PLAUSIBLE = (0.2, 50.0)
"""Focal length as a multiple of the image's longer side: fields of view of 136° to 1°."""
_WHITE = 65535  # of 16 bits
_BITS = (8, 10, 12, 14)  # of sensors
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
    white: float = 255.0  # the stored number that is 1; that of an EXR is unknown


def read_rgb(path: Path, *, upright: bool = True) -> RgbImage:
    """Returns the image in a file; grey is repeated, alpha dropped, EXIF rotation applied.

    Without `upright` the pixels are as they are stored, which is how COLMAP reads photos.

    Raises:
        InputError: The file is missing, damaged, cut short, beyond the budget, or no image.
    """
    data = read_bytes(path)
    kind = kind_of(data)
    # What the file is. HEIF and videos have one kind of container.
    if kind == "EXR":
        return _from_linear_light(path, data)
    if data[4:8] == b"ftyp":
        if data[8:11] in VIDEO_BRANDS:
            raise InputError(f"{path} is a video; `batch` takes videos, with depth of their frames")
        if data[8:12] in (b"avif", b"avis") or not _reads_heic():
            raise InputError(
                f"{path} is a HEIC or AVIF photo; pip install 'pnpdepth[heic]' reads HEIC, or save"
                " it as JPEG"
            )
        kind = "HEIF"
    if kind not in ("PNG", "JPEG", "TIFF", "WEBP", "HEIF"):
        raise InputError(f"{path} is not an image; give a PNG, JPEG, TIFF, WebP or EXR file")
    # Its numbers, in 0…1.
    note = None
    white = 255.0
    with images.open_image(path, data, kind) as image:
        if kind == "TIFF" and image.mode in ("I", "F"):
            raise InputError(f"{path} is no image; save it with 8 or 16 bits, none below 0")
        wide = ";16" in images.raw_mode(image)
        image.load()  # which applies the orientation of a TIFF
        orientation = images.orientation_of(image)
        if wide:
            values, white = _decode_16_bit(path, data, kind)
            if white < _WHITE:
                bits = int(white).bit_length()
                note = f"16-bit numbers up to {white:.0f} are read as of {bits} bits"
            if kind == "TIFF":  # OpenCV applies the orientation of a TIFF, not that of a PNG
                orientation = 1
        else:
            frames = 1 if kind == "JPEG" else getattr(image, "n_frames", 1)  # a JPEG has previews
            note = f"first of {frames} images" if frames > 1 else None
            image.seek(0)
            pixels = np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
            values = np.divide(pixels, np.float32(255), dtype=np.float32)
    # How it was held.
    if upright:
        values = _turn_upright(values, orientation)
    elif orientation in range(2, 9):
        note = "EXIF rotation not applied, as COLMAP reads the photo"
    return RgbImage(values=np.ascontiguousarray(values), note=note, white=white)


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
    """Returns (H, W) of the image that `read_rgb` returns, upright and as stored.

    Raises:
        InputError: The file is missing or no image.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            width, height = image.size
            upright = (width, height) if images.orientation_of(image) >= 5 else (height, width)
            return upright, (height, width)
    except (OSError, Image.DecompressionBombError):  # an EXR, say
        height, width, _ = read_rgb(path).values.shape
        return (height, width), (height, width)


def orientation_in(path: Path) -> int:
    """Returns the EXIF orientation 1…8 of an image's file; 1 where it has none."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            orientation = images.orientation_of(image)
    except (OSError, Image.DecompressionBombError):  # an EXR, say
        return 1
    return orientation if orientation in range(1, 9) else 1


def _decode_16_bit(path: Path, data: bytes, kind: str) -> tuple[NDArray[np.float32], float]:
    """(H, W, 3) in 0..1, by OpenCV as Pillow cuts colours to 8 bits; and the number of white."""
    import cv2

    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if pixels is None:
        raise damaged(path, kind, "cannot be decoded")
    rgb = pixels[:, :, ::-1]
    white = _white_of(data, kind, int(rgb.max()))
    return np.asarray(np.divide(rgb, np.float32(white), dtype=np.float32)), float(white)


def _white_of(data: bytes, kind: str, largest: int) -> float:
    """The number of white in an image of 16 bits: of the bits that it states, else that it uses.

    Cameras store 10, 12 or 14 bits in 16, and such images would be black.
    """
    at = data.find(b"sBIT", 0, _PNG_HEAD) if kind == "PNG" else -1
    if at >= 0:  # the significant bits of a PNG; numbers beyond them were scaled to 16
        bits = data[at + 4]
        return float(2**bits - 1) if 1 < largest < 2**bits <= _WHITE else float(_WHITE)
    for bits in _BITS:
        if 1 < largest < 2**bits:
            return float(2**bits - 1)
    return float(_WHITE)


def _turn_upright(values: NDArray[np.float32], orientation: int) -> NDArray[np.float32]:
    """Applies EXIF orientation 1..8 (TIFF 6.0, tag 274); other numbers are ignored."""
    if orientation in (5, 6, 7, 8):
        values = values.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    return values[:, ::-1] if orientation in (2, 3, 6, 7) else values


def _from_linear_light(path: Path, data: bytes) -> RgbImage:
    linear = read_exr_colour(path, data).astype(np.float32)
    np.nan_to_num(linear, copy=False, nan=0.0, posinf=1e9, neginf=0.0)
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
    """Returns R, G and B (H, W, 3) as an EXR stores them; its only channel is repeated.

    Raises:
        InputError: It is damaged, beyond the budget, or holds no single image.
    """
    channels = images.read_exr_channels(path, data)
    reds = [name for name in channels if name.rpartition(".")[2] == "R"]
    layer = reds[0][:-1] if len(reds) == 1 else ""
    names = [layer + letter for letter in "RGB"]
    grey = [name for name in channels if name != "A"]
    if len(grey) == 1:
        names = grey * 3
    if not channels.keys() >= {*names}:
        raise InputError(f"{path} has no one image in ({', '.join(channels)}); export R, G and B")
    return np.stack([channels[name] for name in names], axis=2)


def read_focal_length(path: Path, size: tuple[int, int]) -> tuple[float, str] | None:
    """Returns the focal length in pixels by an image's EXIF, and what gave it, for a person.

    None if there is none that a camera can have.

    It is the 35 mm equivalent, taken as one of equal diagonal field of view, which is how CIPA
    DCG-001 has it. The image is used at the size (H, W).
    """
    from PIL import Image
    from PIL.ExifTags import IFD, Base

    try:
        with Image.open(path) as image:
            images.check_exif(image)
            film_mm = float(image.getexif().get_ifd(IFD.Exif).get(Base.FocalLengthIn35mmFilm, 0))
    except (*images.IMAGE_ERRORS, TypeError):  # damaged EXIF gives no focal length
        return None
    pixels = film_mm / _FILM_DIAGONAL_MM * math.hypot(*size)
    if not _PLAUSIBLE[0] <= pixels / max(size) <= _PLAUSIBLE[1]:
        return None
    return pixels, f"EXIF, equivalent to {film_mm:g} mm on film"


def read_video_frame(path: Path, index: int) -> NDArray[np.float32]:
    """Returns frame `index` from 0, (H, W, 3) float32 in 0..1, as it is stored: not turned.

    Raises:
        InputError: There is no such file, it is no MP4 or MOV file, cannot be decoded, exceeds the
            budget, or is shorter.
    """
    size_of_regular_file(path)
    opened = path, path.stat().st_mtime_ns
    with _VIDEO_LOCK:
        frames, last = _open_video(*opened)
        if last and index < last[0][0]:  # no longer in memory
            _open_video.cache_clear()
            frames, last = _open_video(*opened)
        while (bgr := dict(last).get(index)) is None:
            decoded = next(frames, None)
            if decoded is None:
                raise InputError(f"{path} has no frame {index:,}; it ends before, or is cut short")
            last.append(decoded)
    return np.divide(bgr[:, :, ::-1], np.float32(255), dtype=np.float32)


@functools.lru_cache(maxsize=1)
def _open_video(
    path: Path, mtime_ns: int
) -> tuple[Iterator[tuple[int, Pixels]], deque[tuple[int, Pixels]]]:
    """The frames of a video that are still to be decoded, and the last that were."""
    return enumerate(_decode_video(path)), deque(maxlen=_FRAMES_IN_MEMORY)


def _decode_video(path: Path) -> Iterator[Pixels]:
    """Yields the frames (H, W, 3), blue first; seeking would need a constant rate."""
    import cv2

    with path.open("rb") as file:
        if file.read(8)[4:] != b"ftyp":  # FFmpeg would follow the addresses in a playlist
            raise InputError(f"{path} is not an MP4 or MOV video; convert it")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise damaged(path, "video", "cannot be decoded")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    sides = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    width, height = (int(capture.get(side)) for side in sides)
    check_pixel_count(path, width, height, pixel_bytes=3)
    while (read := capture.read())[0]:
        yield np.asarray(read[1], np.uint8)
