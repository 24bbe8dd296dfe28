from __future__ import annotations

import math
import re
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from pnpdepth_cli.errors import FileFormatError, InputError, UsageError
from pnpdepth_cli.io.depth import read_depth
from tests.exr_files import write_exr

CODES = np.array([[0, 256, 512], [1000, 25600, 65534]], dtype=np.uint16)
METRES = np.array([[0, 1.5, np.nan], [np.inf, -2, 80.25]], dtype=np.float32)
KNOWN = np.array([[0, 1.5, 0], [0, 0, 80.25]], dtype=np.float32)


def save(path: Path, values: np.ndarray, text: str | None = None) -> Path:
    """Writes by the suffix; `text` is the scale that the file itself gives."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif text is None:
        cv2.imwrite(str(path), values)
    elif path.suffix == ".png":
        info = PngInfo()
        info.add_text("pnpdepth:scale", text)
        Image.fromarray(values).save(path, pnginfo=info)
    else:
        Image.fromarray(values).save(path, description=f"pnpdepth:scale={text}")
    return path


@pytest.mark.parametrize("name", ["d.png", "d.tif"])
@pytest.mark.parametrize(
    ("text", "scale", "used", "end"),
    [
        (None, None, 256, "÷ 256"),
        (None, 1000, 1000, "÷ 1000"),
        ("1000", None, 1000, "÷ 1000 (from the file)"),
        ("1000", 500, 500, "÷ 500"),
    ],
)
def test_a_given_scale_beats_that_in_the_file_which_beats_kittis(
    name: str, text: str | None, scale: float | None, used: float, end: str, tmp_path: Path
) -> None:
    depth = read_depth(save(tmp_path / name, CODES, text), scale=scale)
    assert np.array_equal(depth.values, (CODES / used).astype(np.float32))
    assert depth.values.dtype == np.float32
    assert depth.source == f"16-bit {'PNG' if name == 'd.png' else 'TIFF'} {end}"
    assert depth.assumed_scale == (text is None and scale is None)
    assert depth.scale == used
    assert np.array_equal(depth.valid, CODES > 0)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "many"])
def test_a_senseless_scale_in_the_file_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(FileFormatError, match=f"pnpdepth:scale={text}"):
        read_depth(save(tmp_path / "d.png", CODES, text))


@pytest.mark.parametrize("scale", [0.0, -256.0, math.nan, math.inf])
def test_a_senseless_given_scale_is_wrong_usage(tmp_path: Path, scale: float) -> None:
    with pytest.raises(UsageError, match="--depth-scale must be a finite number above 0"):
        read_depth(save(tmp_path / "d.png", CODES), scale=scale)


def test_the_largest_code_is_unknown_and_gets_a_note(tmp_path: Path) -> None:
    path = tmp_path / "d.png"
    cv2.imwrite(str(path), np.array([[65535, 1000, 65535]], dtype=np.uint16))
    depth = read_depth(path, scale=1000)
    assert depth.values.tolist() == [[0, 1, 0]]
    assert depth.source == "16-bit PNG ÷ 1000, 2 pixels of value 65535 taken as unknown"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.int64, np.uint64])
def test_integers_in_npy_need_a_scale_as_png_does(tmp_path: Path, dtype: type) -> None:
    depth = read_depth(save(tmp_path / "d.npy", np.array([[0, 128]], dtype=dtype)))
    assert depth.values.tolist() == [[0, 0.5]]
    assert depth.assumed_scale
    assert depth.source == f"{np.dtype(dtype)} NPY ÷ 256"
    negative = read_depth(save(tmp_path / "d.npy", np.array([[-1, 256]], dtype=np.int16)))
    assert negative.values.tolist() == [[0, 1]]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
def test_floats_are_metres_whatever_the_scale_and_known_where_finite_and_above_zero(
    tmp_path: Path, dtype: str
) -> None:
    path = save(tmp_path / "d.npy", METRES.astype(dtype))
    for depth in (read_depth(path), read_depth(path, scale=1000)):
        assert np.array_equal(depth.values, KNOWN)
        assert not depth.assumed_scale
        assert depth.scale is None
    beyond_float32 = read_depth(save(tmp_path / "d.npy", np.array([[1e300, 2.0]])))
    assert beyond_float32.values.tolist() == [[0, 2]]


@pytest.mark.parametrize("shape", [(2, 3), (1, 2, 3), (2, 3, 1), (1, 1, 2, 3), (1, 2, 3, 1)])
def test_npy_may_have_one_channel_before_or_behind_and_be_a_batch_of_one(
    tmp_path: Path, shape: tuple[int, ...]
) -> None:
    np.save(tmp_path / "d.npy", METRES.reshape(shape))
    assert np.array_equal(read_depth(tmp_path / "d.npy").values, KNOWN)


@pytest.mark.parametrize(
    "shape", [(), (6,), (2, 2, 3), (3, 2, 1, 1), (1, 2, 2, 3), (1, 1, 1, 2, 3), (0, 4), (4, 0)]
)
def test_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "d.npy", np.ones(shape, np.float32))
    with pytest.raises(FileFormatError, match=r"is \(H, W\)|no pixels"):
        read_depth(tmp_path / "d.npy")


@pytest.mark.parametrize("values", [np.array([[True]]), np.array([[1j]]), np.array([["a"]])])
def test_what_is_no_number_is_refused(tmp_path: Path, values: np.ndarray) -> None:
    np.save(tmp_path / "d.npy", values)
    with pytest.raises(FileFormatError, match="depth is float or integer"):
        read_depth(tmp_path / "d.npy")


class WritesAFile:
    """Unpickled, it leaves a trace."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (self.path, "w")


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_pickled_objects_are_never_loaded(tmp_path: Path, suffix: str) -> None:
    trace = tmp_path / "trace"
    evil = np.array([WritesAFile(str(trace))], dtype=object)
    path = tmp_path / f"d{suffix}"
    if suffix == ".npy":
        np.save(path, evil, allow_pickle=True)
    else:
        np.savez(path, evil)
    with pytest.raises(FileFormatError, match="allow_pickle"):
        read_depth(path)
    assert not trace.exists()


def test_npz_with_one_array_needs_no_key(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", anything=METRES)
    depth = read_depth(tmp_path / "d.npz")
    assert np.array_equal(depth.values, KNOWN)
    assert depth.source == "float32 NPZ array anything"


def test_npz_with_several_arrays_lists_them_unless_one_is_chosen(tmp_path: Path) -> None:
    path = tmp_path / "d.npz"
    np.savez(path, near=METRES, far=METRES * 2)
    with pytest.raises(FileFormatError, match=r"2 arrays \(near, far\); choose one with --channel"):
        read_depth(path)
    assert np.array_equal(read_depth(path, channel="far").values, KNOWN * 2)
    with pytest.raises(UsageError, match="no array 'mid'; --channel can be one of: near, far"):
        read_depth(path, channel="mid")


def test_an_empty_npz_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz")
    with pytest.raises(FileFormatError, match="holds no array"):
        read_depth(tmp_path / "d.npz")


def test_a_zip_of_something_else_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "d.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(FileFormatError, match="is not an array"):
        read_depth(tmp_path / "d.npz")


def test_a_subsampled_exr_channel_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.exr"
    write_exr(path, {"Z": np.ones((4, 4), np.float32)})
    # In the list of channels: name, float, not linear, then the sampling in x and y.
    entry = b"Z\0" + struct.pack("<4I", 2, 0, 1, 1)
    content = path.read_bytes()
    assert content.count(entry) == 1
    path.write_bytes(content.replace(entry, entry[:-8] + struct.pack("<2I", 2, 2)))
    with pytest.raises(FileFormatError, match="channel Z is subsampled"):
        read_depth(path)


def test_transparency_in_a_16_bit_png_changes_no_depth(tmp_path: Path) -> None:
    Image.fromarray(CODES).save(tmp_path / "d.png", transparency=256)
    assert np.array_equal(read_depth(tmp_path / "d.png").values, CODES.astype(np.float32) / 256)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("name", ["Z", "depth", "anything", "A"])
def test_the_only_exr_channel_is_taken_whatever_its_name(
    tmp_path: Path, dtype: type, name: str
) -> None:
    write_exr(tmp_path / "d.exr", {name: METRES.astype(dtype)})
    depth = read_depth(tmp_path / "d.exr")
    assert np.array_equal(depth.values, KNOWN)
    assert depth.source == f"EXR channel {name}"


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (("R", "G", "B", "Z"), "Z"),
        (("R", "G", "B", "depth"), "depth"),
        (("View.Combined.R", "View.Depth.Z"), "View.Depth.Z"),
        (("A", "Y"), "Y"),
    ],
)
def test_of_several_exr_channels_the_one_named_for_depth_is_taken(
    tmp_path: Path, names: tuple[str, ...], chosen: str
) -> None:
    values = {name: np.full((2, 3), 1 + k, np.float32) for k, name in enumerate(names)}
    write_exr(tmp_path / "d.exr", values)
    depth = read_depth(tmp_path / "d.exr")
    assert depth.source == f"EXR channel {chosen}"
    assert np.array_equal(depth.values, values[chosen])


@pytest.mark.parametrize("names", [("R", "G", "B"), ("depth", "Z"), ("U", "V"), ("R", "Y")])
def test_an_ambiguous_exr_lists_its_channels_unless_one_is_chosen(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    path = tmp_path / "d.exr"
    write_exr(path, {name: np.full((2, 3), 1 + k, np.float32) for k, name in enumerate(names)})
    listing = re.escape(f"({', '.join(sorted(names))}); choose one with --channel")
    with pytest.raises(FileFormatError, match=listing):
        read_depth(path)
    assert read_depth(path, channel=names[1]).values[0, 0] == 2
    with pytest.raises(UsageError, match="no channel 'Q'; --channel can be one of"):
        read_depth(path, channel="Q")


def test_an_exr_with_equal_r_g_b_gives_that_grey(tmp_path: Path) -> None:
    write_exr(
        tmp_path / "d.exr", {"R": METRES, "G": METRES, "B": METRES, "A": np.ones_like(METRES)}
    )
    assert np.array_equal(read_depth(tmp_path / "d.exr").values, KNOWN)


def test_an_exr_of_integers_needs_a_scale_too(tmp_path: Path) -> None:
    write_exr(tmp_path / "d.exr", {"Z": np.array([[512, 0]], dtype=np.uint32)})
    depth = read_depth(tmp_path / "d.exr")
    assert depth.values.tolist() == [[2, 0]]
    assert depth.assumed_scale


def test_a_cropped_exr_is_placed_in_its_display_window(tmp_path: Path) -> None:
    window = (np.array([0, 0], np.int32), np.array([4, 3], np.int32))
    crop = (np.array([1, 1], np.int32), np.array([3, 2], np.int32))
    write_exr(tmp_path / "d.exr", {"Z": KNOWN}, displayWindow=window, dataWindow=crop)
    expected = np.zeros((4, 5), np.float32)
    expected[1:3, 1:4] = KNOWN
    assert np.array_equal(read_depth(tmp_path / "d.exr").values, expected)


def test_the_channels_of_a_multi_part_exr_carry_the_part_name(tmp_path: Path) -> None:
    header = {"type": OpenEXR.scanlineimage}
    parts = [
        OpenEXR.Part(dict(header), {"Y": METRES * 2}, "left"),
        OpenEXR.Part(dict(header), {"Z": METRES}, "right"),
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "d.exr"))
    assert read_depth(tmp_path / "d.exr").source == "EXR channel right.Z"
    assert np.array_equal(read_depth(tmp_path / "d.exr", channel="left.Y").values, KNOWN * 2)


def test_a_tiled_exr_is_read(tmp_path: Path) -> None:
    depth = np.arange(1, 6001, dtype=np.float32).reshape(60, 100)
    write_exr(
        tmp_path / "d.exr", {"Z": depth}, type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription()
    )
    assert np.array_equal(read_depth(tmp_path / "d.exr").values, depth)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_float_tiff_holds_metres(tmp_path: Path, dtype: type) -> None:
    cv2.imwrite(str(tmp_path / "d.tiff"), METRES.astype(dtype))
    depth = read_depth(tmp_path / "d.tiff")
    assert np.array_equal(depth.values, KNOWN)
    assert depth.source == f"{np.dtype(dtype).itemsize * 8}-bit float TIFF"


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp"])
def test_8_bits_are_refused_as_a_preview_of_depth(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"d{suffix}"
    Image.fromarray(np.zeros((3, 4), np.uint8)).save(path)
    with pytest.raises(FileFormatError, match="8 bits cannot hold depth"):
        read_depth(path)


def test_a_16_bit_png_of_three_equal_channels_is_depth_and_gets_a_note(tmp_path: Path) -> None:
    path = tmp_path / "rgb.png"
    cv2.imwrite(str(path), np.repeat(np.where(CODES == 0, 65535, CODES)[:, :, None], 3, axis=2))
    depth = read_depth(path, scale=100)
    assert np.array_equal(depth.values, (CODES / 100).astype(np.float32))
    assert depth.source == (
        "16-bit PNG of three equal channels ÷ 100, 1 pixels of value 65535 taken as unknown"
    )
    # one colour made transparent (tRNS, before the pixels) changes no depth
    content = path.read_bytes()
    body = b"tRNS" + struct.pack(">3H", 256, 256, 256)
    chunk = struct.pack(">I", 6) + body + struct.pack(">I", zlib.crc32(body))
    start = content.index(b"IDAT") - 4
    path.write_bytes(content[:start] + chunk + content[start:])
    assert np.array_equal(read_depth(path, scale=100).values, depth.values)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_16_bit_png_with_one_channel_off_by_one_code_is_refused(
    tmp_path: Path, channel: int
) -> None:
    pixels = np.repeat(CODES[:, :, None], 3, axis=2)
    pixels[1, 2, channel] += 1
    cv2.imwrite(str(tmp_path / "rgb.png"), pixels)
    with pytest.raises(FileFormatError, match="several channels; depth is one 16-bit grey"):
        read_depth(tmp_path / "rgb.png")


def test_colour_and_palette_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "rgba.png"), np.zeros((3, 4, 4), np.uint16))
    with pytest.raises(FileFormatError, match="several channels"):
        read_depth(tmp_path / "rgba.png")
    Image.new("P", (4, 3)).save(tmp_path / "p.png")
    with pytest.raises(FileFormatError, match="a palette"):
        read_depth(tmp_path / "p.png")
    cv2.imwrite(str(tmp_path / "rgb.tif"), np.zeros((3, 4, 3), np.float32))
    with pytest.raises(FileFormatError, match="3 channels"):
        read_depth(tmp_path / "rgb.tif")
    (tmp_path / "c.pfm").write_bytes(b"PF\n1 1\n-1\n" + bytes(12))
    with pytest.raises(FileFormatError, match="colour PFM"):
        read_depth(tmp_path / "c.pfm")


def test_the_content_decides_not_the_suffix(tmp_path: Path) -> None:
    path = tmp_path / "d.exr"
    with path.open("wb") as file:
        np.save(file, METRES)
    assert np.array_equal(read_depth(path).values, KNOWN)


def test_missing_empty_and_unknown_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.png: no such file; check the path"):
        read_depth(tmp_path / "none.png")
    (tmp_path / "e.png").touch()
    with pytest.raises(FileFormatError, match=r"e\.png is empty"):
        read_depth(tmp_path / "e.png")
    (tmp_path / "t.png").write_text("hello")
    with pytest.raises(FileFormatError, match=r"t\.png is not a depth file; give a 16-bit PNG"):
        read_depth(tmp_path / "t.png")
    with pytest.raises(InputError, match="is a folder"):
        read_depth(tmp_path)


def test_kitti_depth_is_read_as_the_benchmark_defines_it(shared_data: Path) -> None:
    path = next((shared_data / "kitti_dc" / "groundtruth").glob("*.png"))
    depth = read_depth(path)
    codes = np.asarray(Image.open(path))
    assert depth.values.shape == (375, 1242)
    assert np.array_equal(depth.values, codes.astype(np.float32) / 256)
    assert depth.assumed_scale
    assert 0.1 < depth.valid.mean() < 0.3


def test_kinect_depth_in_millimetres_loses_its_saturated_pixels(shared_data: Path) -> None:
    for path in sorted((shared_data / "7scenes").glob("*.depth.png"))[:10]:
        codes = np.asarray(Image.open(path))
        depth = read_depth(path, scale=1000)
        assert np.array_equal(depth.valid, (codes > 0) & (codes < 65535))
        assert depth.values.max() < 10
