"""The guide from a folder of photos to a cloud runs as it is shown, and gives the scene."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnpdepth_cli.io.scans import read_scan
from tests.test_readme import RECONSTRUCTION, ROOT, blocks, run, shown_commands

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all that the guide shows was run."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("guide")
    shutil.copytree(ROOT / "samples", folder / "samples")
    (script,) = blocks(RECONSTRUCTION, "python")
    (folder / "reconstruct.py").write_text(script)
    for program, *arguments in shown_commands(RECONSTRUCTION):
        command = [] if program == "python" else ["-m", "pnpdepth_cli", program]
        run([*command, *arguments], folder)
    return folder


def test_the_cloud_lies_on_the_points_of_the_model(folder: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(folder / "room" / "dense" / "sparse"))
    image = sorted(model.images.values(), key=lambda each: each.name)[1]
    seen = [p.point3D_id for p in image.points2D if p.has_point3D()]
    points = np.array([model.points3D[n].xyz for n in seen if model.points3D[n].track.length() > 2])
    pose = image.cam_from_world()
    depth = (points @ pose.rotation.matrix().T + pose.translation)[:, 2]
    cloud = read_scan(folder / "room" / "scene.ply")[0][:, :3]
    assert len(cloud) > 10_000
    near = depth < 1.5 * np.median(depth)
    off, _ = cKDTree(cloud).query(points[near])
    assert np.median(off / depth[near]) < 0.01


def test_every_export_lies_in_the_project(folder: Path) -> None:
    dense = folder / "room" / "dense"
    assert len(list((dense / "stereo" / "depth_maps").glob("*.geometric.bin"))) == 3  # COLMAP
    assert len(json.loads((dense / "transforms.json").read_text())["frames"]) == 3  # Nerfstudio
    assert len(list((dense / "inverse_depths").glob("*.png"))) == 3  # 3DGS
    assert (dense / "sparse" / "0" / "depth_params.json").is_file()
