from __future__ import annotations

import io
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.scans import read_scan, write_cloud

POINTS = np.random.default_rng(3).normal(0, 20, (37, 3)).astype(np.float32)


def bin_bytes(points: NDArray[np.float32]) -> bytes:
    return np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4").tobytes()


def pcd_bytes(points: NDArray[np.float32], stored: str = "binary") -> bytes:
    """x, y, z between an intensity and a pair of normals, as a PCD may have them."""
    n = len(points)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x y z n\nSIZE 1 4 4 4 4\nTYPE U F F F F\n"
        f"COUNT 1 1 1 1 2\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\n"
        f"DATA {stored}\n"
    )
    if stored == "ascii":
        return (header + "".join(f"7 {x:.9g} {y:.9g} {z:.9g} 0 1\n" for x, y, z in points)).encode()
    rows = np.zeros(n, [("i", "u1"), ("p", "<f4", 3), ("n", "<f4", 2)])
    rows["p"] = points
    return header.encode() + rows.tobytes()


def compressed_pcd_bytes(points: NDArray[np.float32]) -> bytes:
    """The same fields one after the other, as LZF: literals, but for n, which copies itself."""
    header = pcd_bytes(points).partition(b"DATA")[0] + b"DATA binary_compressed\n"
    literal = bytes(len(points)) + points.T.astype("<f4").tobytes()
    parts = [literal[at : at + 32] for at in range(0, len(literal), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    packed += b"\x00\x00"  # one byte of n; the others are copies from one byte back
    for at in range(0, 8 * len(points) - 1, 250):
        packed += bytes([7 << 5, min(8 * len(points) - 1 - at, 250) - 9, 0])
    return header + struct.pack("<II", len(packed), len(points) * (1 + 12 + 8)) + packed


def ply_bytes(points: NDArray[np.float32], stored: str = "binary_little_endian") -> bytes:
    """Vertices of doubles with a colour before them, and a face after them."""
    header = (
        f"ply\nformat {stored} 1.0\ncomment made by a test\nelement vertex {len(points)}\n"
        "property uchar red\nproperty double x\nproperty double y\nproperty double z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if stored == "ascii":
        text = "".join(f"9 {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points)
        return (header + text + "3 0 1 2\n").encode()
    rows = np.zeros(len(points), [("r", "u1"), ("p", f"{'<' if 'little' in stored else '>'}f8", 3)])
    rows["p"] = points
    return header.encode() + rows.tobytes() + b"\x03" + bytes(12)


def npy_bytes(points: NDArray[np.float32], dtype: type = np.float64) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.column_stack([points, points[:, :1]]).astype(dtype))
    return buffer.getvalue()


FILES = {
    "kitti.bin": bin_bytes,
    "scan.npy": npy_bytes,
    "scan.txt": lambda points: "".join(f"{x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points).encode(),
    "binary.pcd": pcd_bytes,
    "compressed.pcd": compressed_pcd_bytes,
    "ascii.pcd": lambda points: pcd_bytes(points, "ascii"),
    "little.ply": ply_bytes,
    "big.ply": lambda points: ply_bytes(points, "binary_big_endian"),
    "ascii.ply": lambda points: ply_bytes(points, "ascii"),
}


@pytest.mark.parametrize("name", FILES)
def test_points_survive_every_format_also_what_is_no_number(tmp_path: Path, name: str) -> None:
    bad = POINTS.copy()
    bad[5], bad[20, 0] = np.nan, np.inf
    for points in (1e-3 * POINTS, 1e4 * POINTS, bad):
        (tmp_path / name).write_bytes(FILES[name](points))
        got = read_scan(tmp_path / name)[0]
        np.testing.assert_array_equal(got.astype(np.float32), points.astype(np.float32))


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
    path, halves = tmp_path / "a.ply", (slice(20), slice(20, None))
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
