"""Late fusion of rgb and sparse depth (Jaritz et al., 3DV 2018): two NASNet encoders, one decoder.

Own implementation of the paper; the authors published neither code nor weights. From the paper: an
encoder of NASNet cells for each modality, no batch norm behind its first strided convolution (the
zeros of the sparse map would shift the statistics), no mask of known pixels, both encoders'
features concatenated before the decoder, skips, and training on inverse depth. Chosen here, as no
public source says: the mobile NASNet-A (4 cells a stage, 44 filters), skips from both encoders, a
decoder of bilinear upsampling and one 3×3 convolution a level up to 1/2, and softplus for inverse
depth, which keeps depth between 0 and 200 m.

Input: rgb as (x − 0.5) / 0.5, sparse depth in metres (0 = unknown); H and W are multiples of 32.
Output: depth in metres. The paper's z (Wang et al.) is "the 8× feature map": here the decoder's.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple, Normalisation, Settings

FARTHEST = 200.0
"""Metres; our choice, so that depth stays finite."""
TUNED = Settings(layer="decoder.s8", lr="10%")
"""Settings of refinement for `-tiny` and 500 points."""
LEVELS = ("s16", "s8", "s4", "s2")
"""Levels of the decoder: at 1/16, 1/8, 1/4 and 1/2 of the image's size."""


def pointwise(channels: int, out: int) -> nn.Sequential:
    """Returns ReLU, 1×1 convolution, batch norm: `channels` → `out` channels."""
    return nn.Sequential(nn.ReLU(), nn.Conv2d(channels, out, 1, bias=False), nn.BatchNorm2d(out))


def separable(channels: int, out: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Returns ReLU, separable convolution, batch norm, twice: `channels` → `out` channels.

    Args:
        channels: Channels of the input.
        out: Channels of the output.
        kernel: Pixels of the kernels' sides.
        stride: Stride of the first convolution.
    """
    layers: list[nn.Module] = []
    for count, step in ((channels, stride), (out, 1)):
        layers += [
            nn.ReLU(),
            nn.Conv2d(count, count, kernel, step, kernel // 2, groups=count, bias=False),
            nn.Conv2d(count, out, 1, bias=False),
            nn.BatchNorm2d(out),
        ]
    return nn.Sequential(*layers)


class Halved(nn.Module):
    """Features at half the size: half of the channels each from the even and the odd pixels.

    Even are the pixels (2i, 2j), odd the pixels (2i + 1, 2j + 1).
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.even = nn.Conv2d(channels, out // 2, 1, bias=False)
        self.odd = nn.Conv2d(channels, out - out // 2, 1, bias=False)
        self.norm = nn.BatchNorm2d(out)

    def forward(self, x: Tensor) -> Tensor:
        """Returns (B, out, h/2, w/2) from (B, channels, h, w); the sides are even."""
        x = F.relu(x)
        even = self.even(x[..., ::2, ::2])
        odd = self.odd(x[..., 1::2, 1::2])
        return self.norm(torch.cat([even, odd], dim=1))  # type: ignore[no-any-return]


def fitted(channels: int, width: int, halved: bool) -> nn.Module:
    """Returns a layer that brings earlier features to the shape of the later ones.

    Args:
        channels: Channels of the earlier features.
        width: Channels of the result.
        halved: Whether the earlier features are twice as large as the later ones.
    """
    return Halved(channels, width) if halved else pointwise(channels, width)


def averaged(x: Tensor, stride: int = 1) -> Tensor:
    """Returns the means of 3×3 pixels, (B, c, h/stride, w/stride); those outside do not count."""
    return F.avg_pool2d(x, 3, stride, 1, count_include_pad=False)


class NormalCell(nn.Module):
    """NASNet-A's normal cell on the last two features: 6·width channels, same size.

    Args:
        earlier: Channels of the features before the last.
        later: Channels of the last features.
        width: Channels inside the cell.
        halved: Whether the earlier features are twice as large as the later ones.
    """

    def __init__(self, earlier: int, later: int, width: int, *, halved: bool) -> None:
        super().__init__()
        self.earlier = fitted(earlier, width, halved)
        self.later = pointwise(later, width)
        self.later5 = separable(width, width, 5)
        self.later3 = separable(width, width, 3)
        self.earlier5 = separable(width, width, 5)
        self.earlier3 = separable(width, width, 3)
        self.earlier3_too = separable(width, width, 3)

    def forward(self, earlier: Tensor, later: Tensor) -> Tensor:
        """Returns (B, 6·width, h, w) from the last two features.

        Args:
            earlier: The features before the last (B, earlier, h, w), or of twice the size.
            later: The last features (B, later, h, w).
        """
        earlier = self.earlier(earlier)
        later = self.later(later)
        # The earlier features and five sums of two.
        concatenated = [
            earlier,
            self.later5(later) + self.earlier3(earlier),
            self.earlier5(earlier) + self.earlier3_too(earlier),
            averaged(later) + earlier,
            2 * averaged(earlier),
            self.later3(later) + later,
        ]
        return torch.cat(concatenated, dim=1)


class ReductionCell(nn.Module):
    """NASNet-A's reduction cell on the last two features: 4·width channels, half the size.

    Args:
        earlier: Channels of the features before the last; None if there are none yet.
        later: Channels of the last features.
        width: Channels inside the cell.
        halved: Whether the earlier features are twice as large as the later ones.
    """

    def __init__(self, earlier: int | None, later: int, width: int, *, halved: bool) -> None:
        super().__init__()
        # At the beginning, the last features count as those before, too.
        self.earlier = nn.Identity() if earlier is None else fitted(earlier, width, halved)
        earlier_width = later if earlier is None else width
        self.later = pointwise(later, width)
        self.later5 = separable(width, width, 5, 2)
        self.earlier7 = separable(earlier_width, width, 7, 2)
        self.earlier7_too = separable(earlier_width, width, 7, 2)
        self.earlier5 = separable(earlier_width, width, 5, 2)
        self.first3 = separable(width, width, 3)

    def forward(self, earlier: Tensor, later: Tensor) -> Tensor:
        """Returns (B, 4·width, h/2, w/2) from the last two features.

        Args:
            earlier: The features before the last (B, earlier, h, w), or of twice the size.
            later: The last features (B, later, h, w).
        """
        earlier = self.earlier(earlier)
        later = self.later(later)
        # The cell's five sums of two, at half the size. The first goes into the fourth and fifth.
        first = self.later5(later) + self.earlier7(earlier)
        largest = F.max_pool2d(later, 3, 2, 1)
        second = largest + self.earlier7_too(earlier)
        third = averaged(later, 2) + self.earlier5(earlier)
        fourth = averaged(first) + second
        fifth = self.first3(first) + largest
        return torch.cat([second, third, fourth, fifth], dim=1)


class Stage(nn.Module):
    """A reduction cell and normal cells: the last two features → the last two features.

    Args:
        earlier: Channels of the features before the last; None if there are none yet.
        later: Channels of the last features.
        reduced: Channels inside the reduction cell.
        normal: Channels inside the normal cells.
        count: Number of normal cells.
        halved: Whether the earlier features are twice as large as the later ones.
    """

    def __init__(
        self,
        earlier: int | None,
        later: int,
        reduced: int,
        normal: int,
        count: int,
        *,
        halved: bool,
    ) -> None:
        super().__init__()
        self.cells = nn.ModuleList([ReductionCell(earlier, later, reduced, halved=halved)])
        # Channels of the last two features.
        self.earlier = later
        self.later = 4 * reduced
        for number in range(count):
            # Before the first one, the reduction cell has halved the size.
            is_first = number == 0
            self.cells.append(NormalCell(self.earlier, self.later, normal, halved=is_first))
            self.earlier = self.later
            self.later = 6 * normal

    def forward(self, earlier: Tensor, later: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the last two features behind the stage from the last two before it."""
        for cell in self.cells:
            newest = cell(earlier, later)
            earlier = later
            later = newest
        return earlier, later


class Encoder(nn.Module):
    """(B, channels, H, W) → features at 1/2, 1/4, 1/8, 1/16, 1/32 as NASNet-A goes down.

    Args:
        channels: Channels of the input.
        width: Filters of the normal cells at 1/8.
        cells: Number of normal cells a stage.
    """

    def __init__(self, channels: int, width: int, cells: int) -> None:
        super().__init__()
        # A convolution to 1/2.
        stem = width * 8 // 11  # NASNet's 32 before its 44
        self.stem = nn.Conv2d(channels, stem, 3, 2, 1)  # without batch norm, as in the paper
        earlier = None
        later = stem
        halved = False
        self.channels = [stem]
        # Stages to 1/4 (without normal cells), 1/8, 1/16 and 1/32.
        self.stages = nn.ModuleList()
        for reduced, normal, count in (
            (width // 4, 0, 0),
            (width // 2, width, cells),
            (2 * width, 2 * width, cells),
            (4 * width, 4 * width, cells),
        ):
            stage = Stage(earlier, later, reduced, normal, count, halved=halved)
            earlier = stage.earlier
            later = stage.later
            # Behind a reduction cell alone, the earlier features are twice as large.
            halved = count == 0
            self.stages.append(stage)
            self.channels.append(later)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Returns the features at 1/2, 1/4, 1/8, 1/16 and 1/32 of x (B, channels, H, W)."""
        later = self.stem(x)
        earlier = later
        features = [later]
        for stage in self.stages:
            earlier, later = stage(earlier, later)
            features.append(later)
        return features


def convolved(channels: int, out: int) -> nn.Sequential:
    """Returns 3×3 convolution, batch norm, ReLU: `channels` → `out` channels."""
    return nn.Sequential(
        nn.Conv2d(channels, out, 3, padding=1, bias=False), nn.BatchNorm2d(out), nn.ReLU()
    )


class Level(nn.Sequential):
    """Features at twice the size, from coarser ones and both encoders' skips of that size."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__(*convolved(channels, out))

    def forward(self, x: Tensor, *skips: Tensor) -> Tensor:
        """Returns (B, out, 2h, 2w) from coarser features (B, c, h, w) and skips (B, d, 2h, 2w)."""
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        return super().forward(torch.cat([x, *skips], dim=1))  # type: ignore[no-any-return, no-untyped-call]


class LateFusion(nn.Module):
    """Depth (B, 1, H, W) in metres from rgb (B, 3, H, W) and sparse (B, 1, H, W) in metres.

    Args:
        width: Filters of the cells at 1/8; each later stage has twice as many.
        cells: Normal cells a stage.
    """

    def __init__(self, width: int = 44, cells: int = 4) -> None:
        super().__init__()
        self.rgb = Encoder(3, width, cells)
        self.sparse = Encoder(1, width, cells)
        # Both encoders' features at 1/32, and their skips at the other sizes.
        *skips, deepest = (2 * count for count in self.rgb.channels)
        channels = 4 * width
        self.fuse = convolved(deepest, channels)
        # Each level but the first has half the channels of the one before.
        self.decoder = nn.ModuleDict()
        for level, skip in zip(LEVELS, reversed(skips), strict=True):
            out = channels if level == "s16" else channels // 2
            self.decoder[level] = Level(channels + skip, out)
            channels = out
        self.inverse = nn.Conv2d(channels, 1, 3, padding=1)
        nn.init.constant_(self.inverse.bias, -1.5)  # type: ignore[arg-type]  # about 5 m

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        """Returns depth (B, 1, H, W) from image (B, 3, H, W) and sparse depth; in metres."""
        rgb_skips = self.rgb(rgb)
        sparse_skips = self.sparse(sparse)
        x = self.fuse(torch.cat([rgb_skips.pop(), sparse_skips.pop()], dim=1))
        for layer in self.decoder.values():
            x = layer(x, rgb_skips.pop(), sparse_skips.pop())
        x = F.interpolate(self.inverse(x), rgb.shape[-2:], mode="bilinear", align_corners=False)
        return 1 / (F.softplus(x) + 1 / FARTHEST)


def _definition(name: str, summary: str, width: int, cells: int) -> ModelDefinition:
    """Returns the definition of a network of this name; that of "-tiny" has weights.

    Width and cells are as in `LateFusion`.
    """
    own = name.endswith("-tiny")
    weights = Path(__file__).parent / "weights" / f"{name}.safetensors"
    return ModelDefinition(
        name=name,
        summary=summary,
        paper="Jaritz et al., Sparse and Dense Data with CNNs, 3DV 2018",
        licence="Apache-2.0" if own else "no weights published",
        input_kind="rgb+sparse",
        size=Multiple(32),
        normalisation=Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)),
        build=partial(LateFusion, width, cells),
        layers=("fuse", "decoder.s16", "decoder.s8", "decoder.s4", "decoder.s2"),
        defaults=TUNED if own else Settings(layer="decoder.s8"),
        checkpoint=weights if own else None,
    )


definitions: dict[str, ModelDefinition] = {
    definition.name: definition
    for definition in (
        _definition("latefusion", "two NASNet-A encoders, fused late, own building", 44, 4),
        _definition(
            "latefusion-tiny",
            "narrower, one normal cell a stage, trained on rendered scenes",
            16,
            1,
        ),
    )
}
