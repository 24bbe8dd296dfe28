"""Files that claim much or are no files: one line, little memory, and no word of a library."""

from __future__ import annotations

import io
import os
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.file_bytes import read_json, sha256_of
from pnpdepth_cli.io.formats import list_npz
from pnpdepth_cli.io.point_files import read_sparse
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from tests.models.weights.files import little

TAGS = 3000
HIGH = 2**31 - 1


def png(side: int, bits: int, body: bytes) -> bytes:
    """A PNG in colour with right checksums around this compressed body."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", side, side, bits, 2, 0, 0, 0)), (b"IDAT", body)]
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in [*chunks, (b"IEND", b"")]:
        content += struct.pack(">I", len(data)) + kind + data
        content += struct.pack(">I", zlib.crc32(kind + data))
    return content


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
    pointers = b"".join(struct.pack("<HHII", 34665, 4, 0, offset) for offset in start)
    shared = struct.pack("<HHIHH", 1, 1, 0, 0, 60_000) * (60_000 + TAGS + 1)
    return b"II*\0" + struct.pack("<IH", 8, TAGS) + pointers + bytes(4) + shared


def exr(*names: str, **header: object) -> bytes:
    """An uncompressed file of 4×2 pixels, as OpenEXR writes it."""
    channels = {name: np.full((2, 4), 2, np.float32) for name in names}
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        attributes = {"compression": OpenEXR.NO_COMPRESSION, **header}
        OpenEXR.File(attributes, channels).write(file.name)
        return Path(file.name).read_bytes()


def claiming(content: bytes, name: str, kind: str, value: bytes) -> bytes:
    """The file with another value of this attribute."""
    start = content.index(f"{name}\0{kind}\0".encode()) + len(name) + len(kind) + 6
    return content[:start] + value + content[start + len(value) :]


def windowed(content: bytes, name: str, *corners: int) -> bytes:
    """The file with another dataWindow or displayWindow."""
    return claiming(content, name, "box2i", struct.pack("<4i", *corners))


def npy(shape: str, descr: str = "<f4") -> bytes:
    """A header, and 48 numbers of four bytes."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(4 * 48)


def npz(
    shape: str, zeros: int = 0, claimed: int | None = None, compression: int = zipfile.ZIP_DEFLATED
) -> bytes:
    """An archive of an array and so many zeros behind it; `claimed` is the size it states."""
    buffer = io.BytesIO()
    archive = zipfile.ZipFile(buffer, "w", compression)
    with archive, archive.open("depth.npy", "w") as member:
        member.write(npy(shape))
        for start in range(0, zeros, 1 << 20):
            member.write(bytes(min(zeros - start, 1 << 20)))
    content = bytearray(buffer.getvalue())
    if claimed is not None:
        struct.pack_into("<I", content, content.index(b"PK\x01\x02") + 24, claimed)
    return bytes(content)


PLAIN = exr("Z")
MANY = exr(*(f"c{n}" for n in range(5000)))
TILED = exr("Z", type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription())
LONG = exr("Z", a="x").replace(b"a\0string\0\1\0\0\0", b"a\0string\0\xff\xff\xff\x7f")
SHAPES = ["(6, 8", "(True, 5)", "(2, 10**9)", "(-1, 8)", "(6, 8.0)", "(1" * 900]
SHAPES += [f"(0, {10**30})", f"({'1, ' * 100})"]
HOSTILE = {
    "2^28 pixels of 8 bits.png": png(16383, 8, bytes(600_000)),
    "2^28 pixels of 16 bits.png": png(16383, 16, bytes(600_000)),
    "cut inside.png": png(64, 16, zlib.compress(b"x" * 9)[:-6]),
    **{f"tags of {w} that share bytes.tif": shared_tags(w) for w in ("first page", "second page")},
    "tags of EXIF that share bytes.tif": shared_tags("exif"),
    "overlapping pages.tif": overlapping_pages(),
    "every pixel there is.exr": windowed(PLAIN, "dataWindow", -HIGH, -HIGH, HIGH, HIGH),
    "a display of every pixel.exr": windowed(PLAIN, "displayWindow", 0, 0, HIGH, HIGH),
    "5,000 channels.exr": windowed(MANY, "dataWindow", 0, 0, 99, 99),
    "an attribute of 2 GB.exr": LONG,
    "tiles of no pixel.exr": claiming(TILED, "tiles", "tiledesc", struct.pack("<IIB", 0, 0, 0)),
    **{f"shape {n}.npy": npy(shape) for n, shape in enumerate(SHAPES)},
    **{f"{n}.npy": npy("(2, 2)", d) for n, d in enumerate(["f999", "i4, i4", "M8[x]", "\x00f4"])},
    "a bomb.npz": npz("(6, 8)", zeros=600 << 20),
    "too large.npz": npz("(10000, 5000)", zeros=1000),
    "of a wrong size.npz": npz("(600, 800)", zeros=4 * (600 * 800 - 48), claimed=500),
    "bzip2.npz": npz("(6, 8)", compression=zipfile.ZIP_BZIP2),
    "lzma.npz": npz("(6, 8)", compression=zipfile.ZIP_LZMA),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_claims_much_or_lies_is_refused_with_little_memory_and_in_silence(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(HOSTILE[name])
    for read in (read_depth, read_rgb) if path.suffix in (".png", ".tif") else (read_depth,):
        with little(), pytest.raises(InputError, match=f"^.*{re.escape(str(path))}.*$"):
            read(path)
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err == "" or path.suffix == ".exr"  # OpenEXR complains on its own


READERS = [read_depth, read_sparse, read_rgb, read_calibration, read_json, sha256_of, read_scan]


@pytest.mark.parametrize("read", READERS)
def test_no_device_pipe_or_terabyte_is_read(read: Callable[[Path], object], tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.bin"
    huge = tmp_path / "huge.bin"
    os.mkfifo(pipe)
    huge.touch()
    os.truncate(huge, 1 << 42)
    endless = Path("/proc/self/pagemap")  # a file of 0 bytes that can be read for days
    several = [path for path in (Path("/dev/zero"), pipe, endless) if path.exists()]
    for path in (*several, *([huge] if read is not sha256_of else [])):
        with little(), pytest.raises(InputError):
            read(path)


@pytest.mark.parametrize("suffix", [".png", ".exr", ".pfm", ".tiff", ".npy", ".npz"])
def test_more_pixels_than_the_budget_are_refused_unread(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"d{suffix}"
    write_depth(path, np.ones((300, 400), np.float32))
    try:
        set_max_pixels(119_999)
        with pytest.raises(InputError):
            read_depth(path)
        set_max_pixels(120_000)
        assert read_depth(path).values.shape == (300, 400)
    finally:
        set_max_pixels(None)


def archive_of(members: dict[str, list[bytes]]) -> bytes:
    """A compressed archive of these members, each in pieces."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, pieces in members.items():
            with archive.open(name, "w") as member:
                for piece in pieces:
                    member.write(piece)
    return stream.getvalue()


@pytest.mark.parametrize(
    "members",
    [
        {"a.npy": [b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 30), *[b" " * (1 << 20)] * 200]},
        {f"{number}.npy": [b""] for number in range(2000)},
        {"a.npy": [b"no array"]},
        {"data.pkl": [b"a checkpoint"]},
    ],
    ids=["a long header", "many arrays", "no header", "no arrays"],
)
def test_the_arrays_of_an_archive_are_listed_in_little_memory(
    members: dict[str, list[bytes]],
) -> None:
    data = archive_of(members)
    with little(), pytest.raises(InputError, match=r"a\.npz"):
        list_npz(Path("a.npz"), data)
