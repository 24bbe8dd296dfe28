"""sparse2dense: the authors' files, against a network written from their keys."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs.sparse2dense import SparseToDense, definitions
from pnpdepth_cli.models.network import load_network

BLOCKS = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3)}
NETWORKS = {50: "sparse2dense", 18: "sparse2dense-kitti"}
Shapes = dict[str, tuple[int, ...]]


def norm(name: str, channels: int) -> Shapes:
    vectors = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{v}": (channels,) for v in vectors} | {f"{name}.num_batches_tracked": ()}


def stage(name: str, depth: int, position: int, channels: int, width: int) -> tuple[Shapes, int]:
    """Tensor shapes of stage `position` (0…3) of torchvision's ResNet, and its output channels."""
    inner, shapes = width << position, Shapes()
    out = inner * (4 if depth >= 50 else 1)
    for number in range(BLOCKS[depth][position]):
        block = f"{name}.{number}"
        convs = [(inner, channels, 3), (inner, inner, 3)]
        if depth >= 50:
            convs = [(inner, channels, 1), (inner, inner, 3), (out, inner, 1)]
        for i, (to, of, k) in enumerate(convs, start=1):
            shapes |= {f"{block}.conv{i}.weight": (to, of, k, k), **norm(f"{block}.bn{i}", to)}
        if number == 0 and (position or channels != out):
            shapes[f"{block}.downsample.0.weight"] = (out, channels, 1, 1)
            shapes |= norm(f"{block}.downsample.1", out)
        channels = out
    return shapes, channels


def published(depth: int, width: int = 64) -> Shapes:
    """Every key and shape of the state dict of a checkpoint of the authors'."""
    shapes = {"conv1.weight": (width, 4, 7, 7), **norm("bn1", width)}
    count = width
    for index in range(4):
        more, count = stage(f"layer{index + 1}", depth, index, count, width)
        shapes |= more
    half = count // 2
    shapes |= {"conv2.weight": (half, count, 1, 1), **norm("bn2", half)}
    for number in range(1, 5):
        name, of, to = f"decoder.layer{number}", half, half // 2
        upper, bottom = f"{name}.upper_branch", f"{name}.bottom_branch"
        shapes |= {f"{upper}.conv1.weight": (to, of, 5, 5), **norm(f"{upper}.batchnorm1", to)}
        shapes |= {f"{upper}.conv2.weight": (to, to, 3, 3), **norm(f"{upper}.batchnorm2", to)}
        shapes |= {f"{bottom}.conv.weight": (to, of, 5, 5), **norm(f"{bottom}.batchnorm", to)}
        half = to
    return {**shapes, "conv3.weight": (1, half, 3, 3)}


def filled(shapes: Shapes) -> dict[str, Tensor]:
    """Random weights that whose activations neither vanish nor grow."""
    generator, state = torch.Generator().manual_seed(2), {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            state[name] = torch.tensor(7)
        elif name.endswith(("running_var", ".weight")) and len(shape) == 1:
            state[name] = 0.5 + torch.rand(shape, generator=generator)
        else:
            scale = (2 / (shape[1] * shape[2] * shape[3])) ** 0.5 if len(shape) == 4 else 0.1
            state[name] = scale * torch.randn(shape, generator=generator)
    return state


class Reference:
    """The authors' network straight from the named tensors; notes which of them it used."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.state, self.used = state, set[str]()

    def __getitem__(self, name: str) -> Tensor:
        self.used.add(name)
        return self.state[name]

    def conv(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        weight = self[f"{name}.weight"]
        return F.conv2d(x, weight, stride=stride, padding=weight.shape[-1] // 2)

    def norm(self, x: Tensor, name: str) -> Tensor:
        mean, variance = self[f"{name}.running_mean"], self[f"{name}.running_var"]
        return F.batch_norm(x, mean, variance, self[f"{name}.weight"], self[f"{name}.bias"])

    def stage(self, x: Tensor, name: str, scene: int, count: int) -> Tensor:
        for number in range(count):
            block = f"{name}.{number}"
            stride = 2 if scene and not number else 1
            bottleneck = f"{block}.conv3.weight" in self.state
            y = F.relu(self.norm(self.conv(x, f"{block}.conv1", 1 if bottleneck else stride),
                                 f"{block}.bn1"))  # fmt: skip
            y = self.norm(self.conv(y, f"{block}.conv2", stride if bottleneck else 1),
                          f"{block}.bn2")  # fmt: skip
            if bottleneck:
                y = self.norm(self.conv(F.relu(y), f"{block}.conv3"), f"{block}.bn3")
            if f"{block}.downsample.0.weight" in self.state:
                x = self.norm(
                    self.conv(x, f"{block}.downsample.0", stride), f"{block}.downsample.1"
                )
            x = F.relu(x + y)
        return x

    def up_projection(self, x: Tensor, name: str) -> Tensor:
        x = unpooled(x)
        upper, bottom = f"{name}.upper_branch", f"{name}.bottom_branch"
        y = F.relu(self.norm(self.conv(x, f"{upper}.conv1"), f"{upper}.batchnorm1"))
        y = self.norm(self.conv(y, f"{upper}.conv2"), f"{upper}.batchnorm2")
        return F.relu(y + self.norm(self.conv(x, f"{bottom}.conv"), f"{bottom}.batchnorm"))

    def depth(self, x: Tensor, depth: int) -> Tensor:
        size = x.shape[-2:]
        x = F.max_pool2d(F.relu(self.norm(self.conv(x, "conv1", 2), "bn1")), 3, 2, 1)
        for scene, count in enumerate(BLOCKS[depth]):
            x = self.stage(x, f"layer{scene + 1}", scene, count)
        x = self.norm(self.conv(x, "conv2"), "bn2")
        for number in range(1, 5):
            x = self.up_projection(x, f"decoder.layer{number}")
        return F.interpolate(self.conv(x, "conv3"), size, mode="bilinear", align_corners=True)


def unpooled(x: Tensor) -> Tensor:
    """Zeros between the pixels, by hand."""
    large = x.new_zeros(*x.shape[:2], 2 * x.shape[2], 2 * x.shape[3])
    large[..., ::2, ::2] = x
    return large


def frame(height: int = 228, width: int = 304) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    rgb = torch.rand(1, 3, height, width, generator=generator)
    depth = 1 + 4 * torch.rand(1, 1, height, width, generator=generator)
    return rgb, depth * (torch.rand(depth.shape, generator=generator) < 0.01)


# ------------------------------------------------------------------ the architecture


@pytest.mark.parametrize("depth", NETWORKS)
def test_each_network_has_the_published_keys_and_shapes(depth: int) -> None:
    with torch.device("meta"):
        network = definitions[NETWORKS[depth]].build()
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert shapes == published(depth)


@pytest.mark.parametrize("depth", NETWORKS)
def test_each_network_computes_what_the_published_tensors_say(depth: int) -> None:
    state = filled(published(depth, width=16))
    network = SparseToDense(depth, width=16).eval()
    network.load_state_dict(state)
    reference = Reference(state)
    with torch.no_grad():
        output = network(*frame(100, 130))
        expected = reference.depth(torch.cat(frame(100, 130), dim=1), depth)
    assert output.shape == (1, 1, 100, 130)
    torch.testing.assert_close(output, expected, rtol=1e-3, atol=1e-4 * float(expected.std()))
    counters = {name for name in state if name.endswith("num_batches_tracked")}
    assert reference.used == set(state) - counters


# ------------------------------------------------------------------ published files


@pytest.mark.parametrize("counters", [True, False], ids=["now", "before PyTorch 0.4.1"])
def test_a_published_file_loads_whole(counters: bool, tmp_path: Path) -> None:
    state = filled(published(18))
    kept = {n: t for n, t in state.items() if counters or not n.endswith("num_batches_tracked")}
    args = argparse.Namespace(data="nyudepthv2", arch="resnet18", modality="rgbd")
    path = tmp_path / "model_best.pth.tar"
    torch.save(
        {"args": args, "epoch": 9, "model": kept}, path, _use_new_zipfile_serialization=counters
    )
    network = load_network("sparse2dense-kitti", path)
    own = network.module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], tensor) for name, tensor in kept.items())
