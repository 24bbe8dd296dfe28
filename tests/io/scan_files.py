"""Scans of a LiDAR as bytes in every format that is read."""

from __future__ import annotations

import io
import struct

import numpy as np
from numpy.typing import NDArray

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
    packed = b"".join(bytes([len(literals) - 1]) + literals for literals in parts)
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
