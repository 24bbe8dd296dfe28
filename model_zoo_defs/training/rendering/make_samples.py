"""Renders three frames of samples/: python -m model_zoo_defs.training.rendering.make_samples.

One indoor frame with some random sparse points, one of a colour camera that is not registered to
the depth camera, and one street frame with a laser scan in KITTI's formats. Their seeds are
reserved: no training frame is rendered with them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from model_zoo_defs.training.rendering.camera_effects import photographed
from model_zoo_defs.training.rendering.shading import seen
from model_zoo_defs.training.rendering.shapes import FloatArray, rotation
from model_zoo_defs.training.scenes.scenes import build, generator, pick_view
from model_zoo_defs.training.scenes.world import View, World, looking

SAMPLE_SEED = 770077
"""Reserved for samples; training uses others."""

# Numbers of the scenes and of a view among those of the reserved seed.
INDOOR_SCENE = 5
INDOOR_VIEW = 1
STREET_SCENE = 13
UNREGISTERED_SCENE = 22

_COLOUR_FOCAL = 0.9
"""Focal length of the colour camera over that of the depth camera."""
_COLOUR_ASIDE_M = 0.025
"""Distance of the colour camera from the depth camera."""

INDOOR_SCALE = 1000
"""Integers a metre in a stored depth map of a room, as NYU has them."""
STREET_SCALE = 256
"""Integers a metre in a stored depth map of a street, as KITTI has them."""
SPARSE_POINTS = 500

_AMBIENT_RAYS = 24
"""Enough for noise-free ambient occlusion."""

# The rectified left colour camera of KITTI's first recording day, and its offsets along x from
# the reference camera (Geiger et al. 2013, calib_cam_to_cam.txt), rounded.
_FOCAL_PX = 721.54
_CX = 609.56
_CY = 172.85
_BASELINES_M = (0.0, -0.54, 0.06, -0.48)
_LASER_IN_CAMERA = np.array([0.0, -0.08, -0.27])
"""Position of the scanner in the reference camera's frame (right, down, forward), metres."""

_IMU_TO_LASER = (1, 0, 0, -0.81, 0, 1, 0, 0.32, 0, 0, 1, -0.8)
"""Rows of (rotation, metres) from the IMU's frame to the scanner's: KITTI's offset, not turned."""

# A scanner like KITTI's HDL-64E: beams, and the elevation of the first and of the last one.
_BEAMS = 64
_TOP_DEG = 2.0
_BOTTOM_DEG = -24.8
_STEP_DEG = 0.17
"""Azimuth from point to point of a beam."""
_SECTOR_DEG = 120.0
"""Azimuth that is scanned, the image's field of view in its middle."""
_RANGE_NOISE_M = 0.015
"""Standard deviation of a range."""
_NEAREST_M = 0.5
"""Depth below which a point is not projected."""
_REACH_M = 100.0
"""Range beyond which nothing returns."""


def make_indoor(folder: Path) -> None:
    """Writes rgb.png, sparse.png and gt.png of an indoor frame."""
    world, plan = build("room", generator(SAMPLE_SEED, INDOOR_SCENE, 0))
    rng = generator(SAMPLE_SEED, INDOOR_SCENE, 1 + INDOOR_VIEW)
    view = pick_view(world, plan, "room", rng, size=(480, 640))
    depth = _write_images(world, view, rng, folder, INDOOR_SCALE)
    _write_points(folder, depth, rng)


def _write_points(folder: Path, depth: FloatArray, rng: np.random.Generator) -> None:
    """Writes sparse.png with random pixels of the depth."""
    v, u = np.nonzero(depth)
    keep = np.sort(rng.choice(len(v), SPARSE_POINTS, replace=False))
    sparse = np.zeros_like(depth)
    sparse[v[keep], u[keep]] = depth[v[keep], u[keep]]
    write_depth(folder / "sparse.png", sparse, INDOOR_SCALE)


def make_unregistered(folder: Path) -> None:
    """Writes rgb.jpg of a colour camera beside the depth camera of sparse.png and gt.png."""
    world, plan = build("room", generator(SAMPLE_SEED, UNREGISTERED_SCENE, 0))
    rng = generator(SAMPLE_SEED, UNREGISTERED_SCENE, 1)
    view = pick_view(world, plan, "room", rng, size=(480, 640))
    focal_px = np.float32(view.fx * _COLOUR_FOCAL)
    aside = replace(
        view, position=view.position + view.axes[:, 0] * np.float32(_COLOUR_ASIDE_M),
        fx=float(focal_px), fy=float(focal_px),
    )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    colour, _ = seen(world, aside, rng, ambient_rays=_AMBIENT_RAYS)
    image = Image.fromarray(photographed(colour, rng, clean=True))
    _write(folder / "rgb.jpg", lambda stream: image.save(stream, "JPEG", quality=90))
    _, depth = seen(world, view, rng, ambient_rays=1)
    write_depth(folder / "gt.png", depth, INDOOR_SCALE)
    _write_points(folder, depth, rng)


def make_street(folder: Path) -> None:
    """Writes a street frame: rgb.png, gt.png, sparse.png, 000000.bin and calib.txt."""
    rng = generator(SAMPLE_SEED, STREET_SCENE, 0)
    world, plan = build("street", rng)
    lane = float(plan.high[0]) * 0.55
    view = replace(
        looking((lane, 0.0, 1.65), (0.02, -0.01, 0.0), fov_deg=80, size=(375, 1242)),
        fx=_FOCAL_PX, fy=_FOCAL_PX, cx=_CX, cy=_CY,
    )  # fmt: skip
    _write_images(world, view, rng, folder, STREET_SCALE)
    turn = laser_axes()
    scan = laser_scan(world, view, turn, rng)
    _write(folder / "000000.bin", lambda stream: stream.write(scan.astype("<f4").tobytes()))
    text = calibration_text(turn)
    _write(folder / "calib.txt", lambda stream: stream.write(text.encode("ascii")))
    write_depth(folder / "sparse.png", projected(scan, turn, view), STREET_SCALE)


def _write_images(
    world: World, view: View, rng: np.random.Generator, folder: Path, scale: int
) -> FloatArray:
    """Writes rgb.png and gt.png of a view; returns its depth (H, W) in metres.

    The scale is integers a metre in gt.png.
    """
    folder.mkdir(parents=True, exist_ok=True)
    colour, depth = seen(world, view, rng, ambient_rays=_AMBIENT_RAYS)
    image = Image.fromarray(photographed(colour, rng, clean=True))
    _write(folder / "rgb.png", lambda stream: image.save(stream, "PNG", optimize=True))
    write_depth(folder / "gt.png", depth, scale)
    return depth


def laser_axes() -> npt.NDArray[np.float64]:
    """Returns R (3, 3) of p_camera = R p_laser + t.

    The scanner has x forward, y left, z up, the camera x right, y down, z forward. The mount is
    slightly rotated, as real mounts are.
    """
    straight = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    off = rotation(yaw=0.008, pitch=-0.004, roll=0.006).astype(np.float64)
    # The nearest rotation, as float32 was not exact.
    left, _, right = np.linalg.svd(straight @ off)
    return np.asarray(left @ right)


def laser_scan(
    world: World, view: View, turn: npt.NDArray[np.float64], rng: np.random.Generator
) -> FloatArray:
    """Returns the points (n, 4) of one turn: x forward, y left, z up in metres, reflectance."""
    elevation = np.radians(np.linspace(_TOP_DEG, _BOTTOM_DEG, _BEAMS))[:, None]
    half = _SECTOR_DEG / 2
    azimuth = np.radians(np.arange(half, -half, -_STEP_DEG))[None, :]
    beams = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) * np.ones_like(azimuth),
        ],
        axis=2,
    ).reshape(-1, 3)
    # The reference camera is offset from the image's camera by the latter's baseline.
    axes = view.axes.astype(np.float64)
    reference = view.position + axes[:, 0] * _BASELINES_M[2]
    origin = reference + axes @ _LASER_IN_CAMERA
    directions = (beams @ turn.T @ axes.T).astype(np.float32)
    origins = np.tile(origin.astype(np.float32), (len(beams), 1))
    hits = world.cast(origins, directions)
    bright = world.table.albedo(hits.material, hits.uv, hits.t * np.float32(0.003)).mean(axis=1)
    facing = np.abs(np.einsum("ij,ij->i", hits.flat, directions))
    # Glass and polished paint reflect most of the pulse away.
    lost = rng.random(len(beams)) < 3 * world.table.mirror[hits.material] + 0.02
    back = hits.met & (hits.t < _REACH_M) & ~lost
    distance = hits.t + rng.normal(0, _RANGE_NOISE_M, len(beams)).astype(np.float32)
    reflectance = np.clip(0.1 + 0.9 * bright * facing, 0, 0.99)
    points = np.column_stack([beams * distance[:, None], reflectance])[back]
    return points.astype(np.float32)


def calibration_text(turn: npt.NDArray[np.float64]) -> str:
    """Returns a calibration file in the format of KITTI's object benchmark.

    Args:
        turn: Rotation (3, 3) from the scanner's frame to the reference camera's.
    """
    # The projections of the four cameras, which differ in their offset along x alone.
    rows = {}
    for camera, baseline in enumerate(_BASELINES_M):
        rows[f"P{camera}"] = [
            _FOCAL_PX, 0, _CX, _FOCAL_PX * baseline, 0, _FOCAL_PX, _CY, 0, 0, 0, 1, 0,
        ]  # fmt: skip
    # The images are rectified, and no rotation is left.
    rows["R0_rect"] = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    rows["Tr_velo_to_cam"] = np.column_stack([turn, _LASER_IN_CAMERA]).ravel().tolist()
    rows["Tr_imu_to_velo"] = list(_IMU_TO_LASER)
    return "".join(
        f"{name}: {' '.join(f'{value:.12e}' for value in values)}\n"
        for name, values in rows.items()
    )


def projected(scan: FloatArray, turn: npt.NDArray[np.float64], view: View) -> FloatArray:
    """Returns a scan as a sparse depth map (H, W); of two points in a pixel the nearer is kept.

    Args:
        scan: Points (n, 4) of `laser_scan`.
        turn: Rotation from the scanner's frame to the reference camera's.
        view: The image's camera, beside the reference camera.
    """
    # In the reference camera's frame, and in front of it.
    points = scan[:, :3].astype(np.float64) @ turn.T + _LASER_IN_CAMERA
    points = points[points[:, 2] > _NEAREST_M]
    u = np.rint((points[:, 0] + _BASELINES_M[2]) / points[:, 2] * view.fx + view.cx).astype(int)
    v = np.rint(points[:, 1] / points[:, 2] * view.fy + view.cy).astype(int)
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    # The nearest is written last.
    order = np.argsort(-points[inside, 2], kind="stable")
    sparse = np.zeros((view.height, view.width), np.float32)
    sparse[v[inside][order], u[inside][order]] = points[inside, 2][order]
    return sparse


def write_depth(path: Path, depth: npt.NDArray[np.floating], scale: int) -> None:
    """Writes depth as a 16-bit PNG of round(depth * scale); its text chunk states the scale."""
    stored = np.rint(depth * scale)
    if stored.max() > 65535:
        raise ValueError(f"{path}: depth {depth.max():.1f} m does not fit 16 bits at {scale} per m")
    image = Image.fromarray(stored.astype(np.uint16))
    words = PngInfo()
    words.add_text("pnpdepth:scale", str(scale))
    _write(path, lambda stream: image.save(stream, "PNG", pnginfo=words, optimize=True))


def _write(path: Path, fill: Callable[[BytesIO], object]) -> None:
    """Writes a file, whole or not at all, with what the function writes to a stream."""
    memory = BytesIO()
    fill(memory)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(memory.getvalue())
    temporary.replace(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the frames below the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Render the frames of samples/.")
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args(arguments).out
    make_indoor(out / "indoor")
    make_street(out / "street")
    make_unregistered(out / "unregistered")


if __name__ == "__main__":
    main()
