from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from pnpdepth_cli.errors import OutputError, SizeError, UsageError
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES

FLOAT_SUFFIXES = [suffix for suffix in DEPTH_SUFFIXES if suffix != ".png"]
images = array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12)


@pytest.mark.parametrize("suffix", FLOAT_SUFFIXES)
@settings(max_examples=30, deadline=None)
@given(depth=arrays(np.float32, images, elements=st.floats(width=32)))
def test_float_formats_give_back_every_known_depth_exactly(
    suffix: str, depth: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / f"round{suffix}"
    write_depth(path, depth)
    with np.errstate(invalid="ignore"):
        known = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    again = read_depth(path)
    assert again.values.dtype == np.float32
    assert np.array_equal(again.values, known)
    assert not again.assumed_scale


@settings(max_examples=60, deadline=None)
@given(
    codes=arrays(np.uint16, images, elements=st.integers(0, 65534)),
    scale=st.sampled_from([256.0, 1000.0, 5000.0, 1.0, 0.1, 333.3333333333333]),
)
def test_png_gives_back_every_depth_to_half_a_code(
    codes: np.ndarray, scale: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "round.png"
    depth = (codes / scale).astype(np.float32)
    write_depth(path, depth, scale=scale)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), codes)
    again = read_depth(path)
    assert np.array_equal(again.values, depth)
    assert again.scale == scale
    assert not again.assumed_scale
    assert again.source.endswith("(from the file)")


@settings(max_examples=60, deadline=None)
@given(depth=arrays(np.float32, images, elements=st.floats(0, 255, width=32)))
def test_png_is_right_to_half_a_code_or_refuses(
    depth: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.png"
    if ((depth > 0) & (np.rint(depth.astype(float) * 256) == 0)).any():
        with pytest.raises(OutputError, match="would become 0"):
            write_depth(path, depth)
        return
    write_depth(path, depth)
    again = read_depth(path).values
    assert np.array_equal(again > 0, depth > 0)
    assert np.abs(again.astype(float) - depth).max() <= 0.5 / 256


@pytest.mark.parametrize("suffix", DEPTH_SUFFIXES)
def test_the_same_depth_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    depth = np.random.default_rng(0).uniform(0.1, 80, (20, 30)).astype(np.float32)
    first, second = tmp_path / f"first{suffix}", tmp_path / f"another{suffix}"
    write_depth(first, depth)
    write_depth(second, depth.copy())
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("suffix", DEPTH_SUFFIXES)
def test_the_depth_given_is_not_changed(tmp_path: Path, suffix: str) -> None:
    depth = np.array([[np.nan, -1, 2]], dtype=np.float32)
    write_depth(tmp_path / f"d{suffix}", depth)
    assert np.array_equal(depth, np.array([[np.nan, -1, 2]], np.float32), equal_nan=True)
    assert read_depth(tmp_path / f"d{suffix}").values.tolist() == [[0, 0, 2]]
    other_memory_layout = np.arange(1, 13, dtype=np.float32).reshape(3, 4)[::-1].T
    write_depth(tmp_path / f"D{suffix.upper()}", other_memory_layout)
    assert np.array_equal(read_depth(tmp_path / f"D{suffix.upper()}").values, other_memory_layout)


def test_exr_holds_one_float32_channel_called_z(tmp_path: Path) -> None:
    write_depth(tmp_path / "d.exr", np.ones((2, 3), np.float32))
    with OpenEXR.File(str(tmp_path / "d.exr"), separate_channels=True) as file:
        assert list(file.channels()) == ["Z"]
        assert file.channels()["Z"].pixels.dtype == np.float32
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION


def test_other_programs_read_what_is_written(tmp_path: Path) -> None:
    depth = np.arange(1, 7, dtype=np.float32).reshape(2, 3)
    for suffix in (".tif", ".pfm"):
        write_depth(tmp_path / f"d{suffix}", depth)
        other = cv2.imread(str(tmp_path / f"d{suffix}"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(other, depth)
    write_depth(tmp_path / "d.npz", depth)
    assert np.array_equal(np.load(tmp_path / "d.npz")["depth"], depth)


@pytest.mark.parametrize(
    ("largest", "scale"), [(65.535, 1000.0), (66, 1000), (256, 256), (1e30, 256)]
)
def test_a_depth_beyond_16_bits_is_refused_and_never_wraps(
    tmp_path: Path, largest: float, scale: float
) -> None:
    with pytest.raises(OutputError, match=r"the largest depth, .* m, does not fit") as caught:
        write_depth(tmp_path / "d.png", np.array([[1, largest]], np.float32), scale=scale)
    assert f"{np.float32(largest):.6g} m" in str(caught.value)
    assert "write .exr" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_depth_that_would_become_unknown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"2 depths down to 0\.0001 m would become 0 \(unknown\)"):
        write_depth(tmp_path / "d.png", np.array([[1, 0.001, 0.0001]], np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_senseless_scale_is_wrong_usage(tmp_path: Path, scale: float) -> None:
    with pytest.raises(UsageError, match="--depth-scale"):
        write_depth(tmp_path / "d.png", np.ones((2, 2), np.float32), scale=scale)


@pytest.mark.parametrize("name", ["d.jpg", "d", "d.bmp", "d.json"])
def test_another_suffix_is_refused_with_the_possible_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match=r"\.png, \.exr, \.npy, \.npz, \.pfm, \.tif, \.tiff"):
        write_depth(tmp_path / name, np.ones((2, 2), np.float32))


@pytest.mark.parametrize("shape", [(3,), (1, 2, 3), (0, 4)])
def test_what_is_no_image_is_not_written(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(SizeError, match=r"is no image; give \(H, W\)"):
        write_depth(tmp_path / "d.npy", np.ones(shape, np.float32))


def test_a_real_frame_survives_every_format(shared_data: Path, tmp_path: Path) -> None:
    depth = read_depth(next((shared_data / "kitti_dc" / "velodyne_raw").glob("*.png"))).values
    for suffix in DEPTH_SUFFIXES:
        write_depth(tmp_path / f"d{suffix}", depth)
        assert np.array_equal(read_depth(tmp_path / f"d{suffix}").values, depth)
