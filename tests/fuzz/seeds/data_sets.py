"""Manifests, and the index files of every layout that has one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pnpdepth_cli.io.depth import write_depth
from tests.colmap_models import write_binary_model, write_text_model
from tests.data_sets import tum, void
from tests.fuzz.seeds.seed import LISTING, Seed

_SAMPLED = ("--sample", "20")
"""For layouts without sparse depth."""

_POSE = "1 0 0 {} 0 1 0 0 0 0 1 0\n"


def write_seeds(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    """Returns what a batch reads before its first frame, and the arrays in HDF5 files."""
    image = (folder / "rgb.png").read_bytes()
    parts = (_manifests, _colmap, _tum, _odometry, _void)
    return [
        *(seed for part in parts for seed in part(folder, image)),
        *_with_h5py(folder, image, depth),
    ]


def _indices(*files: str, options: tuple[str, ...] = ()) -> list[Seed]:
    """Files that listing the frames of their uppermost folder reads."""
    return [Seed(file=f, command=("batch", f.split("/")[0], *LISTING, *options)) for f in files]


def _write_all(folder: Path, content: bytes, *files: str) -> None:
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(content)


def _manifests(folder: Path, image: bytes) -> list[Seed]:
    (folder / "frames.csv").write_text("image,sparse,gt,name\nrgb.png,sparse.png,gt.npy,a\n")
    (folder / "frames.jsonl").write_text('{"image": "rgb.png", "sparse": "sparse.png"}\n')
    return _indices("frames.csv", "frames.jsonl")


def _colmap(folder: Path, image: bytes) -> list[Seed]:
    """Models as layouts, and one whose points are projected."""
    write_text_model(folder / "photos/sparse/0")
    _write_all(folder / "photos/images", image, "a.png", "b.png", "c.png")
    write_binary_model(folder / "binary/sparse/0")
    _write_all(folder / "binary/images/dir", image, "1.png", "2.png")
    write_text_model(folder / "model")
    text, binary = (
        [f"sparse/0/{part}.{suffix}" for part in ("cameras", "images", "points3D")]
        for suffix in ("txt", "bin")
    )
    network = "--model fcrn-tiny --propagate none --iterations 1"
    refine = f"refine photos/images/a.png --sparse model {network}".split()
    return [
        *_indices(*(f"photos/{name}" for name in text), *(f"binary/{name}" for name in binary)),
        *(
            Seed(file=f"model/{Path(name).name}", command=(*refine, "-o", "refined"))
            for name in text
        ),
    ]


def _tum(folder: Path, image: bytes) -> list[Seed]:
    _write_all(folder / "tum", image, "rgb/1.000.png", "rgb/1.033.png")
    _write_all(folder / "tum", image, "rgb/2.png", "depth/1.015.png", "depth/1.030.png")
    tum(folder / "tum")
    _write_all(folder / "associated", image, "rgb/0.png", "depth/0.png")
    (folder / "associated/associations.txt").write_text("0 depth/0.png 0 rgb/0.png\n")
    files = ("tum/rgb.txt", "tum/depth.txt", "associated/associations.txt")
    return _indices(*files, options=_SAMPLED)


def _odometry(folder: Path, image: bytes) -> list[Seed]:
    numbers = (0, 1)
    sequence = folder / "odometry/sequences/00"
    _write_all(sequence, image, *(f"image_2/{n:06}.png" for n in numbers))
    scan = (folder / "good.bin").read_bytes()
    _write_all(sequence, scan, *(f"velodyne/{n:06}.bin" for n in numbers))
    (sequence / "calib.txt").write_text("P2: 30 0 16 0 0 30 12 0 0 0 1 0\n")
    poses = "".join(_POSE.format(n) for n in numbers)
    _write_all(folder, poses.encode(), "odometry/poses/00.txt")
    return _indices("odometry/poses/00.txt")


def _void(folder: Path, image: bytes) -> list[Seed]:
    void(folder / "void")
    return _indices("void/test_image.txt")


def _with_h5py(folder: Path, image: bytes, depth: np.ndarray) -> list[Seed]:
    """HDF5 as ground truth; none if h5py is not installed."""
    try:
        import h5py
    except ImportError:
        return []
    seeds = []
    writers: tuple[tuple[str, str, Callable[[Path], None]], ...] = (
        ("h5", "00001", lambda root: _write_h5(h5py, root / "00001.h5")),
        ("labeled", "0002", lambda root: _write_labeled(h5py, root)),
    )
    for name, frame, write in writers:
        (folder / name).mkdir()
        write(folder / name)
        prediction = folder / f"{name}_pred" / f"{frame}.npy"
        prediction.parent.mkdir(parents=True)
        write_depth(prediction, np.full((228, 304), 2.0, np.float32))
        (file,) = [p for p in (folder / name).iterdir() if p.suffix in (".h5", ".mat")]
        command = ("eval", prediction.parent.name, name)
        seeds.append(Seed(file=file.relative_to(folder).as_posix(), command=command))
    (folder / "labeled/test.txt").write_text("2\n")
    return [*seeds, *_indices("labeled/test.txt", options=_SAMPLED)]


def _write_h5(h5py: object, path: Path) -> None:
    with h5py.File(path, "w") as file:  # type: ignore[attr-defined]
        pixels = {"compression": "gzip"}
        file.create_dataset("rgb", data=np.ones((3, 480, 640), np.uint8), **pixels)
        file.create_dataset("depth", data=np.full((480, 640), 2.0, np.float32), **pixels)


def _write_labeled(h5py: object, root: Path) -> None:
    with h5py.File(root / "nyu_depth_v2_labeled.mat", "w") as file:  # type: ignore[attr-defined]
        pixels = {"compression": "gzip"}
        file.create_dataset("images", data=np.ones((2, 3, 640, 480), np.uint8), **pixels)
        file.create_dataset("depths", data=np.full((2, 640, 480), 2.0, np.float32), **pixels)
