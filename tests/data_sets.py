"""Small data sets of every layout, for tests; `MAKERS` and the names of their frames."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.dataset import Frame, Hdf5Array
from pnpdepth_cli.io.dataset.reading import depth_of
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.layouts import list_frames
from tests.colmap_models import write_text_model
from tests.empty_files import touch, tree

HEIGHT, WIDTH = 24, 32
DRIVE = "2011_09_26_drive_0002_sync"
SELECTED = f"{DRIVE}_{{}}_0000000005_image_02"
TREES = {
    "pairs": ("rgb/{a,b}.png sparse/{a,b}.png gt/a.exr calib/a.json", ["a", "b"]),
    "image-depth": ("images/x/{a,b}.jpg depth/x/{a,b}.png", ["x/a", "x/b"]),
    "kitti-object": (
        "training/image_2/00000{0,1}.png training/velodyne/00000{0,1}.bin"
        " training/calib/00000{0,1}.txt",
        ["training_000000", "training_000001"],
    ),
    "kitti-odometry": (
        "sequences/{00,03}/image_2/000000.png sequences/{00,03}/velodyne/000000.bin"
        " sequences/{00,03}/calib.txt",
        ["00_000000", "03_000000"],
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
    "synthia": (
        "{RGB,Depth}/Stereo_Left/Omni_F/000000.png {RGB,Depth}/Stereo_Right/Omni_B/000000.png"
        " CameraParams/intrinsics.txt",
        ["Stereo_Left_Omni_F_000000", "Stereo_Right_Omni_B_000000"],
    ),
}
"""Empty files of a layout by its name, and the names of their frames."""


def image(path: Path, height: int = HEIGHT, width: int = WIDTH) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((height, width, 3), 90, np.uint8))


def codes(path: Path, value: int, height: int = HEIGHT, width: int = WIDTH, every: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.zeros((height, width), np.uint16)
    depth[::every, ::every] = value
    cv2.imwrite(str(path), depth)


def mask(path: Path) -> None:
    """The left half is valid."""
    path.parent.mkdir(parents=True, exist_ok=True)
    valid = np.zeros((HEIGHT, WIDTH), np.uint8)
    valid[:, : WIDTH // 2] = 255
    cv2.imwrite(str(path), valid)


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


def ibims(root: Path) -> None:
    image(root / "rgb/corridor_01.png")
    codes(root / "depth/corridor_01.png", round(2 * 65535 / 50))
    mask(root / "mask_invalid/corridor_01.png")
    image(root / "mask_transp/corridor_01.png")


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


def hypersim(root: Path) -> None:
    h5py = pytest.importorskip("h5py")
    images = root / "ai_001_001" / "images"
    image(images / "scene_cam_00_final_preview/frame.0000.tonemap.jpg")
    (images / "scene_cam_00_geometry_hdf5").mkdir()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.sqrt((x - 15.5) ** 2 + (y - 11.5) ** 2 + 886.81**2) / 886.81
    path = images / "scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5"
    with h5py.File(path, "w") as file:
        file["dataset"] = (2 * ray).astype(np.float64)


def tum(root: Path) -> None:
    root.mkdir(exist_ok=True)
    (root / "rgb.txt").write_text(
        "# time file\n1.000 rgb/1.000.png\n1.033 rgb/1.033.png\n2 rgb/2.png\n"
    )
    (root / "depth.txt").write_text("1.015 depth/1.015.png\n1.030 depth/1.030.png\n")


def colmap(root: Path) -> None:
    write_text_model(root / "sparse" / "0", names=("left/a.png", "b.png"))
    touch(root / "images/left/a.png", root / "images/b.png")


def nyu_h5(root: Path) -> None:
    h5py = pytest.importorskip("h5py")
    (root / "official").mkdir(parents=True)
    for number in (1, 9):
        with h5py.File(root / "official" / f"{number:05}.h5", "w") as file:
            file["rgb"] = np.full((3, 480, 640), number, np.uint8)
            file["depth"] = np.full((480, 640), float(number), np.float32)


def nyu_mat(root: Path) -> None:
    h5py = pytest.importorskip("h5py")
    root.mkdir(exist_ok=True)
    with h5py.File(root / "nyu_depth_v2_labeled.mat", "w") as file:
        # MATLAB's column order: frames, channels, columns, rows
        numbers = np.arange(4, dtype=np.uint8)[:, None, None, None]
        file["images"] = numbers * np.ones((1, 3, 640, 480), np.uint8)
        file["depths"] = np.tile(np.arange(640, dtype=np.float32)[:, None] + 1, (4, 1, 480))


FORWARD = [0.5, -0.5, 0.5, -0.5]
"""w x y z of a camera that looks along the car's x axis."""
PINHOLE = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "skew": 0.0}


def nuscenes(root: Path, *, moved: float = 0.5) -> None:
    """One sample: the car drives `moved` metres from the scan to the image."""
    ahead = [1.0, 0, 0, 0]
    intrinsic = [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]

    def pose(token: str, translation: list[float], rotation: list[float], **more: Any) -> Any:
        return {"token": token, "translation": translation, "rotation": rotation, **more}

    def datum(token: str, filename: str, sensor: str, time: str, *, key: bool = True) -> Any:
        return {
            "token": token, "filename": filename, "calibrated_sensor_token": sensor,
            "ego_pose_token": time, "sample_token": "s", "is_key_frame": key,
            "height": 48, "width": 64,
        }  # fmt: skip

    scan = "samples/LIDAR_TOP/a.pcd.bin"
    tables = {
        "scene": [{"token": "scene", "name": "scene-0001"}],
        "sample": [{"token": "s", "scene_token": "scene"}],
        "sensor": [
            {"token": "cam", "channel": "CAM_FRONT"},
            {"token": "lid", "channel": "LIDAR_TOP"},
        ],
        "calibrated_sensor": [
            pose("c", [1.5, 0, 1.5], FORWARD, sensor_token="cam", camera_intrinsic=intrinsic),
            pose("l", [1.0, 0, 1.8], ahead, sensor_token="lid", camera_intrinsic=[]),
        ],
        "ego_pose": [
            pose("at image", [1000 + moved, 2000, 0], ahead),
            pose("at scan", [1000, 2000, 0], ahead),
        ],
        "sample_data": [
            datum("1", "samples/CAM_FRONT/a.jpg", "c", "at image"),
            datum("2", scan, "l", "at scan"),
            datum("3", "sweeps/x.jpg", "c", "at image", key=False),
        ],
    }
    (root / "v1.0-mini").mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    image(root / "samples/CAM_FRONT/a.jpg", 48, 64)
    (root / scan).parent.mkdir(parents=True, exist_ok=True)
    points = [[10.5, 0.0, -0.3, 7, 1], [10.5, 2.0, -0.3, 7, 2]]
    np.array(points, "<f4").tofile(root / scan)


def ddad_scene(
    folder: Path, *, samples: int = 2, intrinsics: dict[str, float] | None = None
) -> None:
    """The car drives 0.5 m from sample to sample, and 0.1 m from the scan to the image."""
    data, rows = [], []
    for name in ("rgb/CAMERA_01", "point_cloud/LIDAR", "calibration"):
        (folder / name).mkdir(parents=True)
    forward = dict(zip(("qw", "qx", "qy", "qz"), FORWARD, strict=True))
    for number in range(samples):
        x, scan, photo = (
            0.5 * number,
            f"point_cloud/LIDAR/{number}.npz",
            f"rgb/CAMERA_01/{number}.png",
        )
        lidar = {
            "filename": scan,
            "pose": {"translation": {"x": x, "y": 0.0}, "rotation": {"qw": 1.0}},
        }
        seen = {"translation": {"x": x + 0.1, "y": 0.0, "z": 1.0}, "rotation": forward}
        camera = {"filename": photo, "pose": seen, "height": 48, "width": 64}
        data += [
            {"key": f"l{number}", "id": {"name": "LIDAR"}, "datum": {"point_cloud": lidar}},
            {"key": f"c{number}", "id": {"name": "CAMERA_01"}, "datum": {"image": camera}},
        ]
        rows.append({"calibration_key": "k", "datum_keys": [f"l{number}", f"c{number}"]})
        image(folder / photo, 48, 64)
        points = np.array([[10.1 - x, 0, 1, 7], [10.1 - x, 2, 1, 7]], np.float32)
        np.savez_compressed(folder / scan, data=points)
    calibration = {"names": ["LIDAR", "CAMERA_01"], "intrinsics": [{}, intrinsics or PINHOLE]}
    (folder / "calibration/k.json").write_text(json.dumps(calibration))
    (folder / "scene_0a.json").write_text(json.dumps({"data": data, "samples": rows}))


def read_frames(root: Path, name: str | None = None) -> list[Frame]:
    """The frames of a data set, all of which are complete."""
    _, listing = list_frames(root, name)
    if listing.broken:
        raise InputError(str(listing.broken[0]))
    return listing.frames


def ground_truth(frame: Frame) -> np.ndarray:
    """The ground truth (H, W) of a frame in metres, cut as its protocol says."""
    assert frame.gt is not None
    if isinstance(frame.gt, Hdf5Array):
        return frame.protocol.apply(depth_of(frame.gt))
    return frame.protocol.apply(read_depth(frame.gt, scale=frame.gt_scale).values)


Maker = Callable[[Path], None]
BENCHMARKS: dict[str, tuple[Maker, list[str]]] = {
    "void": (void, ["data/desktop/1553.25"]),
    "diode": (diode, ["indoors/scene_00019/scan_00183/00019_00183_indoors_000_010"]),
    "ibims": (ibims, ["corridor_01"]),
    "scannet": (scannet, [f"scene000{s}_00/{n}" for s in (0, 1) for n in (0, 2, 10)]),
    "arkitscenes": (arkitscenes, ["41069021/41069021_305.244"]),
    "hypersim": (hypersim, ["ai_001_001/cam_00_frame.0000"]),
}
"""Sets with depth of 2 m."""
MAKERS: dict[str, tuple[Maker, list[str]]] = {
    **{
        name: (lambda root, files=files: tree(root, files), names)  # type: ignore[misc]
        for name, (files, names) in TREES.items()
    },
    **BENCHMARKS,
    "tum": (tum, ["1.000", "1.033"]),
    "colmap": (colmap, ["b", "left/a"]),
    "nyu-h5": (nyu_h5, ["official_00001", "official_00009"]),
    "nyu-mat": (nyu_mat, ["0001", "0002", "0003", "0004"]),
    "nuscenes": (nuscenes, ["scene-0001/a"]),
    "ddad": (lambda root: ddad_scene(root / "000000"), [f"000000/CAMERA_01_{n}" for n in (0, 1)]),
}
