"""fcrn: every array of the authors' file loads, and the graph is theirs, padding included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from model_zoo_defs.fcrn import FCRN, definitions
from pnpdepth_cli.models.weights import load_checkpoint
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


# ------------------------------------------------------------------ the authors' file


def narrow(arrays: Arrays, path: Path, width: int = 4) -> FCRN:
    """A network of this width with these arrays, loaded from a file."""
    network = FCRN(width)
    definition = replace(definitions["fcrn"], build=partial(FCRN, width))
    load_checkpoint(network, definition, npy_of(path / "x.npy", pickled(arrays, 2)))
    return network.eval()


def test_the_authors_arrays_are_read_in_torchs_order(tmp_path: Path) -> None:
    arrays = authors(4, random_arrays(1))
    state = narrow(arrays, tmp_path).state_dict()
    weights = torch.from_numpy(arrays["conv1"]["weights"])  # rows, columns, channels in and out
    assert torch.equal(state["conv1.weight"], weights.permute(3, 2, 0, 1))
    norm = {"weight": "scale", "bias": "offset", "running_mean": "mean", "running_var": "variance"}
    for ours, theirs in norm.items():
        assert torch.equal(state[f"bn_conv1.{ours}"], torch.from_numpy(arrays["bn_conv1"][theirs]))
