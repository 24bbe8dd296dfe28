"""sfmlearner: the published layout loads, the wiring is the published one, the bottleneck is z."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs.sfmlearner import DispNet, definitions
from pnpdepth_cli.models.network import load_network
from tests.model_zoo_defs.cuts import built

# (kernel, channels in, channels out) of dispnet_model_best.pth.tar
DOWN = [(7, 3, 32), (5, 32, 64), (3, 64, 128), (3, 128, 256), (3, 256, 512), (3, 512, 512)]
DOWN += [(3, 512, 512)]
UP = {7: (512, 512), 6: (512, 512), 5: (512, 256), 4: (256, 128), 3: (128, 64), 2: (64, 32)}
UP |= {1: (32, 16)}
JOINED = {7: (1024, 512), 6: (1024, 512), 5: (512, 256), 4: (256, 128), 3: (129, 64), 2: (65, 32)}
JOINED |= {1: (17, 16)}


def published() -> dict[str, tuple[int, ...]]:
    """Every key of the published file with its shape."""
    shapes: dict[str, tuple[int, ...]] = {}
    for level, (kernel, channels, out) in enumerate(DOWN, start=1):
        shapes[f"conv{level}.0.weight"] = (out, channels, kernel, kernel)
        shapes[f"conv{level}.2.weight"] = (out, out, kernel, kernel)
        shapes |= {f"conv{level}.{n}.bias": (out,) for n in (0, 2)}
    for level in range(7, 0, -1):
        channels, out = UP[level]
        shapes[f"upconv{level}.0.weight"] = (channels, out, 3, 3)  # transposed
        shapes[f"upconv{level}.0.bias"] = (out,)
        channels, out = JOINED[level]
        shapes[f"iconv{level}.0.weight"] = (out, channels, 3, 3)
        shapes[f"iconv{level}.0.bias"] = (out,)
    for level, channels in ((4, 128), (3, 64), (2, 32), (1, 16)):
        shapes[f"predict_disp{level}.0.weight"] = (1, channels, 3, 3)
        shapes[f"predict_disp{level}.0.bias"] = (1,)
    return shapes


def test_the_input_range_is_minus_one_to_one() -> None:
    """The published weights were trained so, not with ImageNet's mean and deviation."""
    for name in ("sfmlearner", "sfmlearner-tiny"):
        normalisation = definitions[name].normalisation
        assert normalisation is not None
        for mean, std in zip(normalisation.mean, normalisation.std, strict=True):
            assert [(value - mean) / std for value in (0.0, 0.5, 1.0)] == [-1.0, 0.0, 1.0]


def weights(shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    torch.manual_seed(1)
    return {name: 0.05 * torch.randn(shape) for name, shape in shapes.items()}


def reference(rgb: Tensor, w: dict[str, Tensor]) -> Tensor:
    """Disparity straight from the named tensors, level by level."""

    def conv(x: Tensor, name: str, stride: int = 1) -> Tensor:
        kernel = w[f"{name}.weight"]
        return F.conv2d(x, kernel, w[f"{name}.bias"], stride, kernel.shape[-1] // 2)

    skips = [rgb]
    for level in range(1, 8):
        half = conv(skips[-1], f"conv{level}.0", 2).relu()
        skips.append(conv(half, f"conv{level}.2").relu())
    x = skips[7]
    disparity: Tensor | None = None
    for level in range(7, 0, -1):
        height, width = skips[level - 1].shape[-2:]
        up = F.conv_transpose2d(
            x, w[f"upconv{level}.0.weight"], w[f"upconv{level}.0.bias"], 2, 1, 1
        ).relu()[..., :height, :width]
        parts = [up] if level == 1 else [up, skips[level - 1]]
        if disparity is not None:
            double = F.interpolate(disparity, scale_factor=2, mode="bilinear", align_corners=False)
            parts.append(double[..., :height, :width])
        x = conv(torch.cat(parts, 1), f"iconv{level}.0").relu()
        if level <= 4:
            disparity = 10 * conv(x, f"predict_disp{level}.0").sigmoid() + 0.01
    assert disparity is not None
    return disparity


def test_the_published_file_loads_whole(tmp_path: Path) -> None:
    state = weights(published())
    path = tmp_path / "dispnet_model_best.pth.tar"
    torch.save({"epoch": 200, "state_dict": state}, path)
    network = load_network("sfmlearner", path)
    own = network.module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], state[name]) for name in state)


@pytest.mark.parametrize(("height", "width"), [(130, 420), (65, 71)])
def test_features_larger_than_their_neighbours_are_cropped(height: int, width: int) -> None:
    torch.manual_seed(2)
    network = DispNet(width=4).eval()
    rgb = torch.rand(1, 3, height, width)
    with torch.no_grad():
        expected = reference(rgb, dict(network.state_dict()))
        assert torch.allclose(network(rgb), expected, rtol=1e-4, atol=1e-5)


def test_disparity_is_inverse_depth_between_its_bounds_at_four_sizes() -> None:
    network = built(definitions["sfmlearner-tiny"])
    pyramid = network.module.pyramid(torch.randn(1, 3, 128, 416) * 50)
    assert [tuple(d.shape[-2:]) for d in pyramid] == [(128, 416), (64, 208), (32, 104), (16, 52)]
    for disparity in pyramid:
        assert float(disparity.min()) >= 0.01 - 1e-6
        assert float(disparity.max()) <= 10.01 + 1e-6
    assert float(network.depth_of(torch.full((1, 1, 2, 2), 0.01)).max()) == pytest.approx(100)
