"""Data sets whose frames are found by the names of folders and files: a row each.

`7scenes`: frame-000000.color.png and frame-000000.depth.png, in the folder or in its seq-*/.
`arkitscenes`: the upsampling set, <video>/ with wide/ (color/, lowres_wide/), the phone's
lowres_depth/ and the laser scanner's highres_depth/, in millimetres.
`diode`: NAME.png, NAME_depth.npy in metres and NAME_depth_mask.npy in <scene>/<scan>/.
`hypersim`: ai_*/images/scene_cam_*_final_preview/, the tone-mapped images, and
scene_cam_*_geometry_hdf5/. depth_meters is the distance from the camera's centre; z is computed
with the focal length of a field of view of 60 degrees. The cameras of some scenes differ slightly.
`ibims`: iBims-1 as images: rgb/ depth/ mask_invalid/ mask_transp/; a depth of 65535 is 50 m.
`image-depth`: image/ (or images/) and depth/, ground truth; a calib.txt beside them is of all.
`kitti-object`: image_2/ velodyne/ calib/, in training/ or testing/.
`pairs`: rgb/ and sparse/, and optionally gt/ and calib/, with files of the same stems. Folders in
them are searched too: rgb/drive_1/000.png belongs to sparse/drive_1/000.png. calib/ has one file
per frame; a calib.txt beside the folders applies to all.
`scannet`: exported scans, color/ depth/ intrinsic/ in one or more scene*/; depth in millimetres,
smaller than the images.
`synthia`: video sequences, RGB/ and Depth/ with Stereo_*/Omni_*/ in both, or
SYNTHIA-RAND-CITYSCAPES, RGB/NNNNNNN.png and Depth/[Depth/]NNNNNNN.png, one of them or several. In
16-bit PNGs of one channel or three equal ones, in centimetres; the sky's 65535 is unknown. The
data set has no calibration that `read_calibration` reads. All images have 1280×760 pixels and
K: [532.740352, 0, 640,  0, 532.740352, 380,  0, 0, 1].
`void`: <sequence>/ with image/ sparse_depth/ ground_truth/ and K.txt, below a sequence, data/, a
density or the release; where test_image.txt lists the test split, only its frames.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.dataset import Hdf5Array
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.layouts.layout import Files, Layout, row

_SYNTHIA_HEADER = struct.pack(">II", 1280, 760)
"""Width and height in a PNG, from byte 16 on."""
_PREVIEW, _GEOMETRY = "_final_preview", "_geometry_hdf5"
_HYPERSIM_FOCAL_PX = 886.81  # of images 1024 pixels wide


def _joined(mark: str) -> Callable[[Path, Path, str], str]:
    """A function that puts the place's name and a mark before the stem, if it is not the root."""
    return lambda root, place, stem: stem if place == root else f"{place.name}{mark}{stem}"


def _below(root: Path, place: Path, stem: str) -> str:
    return (place.relative_to(root) / stem).as_posix()


def _of_void(place: Path) -> Callable[[Files], Mapping[str, Any] | None]:
    """None for a frame that is not of the test split, where that is listed."""
    split = place.parent.parent / "test_image.txt"
    if place.parent.name != "data" or not split.is_file():
        return lambda files: {}
    words = read_bytes(split).decode("utf-8", "replace").split()
    wanted = {path.stem for path in map(Path, words) if path.parts[-3:-2] == (place.name,)}
    return lambda files: {} if files["image"].stem in wanted else None


def _synthia_cameras(root: Path) -> list[Path]:
    """The folders of images that have a folder of depth."""
    cameras = []
    for rgb in sorted(p for pattern in ("RGB", "*/RGB") for p in root.glob(pattern)):
        if rgb.with_name("Depth").is_dir():
            cameras += sorted(p for p in rgb.glob("Stereo_*/Omni_*") if p.is_dir())
            # RGB and Depth are common names: numbers and size distinguish SYNTHIA-RAND
            images = (p for p in sorted(rgb.glob("*.png")) if re.fullmatch(r"\d{7}", p.stem))
            if (first := next(images, None)) is not None:
                with first.open("rb") as file:
                    header = file.read(24)
                # A file that is no PNG is reported when it is read.
                if header[16:] == _SYNTHIA_HEADER or header[:4] != b"\x89PNG":
                    cameras.append(rgb)
    return cameras


def _synthia_depth(camera: Path) -> Path:
    rgb = camera if camera.name == "RGB" else camera.parents[1]
    depth = rgb.with_name("Depth") / camera.relative_to(rgb)
    return depth / "Depth" if camera == rgb and (depth / "Depth").is_dir() else depth


def _camera_of(previews: Path) -> str:
    return previews.name.removesuffix(_PREVIEW)


def _hypersim_name(root: Path, previews: Path, stem: str) -> str:
    return f"{previews.parents[1].name}/{_camera_of(previews).removeprefix('scene_')}_{stem}"


def _of_hypersim(previews: Path) -> Callable[[Files], Mapping[str, Any]]:
    """Depth from the array, and the group."""
    group = f"{previews.parents[1].name}/{_camera_of(previews)}"
    array: dict[str, Any] = {"name": "dataset", "axes": (0, 1), "focal_px": _HYPERSIM_FOCAL_PX}
    return lambda files: {"gt": Hdf5Array(path=files["gt"], **array), "group": group}


ROWS: dict[str, Layout] = {
    "7scenes": row(
        {"image": r"(frame-[^.]+)\.color.IMAGE", "gt": r"(frame-[^.]+)\.depth.png"},
        below="|seq-*/",
        marks=("frame-*.color.*",),
        name=_joined("_"),
        calib="camera-intrinsics.txt",
        gt_scale=1000.0,
    ),
    "arkitscenes": row(
        {
            "image": "wide|color|lowres_wide/*.png",
            "sparse": "lowres_depth/*.png",
            "gt": "highres_depth/*.png?",
        },
        below="|*/|*/*/",
        name=_joined("/"),
        sparse_scale=1000.0,
        sparse_other_size=True,
        gt_scale=1000.0,
        gt_other_size=True,
    ),
    "diode": row(
        {"gt": "*_depth.npy", "image": "*.png", "mask": "*_depth_mask.npy"},
        below="|*/|*/*/|*/*/*/|*/*/*/*/",
        marks=("*_depth_mask.npy", "*_depth.npy"),
        name=_below,
    ),
    "hypersim": row(
        {"image": r"(frame\.\d+)\.tonemap.jpg", "gt": r"(frame\.\d+)\.depth_meters.hdf5"},
        places=lambda root: sorted(
            path
            for start in ("", "images/", "*/images/", "*/*/images/")
            for path in root.glob(f"{start}scene_cam_*{_PREVIEW}")
            if path.is_dir()
        ),
        folders={"gt": lambda camera: camera.with_name(_camera_of(camera) + _GEOMETRY)},
        needs=(f"images/scene_cam_*{_PREVIEW}", f"images/scene_cam_*{_GEOMETRY}"),
        name=_hypersim_name,
        more=_of_hypersim,
    ),
    "ibims": row(
        {
            "image": "rgb/*.png",
            "gt": "depth/*.png",
            "mask": "mask_invalid/*.png?",
            "mask of transparent things": "mask_transp/*.png?",
        },
        marks=("mask_invalid", "mask_transp"),
        name=_below,
        gt_scale=65535 / 50,
    ),
    "image-depth": row(
        {"image": "image|images/**.IMAGE", "gt": "depth/**.DEPTH"},
        name=_below,
        calib="calib.txt",
    ),
    "kitti-object": row(
        {"image": "image_2/*.IMAGE", "sparse": "velodyne/*.bin", "calib": "calib/*.txt"},
        below="|training/|testing/",
        name=_joined("_"),
        camera=2,
    ),
    "pairs": row(
        {
            "image": "rgb/**.IMAGE",
            "sparse": "sparse/**.SPARSE",
            "gt": "gt/**.DEPTH?",
            "calib": "calib/**.CALIB?",
        },
        name=_below,
        calib="calib.txt",
    ),
    "scannet": row(
        {"image": "color/*.IMAGE", "gt": "depth/*.png"},
        below="|*/|*/*/",
        marks=("intrinsic",),
        name=_joined("/"),
        gt_scale=1000.0,
        gt_other_size=True,
    ),
    "synthia": row(
        {"image": "*.png", "gt": "*.png"},
        places=_synthia_cameras,
        folders={"gt": _synthia_depth},
        needs=("RGB", "Depth"),
        name=lambda root, camera, stem: "_".join(
            part for part in (*camera.relative_to(root).parts, stem) if part != "RGB"
        ),
        gt_scale=100.0,
    ),
    "void": row(
        {
            "image": "image/*.png",
            "sparse": "sparse_depth/*.png",
            "gt": "ground_truth/*.png?",
        },
        below="|*/|data/*/|*/data/*/",
        marks=("sparse_depth", "ground_truth"),
        name=_below,
        calib="K.txt",
        more=_of_void,
        sparse_scale=256.0,
        gt_scale=256.0,
    ),
}
