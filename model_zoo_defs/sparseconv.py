"""Sparsity-invariant CNN (Uhrig et al., 3DV 2017): convolutions that count known pixels only.

Input: sparse depth in metres (0 = unknown), any size. Output: dense depth in metres. Five layers
(11, 7, 5, 3, 3; 16 channels) map features and a mask of known pixels; a last 1×1 convolution gives
depth. The paper's z is the features behind the first layer; the mask is not changed.

There are two forms of the network:
- `sparseconv`, the most used port (yxgeee/DepthComplete, MIT): a layer divides by the number of
  known values over all its input channels; the last convolution takes features and mask (17 → 1).
- `sparseconv-nomask`, that of the paper and of nchodosh/Super-LiDAR (no licence named), which Wang
  et al. used: a layer divides by the number of known pixels; the last convolution takes the
  features only. Its TensorFlow variables (`sp_conv1/kernel` … `conv/kernel`) are read from .npz.

Written from the published description of both. Only the weights of `-tiny` ship.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Settings

KERNELS = (11, 7, 5, 3, 3)
CHANNELS = 16
TUNED = Settings(layer="sparse_convs.1[0]", lr="3%", update="adam")  # of `-tiny`
MIN_COUNT = 1e-5  # what the port divides by where nothing is known
EPSILON = 1e-8  # what the paper's form adds to the number of known pixels
VARIABLES = {  # of Super-LiDAR
    "conv/kernel": "mask_conv.weight",
    **{f"sp_conv{i + 1}/kernel": f"sparse_convs.{i}.sparse_conv.conv.weight" for i in range(5)},
    **{f"sp_conv{i + 1}/bias": f"sparse_convs.{i}.sparse_conv.bias" for i in range(5)},
}


class SparseConv(nn.Module):
    """(B, c, h, w) features, their (B, 1, h, w) mask → `out` features, mask grown by a kernel."""

    def __init__(self, channels: int, out: int, kernel: int, *, per_channel: bool) -> None:
        super().__init__()
        self.per_channel = per_channel
        self.conv = nn.Conv2d(channels, out, kernel, padding=kernel // 2, bias=False)
        self.bias = nn.Parameter(torch.zeros(out))
        # Untrained, every layer averages its known inputs with random weights.
        mean = 1 if per_channel else 1 / channels
        self.conv.weight.data.normal_(mean, mean)

    def forward(self, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        kernel = self.conv.kernel_size[0]
        known = F.avg_pool2d(mask, kernel, 1, kernel // 2, divisor_override=1)
        per_channel = self.per_channel
        count = (known * x.shape[1]).clamp_min(MIN_COUNT) if per_channel else known + EPSILON
        x = self.conv(x * mask) / count + self.bias.reshape(1, -1, 1, 1)
        return x, F.max_pool2d(mask, kernel, 1, kernel // 2)


class Block(nn.Module):
    """A sparse convolution and a ReLU on its features."""

    def __init__(self, channels: int, out: int, kernel: int, *, per_channel: bool) -> None:
        super().__init__()
        self.sparse_conv = SparseConv(channels, out, kernel, per_channel=per_channel)

    def forward(self, pair: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        x, mask = self.sparse_conv(*pair)
        return F.relu(x), mask


class SparseConvNet(nn.Module):
    """Sparse depth (B, 1, H, W) in metres, 0 = unknown → depth (B, 1, H, W) in metres.

    Args:
        with_mask: Whether the last convolution takes the mask too, and layers count known values
            over all input channels.
        width: Channels of the features.
    """

    def __init__(self, *, with_mask: bool = True, width: int = CHANNELS) -> None:
        super().__init__()
        self.with_mask = with_mask
        channels = (1, *[width] * len(KERNELS))
        self.sparse_convs = nn.Sequential(
            *(
                Block(channels[index], width, kernel, per_channel=with_mask)
                for index, kernel in enumerate(KERNELS)
            )
        )
        self.mask_conv = nn.Conv2d(width + with_mask, 1, 1)
        self.mask_conv.weight.data[:, :width] = 1 / width
        self.mask_conv.bias.data.zero_()  # type: ignore[union-attr]

    def forward(self, sparse: Tensor) -> Tensor:
        x, mask = self.sparse_convs((sparse, (sparse > 0).to(sparse)))
        return self.mask_conv(torch.cat([x, mask], 1) if self.with_mask else x)  # type: ignore[no-any-return]


def from_tensorflow(state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Returns Super-LiDAR's variables under this file's names; any other state dict as it is."""
    if "conv/kernel" not in state:
        return state
    renamed = {
        VARIABLES.get(name, name): tensor.permute(3, 2, 0, 1)
        if name.endswith("/kernel")
        else tensor.flatten()
        for name, tensor in state.items()
    }
    return {"mask_conv.bias": torch.zeros(1), **renamed}  # theirs has none


def _definition(name: str, summary: str, with_mask: bool = True) -> ModelDefinition:
    own = name.endswith("-tiny")
    weights = Path(__file__).parent / "weights" / f"{name}.safetensors"
    return ModelDefinition(
        name=name,
        summary=summary,
        paper="Uhrig et al., Sparsity Invariant CNNs, 3DV 2017",
        licence="Apache-2.0" if own else "published weights: MIT, not shipped",
        input_kind="sparse",
        size=Multiple(1),
        build=partial(SparseConvNet, with_mask=with_mask),
        layers=tuple(f"sparse_convs.{index}[0]" for index in range(len(KERNELS))),
        defaults=TUNED if own else Settings(),
        checkpoint=weights if own else None,
        read_checkpoint=None if with_mask else from_tensorflow,
    )


definitions: dict[str, ModelDefinition] = {
    one.name: one
    for one in (
        _definition("sparseconv", "sparsity-invariant convolutions, the mask beside the features"),
        _definition("sparseconv-nomask", "the same without the mask in the last layer", False),
        _definition("sparseconv-tiny", "sparseconv, trained on rendered scenes"),
    )
}
