"""One valid file of each kind, and the command line that reads it."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.numpy import save_file
from torch import nn

from pnpdepth_cli.io.depth_writing import write_depth

HEIGHT, WIDTH = 24, 32
OUT = ("-o", "out.png", "--overwrite")


@dataclass(frozen=True, kw_only=True)
class Seed:
    """A valid file, and a command that reads it."""

    file: str
    """The file that is damaged, relative to the working folder."""
    command: tuple[str, ...]
    """Arguments of `pnpdepth`."""
    scratch: tuple[str, ...] = field(default=("out.png", "out.json", "out.safetensors"))
    """Files that the command may write."""


def write_seeds(folder: Path) -> list[Seed]:
    """Writes a valid file of each kind into the folder and returns them, in a fixed order."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 9, (HEIGHT, WIDTH)).astype(np.float32)
    _write_common(folder, depth, rng)
    seeds: list[Seed] = []
    for writer in (_depths, _images, _scans, _texts, _records, _checkpoints, _networks):
        seeds += writer(folder, depth, rng)
    return seeds


def _write_common(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> None:
    """The valid files that commands need beside the damaged one."""
    np.save(folder / "gt.npy", depth)
    (folder / "k.txt").write_text(f"30 0 {WIDTH / 2} 0 30 {HEIGHT / 2} 0 0 1\n")
    (folder / "calib.txt").write_text(
        f"K: 30 0 {WIDTH / 2} 0 30 {HEIGHT / 2} 0 0 1\nR: 0 -1 0 0 0 -1 1 0 0\nt: 0 0 0\n"
    )
    _points(rng).tofile(folder / "good.bin")
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "rgb.png"), image)
    write_depth(folder / "sparse.png", np.where(rng.random(depth.shape) < 0.1, depth, 0))


def _points(rng: np.random.Generator) -> np.ndarray:
    xyz = rng.uniform((5, -3, -2), (30, 3, 2), (200, 3))
    return np.column_stack([xyz, rng.uniform(0, 1, 200)]).astype(np.float32)


def _depths(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    names = [f"depth.{suffix}" for suffix in ("png", "exr", "npy", "npz", "pfm", "tif")]
    for name in names:
        write_depth(folder / name, depth)
    cv2.imwrite(str(folder / "double.tif"), depth.astype(np.float64))
    points = np.column_stack([rng.uniform(0, 20, (30, 2)), rng.uniform(1, 9, 30)])
    np.savetxt(folder / "points.csv", points, delimiter=",", header="x,y,depth", comments="")
    np.save(folder / "points.npy", points)
    np.save(folder / "stack.npy", np.stack([depth, depth]))
    np.savez(folder / "gt_depths.npz", data=np.stack([depth, depth]))
    return [
        *(
            Seed(file=name, command=("sample", name, "--count", "20", *OUT))
            for name in (*names, "double.tif")
        ),
        *(
            Seed(file=name, command=("eval", "gt.npy", "gt.npy", "--sparse", name))
            for name in ("points.csv", "points.npy")
        ),
        Seed(file="stack.npy", command=("eval", "stack.npy", "stack.npy")),
        Seed(file="gt_depths.npz", command=("eval", "stack.npy", "gt_depths.npz")),
    ]


def _images(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    names = [f"image.{suffix}" for suffix in ("png", "jpg", "webp", "tif")]
    for name in names:
        cv2.imwrite(str(folder / name), image)
    features = ("--pattern", "features", "--count", "5")
    return [
        Seed(file=name, command=("sample", "gt.npy", *features, "--image", name, *OUT))
        for name in names
    ]


def _scans(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    points = _points(rng)
    points.tofile(folder / "scan.bin")
    np.save(folder / "scan.npy", points)
    rows = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in points)
    pcd = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        "COUNT 1 1 1 1\nWIDTH 200\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 200\n"
    )
    (folder / "ascii.pcd").write_text(f"{pcd}DATA ascii\n{rows}\n")
    (folder / "binary.pcd").write_bytes(f"{pcd}DATA binary\n".encode() + points.tobytes())
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    ply = f"ply\nformat {{}} 1.0\nelement vertex 200\n{properties}end_header\n"
    (folder / "ascii.ply").write_text(ply.format("ascii") + rows + "\n")
    (folder / "binary.ply").write_bytes(
        ply.format("binary_little_endian").encode() + points.tobytes()
    )
    names = ("scan.bin", "scan.npy", "ascii.pcd", "binary.pcd", "ascii.ply", "binary.ply")
    size = ("--size", f"{HEIGHT}x{WIDTH}")
    return [
        Seed(file=name, command=("project", name, "--calib", "calib.txt", *size, *OUT))
        for name in names
    ]


def _texts(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    p2 = f"30 0 {WIDTH / 2} 0 0 30 {HEIGHT / 2} 0 0 0 1 0"
    (folder / "kitti.txt").write_text(
        "".join(f"P{n}: {p2}\n" for n in range(4))
        + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    (folder / "own.txt").write_bytes((folder / "calib.txt").read_bytes())
    (folder / "lidar.toml").write_text(
        "elevations_deg = [10, 5, 0, -5, -10]\nazimuth_step_deg = 0.5\nmax_range = 80\n"
        "range_noise = 0.02\n"
    )
    (folder / "frames.csv").write_text("image,sparse,gt,name\nrgb.png,sparse.png,gt.npy,a\n")
    (folder / "frames.jsonl").write_text('{"image": "rgb.png", "sparse": "sparse.png"}\n')
    size = ("--size", f"{HEIGHT}x{WIDTH}")
    simulate = ("simulate", "gt.npy", "--sensor", "lidar.toml", "--calib", "k.txt", *OUT)
    return [
        *(
            Seed(file=name, command=("project", "good.bin", "--calib", name, *size, *OUT))
            for name in ("kitti.txt", "own.txt")
        ),
        Seed(file="lidar.toml", command=simulate),
        *(
            Seed(file=name, command=("batch", name, "-o", "batch", "--dry-run"))
            for name in ("frames.csv", "frames.jsonl")
        ),
    ]


def _records(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    from pnpdepth_cli.cli.main import run

    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(io.StringIO()):
        run(["eval", "stack.npy", "gt_depths.npz", "--json"])
    for name in ("run.json", "other.json"):
        (folder / name).write_text(text.getvalue())
    return [Seed(file="run.json", command=("compare", "run.json", "other.json"))]


def _checkpoints(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    tensors = {"a.weight": rng.normal(size=(4, 3)).astype(np.float32), "a.bias": np.zeros(4)}
    save_file(tensors, str(folder / "net.safetensors"))
    state = {name: torch.from_numpy(value) for name, value in tensors.items()}
    torch.save({"state_dict": state, "epoch": 3}, folder / "net.pt")
    torch.save(state, folder / "old.pth", _use_new_zipfile_serialization=False)
    np.savez(folder / "net.npz", **tensors)
    np.save(folder / "net.npy", np.array(tensors, dtype=object), allow_pickle=True)
    from tests.models.weights.test_tensor_bundle import written

    names = ["net.safetensors", "net.pt", "old.pth", "net.npz", "net.npy", written(folder).name]
    return [
        Seed(file=name, command=("models", "convert", name, "out.safetensors", "--overwrite"))
        for name in names
    ]


def _networks(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    seeds = []
    writers: tuple[tuple[str, Callable[[Path], None]], ...] = (
        ("net.onnx", _write_onnx),
        ("net.pt2", _write_exported),
    )
    for name, write in writers:
        try:
            write(folder / name)
        except ImportError:  # the extra is not installed
            continue
        seeds.append(Seed(file=name, command=("models", "check", name)))
    return seeds


def _write_onnx(path: Path) -> None:
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    shape = [1, 3, HEIGHT, WIDTH]
    weight = np.full((1, 3, 3, 3), 0.1, np.float32)
    nodes = [
        helper.make_node("Conv", ["x", "w"], ["c"], pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["c"], ["r"]),
        helper.make_node("Reshape", ["r", "s"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "net",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 1, HEIGHT, WIDTH])],
        [
            numpy_helper.from_array(weight, "w"),
            numpy_helper.from_array(np.array([1, 1, HEIGHT, WIDTH]), "s"),
        ],
    )
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), path)


def _write_exported(path: Path) -> None:
    network = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.ReLU(), nn.Conv2d(4, 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(network.eval(), (torch.rand(1, 3, HEIGHT, WIDTH),))
        torch.export.save(program, path)
