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

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._same_padding import same_padding
from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings

FILTERS = (8, 16, 32)
KERNELS = (11, 5, 3)
STRIDE = 2
ITERATIONS = 10
TUNED = Settings(layer="solve", lr="3%", update="adam")  # of `-tiny`
BIAS_SCALE = 1e-3  # stored biases are a thousand times the thresholds

Three = tuple[Tensor, Tensor, Tensor]


class State(NamedTuple):
    """Of each layer: the codes z, their non-negative copies y, and the multipliers λ of z = y."""

    codes: Three
    copies: Three
    multipliers: Three


def analysed(x: Tensor, kernel: Tensor) -> Tensor:
    """Returns x (B, c, h, w) convolved with (n, c, k, k), SAME padding: (B, n, ⌈h/2⌉, ⌈w/2⌉)."""
    rows, columns = (same_padding(length, kernel.shape[-1], STRIDE) for length in x.shape[-2:])
    return F.conv2d(F.pad(x, (*columns, *rows)), kernel, stride=STRIDE)


def synthesised(codes: Tensor, kernel: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns the sum of filters (n, c, k, k) weighted by codes: (B, c, h, w).

    The adjoint of `analysed`; codes are (B, n, ⌈h/2⌉, ⌈w/2⌉), size is (h, w).
    """
    top, left = (same_padding(length, kernel.shape[-1], STRIDE)[0] for length in size)
    x = F.conv_transpose2d(codes, kernel, stride=STRIDE)
    return x[..., top : top + size[0], left : left + size[1]]


def shrunk(x: Tensor, bias: Tensor, multiplier: Tensor) -> Tensor:
    """Returns x soft-thresholded by |bias| minus the multiplier, and not below 0."""
    return F.relu(x - (bias.abs() * BIAS_SCALE - multiplier))


class Step(nn.Module):
    """One ADMM iteration over the three layers, from the shallow one to the deep (ρ = 1)."""

    def forward(
        self, state: State, sparse: Tensor, known: Three, kernels: Three, biases: Three
    ) -> State:
        """Returns the state after the iteration; `known` (1 or 0) masks what each layer fits."""
        codes, copies, multipliers = (list(of_layers) for of_layers in state)
        for i, kernel in enumerate(kernels):
            target = known[i] * copies[i - 1] if i else sparse
            start = copies[i] - multipliers[i]
            explained = known[i] * synthesised(start, kernel, _size(target))
            codes[i] = analysed(target - explained, kernel) / 2 + start
            if i + 1 < len(kernels):
                above = synthesised(codes[i + 1], kernels[i + 1], _size(codes[i]))
                copies[i] = shrunk(codes[i] + above, biases[i], multipliers[i]) / 2
            else:
                copies[i] = shrunk(codes[i], biases[i], multipliers[i])
            multipliers[i] = multipliers[i] + codes[i] - copies[i]
        return State(_three(codes), _three(copies), _three(multipliers))


class Solve(nn.Module):
    """Sparse depth (B, 1, H, W) → codes of the last layer (B, 32, ⌈H/8⌉, ⌈W/8⌉)."""

    def __init__(self, iterations: int) -> None:
        super().__init__()
        self.iterations = iterations
        self.step = Step()

    def forward(self, sparse: Tensor, kernels: Three, biases: Three) -> Tensor:
        known = covered((sparse > 0).to(sparse), kernels)
        state = first_state(sparse, known, kernels, biases)
        for _ in range(self.iterations):
            state = self.step(state, sparse, known, kernels, biases)
        return state.codes[-1]


class Synthesis(nn.Module):
    """Codes of one layer → the map they synthesise, of `size`."""

    def forward(self, codes: Tensor, kernel: Tensor, size: tuple[int, int]) -> Tensor:
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
        for i, (count, kernel) in enumerate(zip(filters, KERNELS, strict=True)):
            shape = (count, filters[i - 1] if i else 1, kernel, kernel)
            deviation = (2 / (kernel * kernel * count)) ** 0.5
            self.register_parameter(f"kernel{i}", nn.Parameter(deviation * torch.randn(shape)))
            self.register_parameter(f"bias{i}", nn.Parameter(torch.ones(())))

    def forward(self, sparse: Tensor) -> Tensor:
        kernels = _three([getattr(self, name) for name in self.kernels])
        biases = _three([getattr(self, name) for name in self.biases])
        codes = self.solve(sparse, kernels, biases)
        sizes = [_size(sparse)]
        for _ in kernels[1:]:
            sizes.append((-(-sizes[-1][0] // STRIDE), -(-sizes[-1][1] // STRIDE)))
        for i in reversed(range(len(kernels))):
            codes = self.layers[i](codes, kernels[i], sizes[i])
        return codes  # type: ignore[no-any-return]


def covered(mask: Tensor, kernels: Three) -> Three:
    """Returns the mask of known pixels (B, 1, H, W), and of the codes that cover any of them."""
    masks = [mask]
    for kernel in kernels[:-1]:
        count = analysed(masks[-1], torch.ones_like(kernel[:1, :1]))
        masks.append((count > 0).to(mask))
    return _three(masks)


def first_state(sparse: Tensor, known: Three, kernels: Three, biases: Three) -> State:
    """Returns the codes of one forward pass, with multipliers of 0."""
    codes: list[Tensor] = []
    copies: list[Tensor] = []
    for i, kernel in enumerate(kernels):
        codes.append(analysed(known[i] * copies[i - 1] if i else sparse, kernel))
        copies.append(shrunk(codes[i], biases[i], torch.zeros_like(codes[i])))
    return State(_three(codes), _three(copies), _three([torch.zeros_like(z) for z in codes]))


def from_tensorflow(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the state dict with kernels (k, k, c, n), TensorFlow's order, as (n, c, k, k)."""
    return {
        name: tensor.permute(3, 2, 0, 1)
        if tensor.ndim == 4 and tensor.shape[2] != tensor.shape[3]
        else tensor
        for name, tensor in state.items()
    }


def _three(parts: list[Tensor]) -> Three:
    first, second, third = parts
    return first, second, third


def _size(x: Tensor) -> tuple[int, int]:
    return x.shape[-2], x.shape[-1]


def _definition(name: str, summary: str) -> ModelDefinition:
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
