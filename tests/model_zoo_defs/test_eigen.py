"""eigen: two published files make one network; its sizes are the paper's."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs.eigen import Eigen, definitions
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.models.weights.checkpoint import load_checkpoint

COARSE = {
    "conv1": (6, 3, 11, 11), "conv2": (8, 6, 5, 5), "conv3": (10, 8, 3, 3),
    "conv4": (9, 10, 3, 3), "conv5": (7, 9, 3, 3), "fc1": (20, 7 * 6 * 8), "fc2": (4070, 20),
}  # fmt: skip
FINE = {"conv1": (11, 3, 9, 9), "conv2": (12, 12, 5, 5), "conv3": (1, 12, 5, 5)}
PUBLISHED = {
    "coarse.conv1.weight": (96, 3, 11, 11), "coarse.conv2.weight": (256, 96, 5, 5),
    "coarse.conv3.weight": (384, 256, 3, 3), "coarse.conv4.weight": (384, 384, 3, 3),
    "coarse.conv5.weight": (256, 384, 3, 3), "coarse.fc1.weight": (4096, 12288),
    "coarse.fc2.weight": (4070, 4096), "fine.conv1.weight": (63, 3, 9, 9),
    "fine.conv2.weight": (64, 64, 5, 5), "fine.conv3.weight": (1, 64, 5, 5),
}  # fmt: skip


def weights(shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    torch.manual_seed(1)
    state = {}
    for name, shape in shapes.items():
        state[f"{name}.weight"] = torch.randn(shape) / (shape[1] * 9) ** 0.5
        state[f"{name}.bias"] = torch.randn(shape[0]) * 0.1
    return state


def reference(rgb: Tensor, coarse: dict[str, Tensor], fine: dict[str, Tensor]) -> Tensor:
    """Log depth straight from the named tensors."""

    def conv(x: Tensor, w: dict[str, Tensor], name: str, stride: int = 1, pad: int = 0) -> Tensor:
        return F.conv2d(x, w[f"{name}.weight"], w[f"{name}.bias"], stride, pad)

    x = F.max_pool2d(conv(rgb, coarse, "conv1", 4).relu(), 2)
    x = F.max_pool2d(conv(x, coarse, "conv2", 1, 2).relu(), 2)
    x = conv(conv(x, coarse, "conv3", 1, 1).relu(), coarse, "conv4", 1, 1).relu()
    x = conv(x, coarse, "conv5", 2).relu().flatten(1)
    x = (x @ coarse["fc1.weight"].T + coarse["fc1.bias"]).relu()
    log_depth = (x @ coarse["fc2.weight"].T + coarse["fc2.bias"]).reshape(1, 1, 55, 74)
    x = F.max_pool2d(conv(rgb, fine, "conv1", 2).relu(), 2)
    x = conv(torch.cat([x, log_depth], 1), fine, "conv2", 1, 2).relu()
    return conv(x, fine, "conv3", 1, 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eigen")
    torch.save(weights(COARSE), folder / "coarse_model_12.pth")
    torch.save(weights(FINE), folder / "fine_model_7.pth")
    return folder


def test_a_folder_with_both_published_files_loads_and_gives_what_their_tensors_say(
    folder: Path,
) -> None:
    network = Eigen(channels=(6, 8, 10, 9, 7), hidden=20, fine=12).eval()
    notes = load_checkpoint(network, definitions["eigen"], folder)
    assert "coarse_model_12.pth, fine_model_7.pth" in notes[0]
    coarse, fine = weights(COARSE), weights(FINE)
    own = network.state_dict()
    assert len(own) == len(coarse) + len(fine)
    assert torch.equal(own["coarse.fc2.weight"], coarse["fc2.weight"])
    rgb = torch.rand(1, 3, 228, 304)
    with torch.no_grad():
        log_depth = network(rgb)
        expected = reference(rgb, coarse, fine)
    assert log_depth.shape == (1, 1, 55, 74)
    assert torch.allclose(log_depth, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    depth = Network(
        definition=definitions["eigen"], module=network, device=rgb.device, checkpoint=None
    ).depth_of(log_depth)
    assert torch.equal(depth, log_depth.exp())


def test_it_has_the_published_shapes_and_the_papers_output() -> None:
    definition = definitions["eigen"]
    with torch.device("meta"):
        network = definition.build()
        own = {n: tuple(t.shape) for n, t in network.state_dict().items()}
        assert {n: shape for n, shape in own.items() if n.endswith("weight")} == PUBLISHED
        assert definition.size == Fixed(228, 304)
        assert network(torch.empty(1, 3, 228, 304)).shape == (1, 1, 55, 74)
