"""Images as other programs see them: upright, in 0..1, whatever their format; and their EXIF."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.rgb import orientation_in, read_focal_length, read_rgb, sizes_of

COLOURS = np.random.default_rng(1).integers(0, 256, (7, 11, 3)).astype(np.uint8)
COLOURS_16 = np.random.default_rng(2).integers(0, 65536, (7, 11, 3)).astype(np.uint16)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("colours", [COLOURS, COLOURS_16])
def test_all_bits_of_a_colour_are_kept_and_alpha_is_dropped(
    tmp_path: Path, suffix: str, colours: np.ndarray
) -> None:
    path = tmp_path / f"a{suffix}"
    expected = colours / np.float32(np.iinfo(colours.dtype).max)
    alpha = cv2.cvtColor(colours, cv2.COLOR_RGB2BGRA)
    red = expected[:, :, :1].repeat(3, axis=2)
    stored = {"colours": (alpha[:, :, :3], expected), "grey": (colours[:, :, :1], red)}
    if suffix == ".png":
        stored["alpha"] = alpha, expected
    for pixels, values in stored.values():
        cv2.imwrite(str(path), pixels)
        assert np.array_equal(read_rgb(path).values, values)


UPRIGHT = np.arange(6).reshape(2, 3)
STORED = [UPRIGHT, UPRIGHT[:, ::-1], UPRIGHT[::-1, ::-1], UPRIGHT[::-1]]
STORED += [stored.T for stored in STORED]
"""What is stored of the upright image, by EXIF orientation from 1."""


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "PNG16", "TIFF", "TIFF16"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_rotation_is_honoured(tmp_path: Path, kind: str, orientation: int) -> None:
    # 16 x 16 blocks, so that JPEG keeps each one's grey
    pixels = np.kron(STORED[orientation - 1].astype(np.uint8) * 50, np.ones((16, 16), np.uint8))
    path = tmp_path / "a.img"
    exif = Image.Exif()
    exif[0x0112] = orientation
    image = Image.fromarray(pixels.astype(np.uint16) * 257 if "16" in kind else pixels)
    image.save(path, kind.removesuffix("16"), exif=exif)
    assert "TIFF" in kind or sizes_of(path) == ((32, 48), pixels.shape)
    values = read_rgb(path).values[8::16, 8::16, 0] * 255
    assert np.allclose(values, UPRIGHT * 50, atol=1.5)


@pytest.mark.parametrize(
    "kind", [b"avif", b"heic", b"isom", b"", b"hello, world", b"\x93NUMPY\x01\x00"]
)
def test_what_is_no_image_is_refused(tmp_path: Path, kind: bytes) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"\0\0\0\x18ftyp" + kind + b"\0\0\0\0" if len(kind) == 4 else kind)
    said = f"{path} is a video" if kind == b"isom" else str(path)
    with pytest.raises(InputError, match=said):
        read_rgb(path)


def test_a_heic_photo_is_read_upright(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="needs the extra [heic]")
    path = tmp_path / "a.heic"
    exif = Image.Exif()
    exif[0x0112] = 6
    red_above_blue = np.uint8([[[200, 0, 0]], [[0, 0, 200]]]).repeat(32, 0).repeat(32, 1)
    heif.from_pillow(Image.fromarray(red_above_blue)).save(path, exif=exif.tobytes(), quality=100)
    values = read_rgb(path).values
    assert values.shape == (32, 64, 3)  # turned by a quarter
    assert values[16, 16, 2] > 0.7 > 0.1 > values[16, 48, 2]


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_every_truncation_of_an_image_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.img"
    Image.fromarray(np.kron(COLOURS, np.ones((6, 6, 1), np.uint8))).save(path, kind)
    content = path.read_bytes()
    for length in [*range(0, len(content), 41), len(content) - 2, len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(InputError):
            read_rgb(path)


def test_the_focal_length_is_that_of_film_if_a_camera_can_have_it(tmp_path: Path) -> None:
    image = Image.new("RGB", (400, 300))
    path = tmp_path / "a.jpg"
    for tags in ({0xA405: 50}, {}, {0xA405: 5}, {0xA405: 5000}, {0x920A: 5.0}):
        exif = image.getexif()
        exif[0x8769] = tags
        image.save(path, exif=exif)
        focal = read_focal_length(path, (300, 400))
        if tags == {0xA405: 50}:  # of equal diagonal field of view on film
            assert focal[0] == pytest.approx(50 / math.hypot(36, 24) * 500)
        else:
            assert focal is None


def test_linear_exr_gets_the_srgb_curve_and_what_is_clipped_a_note(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    linear = np.array([[0, 0.002, 0.2140411], [0.5, 1, 0]], np.float32)
    layer = {f"V.Combined.{c}": linear * shown for c, shown in zip("RGB", (1, 1, 0), strict=True)}
    OpenEXR.File({}, {**layer, "V.Depth.Z": linear}).write(str(path))
    encoded = np.array([[0, 12.92 * 0.002, 0.5], [0.7353569, 1, 0]])[:, :, None] * [1, 1, 0]
    np.testing.assert_allclose(read_rgb(path).values, encoded, atol=1e-6)
    bright = np.array([[0.5, 4.0], [np.nan, np.inf]], np.float16)
    OpenEXR.File({}, {"Y": bright, "A": bright}).write(str(path))
    image = read_rgb(path)
    np.testing.assert_allclose(image.values[:, :, 0], [[0.7353569, 1], [0, 1]], atol=1e-6)
    assert "50 %" in str(image.note)
    assert sizes_of(path) == ((2, 2), (2, 2))


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_the_exif_orientation_is_told(orientation: int, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    Image.new("RGB", (8, 4)).save(tmp_path / "a.jpg", exif=exif)
    assert orientation_in(tmp_path / "a.jpg") == orientation
    Image.new("RGB", (8, 4)).save(tmp_path / "a.png")
    assert orientation_in(tmp_path / "a.png") == 1


def test_an_exif_orientation_that_does_not_exist_turns_no_image(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    exif = Image.Exif()
    exif[274] = 9
    Image.new("RGB", (8, 4)).save(path, exif=exif)
    assert read_rgb(path).values.shape == (4, 8, 3)
    assert sizes_of(path) == ((4, 8), (4, 8))


def test_the_orientation_of_an_exr_which_has_no_exif_is_upright(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(b"\x76\x2f\x31\x01")  # how an EXR begins
    assert orientation_in(path) == 1
