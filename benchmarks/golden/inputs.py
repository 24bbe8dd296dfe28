"""Writes the small inputs that the commands read."""

from __future__ import annotations

import json
import math
import re
import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

Array = NDArray[Any]
ROOT = Path(__file__).resolve().parents[2]

_MY_NET = '''"""A small network of a user."""

import torch
from torch import nn


class MyNet(nn.Module):
    def __init__(self):
        super().__init__()
        self.encode = nn.Conv2d(3, 8, 3, stride=2, padding=1)
        self.decode = nn.ConvTranspose2d(8, 1, 4, stride=2, padding=1)

    def forward(self, rgb):
        return 3 + self.decode(torch.tanh(self.encode(rgb)))


class Exploding(MyNet):
    def forward(self, rgb):
        return torch.exp(self.decode(self.encode(rgb)))


def make():
    return MyNet()
'''
_DEFINITION = """
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

definition = ModelDefinition(
    name="my-net", input_kind="rgb", size=Multiple(2), build=MyNet, layers=("encode",)
)
"""
_LIDAR = """elevations_deg = [4, 2, 0, -2, -4, -6, -8, -12]
azimuth_step_deg = 0.4
max_range = 60
range_noise = 0.02
"""


_PREPROCESSOR = {
    "image_processor_type": "DPTImageProcessor",
    "do_resize": True,
    "size": {"height": 56, "width": 56},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "resample": 3,
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_normalize": True,
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
}


def make_inputs(root: Path, shared: Path | None = None) -> None:
    """Writes the small inputs of all commands into `root`, from the samples and the real frames.

    Leaves threads of torch behind.
    """
    shutil.copytree(ROOT / "samples", root, dirs_exist_ok=True)
    indoor = {name: Image.open(root / "indoor" / f"{name}.png") for name in ("rgb", "gt")}
    rgb = np.asarray(indoor["rgb"].convert("RGB"))
    gt = np.asarray(indoor["gt"]).astype(np.uint16)
    small, gt_values = _quarter(rgb), gt[2::4, 2::4]
    sparse = _some_of(gt_values, 150)
    _save(root / "small" / "rgb.png", small)
    _save(root / "small" / "gt.png", gt_values, scale=1000)
    _save(root / "small" / "sparse.png", sparse, scale=1000)
    _save(root / "grey.png", np.round(small.mean(axis=2)).astype(np.uint8))
    _points(root / "few.csv", sparse, every=8)
    _points(root / "points.csv", gt, every=len(np.argwhere(gt)) // 200)
    np.savez(
        root / "sparse.npz", depth=sparse / np.float32(1000), other=gt_values / np.float32(1000)
    )
    np.save(root / "empty.npy", np.zeros((120, 160), np.float32))
    (root / "empty").mkdir()
    (root / "broken.png").write_bytes((root / "small" / "rgb.png").read_bytes()[:500])
    (root / "lidar.toml").write_text(_LIDAR)
    _make_pairs(root, rgb, gt)
    _make_street(root)
    _make_layouts(root, rgb, gt)
    _make_networks(root)
    if shared is not None:
        (root.parent / "shared").symlink_to(shared, target_is_directory=True)
        for kind in ("image", "velodyne_raw", "groundtruth"):
            folder = shared / "kitti_dc" / kind
            frame = np.asarray(Image.open(next(folder.glob("0000000005.*"))))
            part = frame[150:310, 400:720]
            scale = None if kind == "image" else 256
            part = part if kind == "image" else part.astype(np.uint16)
            _save(root / "kitti_small" / kind / "0000000005.png", part, scale=scale)


def _save(path: Path, values: Array, *, scale: int | None = None) -> None:
    """A PNG; with a scale one of depth that says it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = PngInfo()
    if scale is not None:
        text.add_text("pnpdepth:scale", str(scale))
    Image.fromarray(np.ascontiguousarray(values)).save(path, pnginfo=text)


def _quarter(rgb: Array) -> Array:
    height, width = (side // 4 for side in rgb.shape[:2])
    blocks = rgb[: 4 * height, : 4 * width].reshape(height, 4, width, 4, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def _some_of(gt_values: Array, count: int, seed: int = 0) -> Array:
    """The ground truth at `count` random pixels, 0 elsewhere."""
    rows, columns = np.nonzero(gt_values)
    indices = np.random.default_rng(seed).choice(len(rows), min(count, len(rows)), replace=False)
    sparse = np.zeros_like(gt_values)
    sparse[rows[indices], columns[indices]] = gt_values[rows[indices], columns[indices]]
    return sparse


def _points(path: Path, depth: Array, every: int) -> None:
    rows, columns = (index[::every] for index in np.nonzero(depth))
    lines = [
        f"{x}.25 {y} {depth[y, x] / 1000}"
        for y, x in zip(rows.tolist(), columns.tolist(), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")


def _make_pairs(root: Path, rgb: Array, gt: Array) -> None:
    """Five frames of 96×72, of which one is in a folder, nine of 48×32, and lists of frames."""
    rows = []
    for number, name in enumerate(("a", "b", "c", "d", "deep/e")):
        top, left = 40 * number, 80 * number
        part = np.s_[top : top + 288 : 4, left : left + 384 : 4]
        image = _quarter(rgb[top : top + 288, left : left + 384])
        sparse = _some_of(gt[part], 80, seed=number)
        _save(root / "pairs" / "rgb" / f"{name}.png", image)
        _save(root / "pairs" / "sparse" / f"{name}.png", sparse, scale=1000)
        _save(root / "pairs" / "gt" / f"{name}.png", gt[part], scale=1000)
        rows.append({"image": f"pairs/rgb/{name}.png", "sparse": f"pairs/sparse/{name}.png"})
    for number in range(9):
        part = np.s_[10 * number : 10 * number + 64 : 2, 30 * number : 30 * number + 96 : 2]
        _save(root / "many" / "rgb" / f"{number}.png", rgb[part])
        _save(root / "many" / "sparse" / f"{number}.png", _some_of(gt[part], 40), scale=1000)
    with (root / "frames.jsonl").open("w") as lines:
        for number, row in enumerate(rows[:2]):
            gt_of = row["image"].replace("rgb", "gt")
            lines.write(json.dumps(row | {"name": f"frame {number}", "gt": gt_of}) + "\n")
    with (root / "broken.csv").open("w") as file:
        file.write("name,image,sparse,gt\n")
        file.write(f"good,{rows[0]['image']},{rows[0]['sparse']},pairs/gt/a.png\n")
        file.write(f"damaged,broken.png,{rows[0]['sparse']},\n")
        file.write(f"absent,pairs/rgb/none.png,{rows[0]['sparse']},\n")
        file.write(f"empty,{rows[1]['image']},empty.npy,\n")


def _make_street(root: Path) -> None:
    """A window of the street, with the calibration that belongs to it."""
    rows, columns = slice(150, 342), slice(300, 940)
    for name in ("rgb", "gt", "sparse"):
        with Image.open(root / "street" / f"{name}.png") as image:
            values = np.asarray(image)[rows, columns]
        scale = None if name == "rgb" else 256
        values = values if name == "rgb" else values.astype(np.uint16)
        _save(root / "street_small" / f"{name}.png", values, scale=scale)
    shutil.copy(root / "street" / "000000.bin", root / "street_small" / "000000.bin")
    lines = []
    for line in (root / "street" / "calib.txt").read_text().splitlines():
        key, _, numbers = line.partition(":")
        matrix = np.array([float(number) for number in numbers.split()])
        if re.fullmatch(r"P\d", key):
            matrix = matrix.reshape(3, 4)
            matrix[0] -= columns.start * matrix[2]
            matrix[1] -= rows.start * matrix[2]
        lines.append(f"{key}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}")
    (root / "street_small" / "calib.txt").write_text("\n".join(lines) + "\n")


def _make_layouts(root: Path, rgb: Array, gt: Array) -> None:
    """A tiny folder in each layout."""
    import h5py

    folder, street = root / "layouts", root / "street_small"
    small, depth = rgb[:240:2, :320:2], gt[:240:2, :320:2]
    _save(folder / "7scenes" / "frame-000000.color.png", small)
    _save(folder / "7scenes" / "frame-000000.depth.png", depth)
    _save(folder / "7scenes" / "frame-000010.color.png", small)
    _save(folder / "tum" / "rgb" / "1.000.png", small)
    _save(folder / "tum" / "depth" / "1.010.png", depth * 5)
    (folder / "tum" / "rgb.txt").write_text("# time path\n1.000 rgb/1.000.png\n2.0 rgb/2.png\n")
    (folder / "tum" / "depth.txt").write_text("1.010 depth/1.010.png\n")
    for kind, values in (("RGB", small), ("Depth", depth // 10)):
        _save(folder / "synthia" / kind / "Stereo_Left" / "Omni_F" / "000001.png", values)
    for name in ("nyu-h5", "nyu-mat"):
        (folder / name).mkdir(parents=True)
    with h5py.File(folder / "nyu-h5" / "00001.h5", "w") as file:
        file["rgb"], file["depth"] = np.moveaxis(small, 2, 0), depth.astype(np.float32) / 1000
    with h5py.File(folder / "nyu-mat" / "nyu_depth_v2_labeled.mat", "w") as file:
        file["images"] = np.stack([small, small[:, ::-1]]).transpose(0, 3, 2, 1)
        file["depths"] = np.stack([depth, depth[:, ::-1]]).transpose(0, 2, 1).astype("f4") / 1000
    (folder / "nyu-mat" / "test.txt").write_text("2\n")
    kitti = folder / "kitti-object" / "training"
    for relative, source in (
        ("image_2/000000.png", "rgb.png"),
        ("velodyne/000000.bin", "000000.bin"),
    ):
        for part in (kitti, folder / "kitti-odometry" / "sequences" / "00"):
            (part / relative).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(street / source, part / relative)
    (kitti / "calib").mkdir()
    shutil.copy(street / "calib.txt", kitti / "calib" / "000000.txt")
    lines = (street / "calib.txt").read_text().replace("Tr_velo_to_cam", "Tr").splitlines()
    wanted = [line for line in lines if line.startswith(("P", "Tr:"))]
    odometry = folder / "kitti-odometry"
    (odometry / "sequences" / "00" / "calib.txt").write_text("\n".join(wanted) + "\n")
    (odometry / "poses").mkdir()
    (odometry / "poses" / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    selection, drive = folder / "kitti-depth", "2011_09_26_drive_0001_sync"
    name = f"{drive}_{{}}_0000000005_image_02.png"
    tree = folder / "kitti-tree" / drive
    for source, kind, relative in (
        ("rgb", "image", "image_02/data"),
        ("sparse", "velodyne_raw", "proj_depth/velodyne_raw/image_02"),
        ("gt", "groundtruth_depth", "proj_depth/groundtruth/image_02"),
    ):
        for path in (selection / kind / name.format(kind), tree / relative / "0000000005.png"):
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(street / f"{source}.png", path)
    (selection / "intrinsics").mkdir()
    (selection / "intrinsics" / name.format("image").replace(".png", ".txt")).write_text(
        "721.54 0 309.56 0 721.54 22.85 0 0 1\n"
    )


def _make_networks(root: Path) -> None:
    """A user's network with weights, an exported one, and a Hugging Face folder."""
    import torch
    from safetensors.torch import save_file

    (root / "my_net.py").write_text(_MY_NET)
    (root / "my_definition.py").write_text(_MY_NET + _DEFINITION)
    (root / "broken.py").write_text("import nothing_of_this_name\n")
    namespace = runpy.run_path(str(root / "my_net.py"))
    net = _with_weights(namespace["MyNet"]())
    weights = {name: value.detach() for name, value in net.state_dict().items()}
    save_file(weights, root / "my_net.safetensors")
    torch.save({"epoch": 3, "state_dict": weights}, root / "my_net.pt")
    other = {name.replace("encode", "encoder"): value for name, value in weights.items()}
    save_file(other, root / "other.safetensors")
    dim: Any = torch.export.Dim
    sides = {2: 2 * dim("rows", min=8), 3: 2 * dim("columns", min=8)}
    program = torch.export.export(net.eval(), (torch.zeros(1, 3, 64, 96),), dynamic_shapes=(sides,))
    torch.export.save(program, root / "net.pt2")
    try:
        import transformers
    except ImportError:
        return
    transformers.utils.logging.disable_progress_bar()  # whose monitor is a thread that stays
    backbone = transformers.Dinov2Config(
        hidden_size=24, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=24, head_hidden_size=8, patch_size=14,
        depth_estimation_type="relative", neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8,
    )  # fmt: skip
    model = _with_weights(transformers.DepthAnythingForDepthEstimation(config))
    model.save_pretrained(root / "depth_anything")
    (root / "depth_anything" / "preprocessor_config.json").write_text(json.dumps(_PREPROCESSOR))


def _with_weights(net: Any) -> Any:
    """The network with weights that are the same everywhere, and drawn by nobody's generator."""
    import torch

    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if name.endswith("bias"):
                parameter.zero_()
            elif parameter.ndim > 1:
                count = parameter.numel()
                waves = torch.sin(torch.arange(count, dtype=torch.float64) * 12.9898) * 43758.5453
                values = (waves - waves.floor() - 0.5) / math.sqrt(count / len(parameter) / 3)
                parameter.copy_(values.reshape(parameter.shape).float())
    return net
