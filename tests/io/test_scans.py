from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.scans import read_scan, write_cloud
from tests.io.scan_files import (
    FILES,
    POINTS,
    bin_bytes,
    compressed_pcd_bytes,
    npy_bytes,
    pcd_bytes,
    ply_bytes,
)


@pytest.mark.parametrize("name", FILES)
def test_points_survive_every_format_also_what_is_no_number(tmp_path: Path, name: str) -> None:
    bad = POINTS.copy()
    bad[5], bad[20, 0] = np.nan, np.inf
    for points in (1e-3 * POINTS, 1e4 * POINTS, bad):
        (tmp_path / name).write_bytes(FILES[name](points))
        got = read_scan(tmp_path / name)[0]
        np.testing.assert_array_equal(got.astype(np.float32), points.astype(np.float32))


@pytest.mark.parametrize(("away", "kind"), [(0, np.float32), (5e6, np.float64)])
def test_coordinates_of_64_bits_keep_them_only_where_32_would_round_by_millimetres(
    tmp_path: Path, away: float, kind: type
) -> None:
    points = POINTS.astype(np.float64) + away
    np.save(tmp_path / "a.npy", points)
    got = read_scan(tmp_path / "a.npy")[0]
    assert got.dtype == kind
    assert np.abs(got - points).max() < 1e-3


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(24)),
        ("a.bin", b"\x89PNG\r\n\x1a\n" + bytes(24)),
        ("a.bin", bin_bytes(POINTS)[:-1]),
        ("a.bin", bytes(80)),  # of any number of fields
        ("a.npy", npy_bytes(POINTS)[:-4]),
        ("a.npy", npy_bytes(POINTS, np.int32)),
        ("a.pcd", b"VERSION 0.7\nPOINTS 3\n"),
        ("a.pcd", pcd_bytes(POINTS).replace(b" y ", b" w ")),
        ("a.pcd", compressed_pcd_bytes(POINTS).replace(b"SIZE 1 4", b"SIZE 1 6")),
        ("a.pcd", pcd_bytes(POINTS).replace(b"DATA binary", b"DATA binary_compressed")),
        ("a.ply", b"ply\nend_header\n"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n"),
        ("a.ply", ply_bytes(POINTS).replace(b"uchar red", b"list uchar int red")),
        # counts of points that the files do not hold
        *(
            (name, re.sub(rb"(POINTS|vertex) 37", rb"\g<1> " + count, content(POINTS)))
            for name, content in FILES.items()
            if name.endswith((".pcd", ".ply"))
            for count in (b"9037", b"9" * 5000, b"9" * 12, b"-1")
        ),
    ],
)
def test_what_is_no_scan_is_an_error_of_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"^.*$"):
        read_scan(tmp_path / name)


@pytest.mark.parametrize("channels", [0, 3])
def test_the_parts_of_a_cloud_are_the_rows_of_a_ply(tmp_path: Path, channels: int) -> None:
    path = tmp_path / "a.ply"
    halves = (slice(20), slice(20, None))
    colours = np.arange(POINTS.size, dtype=np.uint8).reshape(POINTS.shape)
    parts = [(POINTS[n], -POINTS[n], colours[n] if channels else None) for n in halves]
    assert write_cloud(path, parts) == len(POINTS)
    assert np.array_equal(read_scan(path)[0], POINTS)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = b" ".join(re.findall(rb"property \w+ (\w+)", header))
    assert names == b"x y z nx ny nz red green blue"[: 29 if channels else 14]
    rows = np.frombuffer(body, [("numbers", "<f4", 6), ("colours", "u1", channels)])
    assert np.array_equal(rows["numbers"], np.hstack([POINTS, -POINTS]))
    assert np.array_equal(rows["colours"], colours[:, :channels])
