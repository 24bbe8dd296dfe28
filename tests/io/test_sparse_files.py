from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from pnpdepth_cli.errors import FileFormatError, InputError, NoPointsError, SizeError, UsageError
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.sparse_files import read_sparse

SIZE = (10, 20)
ROWS = [[10.5, 3.25, 4.0], [0.0, 0.0, 0.5], [7.0, 2.0, 80.0]]


def test_an_image_gives_its_known_pixels_row_by_row(tmp_path: Path) -> None:
    depth = np.array([[0, 2, 0, 0], [3, 0, 0, 4]], dtype=np.float32)
    write_depth(tmp_path / "s.png", depth)
    sparse = read_sparse(tmp_path / "s.png")
    assert sparse.points.xy.tolist() == [[1, 0], [0, 1], [3, 1]]
    assert sparse.points.depth.tolist() == [2, 3, 4]
    assert (sparse.points.xy.dtype, sparse.points.depth.dtype) == (np.float32, np.float32)
    assert sparse.points.size == (2, 4)
    assert sparse.source == "16-bit PNG ÷ 256 (from the file)"
    assert not sparse.assumed_scale


@settings(max_examples=40, deadline=None)
@given(
    depth=arrays(
        np.float32,
        array_shapes(min_dims=2, max_dims=2, min_side=4, max_side=9),
        elements=st.one_of(st.just(0.0), st.floats(0.125, 100, width=32)),
    ),
    suffix=st.sampled_from([".npy", ".npz", ".exr", ".pfm", ".tif"]),
)
def test_the_points_of_an_image_put_back_give_the_image(
    depth: np.ndarray, suffix: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / f"points{suffix}"
    write_depth(path, depth)
    if not depth.any():
        with pytest.raises(NoPointsError):
            read_sparse(path)
        return
    sparse = read_sparse(path)
    again = np.zeros(sparse.points.size, np.float32)
    columns, rows = sparse.points.xy.astype(int).T
    again[rows, columns] = sparse.points.depth
    assert np.array_equal(again, depth)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".csv", ".txt"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_list_keeps_order_and_fractions_of_pixels(
    tmp_path: Path, suffix: str, dtype: type
) -> None:
    path = tmp_path / f"s{suffix}"
    rows = np.array(ROWS, dtype=dtype)
    if suffix == ".npy":
        np.save(path, rows)
    elif suffix == ".npz":
        np.savez(path, rows)
    else:
        np.savetxt(path, rows, delimiter="," if suffix == ".csv" else " ")
    sparse = read_sparse(path, size=SIZE)
    assert sparse.points.xy.tolist() == [row[:2] for row in ROWS]
    assert sparse.points.depth.tolist() == [row[2] for row in ROWS]
    assert sparse.points.size == SIZE
    assert not sparse.assumed_scale
    assert sparse.source.startswith("point list")


def test_a_list_needs_the_size_of_its_frame(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("1 2 3\n")
    with pytest.raises(SizeError, match="which needs an image to say the frame's size"):
        read_sparse(tmp_path / "s.csv")


@pytest.mark.parametrize(
    "text",
    [
        "10.5 3.25 4\n0 0 .5\n7 2 80",
        "x,y,depth\n10.5,3.25,4\n0,0,0.5\n7,2,80\n",
        "# from a laser\n10.5;3.25;4\r\n\r\n0; 0; 0.5 # near\r\n7\t2\t8e1\r\n",
        '\ufeff"x", "y", "depth"\n10.5, 3.25, 4\n 0, 0, 0.5\n7, 2, 80\n',
    ],
)
def test_common_ways_of_writing_rows_are_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "s.csv").write_text(text, encoding="utf-8", newline="")
    sparse = read_sparse(tmp_path / "s.csv", size=SIZE)
    assert np.column_stack([sparse.points.xy, sparse.points.depth]).tolist() == ROWS


@settings(max_examples=50, deadline=None)
@given(
    rows=st.lists(
        st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 2, st.floats(0.125, 1e4, width=32)),
        min_size=1,
        max_size=20,
    )
)
def test_rows_written_as_text_come_back_exactly(
    rows: list[tuple[float, float, float]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "rows.txt"
    path.write_text("\n".join(" ".join(map(repr, row)) for row in rows))
    sparse = read_sparse(path, size=SIZE)
    assert np.array_equal(
        np.column_stack([sparse.points.xy, sparse.points.depth]), np.array(rows, np.float32)
    )


def test_rows_without_known_depth_are_dropped(tmp_path: Path) -> None:
    (tmp_path / "s.txt").write_text("1 1 0\n2 2 nan\n3 3 inf\n4 4 -1\n5 5 5\n")
    sparse = read_sparse(tmp_path / "s.txt", size=SIZE)
    assert (sparse.points.xy.tolist(), sparse.points.depth.tolist()) == ([[5, 5]], [5])


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("1 2 3\n4 5\n", r"line 2: '4 5' is not x, y and depth"),
        ("1 2 3 4\n", r"line 1: '1 2 3 4' is not"),
        ("1 2 3\nx y depth\n", r"line 2: 'x y depth' is not"),
        ("u v w\n1 2 3\n", r"line 1"),
        ("1,5;2,5;3,5\n", r"line 1"),
        ("1 inf 3\n", r"line 1: the coordinates are not finite"),
    ],
)
def test_a_bad_row_is_named_by_its_line(tmp_path: Path, text: str, fact: str) -> None:
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(FileFormatError, match=fact):
        read_sparse(tmp_path / "s.csv")


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_bytes(b"\xff\xfe1\x00")
    with pytest.raises(FileFormatError, match="is not a text file"):
        read_sparse(tmp_path / "s.csv")


def test_a_depth_image_with_the_suffix_of_a_list_is_read_as_what_it_is(tmp_path: Path) -> None:
    write_depth(tmp_path / "s.npy", np.ones((4, 5), np.float32))
    (tmp_path / "s.npy").rename(tmp_path / "s.txt")
    assert read_sparse(tmp_path / "s.txt").points.size == (4, 5)


def test_non_finite_coordinates_in_an_array_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "s.npy", np.array([[1, 1, 0], [np.nan, 2, 3.0]]))
    with pytest.raises(FileFormatError, match="point 2 has no finite coordinates"):
        read_sparse(tmp_path / "s.npy")


def test_an_integer_list_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "s.npy", np.array([[1, 1, 2]]))
    with pytest.raises(FileFormatError, match="save x, y, depth as float metres"):
        read_sparse(tmp_path / "s.npy")


def test_a_three_pixel_wide_image_in_another_format_is_an_image(tmp_path: Path) -> None:
    write_depth(tmp_path / "s.pfm", np.ones((4, 3), np.float32))
    assert read_sparse(tmp_path / "s.pfm").points.size == (4, 3)


@pytest.mark.parametrize("name", ["s.npy", "s.txt", "s.png", "l.npy"])
def test_no_known_depth_at_all_is_an_error(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "s.txt":
        path.write_text("# nothing\n")
    elif name == "l.npy":
        np.save(path, np.zeros((5, 3)))
    else:
        write_depth(path, np.zeros((4, 5), np.float32))
    with pytest.raises(NoPointsError, match="holds no depth above 0"):
        read_sparse(path)


def test_scale_and_channel_reach_images(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", a=np.full((2, 2), 500, np.uint16), b=np.ones((2, 2), np.uint16))
    sparse = read_sparse(tmp_path / "s.npz", scale=1000, channel="a")
    assert sparse.points.depth.tolist() == [0.5] * 4
    assert sparse.scale == 1000
    with pytest.raises(UsageError):
        read_sparse(tmp_path / "s.npz", scale=0, channel="a")


def test_a_missing_list_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        read_sparse(tmp_path / "none.csv")


def test_a_real_lidar_scan_gives_all_its_points(shared_data: Path) -> None:
    path = next((shared_data / "kitti_dc" / "velodyne_raw").glob("*.png"))
    sparse, image = read_sparse(path), read_depth(path)
    assert sparse.points.size == (375, 1242)
    assert len(sparse.points.depth) == image.valid.sum() > 10_000
    columns, rows = sparse.points.xy.astype(int).T
    assert np.array_equal(image.values[rows, columns], sparse.points.depth)
    assert sparse.assumed_scale
