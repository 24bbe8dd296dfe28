from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.rgb import read_rgb, srgb_from_linear
from tests.exr_files import write_exr

COLOURS = np.random.default_rng(1).integers(0, 256, (7, 11, 3)).astype(np.uint8)
COLOURS_16 = np.random.default_rng(2).integers(0, 65536, (7, 11, 3)).astype(np.uint16)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_8_bit_colours_come_back_exactly(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    Image.fromarray(COLOURS).save(path)
    image = read_rgb(path)
    assert image.values.dtype == np.float32
    assert np.array_equal(image.values, COLOURS.astype(np.float32) / np.float32(255))
    assert image.note is None


def test_lossless_webp_comes_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "a.webp"
    Image.fromarray(COLOURS).save(path, lossless=True)
    assert np.array_equal(read_rgb(path).values * 255, COLOURS)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_16_bit_colours_keep_all_16_bits(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), COLOURS_16[:, :, ::-1])
    assert np.array_equal(read_rgb(path).values, COLOURS_16.astype(np.float32) / np.float32(65535))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("colours", [COLOURS, COLOURS_16])
def test_grey_is_repeated(tmp_path: Path, suffix: str, colours: np.ndarray) -> None:
    path, grey = tmp_path / f"a{suffix}", colours[:, :, :1]
    cv2.imwrite(str(path), grey)
    expected = grey.astype(np.float32) / np.float32(np.iinfo(colours.dtype).max)
    assert np.array_equal(read_rgb(path).values, np.repeat(expected, 3, axis=2))


@pytest.mark.parametrize("bits", [8, 16])
def test_alpha_is_dropped_and_does_not_darken(tmp_path: Path, bits: int) -> None:
    path = tmp_path / "a.png"
    colours = COLOURS if bits == 8 else COLOURS_16
    alpha = np.zeros_like(colours[:, :, :1])
    cv2.imwrite(str(path), np.concatenate([colours[:, :, ::-1], alpha], axis=2))
    top = np.float32(2**bits - 1)
    assert np.array_equal(read_rgb(path).values, colours.astype(np.float32) / top)


@pytest.mark.parametrize("mode", ["1", "P", "LA", "CMYK"])
def test_other_colour_modes_become_rgb(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "a.tif"
    Image.new("RGB", (5, 3), "white").convert(mode).save(path)
    assert np.array_equal(read_rgb(path).values, np.ones((3, 5, 3), np.float32))


# What is stored when the upright image is [[0, 1, 2], [3, 4, 5]], by EXIF orientation.
STORED = {
    1: [[0, 1, 2], [3, 4, 5]],
    2: [[2, 1, 0], [5, 4, 3]],
    3: [[5, 4, 3], [2, 1, 0]],
    4: [[3, 4, 5], [0, 1, 2]],
    5: [[0, 3], [1, 4], [2, 5]],
    6: [[2, 5], [1, 4], [0, 3]],
    7: [[5, 2], [4, 1], [3, 0]],
    8: [[3, 0], [4, 1], [5, 2]],
}


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "PNG16", "WEBP", "TIFF", "TIFF16"])
def test_exif_rotation_is_honoured(tmp_path: Path, orientation: int, kind: str) -> None:
    # 16 x 16 blocks, so that JPEG keeps each one's grey
    small = np.array(STORED[orientation], dtype=np.uint8) * 50
    pixels = np.kron(small, np.ones((16, 16), np.uint8))
    if kind.endswith("16"):
        pixels = pixels.astype(np.uint16) * 257
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "a.img"
    options = {"lossless": True} if kind == "WEBP" else {}
    Image.fromarray(pixels).save(path, kind.removesuffix("16"), exif=exif, **options)
    values = read_rgb(path).values[8::16, 8::16, 0] * 255
    assert np.allclose(values, np.arange(6).reshape(2, 3) * 50, atol=1.5)


def test_linear_exr_gets_the_srgb_curve_and_a_note(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    linear = np.array([[0.0, 0.001, 0.2140411], [0.5, 1.0, 0.0031308]], dtype=np.float32)
    write_exr(path, {"R": linear, "G": linear, "B": np.zeros_like(linear)})
    image = read_rgb(path)
    assert image.note == "EXR linear light, converted with the sRGB curve"
    assert np.array_equal(image.values[:, :, 0], srgb_from_linear(linear))
    assert np.array_equal(image.values[:, :, 0], image.values[:, :, 1])
    assert image.values[0, 2, 0] == pytest.approx(0.5, abs=1e-6)
    assert image.values[1, 1, 0] == 1
    assert not image.values[:, :, 2].any()


def test_exr_beyond_white_is_clipped_and_the_note_has_the_fraction(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    bright = np.array([[0.5, 4.0], [np.nan, np.inf]], dtype=np.float16)
    write_exr(path, {"R": bright, "G": bright, "B": bright})
    image = read_rgb(path)
    assert image.note is not None
    assert "50 % of pixels lay outside 0..1" in image.note
    assert image.values[0, 1].tolist() == image.values[1, 1].tolist() == [1, 1, 1]
    assert image.values[1, 0].tolist() == [0, 0, 0]


def test_grey_exr_and_layered_exr_are_read(tmp_path: Path) -> None:
    ones = np.ones((2, 3), np.float32)
    write_exr(tmp_path / "y.exr", {"Y": ones, "A": ones})
    assert np.array_equal(read_rgb(tmp_path / "y.exr").values, np.ones((2, 3, 3), np.float32))
    layer = {f"View.Combined.{c}": ones * k for k, c in enumerate("RGB")}
    write_exr(tmp_path / "l.exr", {**layer, "View.Depth.Z": ones})
    assert read_rgb(tmp_path / "l.exr").values[0, 0].tolist() == [0, 1, 1]


def test_exr_without_one_image_lists_its_channels(tmp_path: Path) -> None:
    ones = np.ones((2, 3), np.float32)
    write_exr(tmp_path / "a.exr", {"U": ones, "V": ones})
    with pytest.raises(FileFormatError, match=r"\(U, V\)"):
        read_rgb(tmp_path / "a.exr")


def test_a_float_tiff_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), np.ones((3, 4, 3), np.float32))
    with pytest.raises(FileFormatError, match="32-bit float TIFF; save the image with 8 or 16"):
        read_rgb(tmp_path / "a.tif")


def test_only_the_first_page_is_read_with_a_note(tmp_path: Path) -> None:
    first, second = Image.fromarray(COLOURS), Image.new("RGB", (11, 7))
    first.save(tmp_path / "a.tif", save_all=True, append_images=[second])
    image = read_rgb(tmp_path / "a.tif")
    assert image.note == "first of 2 images"
    assert np.array_equal(np.rint(image.values * 255), COLOURS)


def test_an_image_with_damaged_exif_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.new("RGB", (8, 8), "white").save(path, exif=b"Exif\0\0MM\0*\0\0\0\x08\0\x05\x01\x12")
    assert read_rgb(path).values.min() == 1


@pytest.mark.parametrize(
    ("content", "fact"),
    [
        (b"", "is empty"),
        (b"hello, world", "is not an image"),
        (b"\x93NUMPY\x01\x00", "not an im"),
        (b"\0\0\0\x18ftypheic\0\0\0\0", "is a HEIC or AVIF photo; save it as JPEG"),
    ],
)
def test_what_is_no_image_is_refused(tmp_path: Path, content: bytes, fact: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=fact) as caught:
        read_rgb(path)
    assert str(caught.value).startswith(str(path))


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.png: no such file"):
        read_rgb(tmp_path / "none.png")
    with pytest.raises(InputError, match="is a folder"):
        read_rgb(tmp_path)
    with pytest.raises(InputError, match="file name too long"):
        read_rgb(tmp_path / ("n" * 300))
    (tmp_path / "f").write_bytes(b"x")
    with pytest.raises(InputError, match="no such file"):
        read_rgb(tmp_path / "f" / "a.png")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_every_truncation_of_an_image_is_refused(tmp_path: Path, kind: str) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.kron(COLOURS, np.ones((6, 6, 1), np.uint8))).save(buffer, kind)
    content = buffer.getvalue()
    path = tmp_path / "a.img"
    for length in [*range(0, len(content), 41), len(content) - 2, len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError):
            read_rgb(path)


def test_a_progressive_jpeg_cut_between_scans_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.kron(COLOURS, np.ones((6, 6, 1), np.uint8))).save(
        buffer, "JPEG", progressive=True
    )
    content = buffer.getvalue()
    scans = [i for i in range(len(content) - 1) if content[i : i + 2] == b"\xff\xda"]
    assert len(scans) > 2
    for start in scans[1:]:
        (tmp_path / "a.jpg").write_bytes(content[:start])
        with pytest.raises(FileFormatError, match="cut short"):
            read_rgb(tmp_path / "a.jpg")


def test_a_png_with_one_altered_byte_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    text = PngInfo()
    text.add_text("key", "value")
    Image.fromarray(COLOURS).save(buffer, "PNG", pnginfo=text)
    content = bytearray(buffer.getvalue())
    content[len(content) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FileFormatError, match="wrong checksum"):
        read_rgb(tmp_path / "a.png")


def test_a_real_frame_is_read_as_other_programs_read_it(shared_data: Path) -> None:
    path = shared_data / "7scenes" / "frame-000000.color.jpg"
    values = read_rgb(path).values
    assert values.shape == (480, 640, 3)
    with Image.open(path) as image:
        assert np.array_equal(np.rint(values * 255), np.asarray(image))
