"""Clouds are read back as they were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.io.scans import read_scan, write_cloud

RNG = np.random.default_rng(0)
XYZ = RNG.uniform(-5, 5, (200, 3)).astype(np.float32)
RGB = RNG.integers(0, 256, (200, 3), dtype=np.uint8)
NORMALS = (XYZ / np.linalg.norm(XYZ, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("rgb", [RGB, None])
def test_the_parts_of_a_cloud_are_the_rows_of_a_ply(tmp_path: Path, rgb: np.ndarray | None) -> None:
    parts = [
        (XYZ[p], NORMALS[p], rgb if rgb is None else rgb[p]) for p in (slice(70), slice(70, 200))
    ]
    assert write_cloud(tmp_path / "a.ply", parts) == 200
    assert (read_scan(tmp_path / "a.ply").points[:, :3] == XYZ).all()
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if b"property" in line]
    colours = [] if rgb is None else ["red", "green", "blue"]
    assert names == ["x", "y", "z", "nx", "ny", "nz", *colours]
    rows = np.frombuffer(body, np.uint8).reshape(200, 24 + len(colours))
    assert (np.ascontiguousarray(rows[:, :24]).view("<f4") == np.hstack([XYZ, NORMALS])).all()
    assert rgb is None or (rows[:, 24:] == rgb).all()
