"""eigen: two published files make one network; its sizes are the paper's."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs.eigen import definitions, read_two_files
from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.network import load_network

COARSE = {
    "conv1": (96, 3, 11, 11),
    "conv2": (256, 96, 5, 5),
    "conv3": (384, 256, 3, 3),
    "conv4": (384, 384, 3, 3),
    "conv5": (256, 384, 3, 3),
    "fc1": (4096, 12288),
    "fc2": (4070, 4096),
}
COARSE_KITTI = COARSE | {"fc1": (4096, 17408), "fc2": (5822, 4096)}
FINE = {"conv1": (63, 3, 9, 9), "conv2": (64, 64, 5, 5), "conv3": (1, 64, 5, 5)}


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
    network = load_network("eigen", folder)
    assert "coarse_model_12.pth, fine_model_7.pth" in network.notes[0]
    coarse, fine = weights(COARSE), weights(FINE)
    own = network.module.state_dict()
    assert len(own) == len(coarse) + len(fine)
    assert torch.equal(own["coarse.fc2.weight"], coarse["fc2.weight"])
    rgb = torch.rand(1, 3, 228, 304)
    with torch.no_grad():
        log_depth = network.module(rgb)
        expected = reference(rgb, coarse, fine)
    assert log_depth.shape == (1, 1, 55, 74)
    assert torch.allclose(log_depth, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    assert torch.equal(network.depth_of(log_depth), log_depth.exp())


@pytest.mark.parametrize("part", ["coarse_model_12.pth", "fine_model_7.pth"])
def test_one_file_alone_is_an_error_that_names_both(folder: Path, part: str) -> None:
    with pytest.raises(
        CheckpointError, match=rf"this is the {part.partition('_')[0]} network only"
    ):
        load_network("eigen", folder / part)


def test_a_folder_with_one_file_names_what_is_missing(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "coarse_model_12.pth").symlink_to(folder / "coarse_model_12.pth")
    with pytest.raises(CheckpointError, match="this is the coarse network only; name a folder"):
        load_network("eigen", tmp_path)


def test_two_files_for_one_part_are_named() -> None:
    state = {f"{file}.conv1.weight": torch.zeros(1) for file in ("fine_model_1", "fine_model_2")}
    with pytest.raises(
        ValueError, match=r"fine_model_1 and fine_model_2 are both the fine network"
    ):
        read_two_files(state)


def test_weights_for_kitti_name_the_network_they_are_for(tmp_path: Path) -> None:
    for name, shapes in (("coarse", COARSE_KITTI), ("fine", FINE)):
        state = {f"{layer}.weight": torch.zeros(1).expand(shape) for layer, shape in shapes.items()}
        state |= {f"{layer}.bias": torch.zeros(shape[0]) for layer, shape in shapes.items()}
        torch.save(state, tmp_path / f"{name}.pth")
    with pytest.raises(CheckpointError, match="this is eigen-kitti; use --model eigen-kitti"):
        load_network("eigen", tmp_path)


def test_the_output_is_as_large_as_the_fine_features_at_both_sizes() -> None:
    with torch.device("meta"):
        for name, size in (("eigen", (55, 74)), ("eigen-kitti", (41, 142))):
            definition = definitions[name]
            rgb = torch.empty(1, 3, definition.size.height, definition.size.width)
            assert definition.build()(rgb).shape == (1, 1, *size)
