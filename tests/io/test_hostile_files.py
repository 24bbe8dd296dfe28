"""Files that claim much or are no files: one line, little memory, and no word of a library."""

from __future__ import annotations

import io
import os
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth, read_sparse, write_depth
from pnpdepth_cli.io.file_bytes import read_json, sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from tests.exr_files import write_exr
from tests.models.weights.files import little


def png(path: Path, size: tuple[int, int], bits: int, colour: int, body: bytes) -> Path:
    """A PNG with right checksums around this compressed body."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", *size, bits, colour, 0, 0, 0)), (b"IDAT", body)]
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in [*chunks, (b"IEND", b"")]:
        content += struct.pack(">I", len(data)) + kind + data
        content += struct.pack(">I", zlib.crc32(kind + data))
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(("side", "bits"), [(16383, 8), (16383, 16), (64, 16)])
def test_a_png_that_claims_much_or_does_not_decode_is_refused_in_silence(
    tmp_path: Path, side: int, bits: int, capfd: pytest.CaptureFixture[str]
) -> None:
    body = bytes(600_000) if side > 64 else zlib.compress(b"x" * 9)[:-6]
    path = png(tmp_path / "a.png", (side, side), bits, 2, body)
    for read in (read_rgb, read_depth):
        with little(), pytest.raises(FileFormatError, match=r"a\.png"):
            read(path)
    assert capfd.readouterr() == ("", "")


TAGS = 3000


def shared_tags(where: str) -> bytes:
    """A TIFF of so many tags that share their bytes, in a page or in the EXIF tags of one."""
    outside = io.BytesIO()
    Image.new("RGB", (300, 100)).save(outside, "TIFF")
    content = bytearray(outside.getvalue())
    (first,) = struct.unpack_from("<I", content, 4)
    end = first + 2 + 12 * struct.unpack_from("<H", content, first)[0]
    if where == "exif":  # in the place of the last tag
        struct.pack_into("<HHII", content, end - 12, 34665, 4, 1, len(content))
    else:
        struct.pack_into("<I", content, 4 if where == "first page" else end, len(content))
    table = b"".join(struct.pack("<HHII", 256 + number, 2, 90_000, 8) for number in range(TAGS))
    return content + struct.pack("<H", TAGS) + table + bytes(4)


def overlapping_pages() -> bytes:
    """A TIFF of so many pages, each of whose values ends with the tags of a page begun there."""
    start = [8 + 2 + 12 * TAGS + 4 + 10 + 12 * k for k in range(TAGS)]
    pointers = b"".join(struct.pack("<HHII", 34665, 4, 0, each) for each in start)
    shared = struct.pack("<HHIHH", 1, 1, 0, 0, 60_000) * (60_000 + TAGS + 1)
    return b"II*\0" + struct.pack("<IH", 8, TAGS) + pointers + bytes(4) + shared


@pytest.mark.parametrize("where", ["first page", "second page", "exif", "pages"])
def test_tags_and_pages_of_a_tiff_that_share_their_bytes_are_refused(
    where: str, tmp_path: Path
) -> None:
    path = tmp_path / "tags.tif"
    path.write_bytes(overlapping_pages() if where == "pages" else shared_tags(where))
    for read in (read_rgb, read_depth):
        with little(seconds=2), pytest.raises(FileFormatError):
            read(path)


def exr(*names: str, **header: object) -> bytes:
    """An uncompressed file of 4×2 pixels, as OpenEXR writes it."""
    channels = {name: np.full((2, 4), 2, np.float32) for name in names}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        write_exr(path, channels, compression=OpenEXR.NO_COMPRESSION, **header)
        return path.read_bytes()


def claiming(content: bytes, name: str, kind: str, value: bytes) -> bytes:
    """The file with another value of this attribute."""
    start = content.index(f"{name}\0{kind}\0".encode()) + len(name) + len(kind) + 6
    return content[:start] + value + content[start + len(value) :]


PLAIN, HIGH = exr("Z"), 2**31 - 1
TILED = exr("Z", type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription())
WINDOW, DISPLAY = ("dataWindow", "box2i"), ("displayWindow", "box2i")
MANY = exr(*(f"c{n}" for n in range(5000)))
EXRS = {
    "every pixel there is": claiming(PLAIN, *WINDOW, struct.pack("<4i", -HIGH, -HIGH, HIGH, HIGH)),
    "a display of every pixel": claiming(PLAIN, *DISPLAY, struct.pack("<4i", 0, 0, HIGH, HIGH)),
    "5,000 channels": claiming(MANY, *WINDOW, struct.pack("<4i", 0, 0, 99, 99)),
    "an attribute of 2 GB": exr("Z", a="x").replace(
        b"a\0string\0\1\0\0\0", b"a\0string\0\xff\xff\xff\x7f"
    ),
    "tiles of no pixel": claiming(TILED, "tiles", "tiledesc", struct.pack("<IIB", 0, 0, 0)),
}


@pytest.mark.parametrize("kind", EXRS)
def test_what_an_exr_claims_is_checked(
    tmp_path: Path, kind: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(EXRS[kind])
    with little(), pytest.raises(FileFormatError) as caught:
        read_depth(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().out == ""


SHAPES = ["(6, 8", "(True, 5)", "(2, 10**9)", "(-1, 8)", "(6, 8.0)", "(1" * 900]
SHAPES += [f"(0, {10**30})", f"({'1, ' * 100})"]
DTYPES = ["f999", "i4, i4", "M8[x]", "\x00f4"]


@pytest.mark.parametrize(
    ("descr", "shape"), [*(("<f4", shape) for shape in SHAPES), *((d, "(2, 2)") for d in DTYPES)]
)
def test_a_header_of_npy_that_is_no_header_is_damaged(
    tmp_path: Path, descr: str, shape: str
) -> None:
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(4 * 6 * 8))
    with pytest.raises(FileFormatError) as caught:
        read_depth(path)
    assert "\n" not in str(caught.value)


READERS = [read_depth, read_sparse, read_rgb, read_calibration, read_json, sha256_of, read_scan]


@pytest.mark.parametrize("read", READERS)
def test_a_device_a_pipe_and_a_sparse_file_of_terabytes_are_refused_unread(
    read: Any, tmp_path: Path
) -> None:
    pipe, huge = tmp_path / "pipe.bin", tmp_path / "huge.png"
    os.mkfifo(pipe)
    for path in (pipe,) if read is read_scan else (Path("/dev/zero"), pipe):
        with little(), pytest.raises(InputError):
            read(path)
    with huge.open("wb") as file:
        file.truncate(1 << 42)
    if read not in (sha256_of, read_scan):
        with little(), pytest.raises(FileFormatError):
            read(huge)


def npy(shape: tuple[int, ...], body: bytes) -> bytes:
    buffer = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue() + body


@pytest.mark.parametrize(
    ("shape", "data_bytes", "claimed_bytes", "compression"),
    [
        ((6, 8), 600 << 20, None, zipfile.ZIP_DEFLATED),
        ((10_000, 5_000), 1000, None, zipfile.ZIP_DEFLATED),
        ((600, 800), 4 * 600 * 800, 500, zipfile.ZIP_DEFLATED),
        ((6, 8), 4 * 6 * 8, None, zipfile.ZIP_BZIP2),
        ((6, 8), 4 * 6 * 8, None, zipfile.ZIP_LZMA),
    ],
)
def test_an_npz_that_lies_is_too_large_or_compressed_otherwise_is_refused(
    tmp_path: Path,
    shape: tuple[int, int],
    data_bytes: int,
    claimed_bytes: int | None,
    compression: int,
) -> None:
    path = tmp_path / "lie.npz"
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("depth.npy", npy(shape, bytes(data_bytes)))
    if claimed_bytes is not None:
        content = bytearray(path.read_bytes())
        struct.pack_into("<I", content, content.index(b"PK\x01\x02") + 24, claimed_bytes)
        path.write_bytes(content)
    with little(), pytest.raises(FileFormatError):
        read_depth(path)


@pytest.mark.parametrize("suffix", [".png", ".exr", ".pfm", ".tiff", ".npy", ".npz"])
def test_more_pixels_than_the_budget_are_refused_before_they_are_read(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"d{suffix}"
    write_depth(path, np.ones((300, 400), np.float32))
    try:
        set_max_pixels(119_999)
        with pytest.raises(FileFormatError):
            read_depth(path)
        set_max_pixels(120_000)
        assert read_depth(path).values.shape == (300, 400)
    finally:
        set_max_pixels(None)
