"""What a file may claim is bounded before memory is allocated, and only regular files are read."""

from __future__ import annotations

import io
import os
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import PIL.Image
import pytest

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.file_bytes import sha256_of
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.io.sparse_files import read_sparse
from pnpdepth_cli.io.text_files import read_json

READERS = [read_depth, read_sparse, read_rgb, read_calibration, read_json, sha256_of, read_scan]
DEPTH = np.full((6, 8), 2.5, np.float32)


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    """Every test takes less than 5 s of CPU and 300 MB of what Python allocates."""
    tracemalloc.start()
    start = time.process_time()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 3e8
        assert time.process_time() - start < 5
    finally:
        tracemalloc.stop()
        set_max_pixels(None)


def npy_header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": descr, "fortran_order": False, "shape": shape}
    )
    return buffer.getvalue()


def npz(path: Path, content: bytes, compression: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("depth.npy", content)


@pytest.mark.parametrize("read", READERS)
def test_a_device_a_pipe_and_a_sparse_file_of_terabytes_are_refused_unread(
    read: Any, tmp_path: Path
) -> None:
    pipe, huge = tmp_path / "pipe.bin", tmp_path / "huge.png"
    os.mkfifo(pipe)
    for path in (pipe,) if read is read_scan else (Path("/dev/zero"), pipe):
        with pytest.raises(InputError):
            read(path)
    with huge.open("wb") as file:
        file.truncate(1 << 42)
    if read not in (sha256_of, read_scan):
        with pytest.raises(FileFormatError):
            read(huge)


def test_an_npz_member_much_longer_than_its_array_is_not_decompressed_further(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bomb.npz"
    content = npy_header((6, 8)) + DEPTH.tobytes() + bytes(100 << 20)
    tracemalloc.stop()
    npz(path, content)
    del content
    tracemalloc.start()
    assert np.array_equal(read_depth(path).values, DEPTH)
    assert tracemalloc.get_traced_memory()[1] < 2e7


def test_an_npz_that_lies_or_that_python_decompresses_without_bound_is_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "lie.npz"
    npz(path, npy_header((10_000, 5_000)) + bytes(1000))
    with pytest.raises(FileFormatError):
        read_depth(path)
    for compression in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        npz(path, npy_header((6, 8)) + DEPTH.tobytes(), compression)
        with pytest.raises(FileFormatError):
            read_depth(path)
    npz(path, npy_header((600, 800)) + bytes(4 * 600 * 800))
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\x01\x02")
    struct.pack_into("<I", content, entry + 24, 500)  # uncompressed size
    path.write_bytes(content)
    with pytest.raises(FileFormatError):
        read_depth(path)


@pytest.mark.parametrize("suffix", [".png", ".exr", ".pfm", ".tiff", ".npy", ".npz"])
def test_more_pixels_than_the_budget_are_refused_before_they_are_read(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"d{suffix}"
    write_depth(path, np.ones((300, 400), np.float32))
    set_max_pixels(119_999)
    with pytest.raises(FileFormatError):
        read_depth(path)
    set_max_pixels(120_000)
    assert read_depth(path).values.shape == (300, 400)


def test_an_exr_of_a_few_bytes_with_a_vast_display_window_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "window.exr"
    window = (np.array([0, 0], np.int32), np.array([7999, 7989], np.int32))
    header = {"type": OpenEXR.scanlineimage, "displayWindow": window}
    with OpenEXR.File(header, {"Z": DEPTH}) as file:
        file.write(str(path))
    for read in (read_depth, read_rgb):
        with pytest.raises(FileFormatError):
            read(path)


def test_an_image_of_16_bits_is_read_however_many_pixels_pillow_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = np.arange(64 * 64, dtype=np.uint16).reshape(64, 64)
    PIL.Image.fromarray(codes).save(tmp_path / "codes.png")
    PIL.Image.fromarray((codes % 256).astype(np.uint8)).save(tmp_path / "bytes.png")
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 100)  # as 268 megapixels are to its own
    for name in ("codes.png", "bytes.png"):
        assert read_rgb(tmp_path / name).values.shape == (64, 64, 3)
    assert PIL.Image.MAX_IMAGE_PIXELS == 100
