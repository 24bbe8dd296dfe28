"""Depth in every format is metres where it is known, as it was written; none that is cut short."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from pnpdepth_cli.errors import InputError, OutputError, PnpDepthError, UsageError
from pnpdepth_cli.io.depth import (
    DEPTH_SUFFIXES,
    describe_range,
    read_depth,
    write_depth,
)
from pnpdepth_cli.io.formats import Reading
from tests.models.weights.files import Hostile

CODES = np.array([[0, 256, 512], [1000, 25600, 65534]], dtype=np.uint16)
METRES = np.array([[0, 1.5, np.nan], [np.inf, -2, 80.25]], dtype=np.float32)
KNOWN = np.array([[0, 1.5, 0], [0, 0, 80.25]], dtype=np.float32)


def save(path: Path, values: Any, text: str | None = None) -> Path:
    """Writes by the suffix, a mapping as channels; `text` is the scale in the file itself."""
    if path.suffix == ".npz":
        np.savez(path, **values)
    elif path.suffix == ".exr":
        OpenEXR.File({}, values).write(str(path))
    elif text is not None:
        info = PngInfo()
        info.add_text("pnpdepth:scale", text)
        Image.fromarray(values).save(path, pnginfo=info)
    else:
        by_suffix = {".npy": np.save, ".pfm": Path.write_bytes}
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
        assert ("not 1000" in depth.reading.source) == (text is not None and used != 1000)
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
BELOW = ", 1 pixels below 0 taken as unknown"
FACTOR = "PFM, scale factor 0.25 of its header not applied"


@pytest.mark.parametrize(
    ("name", "values", "expected", "source"),
    [
        *(("d.npy", METRES.astype(k), KNOWN, f"{np.dtype(k)} NPY") for k in ("<f2", "<f8", ">f4")),
        *(("d.npy", METRES.reshape(s), KNOWN, "float32 NPY") for s in [(2, 3, 1), (1, 1, 2, 3)]),
        ("d.npy", PIXELS.astype(np.int16), [[0, 1]], f"int16 NPY ÷ 256{BELOW}"),
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
    assert depth.reading.source == source + (BELOW if expected is KNOWN else "")
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


def test_a_file_of_no_format_is_refused_with_the_formats(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="PNG, EXR, NPY, NPZ, PFM, TIFF"):
        read_depth(save(tmp_path / "d.pfm", b"hello"))


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
        with pytest.raises(InputError, match=f"^{path}.*$"):
            read_depth(path)
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err == "" or suffix == ".exr"  # OpenEXR complains on its own


def test_an_exr_of_several_parts_or_with_a_crop_of_its_display_is_refused(tmp_path: Path) -> None:
    parts = [OpenEXR.Part({}, {name: METRES}, name) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    window = (np.array([0, 0], np.int32), np.array([4, 3], np.int32))
    OpenEXR.File({"displayWindow": window}, {"Z": METRES}).write(str(tmp_path / "crop.exr"))
    for name in ("parts.exr", "crop.exr"):
        with pytest.raises(InputError, match=name):
            read_depth(tmp_path / name)


SPECIAL = [[np.nan, np.inf, -np.inf, -1], [0, -0.0, 1e-45, 3.4e38], [1 / 3, 80.25, 2, 1e-3]]


def as_others_read(path: Path) -> np.ndarray:
    """The depth in a file, read without this program."""
    if path.suffix == ".EXR":
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return file.channels()["Z"].pixels
    if path.suffix in (".NPY", ".NPZ"):
        content = np.load(path)
        return content if path.suffix == ".NPY" else content["depth"]
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("suffix", [s for s in DEPTH_SUFFIXES if s != ".png"])
@pytest.mark.parametrize("layout", [np.array, np.transpose, np.flipud])
def test_float_formats_give_back_every_known_depth_exactly_also_to_other_programs(
    suffix: str, layout: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / f"d{suffix.upper()}"
    depth = layout(np.array(SPECIAL, np.float32))
    write_depth(path, depth)
    known = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    assert (again := read_depth(path).values).dtype == np.float32
    assert np.array_equal(again, known)
    assert np.array_equal(as_others_read(path), known)


@pytest.mark.parametrize("scale", [256.0, 1000.0, 5000.0, 1.0, 0.1, 1000 / 3])
def test_png_gives_back_every_code_and_its_scale(scale: float, tmp_path: Path) -> None:
    path = tmp_path / "d.png"
    codes = np.arange(65535, dtype=np.uint16).reshape(257, 255)
    depth = (codes / scale).astype(np.float32)
    write_depth(path, depth, scale=scale)
    assert np.array_equal(as_others_read(path), codes)
    again = read_depth(path)
    assert np.array_equal(again.values, depth)
    assert (again.reading.scale, again.reading.assumed) == (scale, False)


ONE = [[1.0]]


@pytest.mark.parametrize(
    ("name", "depth", "scale", "error"),
    [
        *(("d.png", [[1, large]], 1000, OutputError) for large in (65.535, 1e30)),
        ("d.png", [[1, 1e-3, 1e-4]], 256, OutputError),
        *(("d.png", ONE, s, UsageError) for s in (0, np.nan)),
        *((name, ONE, 256, OutputError) for name in ("d.jpg", "d")),
        ("d.npy", np.ones((0, 4)), 256, InputError),
    ],
)
def test_what_a_format_cannot_hold_is_refused_and_nothing_is_written(
    tmp_path: Path, name: str, depth: list, scale: float, error: type[PnpDepthError]
) -> None:
    with pytest.raises(error):
        write_depth(tmp_path / name, np.array(depth, np.float32), scale=scale)
    assert list(tmp_path.iterdir()) == []


FLOAT = Reading("PFM", None, False)
BY_256 = Reading("PNG", 256.0, False)


def test_the_range_has_count_and_ends_and_says_how_to_change_an_assumed_scale() -> None:
    assert describe_range(np.array([0, np.nan, 5.0]), FLOAT).startswith("1 point, 5.0 m")
    assert describe_range(np.array([0.034, 0.97]), FLOAT).startswith("2 points, 0.034–1.0 m")
    assert describe_range(np.zeros(2), FLOAT).startswith("no points")
    assumed = BY_256._replace(source="16-bit PNG ÷ 256", assumed=True)
    assert "--depth-scale 1000" in describe_range(np.array([3.125, 13.28]), assumed)
