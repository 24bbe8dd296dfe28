"""Small files that claim much, and headers that evaluate to nothing: one line, little memory."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from PIL import Image

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.decoding import check_tags
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.file_bytes import check_pixel_count
from pnpdepth_cli.io.formats.images import _claimed_bytes
from pnpdepth_cli.io.rgb import read_rgb
from tests.exr_files import (
    DEEP,
    PARTS,
    TILED,
    exr_attribute,
    exr_file,
    exr_header,
    exr_line,
)
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


@pytest.mark.parametrize(("bits", "colour"), [(8, 0), (16, 0), (16, 2)])
def test_an_image_beyond_64_megapixels_is_refused_by_its_header(
    tmp_path: Path, bits: int, colour: int
) -> None:
    path = png(tmp_path / "zeros.png", (16383, 16383), bits, colour, bytes(600_000))
    for read in (read_rgb, read_depth):
        with pytest.raises(FileFormatError, match=r"pixels, more than|8-bit PNG"):
            read(path)


@pytest.mark.parametrize("colour", [0, 2])
def test_pixels_that_do_not_decode_are_one_line_and_libraries_say_nothing(
    tmp_path: Path, colour: int
) -> None:
    path = png(tmp_path / "broken.png", (64, 64), 16, colour, zlib.compress(b"x" * 9)[:-6])
    program = (
        "import sys\nfrom pathlib import Path\n"
        "from pnpdepth_cli.errors import FileFormatError\n"
        "from pnpdepth_cli.io.depth import read_depth\nfrom pnpdepth_cli.io.rgb import read_rgb\n"
        "for read in (read_rgb, read_depth):\n"
        "    try:\n        read(Path(sys.argv[1]))\n"
        "    except FileFormatError as error:\n        print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert all("broken.png: PNG" in line for line in lines)


@pytest.mark.parametrize("where", ["first page", "second page", "exif"])
def test_tags_that_share_their_bytes_are_refused(where: str, tmp_path: Path) -> None:
    count, path, outside = 3000, tmp_path / "tags.tif", io.BytesIO()
    Image.new("RGB", (300, 100)).save(outside, "TIFF")
    content = bytearray(outside.getvalue())
    table = b"".join(struct.pack("<HHII", 256 + number, 2, 90_000, 8) for number in range(count))
    (first,) = struct.unpack_from("<I", content, 4)
    entries = first + 2
    end = entries + 12 * struct.unpack_from("<H", content, first)[0]
    if where == "first page":
        struct.pack_into("<I", content, 4, len(content))
    elif where == "second page":
        struct.pack_into("<I", content, end, len(content))
    else:  # in the place of the last tag
        struct.pack_into("<HHII", content, end - 12, 34665, 4, 1, len(content))
    path.write_bytes(content + struct.pack("<H", count) + table + bytes(4))
    for read in (read_rgb, read_depth):
        with pytest.raises(FileFormatError, match="its tags claim more than"):
            read(path)


SMALL, LOW, HIGH = (0, 0, 3, 1), -(2**31), 2**31 - 1
LINES = [exr_line(y, 4) for y in (0, 1)]


def _tiles(width: int, height: int, mode: int) -> bytes:
    return exr_attribute("tiles", "tiledesc", struct.pack("<IIB", width, height, mode))


def _part(number: int, window: tuple[int, ...], kind: str = "scanlineimage") -> bytes:
    rows = struct.pack("<i", window[3] - window[1] + 1)
    more = exr_attribute("name", "string", f"p{number}".encode())
    more += exr_attribute("type", "string", kind.encode())
    more += exr_attribute("chunkCount", "int", rows)
    return exr_header(window, names="YZ", more=more)


EXRS = {
    "every pixel there is": exr_file(exr_header((LOW, LOW, HIGH, HIGH))),
    "a window upside down": exr_file(exr_header((5, 5, 4, 4))),
    "a display of every pixel": exr_file(exr_header(SMALL, display=(0, 0, HIGH, HIGH)), LINES),
    "no rows": exr_file(exr_header(SMALL)),
    "no channel": exr_file(exr_header(SMALL, names=())),
    "5,000 channels": exr_file(exr_header((0, 0, 99, 99), names=[f"c{n}" for n in range(5000)])),
    "100,000 channels": exr_file(exr_header(SMALL, names=[f"c{n}" for n in range(100_000)])),
    "a channel twice": exr_file(exr_header(SMALL, names=("Z", "Z")), LINES),
    "a sampling of 0": exr_file(exr_header(SMALL, sampling=0), LINES),
    "an attribute of 2 GB": exr_file(exr_header(SMALL, more=b"a\0string\0\xff\xff\xff\x7f")),
    "tiles of one pixel": exr_file(exr_header((0, 0, 5000, 5000), more=_tiles(1, 1, 2)), (), TILED),
    "tiles of no pixel": exr_file(exr_header(SMALL, more=_tiles(0, 0, 0)), LINES, TILED),
    "endless tiles": exr_file(exr_header(SMALL, more=_tiles(2**32 - 1, 1, 1)), LINES, TILED),
    "deep": exr_file(_part(0, SMALL, "deepscanline"), LINES, DEEP),
    "parts of 1 GB": exr_file(
        b"".join(_part(n, (0, 0, 5791, 5791)) for n in range(4)) + b"\0", (), PARTS
    ),
}


@pytest.mark.parametrize("kind", EXRS)
def test_what_an_exr_claims_is_checked(
    tmp_path: Path, kind: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(EXRS[kind])
    for read in (read_depth, read_rgb):
        with little(), pytest.raises(FileFormatError) as caught:
            read(path)
        assert "\n" not in str(caught.value)
    assert ("parts in" in str(caught.value)) == (kind == "parts of 1 GB")
    assert capfd.readouterr() == ("", "")


def test_an_exr_with_negative_windows_attributes_or_mipmaps_is_read(tmp_path: Path) -> None:
    path, levels = tmp_path / "a.exr", [(4, 2), (2, 1), (1, 1)]
    pixels = [w * h for w, h in levels]
    mipmaps = [struct.pack("<3i", 0, 0, n) + exr_line(n, p) for n, p in enumerate(pixels)]
    many = b"".join(exr_attribute(f"a{n}", "string", b"x") for n in range(10_000))
    for content in (
        exr_file(exr_header((-3, -1, 0, 0)), [exr_line(y, 4) for y in (-1, 0)]),
        exr_file(exr_header(SMALL, more=many), LINES),
        exr_file(exr_header(SMALL, more=_tiles(64, 64, 1)), mipmaps, TILED),
    ):
        path.write_bytes(content)
        assert read_depth(path).values.tolist() == [[2.0] * 4] * 2
        assert read_rgb(path).values.shape == (2, 4, 3)


def test_an_exr_of_one_long_row_is_converted_in_64_bytes_a_pixel(tmp_path: Path) -> None:
    path, width = tmp_path / "a.exr", 4_000_000
    path.write_bytes(exr_file(exr_header(SMALL, display=(0, 0, width - 1, 0)), LINES))
    with little(megabytes=64 * width // 10**6):
        assert read_rgb(path).values.shape == (1, width, 3)


SHAPES = ["(\n", "(6, 8", "(True, 5)", "(2, 10**9)", "(-1, 8)", "[6, 8]", "(6, 8.0)", "(1" * 900]
SHAPES += [f"(0, {10**30})", f"({'1, ' * 100})"]
DTYPES = ["f999", "<q8", ",", "i4, i4", "M8[x]", "\x00f4"]


@pytest.mark.parametrize(
    ("descr", "shape"), [*(("<f4", shape) for shape in SHAPES), *((d, "(2, 2)") for d in DTYPES)]
)
def test_a_header_of_npy_that_is_no_header_is_damaged(
    tmp_path: Path, descr: str, shape: str
) -> None:
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(4 * 6 * 8))
    with pytest.raises(FileFormatError, match=r"NPY cannot be read|holds .* values") as caught:
        read_depth(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("sixteen", ["value_bytes", "channels"])
def test_a_pixel_is_one_channel_of_one_byte_unless_told(sixteen: str) -> None:
    check_pixel_count(Path("a.tif"), 4000, 8000, **{sixteen: 16})  # the budget to the byte
    with pytest.raises(FileFormatError, match="in 512,064,000 bytes, more than 512,000,000"):
        check_pixel_count(Path("a.tif"), 4000, 8001, **{sixteen: 16})


def test_an_exr_has_four_bytes_a_pixel_of_every_channel() -> None:
    channel = SimpleNamespace(name="Z", xSampling=1, ySampling=1)
    header = dict.fromkeys(("dataWindow", "displayWindow"), ((0, 0), (3999, 3999)))
    _claimed_bytes(Path("a.exr"), header | {"channels": [channel] * 8}, 1 << 30)
    with pytest.raises(FileFormatError, match="in 576,000,000 bytes, more than 512,000,000"):
        _claimed_bytes(Path("a.exr"), header | {"channels": [channel] * 9}, 1 << 30)


def test_pages_of_a_tiff_that_overlap_are_refused() -> None:
    tags = 60_000
    start = [8 + 2 + 12 * 3000 + 4 + 10 + 12 * k for k in range(3000)]
    pointers = b"".join(struct.pack("<HHII", 34665, 4, 0, each) for each in start)
    # each value ends with the number of tags of a page that begins there
    shared = struct.pack("<HHIHH", 1, 1, 0, 0, tags) * (tags + 3001)
    data = b"II*\0" + struct.pack("<IH", 8, 3000) + pointers + bytes(4) + shared
    with little(seconds=2), pytest.raises(ValueError, match="overlap"):
        check_tags(data)


def test_the_tags_of_a_tiff_claim_as_many_bytes_as_their_types_have() -> None:
    sizes = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
    for kind, size in sizes.items():
        for order in "<>":
            for number in (240 // size, 240 // size + 1):
                page = struct.pack(f"{order}IHHHIII", 8, 1, 256, kind, number, 0, 0)
                data = ((b"II*\0" if order == "<" else b"MM\0*") + page).ljust(240, b"\0")
                with nullcontext() if number * size <= 240 else pytest.raises(ValueError):
                    check_tags(data)
