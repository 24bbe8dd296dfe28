"""A small frame and a small network on disk, for tests that go through files; a scan of a wall."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from pnpdepth_cli.commands.refine import refine_image
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.models.registry import find_definition

NETWORK = """
import torch
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.encode = nn.Sequential(nn.Conv2d(3, 8, 3, 2, 1), nn.ReLU(inplace=True))
        self.middle = nn.Conv2d(8, 8, 3, 1, 1)
        self.unused = nn.Conv2d(1, 1, 1)
        self.decode = nn.ConvTranspose2d(8, 1, 4, 2, 1)

    def forward(self, rgb):
        return 2 + 3 * self.decode(torch.tanh(self.middle(self.encode(rgb))))

definition = ModelDefinition(
    name="tiny", input_kind="rgb", size=Multiple(4), build=Net, layers=("encode", "middle"),
    defaults=Settings(layer="middle"),
)
"""
FOCAL_PX, HEIGHT, WIDTH = 60.0, 48, 64
CALIBRATION = f"""K: [{FOCAL_PX}, 0, 31.5, 0, {FOCAL_PX}, 23.5, 0, 0, 1]
R: [0, -1, 0, 0, 0, -1, 1, 0, 0]
t: [0.1, -0.05, -0.2]
"""


@dataclass(frozen=True)
class FrameOnDisk:
    """Files of one frame, with the arrays that are in them."""

    folder: Path
    image: Path
    sparse: Path
    gt: Path
    model: Path
    checkpoint: Path
    depth: NDArray[np.float32]


def frame_on_disk(folder: Path, height: int = 46, width: int = 62) -> FrameOnDisk:
    y, x = np.mgrid[:height, :width]
    depth = (1.5 + x / width + 0.5 * (y > height // 2)).astype(np.float32)
    rgb = np.stack([255 * x / width, 255 * y / height, 128 + 0 * x], -1).astype(np.uint8)
    image, sparse, gt = folder / "img.png", folder / "s.png", folder / "gt.png"
    cv2.imwrite(str(image), rgb)
    points = np.random.default_rng(0).permutation(depth.size)[:60]
    thin = np.zeros_like(depth)
    thin.flat[points] = depth.flat[points]
    write_depth(sparse, thin, scale=1000)
    write_depth(gt, depth, scale=1000)
    model, checkpoint = folder / "my_net.py", folder / "my_net.safetensors"
    model.write_text(NETWORK)
    torch.manual_seed(0)
    state = find_definition(str(model)).build().state_dict()
    state["decode.weight"].abs_()  # so that z can move the depth of a whole neighbourhood
    save_file(state, checkpoint)
    return FrameOnDisk(folder, image, sparse, gt, model, checkpoint, depth)


def run(frame: FrameOnDisk, **changes: Any) -> FrameRecord:
    """The record of the frame, by default refined by the paper's method."""
    request: dict[str, Any] = {
        "image": frame.image,
        "sparse": frame.sparse,
        "output": frame.folder / "out",
        "model": str(frame.model),
        "checkpoint": frame.checkpoint,
        "method": "paper",
    }
    return refine_image(RefineRequest().with_fields(**(request | changes)))


@dataclass(frozen=True)
class ScanOnDisk:
    """Files of one frame; xy (N, 2) are the pixel coordinates of the scan's points."""

    folder: Path
    image: Path
    scan: Path
    calib: Path
    gt: Path
    xy: NDArray[np.float64]
    depth: NDArray[np.float64]


def scan_on_disk(folder: Path) -> ScanOnDisk:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image, scan, calib, gt = (folder / n for n in ("img.png", "img.bin", "calib.txt", "gt.png"))
    rgb = np.stack([255 * x / WIDTH, 255 * y / HEIGHT, 128 + 0 * x], -1).astype(np.uint8)
    cv2.imwrite(str(image), rgb)
    write_depth(gt, (4 + 0.02 * x).astype(np.float32), scale=1000)
    pixels = rng.permutation(HEIGHT * WIDTH)[:150]
    xy = np.column_stack([pixels % WIDTH, pixels // WIDTH]) + rng.uniform(-0.4, 0.4, (150, 2))
    depth = 4 + 0.02 * xy[:, 0]
    in_camera = np.column_stack([(xy - [31.5, 23.5]) / FOCAL_PX, np.ones(150)]) * depth[:, None]
    points = (in_camera - [0.1, -0.05, -0.2]) @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    np.column_stack([points, np.zeros(150)]).astype("<f4").tofile(scan)
    calib.write_text(CALIBRATION)
    return ScanOnDisk(folder, image, scan, calib, gt, xy, depth)
