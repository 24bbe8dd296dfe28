"""Small data sets of every layout, for tests; `MAKERS` and the names of their frames."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.dataset.layouts import list_frames
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import write_depth
from tests.colmap_models import write_text_model


def touch(*paths: Path) -> None:
    """Creates the files and their folders."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def tree(root: Path, patterns: str) -> None:
    """Creates the files of patterns such as "rgb/{a,b}.png depth/a.png" below a folder."""
    for pattern in patterns.split():
        parts = re.split(r"\{([^}]*)\}", pattern)
        choices = [piece.split(",") if index % 2 else [piece] for index, piece in enumerate(parts)]
        touch(*(root / "".join(path) for path in itertools.product(*choices)))


HEIGHT, WIDTH = 24, 32
DRIVE = "2011_09_26_drive_0002_sync"
SELECTED = f"{DRIVE}_{{}}_0000000005_image_02"
TREES = {
    "pairs": ("rgb/{a,b}.png sparse/{a,b}.png gt/a.exr calib/a.json", ["a", "b"]),
    "image-depth": ("images/x/{a,b}.jpg depth/x/{a,b}.png", ["x/a", "x/b"]),
    "kitti-object": (
        "training/image_2/00000{0.png,1.PNG} training/velodyne/00000{0,1}.bin"
        " training/calib/00000{0,1}.txt",
        ["training_000000", "training_000001"],
    ),
    "kitti-odometry": (
        "sequences/{00,03}/image_2/00000{0,2}.png sequences/{00,03}/velodyne/00000{0,2}.bin"
        " sequences/{00,03}/calib.txt",
        ["00_000000", "00_000002", "03_000000", "03_000002"],
    ),
    "kitti-depth": (
        f"image/{SELECTED.format('image')}.png intrinsics/{SELECTED.format('image')}.txt"
        f" velodyne_raw/{SELECTED.format('velodyne_raw')}.png"
        f" groundtruth_depth/{SELECTED.format('groundtruth_depth')}.png",
        [f"{DRIVE}_0000000005_image_02"],
    ),
    "kitti-raw": (
        f"2011_09_26/calib_{{cam_to_cam,velo_to_cam}}.txt"
        f" 2011_09_26/{DRIVE}/velodyne_points/data/000000000{{5,6}}.bin"
        f" 2011_09_26/{DRIVE}/image_0{{2,3}}/data/000000000{{5,6}}.png"
        f" 2011_09_26/{DRIVE}/image_02/data/0000000007.png",
        [f"{DRIVE}_000000000{n}_image_0{camera}" for camera in (2, 3) for n in (5, 6)],
    ),
    "7scenes": (
        "seq-0{1,2}/frame-000000.{color,depth}.png",
        ["seq-01_frame-000000", "seq-02_frame-000000"],
    ),
}
"""Empty files of a layout by its name, and the names of their frames."""


def image(path: Path, height: int = HEIGHT, width: int = WIDTH) -> None:
    _write(path, np.full((height, width, 3), 90, np.uint8))


def codes(path: Path, value: int, height: int = HEIGHT, width: int = WIDTH, every: int = 1) -> None:
    depth = np.zeros((height, width), np.uint16)
    depth[::every, ::every] = value
    _write(path, depth)


def mask(path: Path, height: int = HEIGHT, width: int = WIDTH) -> None:
    """The left half is valid."""
    _write(path, np.where(np.arange(width) < width // 2, 255, 0) * np.ones((height, 1), np.uint8))


def _write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)


def void(root: Path) -> None:
    sequence = root / "data" / "desktop"
    for stem in ("1552.25", "1553.25"):
        image(sequence / f"image/{stem}.png")
        codes(sequence / f"sparse_depth/{stem}.png", 512, every=4)
        codes(sequence / f"ground_truth/{stem}.png", 512)
    np.savetxt(sequence / "K.txt", np.eye(3))
    (root / "test_image.txt").write_text("void_1500/data/desktop/image/1553.25.png\n")


def diode(root: Path) -> None:
    name = root / "indoors/scene_00019/scan_00183/00019_00183_indoors_000_010"
    image(name.with_suffix(".png"))
    np.save(f"{name}_depth.npy", np.full((HEIGHT, WIDTH, 1), 2.0, np.float32))
    valid = np.zeros((HEIGHT, WIDTH), np.float32)
    valid[:, : WIDTH // 2] = 1
    np.save(f"{name}_depth_mask.npy", valid)


def ibims(root: Path, height: int = HEIGHT, width: int = WIDTH) -> None:
    """A frame in 2 m, whose left half is valid."""
    image(root / "rgb/corridor_01.png", height, width)
    codes(root / "depth/corridor_01.png", round(2 * 65535 / 50), height, width)
    mask(root / "mask_invalid/corridor_01.png", height, width)
    image(root / "mask_transp/corridor_01.png", height, width)


def scannet(root: Path) -> None:
    for scene in ("scene0000_00", "scene0001_00"):
        for number in (0, 2, 10):
            image(root / scene / f"color/{number}.jpg", 2 * HEIGHT, 2 * WIDTH)
            codes(root / scene / f"depth/{number}.png", 2000)
        (root / scene / "intrinsic").mkdir()


def arkitscenes(root: Path) -> None:
    video = root / "Validation" / "41069021"
    image(video / "wide/41069021_305.244.png")
    codes(video / "lowres_depth/41069021_305.244.png", 2000, HEIGHT // 4, WIDTH // 4)
    codes(video / "highres_depth/41069021_305.244.png", 2000)


def stray_scanner(root: Path, frames: int = 3) -> None:
    """A video of frames that get brighter, and depth of 2 m of which a quarter is of confidence 0.

    The camera moves 0.1 m to the right from frame to frame.
    """
    for number in range(frames):
        codes(root / f"depth/{number:06}.png", 2000, HEIGHT // 2, WIDTH // 2)
        confidence = np.full((HEIGHT // 2, WIDTH // 2), 2, np.uint8)
        confidence[:, : WIDTH // 8] = 0
        _write(root / f"confidence/{number:06}.png", confidence)
    mp4v = cv2.VideoWriter.fourcc(*"mp4v")
    video = cv2.VideoWriter(str(root / "rgb.mp4"), mp4v, 30, (WIDTH, HEIGHT))
    for number in range(frames):
        video.write(np.full((HEIGHT, WIDTH, 3), 20 + 15 * number, np.uint8))
    video.release()
    (root / "camera_matrix.csv").write_text(f"30.0, 0.0, {WIDTH / 2}\n0.0, 30.0, 12.0\n0, 0, 1")
    rows = [f"{n / 60}, {n:06}, {n / 10}, 0, 0, 0, 0, 0, 1\n" for n in range(frames)]
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    (root / "odometry.csv").write_text(header + "".join(rows))


def record3d(root: Path) -> None:
    """Depth of 2 m, and the same motion in ARKit's axes."""
    for number in range(3):
        image(root / f"rgb/{number}.jpg")
        (root / "depth").mkdir(exist_ok=True)
        write_depth(root / f"depth/{number}.exr", np.full((HEIGHT // 2, WIDTH // 2), 2, np.float32))
    half_turn_about_x = [1, 0, 0, 0]  # from ARKit's axes, y up, to those of the world here
    poses = [[*half_turn_about_x, n / 10, 0, 0] for n in range(3)]
    metadata = {"K": [30, 0, 0, 0, 30, 0, WIDTH / 2, 12, 1], "w": WIDTH, "h": HEIGHT}
    (root / "metadata.json").write_text(json.dumps(metadata | {"poses": poses}))


def tum(root: Path) -> None:
    root.mkdir(exist_ok=True)
    lines = ["# time file", "1.000 rgb/1.000.png", "1.033 rgb/1.033.png", "2 rgb/2.png"]
    (root / "rgb.txt").write_text("\n".join(lines))
    (root / "depth.txt").write_text("1.015 depth/1.015.png\n1.030 depth/1.030.png\n")


def colmap(root: Path) -> None:
    write_text_model(root / "sparse" / "0", names=("left/a.png", "b.png"))
    touch(root / "images/left/a.png", root / "images/b.png")


def eth3d(root: Path, height: int = HEIGHT, width: int = WIDTH) -> None:
    """A frame of 2 m in the left half, without a return in the right one."""
    image(root / "office/images/dslr_images/DSC_0219.JPG", height, width)
    depth = np.full((height, width), 2, "<f4")
    depth[:, width // 2 :] = np.inf
    path = root / "office/ground_truth_depth/dslr_images/DSC_0219.JPG"
    path.parent.mkdir(parents=True)
    depth.tofile(path)


def read_frames(root: Path, name: str | None = None) -> list[FrameFiles]:
    """The frames of a data set, all of which are complete."""
    _, frames, unmatched = list_frames(root, name)
    if unmatched and not frames:
        raise InputError(" ".join(map(str, unmatched[0])))
    return frames


Maker = Callable[[Path], None]
BENCHMARKS: dict[str, tuple[Maker, list[str]]] = {
    "void": (void, ["data/desktop/1553.25"]),
    "diode": (diode, ["indoors/scene_00019/scan_00183/00019_00183_indoors_000_010"]),
    "ibims": (ibims, ["corridor_01"]),
    "eth3d": (eth3d, ["office/DSC_0219"]),
    "scannet": (scannet, [f"scene000{s}_00/{n}" for s in (0, 1) for n in (0, 2, 10)]),
    "arkitscenes": (arkitscenes, ["41069021/41069021_305.244"]),
}
"""Sets with depth of 2 m."""
MAKERS: dict[str, tuple[Maker, list[str]]] = {
    **{name: (partial(tree, patterns=files), names) for name, (files, names) in TREES.items()},
    **BENCHMARKS,
    "stray-scanner": (stray_scanner, ["000000", "000001", "000002"]),
    "record3d": (record3d, ["0", "1", "2"]),
    "tum": (tum, ["1.000", "1.033"]),
    "colmap": (colmap, ["b", "left/a"]),
}
