"""sparseconv: the sparse convolution against a loop, the published layout against a reference."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs.sparseconv import SparseConv, definitions
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.models.network import load_network
from tests.model_zoo_defs.cuts import built

KERNELS = (11, 7, 5, 3, 3)


def sparse_depth(height: int, width: int, fraction: float = 0.1) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    depth = 1 + 9 * torch.rand(1, 1, height, width, generator=generator)
    return depth * (torch.rand(depth.shape, generator=generator) < fraction)


def port() -> dict[str, Tensor]:
    """Every key and shape of the port's checkpoint, with weights of the size of trained ones."""
    generator = torch.Generator().manual_seed(2)
    state, channels = {}, 1
    for index, kernel in enumerate(KERNELS):
        name, shape = f"sparse_convs.{index}.sparse_conv", (16, channels, kernel, kernel)
        state[f"{name}.bias"] = 0.1 * torch.randn(16, generator=generator)
        state[f"{name}.conv.weight"] = 1 + torch.randn(shape, generator=generator)
        channels = 16
    state["mask_conv.weight"] = torch.randn(1, 17, 1, 1, generator=generator)
    state["mask_conv.bias"] = torch.randn(1, generator=generator)
    return state


def looped(x: Tensor, mask: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A sparse convolution pixel by pixel: (c, h, w), (h, w) → (n, h, w)."""
    (out, channels, kernel, _), (height, width) = weight.shape, mask.shape
    result, reach = torch.zeros(out, height, width), kernel // 2
    for i in range(height):
        for j in range(width):
            total, count = torch.zeros(out), 0
            for di in range(-reach, reach + 1):
                for dj in range(-reach, reach + 1):
                    a, b = i + di, j + dj
                    if 0 <= a < height and 0 <= b < width and mask[a, b]:
                        total += weight[:, :, di + reach, dj + reach] @ x[:, a, b]
                        count += channels
            result[:, i, j] = total / max(count, 1) + bias
    return result


@pytest.mark.parametrize("kernel", [3, 5])
def test_a_layer_is_the_sum_over_known_pixels_over_their_number(kernel: int) -> None:
    torch.manual_seed(0)
    layer = SparseConv(3, 4, kernel).requires_grad_(False)
    layer.bias.normal_()
    x, mask = torch.randn(1, 3, 9, 11), (torch.rand(1, 1, 9, 11) < 0.05).float()
    features, grown = layer(x, mask)
    expected = looped(x[0], mask[0, 0], layer.conv.weight, layer.bias)
    torch.testing.assert_close(features[0], expected)
    reach = kernel // 2
    near = [
        mask[0, 0, max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1].max()
        for i in range(9)
        for j in range(11)
    ]
    assert torch.equal(grown.flatten(), torch.stack(near))
    assert 0 < float(grown.mean()) < 1


# ------------------------------------------------------------------ published files


def reference(state: dict[str, Tensor], sparse: Tensor) -> Tensor:
    """Depth before the last convolution's bias, straight from the named tensors, in float64."""
    x, mask = sparse.double(), (sparse > 0).double()
    for index, kernel in enumerate(KERNELS):
        name = f"sparse_convs.{index}.sparse_conv"
        channels, box = x.shape[1], torch.ones(1, 1, kernel, kernel).double()
        pixels = F.conv2d(mask, box, padding=kernel // 2)
        count = pixels * channels
        weight, bias = state[f"{name}.conv.weight"].double(), state[f"{name}.bias"].double()
        x = F.conv2d(x * mask, weight, padding=kernel // 2)
        x = F.relu(torch.where(count > 0, x / count.clamp_min(1), 0.0) + bias.view(1, -1, 1, 1))
        mask = (pixels > 0).double()
    last = state["mask_conv.weight"].double()
    return F.conv2d(torch.cat([x, mask], 1), last)


def close(output: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(
        output.double(), expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max())
    )


def test_the_ports_file_loads_whole_and_gives_what_its_tensors_say(tmp_path: Path) -> None:
    state = port()
    optimizer = {"state": {}, "param_groups": [{"lr": 0.001, "params": [0, 1]}]}
    content = {"epoch": 20, "rmse": 1777.0, "arch": "sparseconv", "optimizer": optimizer}
    torch.save({**content, "state_dict": state}, tmp_path / "best_model.pth.tar")
    network = load_network("sparseconv", tmp_path / "best_model.pth.tar")
    own = network.module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], tensor) for name, tensor in state.items())
    sparse = sparse_depth(40, 60, 0.01)
    with torch.no_grad():
        depth = network.module(sparse)
    close(depth, reference(state, sparse) + state["mask_conv.bias"])


# ------------------------------------------------------------------ the cut


def test_z_is_the_features_behind_the_first_layer_and_the_mask_stays() -> None:
    network = built(definitions["sparseconv"])
    sparse = sparse_depth(64, 96, 0.001)
    with torch.no_grad(), Split(network.module, "sparse_convs.0[0]") as split:
        z = split.front(sparse)
        known = F.max_pool2d((sparse > 0).float(), 11, 1, 5)
        moved = split.rear(z + (1 - known))  # only where the mask says nothing is known
        assert torch.equal(moved, network.module(sparse))
        assert not torch.equal(split.rear(z + known), moved)
