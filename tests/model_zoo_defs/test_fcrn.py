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

from model_zoo_defs.fcrn import FCRN, definitions
from pnpdepth_cli.models.weights.checkpoint import load_checkpoint
from tests.models.weights.files import npy_of, pickled

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


def test_the_network_has_as_many_values_as_the_published_file() -> None:
    with torch.device("meta"):
        own = FCRN().state_dict()
    held = [tensor for name, tensor in own.items() if not name.endswith("num_batches_tracked")]
    shapes = authors(64, lambda shape: np.broadcast_to(np.float32(1), shape))
    assert len(held) == sum(len(layer) for layer in shapes.values())
    assert sum(tensor.numel() for tensor in held) == 63_633_665
    assert sum(array.size for layer in shapes.values() for array in layer.values()) == 63_633_665


def narrow(arrays: Arrays, path: Path, width: int = 4) -> FCRN:
    """A network of this width with these arrays, loaded from a file."""
    network = FCRN(width)
    definition = replace(definitions["fcrn"], build=partial(FCRN, width))
    load_checkpoint(network, definition, npy_of(path / "x.npy", pickled(arrays, 2)))
    return network.eval()


@pytest.mark.parametrize("size", [(228, 304), (97, 130)])
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
