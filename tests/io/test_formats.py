"""Depth files of every format as metres, 0 where unknown; none that is cut short."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES, read_depth, write_depth
from tests.exr_files import write_exr
from tests.models.weights.files import Hostile

CODES = np.array([[0, 256, 512], [1000, 25600, 65534]], dtype=np.uint16)
METRES = np.array([[0, 1.5, np.nan], [np.inf, -2, 80.25]], dtype=np.float32)
KNOWN = np.array([[0, 1.5, 0], [0, 0, 80.25]], dtype=np.float32)


def save(path: Path, values: Any, text: str | None = None) -> Path:
    """Writes by the suffix, a mapping as channels; `text` is the scale in the file itself."""
    if path.suffix == ".npz":
        np.savez(path, **values)
    elif text is not None:
        info = PngInfo()
        info.add_text("pnpdepth:scale", text)
        Image.fromarray(values).save(path, pnginfo=info)
    else:
        by_suffix = {".npy": np.save, ".exr": write_exr, ".pfm": Path.write_bytes}
        by_suffix.get(path.suffix, lambda p, v: cv2.imwrite(str(p), v))(path, values)
    return path


def ones(*names: str) -> dict[str, np.ndarray]:
    """Channels of 1, 2, ... metres."""
    return {name: np.full((2, 3), 1 + k, np.float32) for k, name in enumerate(names)}


@pytest.mark.parametrize(
    ("text", "scale", "used"),
    [(None, None, 256), (None, 1000, 1000), ("1000", None, 1000), ("1000", 500, 500)],
)
def test_a_given_scale_beats_that_in_the_file_which_beats_kittis(
    text: str | None, scale: float | None, used: float, tmp_path: Path
) -> None:
    for name in ("d.png",) if text else ("d.png", "d.tif"):
        path = save(tmp_path / name, CODES, text)
        depth = read_depth(path, scale=scale)
        assert np.array_equal(depth.values, (CODES / used).astype(np.float32))
        assert depth.reading.assumed == (text is None and scale is None)
        assert depth.reading.scale == used
    for senseless in (0.0, -256.0, math.nan):
        with pytest.raises(UsageError):
            read_depth(path, scale=senseless)
        with pytest.raises(InputError, match=f"pnpdepth:scale={senseless}"):
            read_depth(save(tmp_path / "d.png", CODES, str(senseless)))


PIXELS = np.array([[-1, 256]])
ANYTHING, A = {"anything": METRES}, {"A": METRES.astype(np.float16)}
GREY = {"R": METRES, "G": METRES, "B": METRES, "A": np.ones_like(METRES)}
UNSIGNED = {"Z": np.array([[512, 0]], np.uint32)}
LITTLE = b"Pf\n3 2\n-1.0\n" + METRES[::-1].astype("<f4").tobytes()
BIG = b"Pf\n3 2\n1.0\n" + METRES[::-1].astype(">f4").tobytes()
UNKNOWN = "16-bit PNG ÷ 256, 2 pixels of value 65535 taken as unknown"
FACTOR = "PFM, scale factor 0.25 of its header not applied"


@pytest.mark.parametrize(
    ("name", "values", "expected", "source"),
    [
        *(("d.npy", METRES.astype(k), KNOWN, f"{np.dtype(k)} NPY") for k in ("<f2", "<f8", ">f4")),
        *(("d.npy", METRES.reshape(s), KNOWN, "float32 NPY") for s in [(2, 3, 1), (1, 1, 2, 3)]),
        ("d.npy", PIXELS.astype(np.int16), [[0, 1]], "int16 NPY ÷ 256"),
        ("d.npy", np.maximum(PIXELS, 0).astype(np.uint64), [[0, 1]], "uint64 NPY ÷ 256"),
        ("d.npy", np.array([[1e300, 2.0]]), [[0, 2]], "float64 NPY"),
        ("d.npz", ANYTHING, KNOWN, "float32 NPZ array anything"),
        ("d.exr", ANYTHING, KNOWN, "EXR channel anything"),
        ("d.exr", A, KNOWN, "EXR channel A"),
        ("d.exr", GREY, KNOWN, "EXR channel R"),
        ("d.exr", UNSIGNED, [[2, 0]], "EXR channel Z ÷ 256"),
        ("d.exr", ones("R", "G", "B", "depth"), [[4] * 3] * 2, "EXR channel depth"),
        ("d.exr", ones("V.Combined.R", "V.Depth.Z"), [[2] * 3] * 2, "EXR channel V.Depth.Z"),
        ("d.tiff", METRES, KNOWN, "32-bit float TIFF"),
        *(("d.pfm", rows, KNOWN, "PFM") for rows in (LITTLE, BIG)),
        ("d.pfm", b"Pf\n1 1\n-0.25\n" + np.float32(2).tobytes(), [[2]], FACTOR),
        ("d.png", np.array([[65535, 256, 65535]], np.uint16), [[0, 1, 0]], UNKNOWN),
    ],
)
def test_every_format_gives_metres_where_they_are_finite_and_above_zero(
    tmp_path: Path, name: str, values: Any, expected: Any, source: str
) -> None:
    path = save(tmp_path / name, values)
    depth = read_depth(path)
    assert depth.values.tolist() == np.asarray(expected, np.float32).tolist()
    assert depth.reading.source == source
    assert depth.reading.assumed == ("÷" in source)
    if "÷" not in source:  # floats are metres, whatever the scale
        assert np.array_equal(read_depth(path, scale=1000).values, depth.values)
        assert depth.reading.scale is None


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *(("d.npy", np.ones(shape, np.float32)) for shape in [(), (6,), (2, 2, 3), (0, 4)]),
        *(("d.npy", np.array([[value]])) for value in (True, 1j, "a")),
        *(("d.npz", ones(*names)) for names in ("", "ab")),
        *(("d.exr", ones(*names)) for names in (("R", "G", "B"), ("depth", "Z"))),
        *((f"d.{suffix}", np.zeros((3, 4), np.uint8)) for suffix in ("png", "tif", "jpg", "webp")),
        ("d.png", np.zeros((3, 4, 4), np.uint16)),
        *(("d.tif", np.zeros((3, 4), kind)) for kind in (np.float64, np.int32)),
        ("d.tif", np.zeros((3, 4, 3), np.float32)),
        ("d.pfm", b"PF\n1 1\n-1\n" + bytes(12)),
        *(("d.pfm", b"Pf\n2 1\n-1\n" + bytes(count)) for count in (7, 9)),
        *(("d.pfm", b"Pf\n" + head + b"\n" + bytes(8)) for head in (b"2 1\n0", b"2 0\n-1")),
        ("d.pfm", b"hello"),
    ],
)
def test_what_is_no_depth_is_refused(tmp_path: Path, name: str, values: Any) -> None:
    with pytest.raises(InputError):
        read_depth(save(tmp_path / name, values))


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_pickled_objects_are_never_loaded(tmp_path: Path, suffix: str) -> None:
    evil = np.array([Hostile(open, str(tmp_path / "trace"), "w")], dtype=object)
    with pytest.raises(InputError, match="allow_pickle"):
        read_depth(save(tmp_path / f"d{suffix}", evil if suffix == ".npy" else {"a": evil}))
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("suffix", DEPTH_SUFFIXES)
def test_every_truncation_of_a_depth_file_is_refused_in_one_line(
    suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"d{suffix}"
    write_depth(path, np.random.default_rng(5).uniform(0.5, 80, (40, 53)).astype(np.float32))
    content = path.read_bytes()
    for length in [*range(0, len(content), max(1, len(content) // 60)), len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=f"^{path}") as caught:
            read_depth(path)
        assert "\n" not in str(caught.value)
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err == "" or suffix == ".exr"  # OpenEXR complains on its own


def test_an_exr_of_several_parts_or_with_a_crop_of_its_display_is_refused(tmp_path: Path) -> None:

    header = {"type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(header), {name: METRES}, name) for name in ("left", "right")]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "parts.exr"))
    window = (np.array([0, 0], np.int32), np.array([4, 3], np.int32))
    write_exr(tmp_path / "crop.exr", {"Z": METRES}, displayWindow=window)
    for name in ("parts.exr", "crop.exr"):
        with pytest.raises(InputError, match=name):
            read_depth(tmp_path / name)
