"""eigen: two published files make one network."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from model_zoo_defs.eigen import Eigen, definitions
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.models.weights import load_checkpoint

COARSE = {
    "conv1": (6, 3, 11, 11), "conv2": (8, 6, 5, 5), "conv3": (10, 8, 3, 3),
    "conv4": (9, 10, 3, 3), "conv5": (7, 9, 3, 3), "fc1": (20, 7 * 6 * 8), "fc2": (4070, 20),
}  # fmt: skip
FINE = {"conv1": (11, 3, 9, 9), "conv2": (12, 12, 5, 5), "conv3": (1, 12, 5, 5)}


def weights(shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    torch.manual_seed(1)
    state = {}
    for name, shape in shapes.items():
        state[f"{name}.weight"] = torch.randn(shape) / (shape[1] * 9) ** 0.5
        state[f"{name}.bias"] = torch.randn(shape[0]) * 0.1
    return state


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eigen")
    torch.save(weights(COARSE), folder / "coarse_model_12.pth")
    torch.save(weights(FINE), folder / "fine_model_7.pth")
    return folder


def test_a_folder_with_both_published_files_loads_and_gives_log_depth(folder: Path) -> None:
    network = Eigen(channels=(6, 8, 10, 9, 7), hidden=20, fine=12).eval()
    notes = load_checkpoint(network, definitions["eigen"], folder)
    assert "coarse_model_12.pth, fine_model_7.pth" in notes[0]
    coarse, fine = weights(COARSE), weights(FINE)
    own = network.state_dict()
    assert len(own) == len(coarse) + len(fine)
    assert torch.equal(own["coarse.fc2.weight"], coarse["fc2.weight"])
    log_depth = torch.randn(1, 1, 55, 74)
    depth = Network(
        definition=definitions["eigen"], module=network, device=log_depth.device, checkpoint=None
    ).depth_of(log_depth)
    assert torch.equal(depth, log_depth.exp())
