"""A small frame and a small network on disk, for tests that go through files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from pnpdepth_cli.commands.refinement.refine_image import refine_image
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import write_depth

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
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width]
    depth = (1.5 + x / width + 0.5 * (y > height // 2)).astype(np.float32)
    rgb = np.stack([255 * x / width, 255 * y / height, 128 + 0 * x], -1).astype(np.uint8)
    image, sparse, gt = folder / "img.png", folder / "s.png", folder / "gt.png"
    cv2.imwrite(str(image), rgb)
    keep = np.zeros(depth.size, bool)
    keep[rng.permutation(depth.size)[:60]] = True
    write_depth(
        sparse, np.where(keep.reshape(depth.shape), depth, 0).astype(np.float32), scale=1000
    )
    write_depth(gt, depth, scale=1000)
    model, checkpoint = folder / "my_net.py", folder / "my_net.safetensors"
    model.write_text(NETWORK)
    space: dict[str, object] = {}
    exec(NETWORK, space)
    torch.manual_seed(0)
    state = space["Net"]().state_dict()  # type: ignore[operator]
    state["decode.weight"].abs_()  # so that z can move the depth of a whole neighbourhood
    save_file(state, checkpoint)
    return FrameOnDisk(folder, image, sparse, gt, model, checkpoint, depth)


def run(frame: FrameOnDisk, **changes: Any) -> FrameRecord:
    """The record of `pnpdepth refine` of the frame, with these changes of the request.

    The method is the network's own refinement; `propagate=None` gives the default method.
    """
    request: dict[str, Any] = {
        "image": frame.image,
        "sparse": frame.sparse,
        "output": frame.folder / "out",
        "model": str(frame.model),
        "checkpoint": frame.checkpoint,
        "propagate": None if "method" in changes else "none",
    }
    return refine_image(RefineRequest().with_fields(**(request | changes)))
