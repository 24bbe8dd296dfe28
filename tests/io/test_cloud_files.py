"""Clouds are read back by other programs as they were written."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.io.cloud_files import write_cloud
from pnpdepth_cli.io.scans import read_scan

RNG = np.random.default_rng(0)
XYZ = RNG.uniform(-5, 5, (200, 3)).astype(np.float32)
RGB = RNG.integers(0, 256, (200, 3), dtype=np.uint8)
NORMALS = (XYZ / np.linalg.norm(XYZ, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("rgb", [RGB, None])
def test_trimesh_and_our_own_reader_read_a_ply(tmp_path: Path, rgb: np.ndarray | None) -> None:
    trimesh = pytest.importorskip("trimesh")
    parts = [
        (XYZ[p], NORMALS[p], rgb if rgb is None else rgb[p]) for p in (slice(70), slice(70, 200))
    ]
    assert write_cloud(tmp_path / "a.ply", parts) == 200
    cloud = trimesh.load(tmp_path / "a.ply")
    assert (cloud.vertices.astype(np.float32) == XYZ).all()
    if rgb is not None:
        assert (cloud.colors[:, :3] == rgb).all()
    assert (read_scan(tmp_path / "a.ply").points[:, :3] == XYZ).all()


def test_a_glb_has_y_up_and_z_backwards(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_cloud(tmp_path / "a.glb", [(XYZ, NORMALS, RGB)])
    (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert cloud.vertices == pytest.approx(XYZ * [1, -1, -1], abs=1e-6)
    assert (np.asarray(cloud.colors)[:, :3] == RGB).all()


def test_a_laz_keeps_points_to_a_tenth_of_a_millimetre(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    write_cloud(tmp_path / "a.laz", [(XYZ, NORMALS, RGB)])
    las = laspy.read(tmp_path / "a.laz")
    assert np.column_stack([las.x, las.y, las.z]) == pytest.approx(XYZ, abs=1e-4)
    assert (np.column_stack([las.red, las.green, las.blue]) // 257 == RGB).all()


def test_an_unknown_suffix_and_a_missing_package_are_named_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("trimesh", "laspy"):
        monkeypatch.setitem(sys.modules, package, None)
    for suffix, message in (
        (".obj", r"\.ply, \.glb, \.laz"), (".glb", r"pnpdepth\[cloud\]"), (".laz", r"\[cloud\]")
    ):  # fmt: skip
        with pytest.raises(PnpDepthError, match=message):
            write_cloud(tmp_path / f"a{suffix}", [(XYZ, NORMALS, RGB)])
    assert list(tmp_path.iterdir()) == []
