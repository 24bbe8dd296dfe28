"""fcrn: every array of the authors' file loads, and the graph is theirs, padding included."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from model_zoo_defs.fcrn import (
    FCRN,
    Bottleneck,
    MaxPoolSame,
    Unpooling,
    definitions,
    read_authors,
)
from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.weights.checkpoint import load_checkpoint
from tests.model_zoo_defs.cuts import built
from tests.models.weights.files import write_npy

Arrays = dict[str, dict[str, NDArray[np.float32]]]
Fill = Callable[[tuple[int, ...]], NDArray[np.float32]]


def authors(width: int, fill: Fill) -> Arrays:
    """Every array of NYU_ResNet-UpProj.npy, whose `width` is 64."""
    arrays: Arrays = {}

    def conv(name: str, rows: int, columns: int, channels: int, out: int, bias: bool) -> None:
        arrays[name] = {"weights": fill((rows, columns, channels, out))}
        if bias:
            arrays[name]["biases"] = fill((out,))

    def norm(name: str, channels: int) -> None:
        arrays[name] = {kind: fill((channels,)) for kind in ("mean", "scale", "offset")}
        arrays[name]["variance"] = fill((channels,)) ** 2 + np.float32(0.5)

    conv("conv1", 7, 7, 3, width, bias=True)
    norm("bn_conv1", width)
    channels = width
    for stage, letters in ((2, "abc"), (3, "abcd"), (4, "abcdef"), (5, "abc")):
        middle = width << (stage - 2)
        for letter in letters:
            if letter == "a":
                conv(f"res{stage}a_branch1", 1, 1, channels, 4 * middle, bias=False)
                norm(f"bn{stage}a_branch1", 4 * middle)
            for part, size, one, other in (
                ("a", 1, channels, middle),
                ("b", 3, middle, middle),
                ("c", 1, middle, 4 * middle),
            ):
                conv(f"res{stage}{letter}_branch2{part}", size, size, one, other, bias=False)
                norm(f"bn{stage}{letter}_branch2{part}", other)
            channels = 4 * middle
    conv("layer1", 1, 1, channels, channels // 2, bias=True)
    norm("layer1_BN", channels // 2)
    for times in (2, 4, 8, 16):
        channels //= 2
        for branch in ("br1", "br2"):
            for letter, rows, columns in (("A", 3, 3), ("B", 2, 3), ("C", 3, 2), ("D", 2, 2)):
                name = f"layer{times}x_{branch}_Conv{letter}"
                conv(name, rows, columns, channels, channels // 2, bias=True)
            norm(f"layer{times}x_{branch}_BN", channels // 2)
        conv(f"layer{times}x_Conv", 3, 3, channels // 2, channels // 2, bias=True)
        norm(f"layer{times}x_BN", channels // 2)
    conv("ConvPred", 3, 3, channels // 2, 1, bias=True)
    return arrays


def random_arrays(seed: int) -> Fill:
    rng = np.random.default_rng(seed)

    def fill(shape: tuple[int, ...]) -> NDArray[np.float32]:
        scale = 1 / np.sqrt(np.prod(shape[:-1])) if len(shape) == 4 else 0.3
        offset = 1.0 if len(shape) == 1 else 0.0
        return (offset + scale * rng.standard_normal(shape)).astype(np.float32)

    return fill


def reference(rgb: Tensor, arrays: Arrays) -> Tensor:
    """Depth straight from the authors' arrays, written from the facts about their TensorFlow code.

    In their layout (1, rows, columns, channels); convolutions are sums over shifted images.
    """

    def conv(x: Tensor, name: str, stride: int = 1, pads: Any = None) -> Tensor:
        kernel = torch.from_numpy(arrays[name]["weights"])
        rows, columns = kernel.shape[:2]
        if pads is None:
            pads = ((rows - 1) // 2,) * 2, ((columns - 1) // 2,) * 2
        x = F.pad(x, (0, 0, *pads[1], *pads[0]))
        height = (x.shape[1] - rows) // stride + 1
        width = (x.shape[2] - columns) // stride + 1
        y = torch.zeros(1, height, width, kernel.shape[3], dtype=x.dtype)
        for i in range(rows):
            for j in range(columns):
                part = x[:, i : i + stride * height : stride, j : j + stride * width : stride]
                y = y + part[:, :height, :width] @ kernel[i, j].to(x.dtype)
        return y + torch.from_numpy(arrays[name].get("biases", np.zeros(1, np.float32)))

    def norm(x: Tensor, name: str) -> Tensor:
        a = {kind: torch.from_numpy(array) for kind, array in arrays[name].items()}
        return (x - a["mean"]) / (a["variance"] + 1e-4).sqrt() * a["scale"] + a["offset"]

    def unpool(x: Tensor, name: str) -> Tensor:
        a = conv(x, f"{name}_ConvA")
        b = conv(x, f"{name}_ConvB", pads=((1, 0), (1, 1)))
        c = conv(x, f"{name}_ConvC", pads=((1, 1), (1, 0)))
        d = conv(x, f"{name}_ConvD", pads=((1, 0), (1, 0)))
        y = x.new_zeros(1, 2 * a.shape[1], 2 * a.shape[2], a.shape[3])
        y[:, 0::2, 0::2], y[:, 1::2, 0::2], y[:, 0::2, 1::2], y[:, 1::2, 1::2] = a, b, c, d
        return norm(y, f"{name}_BN")

    x = norm(conv(rgb, "conv1", 2), "bn_conv1").relu()
    x = pooled_by_loop(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    for stage, letters in ((2, "abc"), (3, "abcd"), (4, "abcdef"), (5, "abc")):
        for letter in letters:
            stride = 2 if letter == "a" and stage > 2 else 1
            key = f"{stage}{letter}_branch"
            y = norm(conv(x, f"res{key}2a", stride), f"bn{key}2a").relu()
            y = norm(conv(y, f"res{key}2b"), f"bn{key}2b").relu()
            y = norm(conv(y, f"res{key}2c"), f"bn{key}2c")
            if letter == "a":
                x = norm(conv(x, f"res{key}1", stride), f"bn{key}1")
            x = (x + y).relu()
    x = norm(conv(x, "layer1"), "layer1_BN")
    for times in (2, 4, 8, 16):
        y = unpool(x, f"layer{times}x_br1").relu()
        y = norm(conv(y, f"layer{times}x_Conv"), f"layer{times}x_BN")
        x = (y + unpool(x, f"layer{times}x_br2")).relu()
    return conv(x, "ConvPred").relu().permute(0, 3, 1, 2)


def pooled_by_loop(x: Tensor) -> Tensor:
    """3 x 3 at stride 2: of ceil(n/2) windows, as evenly beyond both ends as can be."""

    def windows(length: int) -> Iterator[slice]:
        count = (length + 1) // 2
        beyond = (count - 1) * 2 + 3 - length
        for k in range(count):
            start = 2 * k - beyond // 2
            yield slice(max(0, start), start + 3)

    columns = list(windows(x.shape[3]))
    rows = [
        torch.stack([x[:, :, r, c].amax((2, 3)) for c in columns], -1) for r in windows(x.shape[2])
    ]
    return torch.stack(rows, -2)


# ------------------------------------------------------------------ the authors' file


def test_every_array_of_the_published_file_loads_into_its_parameter(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = authors(64, lambda shape: rng.random(shape, dtype=np.float32))
    path = write_npy(tmp_path / "NYU_ResNet-UpProj.npy", arrays)
    values = sum(array.size for layer in arrays.values() for array in layer.values())
    own = load_network("fcrn", path).module.state_dict()
    held = {name: t for name, t in own.items() if not name.endswith("num_batches_tracked")}
    assert sum(tensor.numel() for tensor in held.values()) == values == 63_633_665
    assert len(held) == sum(len(layer) for layer in arrays.values())
    for name, layer, kind in (
        ("conv1.weight", "conv1", "weights"),
        ("conv1.bias", "conv1", "biases"),
        ("bn_conv1.running_var", "bn_conv1", "variance"),
        ("res4f.branch2b.weight", "res4f_branch2b", "weights"),
        ("res3a.bn_branch1.running_mean", "bn3a_branch1", "mean"),
        ("res5c.bn_branch2c.weight", "bn5c_branch2c", "scale"),
        ("layer1.bias", "layer1", "biases"),
        ("layer1_BN.bias", "layer1_BN", "offset"),
        ("layer2x.br1.ConvB.weight", "layer2x_br1_ConvB", "weights"),
        ("layer16x.br2.ConvC.bias", "layer16x_br2_ConvC", "biases"),
        ("layer8x.Conv.weight", "layer8x_Conv", "weights"),
        ("layer8x.BN.weight", "layer8x_BN", "scale"),
        ("layer4x.br2.BN.running_mean", "layer4x_br2_BN", "mean"),
        ("ConvPred.weight", "ConvPred", "weights"),
    ):
        expected = arrays[layer][kind]
        if expected.ndim == 4:
            expected = expected.transpose(3, 2, 0, 1)
        assert np.array_equal(own[name].numpy(), expected), name


def narrow(arrays: Arrays, path: Path, width: int = 4) -> FCRN:
    """A network of this width with these arrays, loaded from a file."""
    network = FCRN(width)
    definition = replace(definitions["fcrn"], build=partial(FCRN, width))
    load_checkpoint(network, definition, write_npy(path / "x.npy", arrays))
    return network.eval()


@pytest.mark.parametrize("size", [(228, 304), (97, 130), (64, 65)])
def test_the_graph_is_the_authors_for_even_and_odd_sizes(
    size: tuple[int, int], tmp_path: Path
) -> None:
    arrays = authors(4, random_arrays(1))
    network = narrow(arrays, tmp_path)
    rgb = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0)) * 255
    with torch.no_grad():
        depth, expected = network(rgb), reference(rgb.permute(0, 2, 3, 1), arrays)
    assert depth.shape == expected.shape
    assert size != (228, 304) or tuple(depth.shape[-2:]) == (128, 160)
    assert float(expected.amax()) > 0.1
    assert torch.allclose(depth, expected, rtol=1e-3, atol=1e-3 * float(expected.amax()))


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (("conv1", "biases"), r"1 missing \(conv1\.bias\)"),
        (("layer1", "biases"), r"1 missing \(layer1\.bias\)"),
        (("bn3b_branch2a", "variance"), r"1 missing \(res3b\.bn_branch2a\.running_var\)"),
    ],
)
def test_an_array_that_is_missing_is_named(
    gone: tuple[str, str], message: str, tmp_path: Path
) -> None:
    arrays = authors(4, random_arrays(1))
    del arrays[gone[0]][gone[1]]
    with pytest.raises(CheckpointError, match=message):
        narrow(arrays, tmp_path)


def test_an_array_left_over_is_named(tmp_path: Path) -> None:
    arrays = authors(4, random_arrays(1))
    arrays["res4g_branch2a"] = {"weights": np.zeros((1, 1, 64, 16), np.float32)}
    with pytest.raises(CheckpointError, match=r"1 unexpected \(res4g_branch2a\.weight\)"):
        narrow(arrays, tmp_path)
    arrays["conv1"]["momentum"] = np.zeros(4, np.float32)
    with pytest.raises(CheckpointError, match=r"conv1\.momentum is none of weights"):
        narrow(arrays, tmp_path)


def test_what_the_optimiser_left_in_a_tensorflow_checkpoint_is_no_weight() -> None:
    left = {"conv1.weights.Momentum": torch.zeros(7, 7, 3, 4), "global_step": torch.tensor(7)}
    weights = {"conv1.weights": torch.ones(7, 7, 3, 4), "conv1.biases": torch.ones(4)}
    assert list(read_authors(weights | left)) == ["conv1.weight", "conv1.bias"]


def test_a_state_dict_of_ours_loads_too(tmp_path: Path) -> None:
    network = FCRN(4)
    torch.save(network.state_dict(), tmp_path / "x.pt")
    other = FCRN(4)
    definition = replace(definitions["fcrn"], build=partial(FCRN, 4))
    load_checkpoint(other, definition, tmp_path / "x.pt")
    assert torch.equal(other.conv1.weight, network.conv1.weight)


@pytest.mark.parametrize(
    ("key", "port"),
    [
        ("up1.conv1_1.weight", "XPFly1989"),
        ("upSample.layer1.upper_branch.conv1.weight", "dontLoveBugs"),
    ],
)
def test_files_of_ports_are_an_error_that_names_another_network(
    key: str, port: str, tmp_path: Path
) -> None:
    torch.save({"epoch": 1, "state_dict": {key: torch.zeros(1)}}, tmp_path / "checkpoint.pth.tar")
    with pytest.raises(CheckpointError, match=rf"of the port {port}.*NYU_ResNet-UpProj\.npy"):
        load_network("fcrn", tmp_path / "checkpoint.pth.tar")


# ------------------------------------------------------------------ what ports change


@pytest.mark.parametrize("size", [(6, 8), (7, 9), (6, 9), (2, 2), (1, 5)])
def test_the_pooling_is_that_of_a_loop_over_windows(size: tuple[int, int]) -> None:
    x = torch.randn(1, 2, *size, generator=torch.Generator().manual_seed(0))
    assert torch.equal(MaxPoolSame()(x), pooled_by_loop(x))


def test_at_even_sizes_that_is_not_torchs_pooling() -> None:
    x = torch.arange(36.0).reshape(1, 1, 6, 6)
    assert not torch.equal(MaxPoolSame()(x), F.max_pool2d(x, 3, 2, 1))


def test_an_unpooling_is_zero_insertion_and_a_5x5_convolution_but_for_swapped_neighbours() -> None:
    torch.manual_seed(0)
    unpooling = Unpooling(3, 2).eval()
    a, b, c, d = (getattr(unpooling, f"Conv{x}") for x in "ABCD")
    bias = torch.randn(2)
    kernel = torch.zeros(2, 3, 5, 5)
    kernel[..., 0::2, 0::2], kernel[..., 1::2, 0::2] = a.weight, b.weight
    kernel[..., 0::2, 1::2], kernel[..., 1::2, 1::2] = c.weight, d.weight
    for conv in (a, b, c, d):
        conv.bias.data = bias
    x = torch.randn(1, 3, 4, 6)
    inserted = torch.zeros(1, 3, 8, 12)
    inserted[..., 1::2, 1::2] = x
    whole = F.conv2d(inserted, kernel, bias, padding=2)
    with torch.no_grad():
        rows = unpooling(x).reshape(1, 2, 4, 2, 6, 2)
    swapped = rows.flip(3, 5).reshape(1, 2, 8, 12)
    assert torch.allclose(swapped, whole / (1 + 1e-4) ** 0.5, atol=1e-5)


def test_rows_come_from_a_and_b_and_columns_from_a_and_c() -> None:
    unpooling = Unpooling(1, 1).eval()
    for number, letter in enumerate("ABCD"):
        conv = getattr(unpooling, f"Conv{letter}")
        conv.weight.data.zero_()
        conv.bias.data.fill_(float(number))
    with torch.no_grad():
        tile = unpooling(torch.zeros(1, 1, 1, 1))[0, 0] * (1 + 1e-4) ** 0.5
    assert torch.allclose(tile, torch.tensor([[0.0, 2.0], [1.0, 3.0]]))  # A C / B D


def test_a_stride_leaves_out_rows_before_anything_else_looks_at_them() -> None:
    torch.manual_seed(0)
    strided = Bottleneck(8, 4, 2, project=True).eval()
    plain = Bottleneck(8, 4, 1, project=True).eval()
    plain.load_state_dict(strided.state_dict())
    x = torch.randn(1, 8, 7, 10)
    with torch.no_grad():
        assert torch.allclose(strided(x), plain(x[..., ::2, ::2]), atol=1e-6)


def test_depth_is_never_negative_and_rgb_goes_in_as_bytes() -> None:
    network = built(definitions["fcrn"])
    normalisation = network.definition.normalisation
    assert normalisation is not None
    assert [(1.0 - m) / s for m, s in zip(normalisation.mean, normalisation.std, strict=True)] == [
        pytest.approx(255.0)
    ] * 3
    network.module.ConvPred.bias.data.fill_(-100.0)
    with torch.no_grad():
        assert float(network.module(torch.zeros(1, 3, 64, 64)).min()) == 0.0
