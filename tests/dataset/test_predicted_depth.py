"""A stored depth map of any file is read as the numbers that it holds, or refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from pnpdepth_cli.dataset.predicted_depth import (
    PredictedDepth,
    read_predicted_depth,
    resize_known,
)
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.file_bytes import sha256_of

Array = np.ndarray[Any, Any]
RNG = np.random.default_rng(0)
HEIGHT, WIDTH = 60, 80
SIZE = (HEIGHT, WIDTH)
FAR = np.zeros(SIZE, bool)
FAR[:12, 5:60] = True  # the sky, 14 % of the pixels
DISPARITY = RNG.uniform(2, 600, SIZE).astype(np.float32)
DISPARITY[FAR] = 0
CODES = np.rint(DISPARITY * 100).astype(np.uint16)
SAMPLES = Path(__file__).parents[2] / "samples"


def save(path: Path, values: Any, **text: str) -> Path:
    """Writes by the suffix; `text` is kept in a PNG, and a mapping is arrays or channels."""
    info = PngInfo()
    for key, word in text.items():
        info.add_text(key.replace("__", ":"), word)
    height, width = np.shape(values)[:2] if not isinstance(values, dict) else (0, 0)
    match path.suffix:
        case ".npy":
            np.save(path, values)
        case ".npz":
            np.savez_compressed(path, **values)
        case ".exr":
            OpenEXR.File({}, dict(values)).write(str(path))
        case ".png":
            Image.fromarray(values).save(path, pnginfo=info)
        case ".bin":
            path.write_bytes(f"{width}&{height}&1&".encode() + values.astype("<f4").tobytes())
        case _:
            assert cv2.imwrite(str(path), values)
    return path


def read(path: Path, size: tuple[int, int] | None = None) -> PredictedDepth:
    return read_predicted_depth(path, size)


def unknown_where(values: Array, unknown: Array) -> Array:
    return np.where(unknown, np.float32(np.nan), values.astype(np.float32))


def lines_with(depth: PredictedDepth, word: str) -> list[str]:
    return [note for note in depth.notes if word in note]


# The formats


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("a.npy", DISPARITY),
        ("a.npy", DISPARITY.astype(np.float16)),
        ("a.npy", DISPARITY.astype(">f8")),
        ("a.npy", CODES.astype(np.int64)),
        ("a.npz", {"anything": DISPARITY}),
        ("a.exr", {"Y": DISPARITY}),  # as OpenCV and MoGe name the only channel
        ("a.exr", {"R": DISPARITY, "G": DISPARITY, "B": DISPARITY}),
        ("a.pfm", DISPARITY),
        ("a.tiff", DISPARITY),
        ("a.tiff", CODES),
        ("a.png", CODES),
        ("0001.png.geometric.bin", DISPARITY),
    ],
)
def test_a_map_is_read_as_the_numbers_in_its_file(name: str, values: Any, tmp_path: Path) -> None:
    path = save(tmp_path / name, values)
    stored = next(iter(values.values())) if isinstance(values, dict) else values
    depth = read(path)
    np.testing.assert_array_equal(depth.values, unknown_where(stored, FAR))
    assert depth.values.dtype == np.float32
    assert depth.source.path == str(path)
    assert depth.source.sha256 == sha256_of(path)
    assert lines_with(depth, f"{FAR.sum():,} of {FAR.size:,}")


@pytest.mark.parametrize(
    "add",
    [
        lambda m: m[None],
        lambda m: m[..., None],
        lambda m: m[None, None],
        lambda m: m[None, ..., None],
    ],
)
def test_axes_of_length_one_are_left_out(add: Callable[[Array], Array], tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", add(DISPARITY))
    np.testing.assert_array_equal(read(path).values, unknown_where(DISPARITY, FAR))


def test_numbers_below_0_of_a_prediction_are_kept(tmp_path: Path) -> None:
    values = np.log(RNG.uniform(0.1, 5, SIZE)).astype(np.float32)
    depth = read(save(tmp_path / "a.npy", values))
    np.testing.assert_array_equal(depth.values, values)
    assert depth.notes == ()


def test_a_scale_that_a_png_states_is_applied(tmp_path: Path) -> None:
    depth = read(save(tmp_path / "a.png", CODES, pnpdepth__scale="100"))
    np.testing.assert_allclose(depth.values, unknown_where(CODES / 100, FAR), rtol=1e-6)
    assert depth.source.scale == 100


def test_codes_of_log_depth_as_moge_writes_them_become_that_depth(tmp_path: Path) -> None:
    near, far = 0.5, 80.0
    metres = np.exp(RNG.uniform(np.log(near), np.log(far), SIZE))
    codes = 1 + np.rint(np.log(metres / near) / np.log(far / near) * 65533)
    codes[0], codes[1] = 0, 65535  # unknown, and the sky
    path = save(tmp_path / "a.png", codes.astype(np.uint16), near=str(near), far=str(far))
    depth = read(path)
    assert np.isnan(depth.values[:2]).all()
    np.testing.assert_allclose(depth.values[2:], metres[2:], rtol=1e-4)


# Archives


OTHERS = {
    "conf": RNG.uniform(0, 1, SIZE).astype(np.float32),
    "mask": RNG.uniform(0, 1, SIZE) > 0.5,
    "intrinsics": np.eye(3, dtype=np.float32)[None],
    "extrinsics": np.zeros((1, 3, 4), np.float32),
    "points": RNG.uniform(0, 1, (*SIZE, 3)).astype(np.float32),
    "K": np.eye(3),
    "focallength_px": np.float32(700),
}


@pytest.mark.parametrize(
    "name",
    [
        "depth",
        "disparity",
        "pred",
        "metric_depth",
        "arr_0",
        "z",
        "normalized_depth",
        "masked_depth",
        "affine_invariant_depth",
        "Depth",
    ],
)
@pytest.mark.parametrize("stack", [False, True])
def test_the_only_map_of_an_archive_is_found(name: str, stack: bool, tmp_path: Path) -> None:
    values = DISPARITY[None] if stack else DISPARITY
    depth = read(save(tmp_path / "a.npz", {**OTHERS, name: values}))
    np.testing.assert_array_equal(depth.values, unknown_where(DISPARITY, FAR))
    assert str(depth.source.read_as).endswith(name)


def test_an_array_named_as_depth_goes_before_unnamed_maps(tmp_path: Path) -> None:
    depth = read(save(tmp_path / "a.npz", {"arr_0": CODES, "depth": DISPARITY, **OTHERS}))
    np.testing.assert_array_equal(depth.values, unknown_where(DISPARITY, FAR))


def test_of_several_maps_one_is_to_be_named(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", {"depth": DISPARITY, "disparity": 2 * DISPARITY, **OTHERS})
    with pytest.raises(InputError, match=r"depth.*disparity.*a\.npz:depth"):
        read(path)
    depth = read(Path(f"{path}:disparity"))
    np.testing.assert_array_equal(depth.values, unknown_where(2 * DISPARITY, FAR))
    assert depth.source.path == f"{path}:disparity"
    assert depth.source.sha256 == sha256_of(path)


def test_an_array_that_is_named_may_have_any_name(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", OTHERS)
    np.testing.assert_array_equal(read(Path(f"{path}:conf")).values, OTHERS["conf"])


def test_a_channel_of_an_exr_is_named_as_an_array_is(tmp_path: Path) -> None:
    channels = {"X": 3 * DISPARITY, "Y": 2 * DISPARITY, "near": DISPARITY}
    path = save(tmp_path / "a.exr", channels)
    with pytest.raises(InputError, match="X, Y, near"):
        read(path)
    depth = read(Path(f"{path}:near"))
    np.testing.assert_array_equal(depth.values, unknown_where(DISPARITY, FAR))


@pytest.mark.parametrize(
    ("arrays", "part"),
    [
        ({"depth": DISPARITY}, ":disp"),  # no such array
        ({"depth": np.stack([DISPARITY] * 5)}, ""),  # of five images
        ({"a": DISPARITY, "b": DISPARITY}, ""),
        ({"intrinsics": np.eye(3), "conf": DISPARITY}, ""),
        ({"conf": DISPARITY}, ""),
        ({"depth": DISPARITY, "gt_depth": DISPARITY}, ""),
        ({"depth": DISPARITY.astype(np.complex64)}, ""),
        ({"depth": DISPARITY > 0}, ""),
    ],
)
def test_an_archive_without_one_map_is_refused(
    arrays: dict[str, Array], part: str, tmp_path: Path
) -> None:
    path = save(tmp_path / "a.npz", arrays)
    with pytest.raises(InputError, match=r"a\.npz"):
        read(Path(f"{path}{part}"))


# Pictures


GREY = np.rint(255 * DISPARITY / DISPARITY.max()).astype(np.uint8)
SMOOTH = cv2.GaussianBlur(GREY, (0, 0), 6)


@pytest.mark.parametrize(
    ("name", "picture"),
    [
        ("a.png", GREY),
        ("a.png", np.repeat(GREY[..., None], 3, axis=2)),
        ("a.tiff", GREY),
        ("a.npy", GREY),
        ("a.npy", np.repeat(GREY[..., None], 3, axis=2)),
        ("a.npy", GREY.astype(np.float32)),
        ("a.npy", GREY.astype(np.int32)),
        ("a.bmp.png", np.repeat(GREY[..., None], 4, axis=2)),
    ],
)
def test_a_grey_picture_is_read_with_a_warning_of_its_steps_and_clips(
    name: str, picture: Array, tmp_path: Path
) -> None:
    depth = read(save(tmp_path / name, picture))
    clipped = (GREY == 0) | (GREY == 255)
    np.testing.assert_array_equal(depth.values, unknown_where(GREY, clipped))
    (warning,) = lines_with(depth, "256 steps")
    assert warning.startswith("warning: ")
    assert f"{(GREY == 0).sum():,} of" in warning
    assert f"{(GREY == 255).sum():,} are 255" in warning


@pytest.mark.parametrize("channels", [1, 3])
def test_a_grey_jpeg_is_read_up_to_its_compression(channels: int, tmp_path: Path) -> None:
    picture = np.repeat(SMOOTH[..., None], channels, axis=2)
    depth = read(save(tmp_path / "a.jpg", picture))
    known = np.isfinite(depth.values)
    assert known.mean() > 0.8
    assert np.abs(depth.values - SMOOTH)[known].max() < 16
    assert lines_with(depth, "256 steps")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp", "a.tiff", "a.npy"])
@pytest.mark.parametrize("colours", [cv2.COLORMAP_JET, cv2.COLORMAP_INFERNO, cv2.COLORMAP_VIRIDIS])
def test_a_colour_mapped_picture_is_refused_with_what_to_save(
    name: str, colours: int, tmp_path: Path
) -> None:
    path = save(tmp_path / name, cv2.applyColorMap(SMOOTH, colours))
    with pytest.raises(InputError, match="NPY"):
        read(path)


def test_grey_beside_the_photo_is_a_picture_in_colour(tmp_path: Path) -> None:
    photo = cv2.applyColorMap(SMOOTH, cv2.COLORMAP_JET)
    both = np.hstack([photo, np.repeat(SMOOTH[..., None], 3, axis=2)])
    with pytest.raises(InputError, match="colour"):
        read(save(tmp_path / "a.png", both))


# The sky, holes and clips


KNOWN = np.where(FAR, 1, DISPARITY)
TRAPS = {
    "the nearest of a clipped 1/disparity": np.where(FAR, 0.001, np.clip(1 / KNOWN, 0.001, 10)),
    "the farthest of a clipped 1/disparity": np.where(FAR, 10, np.clip(1 / KNOWN, 0.001, 10)),
    "1/0": np.where(FAR, np.inf, 1 / KNOWN),
    "0 + ε": np.where(FAR, 1e6, 1 / KNOWN),
    "NaN": np.where(FAR, np.nan, KNOWN),
    "a far plane": np.where(FAR, 80, 1 + KNOWN / 10),
    "a far plane beside two surfaces": np.where(FAR, 1e4, KNOWN / 30),
    "-1": np.where(FAR, -1, KNOWN),
    "-9999 in logarithms": np.where(FAR, -9999, np.log(KNOWN / 100)),
    "0 in logarithms": np.where(FAR, 0, np.log(KNOWN / 100)),
    "the smallest of logarithms": np.where(FAR, np.log(0.01), np.log(KNOWN / 100)),
    "0 of negated disparity": np.where(FAR, 0, -KNOWN),
    "float16's largest": np.where(FAR, 65504, KNOWN),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_one_value_for_the_sky_is_unknown_and_counted(trap: str, tmp_path: Path) -> None:
    values = TRAPS[trap].astype(np.float32)
    depth = read(save(tmp_path / "a.npy", values))
    np.testing.assert_array_equal(depth.values, unknown_where(values, FAR))
    assert lines_with(depth, f"{FAR.sum():,} of {FAR.size:,} pixels")


def test_unknown_and_the_sky_are_found_behind_each_other(tmp_path: Path) -> None:
    values = np.where(FAR, 0.001, 1 / KNOWN).astype(np.float32)
    values[40:42] = -1
    values[50:52] = 9  # a far plane
    depth = read(save(tmp_path / "a.npy", values))
    unknown = FAR.copy()
    unknown[[40, 41, 50, 51]] = True
    np.testing.assert_array_equal(depth.values, unknown_where(values, unknown))
    assert len(depth.notes) == 3


def test_few_zeros_are_unknown_also_beside_minus_1(tmp_path: Path) -> None:
    values = np.where(FAR, -1, KNOWN).astype(np.float32)
    values[40, :3] = 0
    unknown = FAR.copy()
    unknown[40, :3] = True
    depth = read(save(tmp_path / "a.npy", values))
    np.testing.assert_array_equal(depth.values, unknown_where(values, unknown))


def test_few_zeros_of_logarithms_are_a_number_as_others(tmp_path: Path) -> None:
    values = np.log(RNG.uniform(0.1, 5, SIZE)).astype(np.float32)
    values[40, :3] = 0
    depth = read(save(tmp_path / "a.npy", values))
    np.testing.assert_array_equal(depth.values, values)


@pytest.mark.parametrize(
    "values",
    [
        np.linspace(1, 9, HEIGHT)[:, None] * np.ones(WIDTH),  # a floor: equal rows
        np.round(RNG.uniform(1, 9, SIZE) * 25) / 25,  # steps of 4 cm
        np.round(RNG.exponential(1, SIZE) + 0.5, 1),  # most are near
        np.minimum(RNG.uniform(1, 9, SIZE), 8.98),  # a clip of 12 pixels
        np.where(RNG.uniform(size=SIZE) < 0.3, RNG.uniform(90, 99, SIZE), RNG.uniform(1, 9, SIZE)),
        RNG.normal(0, 1, SIZE),
    ],
)
def test_a_surface_at_the_end_of_the_range_is_known(values: Array, tmp_path: Path) -> None:
    values = values.astype(np.float32)
    np.testing.assert_array_equal(read(save(tmp_path / "a.npy", values)).values, values)


def test_the_ends_of_integers_are_unknown(tmp_path: Path) -> None:
    codes = CODES.astype(np.int16) // 2
    codes[FAR] = 0
    codes[40, 0] = -32768
    codes[41, 0] = 32767
    depth = read(save(tmp_path / "a.npy", codes))
    unknown = FAR.copy()
    unknown[40:42, 0] = True
    np.testing.assert_array_equal(depth.values, unknown_where(codes, unknown))


# Sizes


def resized(values: Array, size: tuple[int, int]) -> Array:
    return resize_known(values.astype(np.float32), size)


@given(
    height=st.integers(2, 12),
    width=st.integers(2, 12),
    to=st.tuples(st.integers(2, 30), st.integers(2, 30)),
    unknown=st.floats(0, 0.9),
    seed=st.integers(0, 1000),
)
def test_a_resized_map_is_between_its_known_neighbours_and_unknown_beside_unknown(
    height: int, width: int, to: tuple[int, int], unknown: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    values = random.uniform(-5, 5, (height, width))
    values[random.uniform(size=values.shape) < unknown] = np.nan
    result = resized(values, to)
    assert result.shape == to
    # Pixel centres lie at whole numbers; beyond the outermost ones the border is repeated.
    y = ((np.arange(to[0]) + 0.5) * height / to[0] - 0.5).clip(0, height - 1)
    x = ((np.arange(to[1]) + 0.5) * width / to[1] - 0.5).clip(0, width - 1)
    for row, at_y in enumerate(y):
        for column, at_x in enumerate(x):
            rows = [int(at_y), min(int(at_y) + 1, height - 1)]
            columns = [int(at_x), min(int(at_x) + 1, width - 1)]
            weight = np.outer(
                [1 - at_y % 1, at_y % 1],
                [1 - at_x % 1, at_x % 1],
            )
            around = values[np.ix_(rows, columns)]
            known = np.isfinite(around)
            share = weight[known].sum()
            if abs(share - 0.5) < 1e-4:  # rounding decides
                continue
            assert np.isfinite(result[row, column]) == (share > 0.5)
            if share > 0.5:
                expected = (weight * np.where(known, around, 0)).sum() / share
                assert result[row, column] == pytest.approx(expected, abs=2e-3)


def test_a_hole_keeps_its_place_and_takes_no_part(tmp_path: Path) -> None:
    values = np.linspace(1, 9, WIDTH // 2) * np.ones((HEIGHT // 2, 1))
    values[10:20, 10:20] = np.nan
    depth = read(save(tmp_path / "a.npy", values.astype(np.float32)), SIZE)
    assert depth.values.shape == SIZE
    assert np.isnan(depth.values[20:40, 20:40]).all()
    assert np.isfinite(depth.values).sum() == HEIGHT * WIDTH - 400
    ramp = resized(np.linspace(1, 9, WIDTH // 2) * np.ones((HEIGHT // 2, 1)), SIZE)
    step = 8 / (WIDTH // 2 - 1)
    assert np.nanmax(np.abs(depth.values - ramp)) <= step  # beside the hole half a pixel is lost
    assert lines_with(depth, f"{WIDTH // 2}×{HEIGHT // 2} and the image {WIDTH}×{HEIGHT}")


@pytest.mark.parametrize(
    ("own", "size"),
    [
        ((154, 518), (375, 1242)),  # multiples of 14
        ((518, 686), (480, 640)),
        ((24, 80), (375, 1242)),
        ((3, 4), (478, 641)),
        ((1080, 1920), (270, 480)),
    ],
)
def test_a_map_of_the_image_s_aspect_ratio_is_resized(
    own: tuple[int, int], size: tuple[int, int], tmp_path: Path
) -> None:
    values = np.arange(own[0] * own[1], dtype=np.float32).reshape(own) + 1
    depth = read(save(tmp_path / "a.npy", values), size)
    assert depth.values.shape == size
    assert np.isfinite(depth.values).all()


@pytest.mark.parametrize(
    ("own", "size", "words"),
    [
        ((60, 80), (60, 60), "80×60.*60×60"),
        ((384, 384), (480, 640), "384×384.*640×480"),
        ((60, 80), (80, 60), "80×60.*60×80.*90°"),
        ((120, 160), (80, 60), "160×120.*60×80.*90°"),
    ],
)
def test_a_map_of_another_aspect_ratio_is_refused_with_both_sizes(
    own: tuple[int, int], size: tuple[int, int], words: str, tmp_path: Path
) -> None:
    path = save(tmp_path / "a.npy", RNG.uniform(1, 9, own).astype(np.float32))
    with pytest.raises(InputError, match=words):
        read(path, size)


# What is no map


def colmap_normals(path: Path) -> None:
    path.write_bytes(b"8&6&3&" + bytes(4 * 8 * 6 * 3))


def cut_colmap_map(path: Path) -> None:
    path.write_bytes(b"8&6&1&" + bytes(4 * 8 * 6 - 1))


def huge_colmap_map(path: Path) -> None:
    path.write_bytes(b"999999999&999999999&1&")


REFUSED: dict[str, tuple[str, Any]] = {
    "one number": ("a.npy", np.full(SIZE, 2.5, np.float32)),
    "a mask": ("a.npy", FAR.astype(np.float32)),
    "a mask as picture": ("a.png", FAR.astype(np.uint8) * 255),
    "only NaN": ("a.npy", np.full(SIZE, np.nan, np.float32)),
    "only 0": ("a.png", np.zeros(SIZE, np.uint16)),
    "only infinite": ("a.exr", {"Y": np.full(SIZE, np.inf, np.float32)}),
    "truth values": ("a.npy", FAR),
    "complex": ("a.npy", DISPARITY.astype(np.complex64)),
    "text in an array": ("a.npy", np.array(["a", "b"])),
    "pickled": ("a.npy", np.array({"depth": DISPARITY}, dtype=object)),
    "points in space": ("a.npy", RNG.uniform(1, 9, (*SIZE, 3)).astype(np.float32)),
    "two channels": ("a.npy", RNG.uniform(1, 9, (*SIZE, 2)).astype(np.float32)),
    "a stack": ("a.npy", RNG.uniform(1, 9, (7, *SIZE)).astype(np.float32)),
    "five axes": ("a.npy", RNG.uniform(1, 9, (2, 3, 4, 5, 6))),
    "flat": ("a.npy", DISPARITY.ravel()),
    "one number alone": ("a.npy", np.float32(3)),
    "no number": ("a.npy", np.zeros((0, 80), np.float32)),
    "a list of points": ("a.npy", RNG.uniform(1, 9, (500, 3)).astype(np.float32)),
    "exchanged bytes": (
        "a.png",
        (np.arange(HEIGHT * WIDTH).reshape(SIZE) // 4 + 500).astype(np.uint16).byteswap(),
    ),
    "normals of COLMAP": ("a.geometric.bin", colmap_normals),
    "a cut map of COLMAP": ("a.geometric.bin", cut_colmap_map),
    "a huge map of COLMAP": ("a.geometric.bin", huge_colmap_map),
    "a video": ("a.mp4", lambda path: path.write_bytes(b"\0\0\0\x20ftypisom" + bytes(100))),
    "another video": ("a.webm", lambda path: path.write_bytes(b"\x1aE\xdf\xa3" + bytes(100))),
    "a text": ("a.csv", lambda path: path.write_text("x,y,depth\n1,2,3\n")),
    "empty": ("a.npy", lambda path: path.touch()),
    "a folder": ("a.npy", lambda path: path.mkdir()),
    "nothing": ("a.npy", lambda path: None),
    "a scan": ("a.bin", lambda path: path.write_bytes(RNG.bytes(1600))),
    "a ZIP of no arrays": ("a.pt", lambda path: path.write_bytes(b"PK\5\6" + bytes(18))),
    "a cut archive": ("a.npz", lambda path: path.write_bytes(b"PK\3\4" + bytes(18))),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_depth_map_is_refused_in_one_line(what: str, tmp_path: Path) -> None:
    name, content = REFUSED[what]
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        save(path, content) if name != "a.npy" else np.save(path, content, allow_pickle=True)
    with pytest.raises(InputError) as caught:
        read(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert ("video" in str(caught.value)) == ("video" in what)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("name", ["a.npy", "a.png", "a.tiff"])
def test_a_file_of_one_map_has_no_part_that_a_name_could_choose(name: str, tmp_path: Path) -> None:
    path = save(tmp_path / name, CODES)
    with pytest.raises(InputError, match="depth"):
        read(Path(f"{path}:depth"))


def test_a_file_may_have_a_colon_in_its_name(tmp_path: Path) -> None:
    path = save(tmp_path / "12:30.npy", DISPARITY)
    assert read(path).source.path == str(path)


def test_few_numbers_are_said_as_labels_have_them(tmp_path: Path) -> None:
    labels = RNG.integers(1, 9, SIZE).astype(np.float32)
    assert lines_with(read(save(tmp_path / "a.npy", labels)), "8 different numbers")


# Against the image


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (lambda m: m, ""),
        (lambda m: m[:, ::-1], "mirrored"),
        (lambda m: m[::-1], "upside down"),
        (lambda m: m[::-1, ::-1], "180°"),
    ],
)
@pytest.mark.parametrize("number", [lambda m: m, lambda m: 1 / m, lambda m: -np.log(m)])
def test_a_map_that_is_mirrored_or_turned_against_its_image_is_noticed(
    turn: Callable[[Array], Array],
    words: str,
    number: Callable[[Array], Array],
    tmp_path: Path,
) -> None:
    rgb = np.asarray(Image.open(SAMPLES / "indoor" / "rgb.png"), np.float32) / 255
    metres = np.asarray(Image.open(SAMPLES / "indoor" / "gt.png"), np.float32) / 1000
    with np.errstate(divide="ignore"):
        values = np.where(metres > 0, number(metres), np.nan).astype(np.float32)
    path = save(tmp_path / "a.npy", turn(values))
    depth = read_predicted_depth(path, (rgb.shape[0], rgb.shape[1]), rgb)
    warnings = lines_with(depth, "edges")
    assert bool(warnings) == bool(words)
    assert all(words in warning for warning in warnings)


# Maps of real networks


def stored_predictions(shared_data: Path, pattern: str) -> list[Path]:
    files = sorted((shared_data / "strong").glob(pattern))
    if not files:
        pytest.skip("needs stored predictions")
    return files


def test_every_stored_prediction_is_read_as_its_readme_says(shared_data: Path) -> None:
    arrays = stored_predictions(shared_data, "*/*_pred*.npy")
    for file in arrays + stored_predictions(shared_data, "*/*_pred*.png"):
        depth = read(file)
        known = np.isfinite(depth.values)
        if file.suffix == ".png":  # 8 bits, 0 and 255 clipped
            stored = np.asarray(Image.open(file))
            assert ((stored > 0) & (stored < 255) == known).all(), file
        else:  # 0 is the sky, or unknown
            stored = np.load(file)
            assert not known[stored == 0].any(), file
            lost = ~known & (stored != 0)
            assert not lost.any() or (stored[lost] == stored.max()).all(), file  # a clip
        assert (depth.values[known] == stored.astype(np.float32)[known]).all(), file


def test_a_clipped_inverse_of_real_disparity_has_no_near_sky(
    shared_data: Path, tmp_path: Path
) -> None:
    for file in stored_predictions(shared_data, "weison_kitti_dav2/*_pred.npy"):
        disparity = np.load(file).astype(np.float32)
        with np.errstate(divide="ignore"):
            values = np.where(disparity > 0, np.clip(1 / disparity, 0.001, 10), 0.001)
        path = save(tmp_path / "a.npy", values.astype(np.float32))
        assert (np.isfinite(read(path).values) == (disparity > 0)).all()


def test_a_colour_mapped_picture_as_users_have_it_is_refused(shared_data: Path) -> None:
    for file in stored_predictions(shared_data, "*/*_as_stored.jpg"):
        with pytest.raises(InputError, match="colour"):
            read(file)
