"""Depths of an integer file: codes per metre, and what is clipped; the 3D view of a frame."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.sensors.lens import rays_of
from pnpdepth_cli.sensors.point_cloud import kept_pixels
from tests.commands.frames import FrameOnDisk, run


def test_depths_beyond_16_bits_are_clipped_and_counted(frame: FrameOnDisk) -> None:
    text = frame.model.read_text()
    own = "2 + 3 * self"
    frame.model.write_text(text.replace(own, "1e-6 + 90 * rgb[:, 2:] ** 9 + 0 * self"))
    run(frame, iterations=0, output=frame.folder / "d.npy")
    exact = np.load(frame.folder / "d.npy")
    record = run(frame, iterations=0)
    written = read_depth(Path(record.refined().outputs["depth"])).values
    assert written == pytest.approx(exact.clip(0.001, 65.534), abs=0.00051)
    beyond = np.count_nonzero((exact > 65.534) | (exact < 0.0005))
    assert any(f" {beyond:,} of {exact.size:,} pixels clipped" in note for note in record.notes)


def unpack(text: str, kind: str, shape: tuple[int, ...]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(shape)


def test_a_3d_view_has_the_depth_and_directions_of_the_cloud(frame: FrameOnDisk) -> None:
    calib = frame.folder / "k.txt"
    calib.write_text("K: [50, 0, 30, 0, 50, 20, 0, 0, 1]\ndistortion: [-0.2, 0.03, 0.001, 0.0]")
    run(frame, view_3d=True, scan=ScanOptions(calib=calib), format="npy", gt=frame.gt)
    view = json.loads((frame.folder / "out" / "img_view.json").read_text())
    width, height = view["size"]
    near, far = view["range"]
    for name, path in (("after", frame.folder / "out/img_depth.npy"), ("gt", frame.gt)):
        codes = unpack(view["depths"][name], "<u2", (height, width)).astype(float)
        depth = np.where(codes > 0, near * (far / near) ** ((codes - 1) / 65534), 0)
        expected = read_depth(path).values
        assert depth == pytest.approx(np.where(kept_pixels(expected), expected, 0), rel=1e-4)
    assert (view["stride"], view["whole"], view["farthest"]) == (1, view["size"], far)
    assert view["spacing"] == pytest.approx(1 / 50)
    colours = unpack(view["colours"], "|u1", (height, width, 3))
    assert (colours == np.rint(read_rgb(frame.image).values * 255)).all()
    # Directions between the nodes are exact to a twentieth of a pixel.
    columns, rows = view["rays"]["size"]
    nodes = unpack(view["rays"]["values"], "<f4", (rows, columns, 2))
    y, x = np.mgrid[:height, :width].reshape(2, -1)
    at = [y / (height - 1) * (rows - 1), x / (width - 1) * (columns - 1)]
    rays = np.stack([map_coordinates(nodes[:, :, axis], at, order=1) for axis in (0, 1)], axis=1)
    intrinsics = np.array([[50, 0, 30], [0, 50, 20], [0, 0, 1.0]])
    camera = Camera(intrinsics=intrinsics, distortion=(-0.2, 0.03, 0.001, 0.0))
    assert np.abs(rays - rays_of(camera, np.column_stack([x, y]))).max() * 50 < 0.05


@pytest.mark.parametrize(
    ("options", "heading"),
    [
        ({"method": "alone"}, "validation points"),
        ({"method": "alone", "holdout": 0.3}, "held-out points"),
        ({"propagate": "none"}, None),
    ],
)
def test_without_ground_truth_improvement_is_at_points_that_nothing_used(
    frame: FrameOnDisk, options: dict[str, object], heading: str | None
) -> None:
    path = frame.folder / "out/img_improvement.png"
    run(frame, gt=frame.gt)  # of an earlier run
    assert path.is_file()
    record = run(frame, overwrite=True, **options)
    assert path.is_file() == (heading is not None) == ("improvement" in record.refined().outputs)
    if heading is None:
        return
    basis = heading.partition(" ")[0].replace("-", "_")
    footer = record.refined().figures["improvement"].footer
    assert footer is not None
    assert footer.startswith(f"at {record.errors[basis]['after']['points']:,} {heading}: ")
    if basis == "held_out" and record.refined().improved_fraction is not None:
        assert f"{100 * record.refined().improved_fraction:.1f} % better" in footer
