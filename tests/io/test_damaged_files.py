"""Files cut short or altered raise our own errors, whatever library reads them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, read_depth, write_depth
from tests.exr_files import write_exr

DEPTH = np.random.default_rng(5).uniform(0.5, 80, (40, 53)).astype(np.float32)


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one valid file of each kind."""
    folder = tmp_path_factory.mktemp("valid")
    for suffix in DEPTH_SUFFIXES:
        write_depth(folder / f"depth{suffix}", DEPTH)
    cv2.imwrite(str(folder / "double.tif"), DEPTH.astype(np.float64))
    codes = Image.fromarray((DEPTH * 256).astype(np.uint16))
    codes.save(folder / "codes-raw.tif")
    codes.save(folder / "codes-lzw.tif", compression="tiff_lzw")
    for name in ("NO", "RLE", "ZIPS", "PIZ", "DWAA"):
        compression = getattr(OpenEXR, f"{name}_COMPRESSION")
        write_exr(folder / f"{name}.exr", {"Z": DEPTH}, compression=compression)
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    write_exr(folder / "tiles.exr", {"Z": DEPTH}, **tiles)
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {name: DEPTH}, f"part {name}")
        for name in ("Z", "Q")
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(folder / "parts.exr"))
    pfm = b"Pf\n53 40\n1.0\n" + DEPTH[::-1].astype(">f4").tobytes()
    (folder / "big-endian.pfm").write_bytes(pfm)
    return folder


NAMES = [
    *(f"depth{suffix}" for suffix in DEPTH_SUFFIXES),
    *("double.tif", "codes-raw.tif", "codes-lzw.tif", "big-endian.pfm"),
    *("NO.exr", "RLE.exr", "ZIPS.exr", "PIZ.exr", "DWAA.exr", "tiles.exr", "parts.exr"),
]


@pytest.mark.parametrize("name", NAMES)
def test_the_file_is_read_and_every_truncation_is_refused_in_one_line_and_silently(
    valid: Path, name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert sorted(path.name for path in valid.iterdir()) == sorted(NAMES)
    assert read_depth(valid / name).values == pytest.approx(DEPTH, rel=0.01, abs=0.002)
    content = (valid / name).read_bytes()
    path = tmp_path / name
    for length in [*range(0, len(content), max(1, len(content) // 60)), len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError) as caught:
            read_depth(path)
        assert str(caught.value).startswith(str(path)), length
        assert "\n" not in str(caught.value)
    # OpenEXR, libtiff and OpenCV like to complain on their own; standard output is for data.
    assert capfd.readouterr() == ("", "")
