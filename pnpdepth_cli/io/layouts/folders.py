"""Data sets whose frames are found by the names of folders and files: a row each.

`7scenes`: frame-000000.color.png and frame-000000.depth.png, in the folder or in its seq-*/.
`arkitscenes`: the upsampling set, <video>/ with wide/ (color/, lowres_wide/), the phone's
lowres_depth/ and the laser scanner's highres_depth/, in millimetres.
`diode`: NAME.png, NAME_depth.npy in metres and NAME_depth_mask.npy in <scene>/<scan>/.
`ibims`: iBims-1 as images: rgb/ depth/ mask_invalid/ mask_transp/; a depth of 65535 is 50 m.
`kitti-object`: image_2/ velodyne/ calib/, in training/ or testing/.
`scannet`: exported scans, color/ depth/ intrinsic/ in one or more scene*/; depth in millimetres,
smaller than the images.
`void`: <sequence>/ with image/ sparse_depth/ ground_truth/ and K.txt, below a sequence, data/, a
density or the release; where test_image.txt lists the test split, only its frames.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.layouts.layout import (
    BIN,
    IMAGE,
    TXT,
    Layout,
    Part,
    Parts,
    of_folders,
)


def beside(place: Path, file: str) -> dict[str, Path]:
    """Returns the calibration that all frames of a place share, if there is one."""
    return {"calib": place / file} if (place / file).is_file() else {}


def _name(mark: str) -> Any:
    """A function that puts the place's name and a mark before the stem, if it is not the root."""
    return lambda root, place, stem: stem if place == root else f"{place.name}{mark}{stem}"


def _below(root: Path, place: Path, stem: str) -> str:
    return (place.relative_to(root) / stem).as_posix()


def _masks_of_ibims(root: Path, place: Path, files: Parts) -> Mapping[str, Any]:
    masks = [place / name / files["image"].name for name in ("mask_invalid", "mask_transp")]
    return {"masks": tuple(mask for mask in masks if mask.is_file())}


def _of_void(root: Path, place: Path, files: Parts) -> Mapping[str, Any] | None:
    """The calibration; None for a frame that is not of the test split, where that is listed."""
    split = place.parent.parent / "test_image.txt"
    if place.parent.name == "data" and split.is_file():
        wanted = _test_split(split, split.stat().st_mtime_ns)
        if (place.name, files["image"].stem) not in wanted:
            return None
    return beside(place, "K.txt")


@functools.lru_cache(maxsize=1)
def _test_split(path: Path, changed_ns: int) -> set[tuple[str, str]]:
    """(sequence, stem) of the frames of the test split; kept for the next frame."""
    listed = (Path(line) for line in read_bytes(path).decode("utf-8", "replace").split())
    return {(each.parts[-3], each.stem) for each in listed if len(each.parts) >= 3}


def _number(text: str) -> tuple[int, str]:
    return len(text), text


ROWS: dict[str, Layout] = {
    "7scenes": of_folders(
        {
            "image": Part("", r"(frame-[^.]+)\.color\." + IMAGE.partition(r"\.")[2]),
            "gt": Part("", r"(frame-[^.]+)\.depth\.png"),
        },
        below=("", "seq-*/"),
        probe="frame-*.color.*",
        needs=("frame-*.color.*",),
        name=_name("_"),
        more=lambda root, place, files: beside(root, "camera-intrinsics.txt"),
        gt_scale=1000.0,
    ),
    "arkitscenes": of_folders(
        {
            "image": Part("wide|color|lowres_wide"),
            "sparse": Part("lowres_depth"),
            "gt": Part("highres_depth", optional=True),
        },
        below=("", "*/", "*/*/"),
        probe="lowres_depth",
        needs=("*/wide", "*/lowres_depth", "*/highres_depth"),
        name=_name("/"),
        sparse_scale=1000.0,
        sparse_other_size=True,
        gt_scale=1000.0,
        gt_other_size=True,
    ),
    "ibims": of_folders(
        {"image": Part("rgb"), "gt": Part("depth")},
        probe="mask_invalid",
        marks=("mask_transp",),
        needs=("rgb", "depth", "mask_invalid", "mask_transp"),
        name=_name("/"),
        more=_masks_of_ibims,
        gt_scale=65535 / 50,
    ),
    "kitti-object": of_folders(
        {
            "image": Part("image_2", IMAGE),
            "sparse": Part("velodyne", BIN),
            "calib": Part("calib", TXT),
        },
        below=("", "training/", "testing/"),
        probe="velodyne",
        needs=("image_2", "velodyne", "calib"),
        name=_name("_"),
        spare=("sparse",),
        camera=2,
    ),
    "scannet": of_folders(
        {"image": Part("color", IMAGE), "gt": Part("depth")},
        below=("", "*/", "*/*/"),
        probe="intrinsic",
        needs=("color", "depth", "intrinsic"),
        name=_name("/"),
        gt_scale=1000.0,
        gt_other_size=True,
        order=_number,
    ),
    "void": of_folders(
        {
            "image": Part("image"),
            "sparse": Part("sparse_depth"),
            "gt": Part("ground_truth", optional=True),
        },
        below=("", "*/", "data/*/", "*/data/*/"),
        probe="sparse_depth",
        marks=("ground_truth",),
        needs=("image", "sparse_depth", "ground_truth"),
        name=_below,
        more=_of_void,
        sparse_scale=256.0,
        gt_scale=256.0,
    ),
    "diode": of_folders(
        {
            "gt": Part("", r"(.+)_depth\.npy"),
            "image": Part("", r"(.+)\.png"),
            "mask": Part("", r"(.+)_depth_mask\.npy"),
        },
        below=("", "*/", "*/*/", "*/*/*/", "*/*/*/*/"),
        probe="*_depth.npy",
        needs=("*_depth.npy", "*_depth_mask.npy"),
        name=_below,
    ),
}
