"""Deep convolutional compressed sensing (Chodosh, Wang & Lucey, ACCV 2018).

Three layers of convolutional dictionaries (8, 16, 32 filters; 11, 5, 3 pixels; stride 2 each). Ten
ADMM iterations find the codes of the last layer that explain the sparse depth; synthesis through
all three layers turns them into depth. Input: sparse depth in metres (0 = unknown), any size.
Output: dense depth in metres; it may be negative.

The paper's z (Wang et al.) is "the optimal x", the codes of the last layer; here the output of
`solve`. The authors' TensorFlow code does more: it updates codes, copies and multipliers of all
layers, and runs ten further iterations after each update. A cut inside the solver
(`solve.step#5[0][2]`) comes close: the iterations behind the cut run again after each update.

Written from the published description and the graph of nchodosh/Super-LiDAR, which names no
licence; parameter names are the same. The authors published no weights. To use your own, save the
variables by name, `numpy.save("adnn.npy", {"kernel0": …, …, "bias2": …})`. `-tiny` is this
project's own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._same_padding import same_padding
from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings

FILTERS = (8, 16, 32)
"""Filters of each layer."""
KERNELS = (11, 5, 3)
"""Pixels of the filters' sides."""
STRIDE = 2
ITERATIONS = 10
TUNED = Settings(layer="solve", lr="3%", update="adam")
"""Settings of refinement for `-tiny`."""
BIAS_SCALE = 1e-3
"""Thresholds over the biases that are stored."""

Three = tuple[Tensor, Tensor, Tensor]
"""A tensor of each layer, the shallow one first."""


class State(NamedTuple):
    """What ADMM iterates: in each layer codes z, and copies y ≥ 0 that shall equal them."""

    codes: Three
    """z of each layer, (B, filters, h, w)."""
    copies: Three
    """y of each layer, of the same shapes."""
    multipliers: Three
    """λ of z = y of each layer, of the same shapes."""


def analysed(x: Tensor, kernel: Tensor) -> Tensor:
    """Returns x (B, c, h, w) convolved with (n, c, k, k), SAME padding: (B, n, ⌈h/2⌉, ⌈w/2⌉)."""
    rows, columns = (same_padding(length, kernel.shape[-1], STRIDE) for length in x.shape[-2:])
    return F.conv2d(F.pad(x, (*columns, *rows)), kernel, stride=STRIDE)


def synthesised(codes: Tensor, kernel: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns the sum of filters weighted by codes, (B, c, h, w): the adjoint of `analysed`.

    Args:
        codes: (B, n, ⌈h/2⌉, ⌈w/2⌉).
        kernel: Filters (n, c, k, k).
        size: (h, w).
    """
    # What SAME padding had added before the map is cut off.
    top, left = (same_padding(length, kernel.shape[-1], STRIDE)[0] for length in size)
    x = F.conv_transpose2d(codes, kernel, stride=STRIDE)
    return x[..., top : top + size[0], left : left + size[1]]


def shrunk(x: Tensor, bias: Tensor, multiplier: Tensor) -> Tensor:
    """Returns x lowered by a threshold, |bias| minus the multiplier, and not below 0."""
    threshold = bias.abs() * BIAS_SCALE - multiplier
    return F.relu(x - threshold)


class Step(nn.Module):
    """One ADMM iteration over the three layers, from the shallow one to the deep (ρ = 1)."""

    def forward(
        self, state: State, sparse: Tensor, known: Three, kernels: Three, biases: Three
    ) -> State:
        """Returns the state after the iteration.

        Args:
            state: State before it.
            sparse: (B, 1, H, W) metres, 0 = unknown: what the first layer fits.
            known: 1 where each layer fits its input, else 0 (`covered`).
            kernels: Filters (n, c, k, k) of each layer.
            biases: Bias () of each layer.
        """
        codes = list(state.codes)
        copies = list(state.copies)
        multipliers = list(state.multipliers)
        for layer, kernel in enumerate(kernels):
            # The codes that explain the layer's input, near the copies.
            target = sparse if layer == 0 else known[layer] * copies[layer - 1]
            start = copies[layer] - multipliers[layer]
            explained = known[layer] * synthesised(start, kernel, _size(target))
            codes[layer] = analysed(target - explained, kernel) / 2 + start
            # The copies near the codes and near what the deeper layer has of them.
            if layer + 1 < len(kernels):
                above = synthesised(codes[layer + 1], kernels[layer + 1], _size(codes[layer]))
                copies[layer] = shrunk(codes[layer] + above, biases[layer], multipliers[layer]) / 2
            else:
                copies[layer] = shrunk(codes[layer], biases[layer], multipliers[layer])
            multipliers[layer] = multipliers[layer] + codes[layer] - copies[layer]
        return State(_three(codes), _three(copies), _three(multipliers))


class Solve(nn.Module):
    """Sparse depth (B, 1, H, W) → codes of the last layer (B, 32, ⌈H/8⌉, ⌈W/8⌉)."""

    def __init__(self, iterations: int) -> None:
        super().__init__()
        self.iterations = iterations
        self.step = Step()

    def forward(self, sparse: Tensor, kernels: Three, biases: Three) -> Tensor:
        """Returns the last layer's codes (B, n, ⌈H/8⌉, ⌈W/8⌉) after all iterations.

        Args:
            sparse: (B, 1, H, W) metres, 0 = unknown.
            kernels: Filters (n, c, k, k) of each layer.
            biases: Bias () of each layer.
        """
        known = covered((sparse > 0).to(sparse), kernels)
        state = first_state(sparse, known, kernels, biases)
        for _ in range(self.iterations):
            state = self.step(state, sparse, known, kernels, biases)
        return state.codes[-1]


class Synthesis(nn.Module):
    """Synthesis as a submodule, so that the network can be cut behind it."""

    def forward(self, codes: Tensor, kernel: Tensor, size: tuple[int, int]) -> Tensor:
        """Returns the map (B, c, h, w) of `size` (h, w) that codes (B, n, …) synthesise."""
        return synthesised(codes, kernel, size)


class Adnn(nn.Module):
    """Sparse depth (B, 1, H, W) in metres, 0 = unknown → depth (B, 1, H, W) in metres."""

    def __init__(
        self, filters: tuple[int, int, int] = FILTERS, iterations: int = ITERATIONS
    ) -> None:
        super().__init__()
        self.solve = Solve(iterations)
        self.layers = nn.ModuleList(Synthesis() for _ in filters)
        self.kernels = tuple(f"kernel{i}" for i in range(len(filters)))
        self.biases = tuple(f"bias{i}" for i in range(len(filters)))
        channels = 1
        for layer, (count, side) in enumerate(zip(filters, KERNELS, strict=True)):
            shape = (count, channels, side, side)
            deviation = (2 / (side * side * count)) ** 0.5
            self.register_parameter(f"kernel{layer}", nn.Parameter(deviation * torch.randn(shape)))
            self.register_parameter(f"bias{layer}", nn.Parameter(torch.ones(())))
            channels = count

    def forward(self, sparse: Tensor) -> Tensor:
        """Returns depth (B, 1, H, W) from sparse depth of this shape, 0 = unknown; metres."""
        kernels = _three([getattr(self, name) for name in self.kernels])
        biases = _three([getattr(self, name) for name in self.biases])
        x = self.solve(sparse, kernels, biases)
        # Synthesis through all layers, each of which doubles the size.
        sizes = [_size(sparse)]
        for _ in kernels[1:]:
            height, width = sizes[-1]
            sizes.append((math.ceil(height / STRIDE), math.ceil(width / STRIDE)))
        for layer in reversed(range(len(kernels))):
            x = self.layers[layer](x, kernels[layer], sizes[layer])
        return x  # type: ignore[no-any-return]


def covered(mask: Tensor, kernels: Three) -> Three:
    """Returns which entries of each layer's input, 1 or 0, have to be explained by its codes.

    Of the first layer these are the known pixels, of a deeper one the codes whose filter covers any
    that have to be explained in the layer before.

    Args:
        mask: (B, 1, H, W), 1 where depth is known, else 0.
        kernels: Filters (n, c, k, k) of each layer.
    """
    masks = [mask]
    for kernel in kernels[:-1]:
        count = analysed(masks[-1], torch.ones_like(kernel[:1, :1]))
        masks.append((count > 0).to(mask))
    return _three(masks)


def first_state(sparse: Tensor, known: Three, kernels: Three, biases: Three) -> State:
    """Returns the state that ADMM starts from: one pass through all layers, multipliers of 0.

    The arguments are those of `Step`.
    """
    codes: list[Tensor] = []
    copies: list[Tensor] = []
    for layer, kernel in enumerate(kernels):
        target = sparse if layer == 0 else known[layer] * copies[layer - 1]
        codes.append(analysed(target, kernel))
        copies.append(shrunk(codes[layer], biases[layer], torch.zeros_like(codes[layer])))
    multipliers = [torch.zeros_like(of_layer) for of_layer in codes]
    return State(_three(codes), _three(copies), _three(multipliers))


def from_tensorflow(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the state dict with kernels (k, k, c, n), TensorFlow's order, as (n, c, k, k).

    Kernels in torch's order, whose last two sides are equal, stay as they are.
    """
    converted = {}
    for name, tensor in state.items():
        is_tensorflow_kernel = tensor.ndim == 4 and tensor.shape[2] != tensor.shape[3]
        converted[name] = tensor.permute(3, 2, 0, 1) if is_tensorflow_kernel else tensor
    return converted


def _three(tensors: list[Tensor]) -> Three:
    """Returns a list of three as a tuple."""
    first, second, third = tensors
    return first, second, third


def _size(x: Tensor) -> tuple[int, int]:
    """Returns (height, width) of a map (…, h, w)."""
    return x.shape[-2], x.shape[-1]


def _definition(name: str, summary: str) -> ModelDefinition:
    """Returns the definition of a network of this name; that of "-tiny" has weights."""
    own = name.endswith("-tiny")
    weights = Path(__file__).parent / "weights" / f"{name}.safetensors"
    return ModelDefinition(
        name=name,
        summary=summary,
        paper="Chodosh et al., Deep Convolutional Compressed Sensing for LiDAR, ACCV 2018",
        licence="Apache-2.0" if own else "no weights published",
        input_kind="sparse",
        size=Multiple(1),
        build=Adnn,
        layers=(f"solve.step#{ITERATIONS // 2}[0][2]", "solve", "layers.2", "layers.1"),
        defaults=TUNED if own else Settings(layer="solve"),
        checkpoint=weights if own else None,
        read_checkpoint=from_tensorflow,
    )


definitions: dict[str, ModelDefinition] = {
    definition.name: definition
    for definition in (
        _definition("adnn", "codes of convolutional dictionaries, found by ADMM"),
        _definition("adnn-tiny", "adnn, trained on rendered scenes"),
    )
}
