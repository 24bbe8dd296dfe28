"""Focal lengths of real image files with EXIF."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import Image

from pnpdepth_cli.io.rgb import read_focal_length

EXIF = 0x8769


def photo(path: Path, tags: dict[int, object]) -> Path:
    image = Image.new("RGB", (400, 300))
    exif = image.getexif()
    exif.get_ifd(EXIF).update(tags)
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_the_equivalent_on_film_has_the_same_diagonal_field_of_view(
    tmp_path: Path, suffix: str
) -> None:
    focal = read_focal_length(photo(tmp_path / f"a{suffix}", {0xA405: 50}), (300, 400))
    assert focal is not None
    assert focal.pixels == pytest.approx(50 / math.hypot(36, 24) * 500)
    assert "50 mm" in focal.source


def test_the_sensor_is_used_without_an_equivalent_and_follows_a_resized_photo(
    tmp_path: Path,
) -> None:
    # 5 mm and 100 pixels per mm on an image that was 800 pixels wide when it was taken
    tags = {0x920A: 5.0, 0xA20E: 1000.0, 0xA210: 3, 0xA002: 800, 0xA003: 600}
    focal = read_focal_length(photo(tmp_path / "a.jpg", tags), (300, 400))
    assert focal is not None
    assert focal.pixels == pytest.approx(5 * 100 / 2)


@pytest.mark.parametrize(
    "tags", [{}, {0xA405: 0}, {0xA405: 5000}, {0x920A: 5.0}, {0x920A: 5.0, 0xA20E: 9.0, 0xA210: 1}]
)
def test_an_image_without_a_focal_length_that_a_camera_can_have_gives_none(
    tmp_path: Path, tags: dict[int, object]
) -> None:
    assert read_focal_length(photo(tmp_path / "a.jpg", tags), (300, 400)) is None


def test_a_file_that_is_no_image_gives_none(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no image")
    assert read_focal_length(tmp_path / "a.jpg", (300, 400)) is None
