"""The 3D view of a frame is packed so that depths and directions are those of its cloud."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.commands.refinement.outputs import _rays
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.sensors.lens import rays_of
from pnpdepth_cli.sensors.point_cloud import kept_pixels
from tests.commands.frames import frame_on_disk, run


def unpack(text: str, kind: str, shape: tuple[int, ...]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(shape)


def calib_in(folder: Path) -> Path:
    path = folder / "k.txt"
    path.write_text("K: [50, 0, 30, 0, 50, 20, 0, 0, 1]")
    return path


def view_of(folder: Path, **changes: Any) -> dict[str, Any]:
    """The 3D view of a frame that is refined in the folder, with a camera."""
    scan = ScanOptions(calib=calib_in(folder))
    run(frame_on_disk(folder), **{"view_3d": True, "scan": scan} | changes)
    content: dict[str, Any] = json.loads((folder / "out" / "img_view.json").read_text())
    return content


def test_depths_are_those_of_the_cloud_to_a_ten_thousandth_and_colours_the_images(
    tmp_path: Path,
) -> None:
    view = view_of(tmp_path, format="npy", gt=tmp_path / "gt.png")
    width, height = view["size"]
    near, far = view["range"]
    for name, path in (("after", "out/img_depth.npy"), ("gt", "gt.png")):
        codes = unpack(view["depths"][name], "<u2", (height, width)).astype(float)
        depth = np.where(codes > 0, near * (far / near) ** ((codes - 1) / 65534), 0)
        expected = read_depth(tmp_path / path).values
        kept = kept_pixels(expected)
        assert ((depth > 0) == kept).all()
        assert depth[kept] == pytest.approx(expected[kept], rel=1e-4)
    assert view["depths"]["before"] != view["depths"]["after"]
    assert (view["stride"], view["whole"], view["farthest"]) == (1, view["size"], far)
    assert view["spacing"] == pytest.approx(1 / 50)
    colours = unpack(view["colours"], "|u1", (height, width, 3))
    assert (colours == np.rint(read_rgb(tmp_path / "img.png").values * 255)).all()


def test_points_have_a_spacing_where_the_lens_shows_nothing_in_a_corner(tmp_path: Path) -> None:
    calib = tmp_path / "camera.yaml"
    calib.write_text(
        "distortion_model: equidistant\nd: [0, 0, 0, 0]\nk: [20, 0, 30, 0, 20, 22, 0, 0, 1]"
    )
    assert view_of(tmp_path, scan=ScanOptions(calib=calib))["spacing"] == 1 / 20


@pytest.mark.slow
def test_interpolated_directions_are_exact_to_a_twentieth_of_a_pixel() -> None:
    focal_px, size = 400.0, (360, 480)
    camera = Camera(
        intrinsics=np.array([[focal_px, 0, 240], [0, focal_px, 180], [0, 0, 1]]),
        distortion=(-0.2, 0.03, 0.001, 0.0),
    )
    nodes = _rays(camera, size)
    y, x = np.mgrid[: size[0], : size[1]].reshape(2, -1)
    at = [y / (size[0] - 1) * (nodes.shape[0] - 1), x / (size[1] - 1) * (nodes.shape[1] - 1)]
    rays = np.stack([map_coordinates(nodes[:, :, axis], at, order=1) for axis in (0, 1)], axis=1)
    exact = rays_of(camera, np.column_stack([x, y]))
    assert np.abs(rays - exact).max() * focal_px < 0.05
