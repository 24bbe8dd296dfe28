"""`compact`, the network that comes with the program: an image and some depths in, dense depth out.

Everything happens in log depth minus the median log depth of the points, so depths ten times
larger give an answer ten times larger. The depth is built from coarse to fine:

1. `PointFit` fits a plane through the points around every 1/16 cell, once per head; how much a
   point counts depends on its distance and on how alike the picture looks in the two places.
2. At 1/16, 1/8, 1/4 and 1/2 the residuals at the points (against the depth so far) are averaged
   over cells. The features of the level say which of the neighbouring cells' residuals, and
   which of the neighbouring coarser depths, each cell takes over.
3. The last step to full size mixes the 3 x 3 neighbours with weights made from the features.

A point is evidence, never copied: depth depends smoothly on the features of every level, which
is what refinement moves.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    ModelDefinition,
    Multiple,
    Normalisation,
    RefineDefaults,
)

# (channels in, out, kernel, stride, expansion, blocks) of the stages at 1/2 .. 1/32:
# EfficientNet-Lite0 without its last block and its classifier.
STAGES = {
    "s2": ((32, 16, 3, 1, 1, 1),),
    "s4": ((16, 24, 3, 2, 6, 2),),
    "s8": ((24, 40, 5, 2, 6, 2),),
    "s16": ((40, 80, 3, 2, 6, 3), (80, 112, 5, 1, 6, 3)),
    "s32": ((112, 192, 5, 2, 6, 4),),
}
ENCODER_CHANNELS = {"s2": 16, "s4": 24, "s8": 40, "s16": 112, "s32": 192}
DECODER_CHANNELS = {"s2": 16, "s4": 32, "s8": 64, "s16": 96, "s32": 96}
STRIDES = {"s16": 16, "s8": 8, "s4": 4, "s2": 2}
FIT_HEADS = 4
FIT_KEY = 16
FIT_CHUNK = 1024
MASKED = -1e4
# the pretrained features have a standard deviation of about 10
FEATURE_SCALE = 0.1
# The initial weights (as logits) make the untrained network a fair interpolator: follow the depth
# so far, correct it by the residual of the own cell, else of the nearest ones.
KEEP, STAY = 4.0, -2.0
NEIGHBOURS = (-0.5, 0.5, -0.5, 0.5, 2.5, 0.5, -0.5, 0.5, -0.5)


class SamePaddedConv(nn.Conv2d):
    """A convolution padded as TensorFlow's SAME does for even sizes: the odd pixel at the end."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int = 1, groups: int = 1):
        super().__init__(channels, out, kernel, stride, groups=groups)
        before = (kernel - stride) // 2
        self.margins = (before, kernel - stride - before) * 2

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(F.pad(x, self.margins))


class InvertedBottleneck(nn.Module):
    """An MBConv block of EfficientNet-Lite, its batch normalisation folded into the weights."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        hidden = channels * expansion
        self.expand = nn.Conv2d(channels, hidden, 1) if expansion != 1 else None
        self.depthwise = SamePaddedConv(hidden, hidden, kernel, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, out, 1)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = cast(Tensor, self.project(F.relu6(self.depthwise(y))))
        return x + y if self.residual else y


class Encoder(nn.Module):
    """Image features at 1/2, 1/4, 1/8, 1/16 and 1/32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = SamePaddedConv(3, 32, 3, 2)
        self.stages = nn.ModuleDict(
            {level: nn.Sequential(*self._blocks(rows)) for level, rows in STAGES.items()}
        )

    @staticmethod
    def _blocks(rows: tuple[tuple[int, int, int, int, int, int], ...]) -> list[nn.Module]:
        blocks: list[nn.Module] = []
        for channels, out, kernel, stride, expansion, count in rows:
            blocks.append(InvertedBottleneck(channels, out, kernel, stride, expansion))
            blocks += [InvertedBottleneck(out, out, kernel, 1, expansion) for _ in range(count - 1)]
        return blocks

    def forward(self, rgb: Tensor) -> dict[str, Tensor]:
        x = F.relu6(self.stem(rgb))
        features = {}
        for level, stage in self.stages.items():
            x = stage(x)
            features[level] = x * FEATURE_SCALE
        return features


class Points:
    """The sparse depth of a batch: log depth minus its median, and where it is known.

    value, mask: (B, 1, H, W); median: (B, 1, 1, 1), 0 for a sample without any point.
    """

    def __init__(self, sparse: Tensor):
        self.mask = (sparse > 0).to(torch.float32)
        log_depth = torch.log(torch.where(sparse > 0, sparse, 1.0).to(torch.float32))
        rows = zip(log_depth.flatten(1), self.mask.flatten(1) > 0, strict=True)
        known = (row[seen] for row, seen in rows)
        medians = [row.median() if row.numel() else row.new_zeros(()) for row in known]
        self.median = torch.stack(medians).view(-1, 1, 1, 1)
        self.value = (log_depth - self.median) * self.mask
        # sums over 2 x 2 pixels are all the residuals need; finer positions change them by less
        # than half a pixel's slope
        moments = torch.cat([self.mask, self.value, self.value.square()], dim=1)
        self.moments = F.avg_pool2d(moments, 2)

    def residual(self, depth: Tensor, stride: int) -> tuple[Tensor, Tensor, Tensor]:
        """(mean, spread, share of known pixels) of points minus `depth`, per cell of `stride`."""
        share, value, square = self.moments.chunk(3, dim=1)
        dense = _resize(depth, share.shape[-2:]) if stride > 2 else depth
        difference = value - dense * share
        squared = square - dense * (2.0 * value - dense * share)
        sums = torch.cat([share, difference, squared], dim=1)
        share, difference, squared = F.avg_pool2d(sums, stride // 2).chunk(3, dim=1)
        known = share.clamp(min=1e-6)
        mean = difference / known
        spread = (squared / known - mean * mean).clamp(min=0.0)
        return mean, torch.sqrt(spread + 1e-6), share


def _cell_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Row and column of every cell's centre, (2, height, width), in cells."""
    rows = torch.arange(height, device=like.device, dtype=torch.float32) + 0.5
    columns = torch.arange(width, device=like.device, dtype=torch.float32) + 0.5
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"))


class PointFit(nn.Module):
    """Weighted local planes through the points, one estimate per head, at 1/16.

    The weight of a cell with points is exp(query . key) / distance^(2 p); p, the ridge of the
    plane's slope (relative to the spread of the points) and the projections are learnt.
    """

    def __init__(self) -> None:
        super().__init__()
        self.near = nn.Conv2d(ENCODER_CHANNELS["s16"], 64, 1)
        self.far = nn.Conv2d(ENCODER_CHANNELS["s32"], 64, 1)
        self.query = nn.Conv2d(64, FIT_HEADS * FIT_KEY, 1)
        self.key = nn.Conv2d(64, FIT_HEADS * FIT_KEY, 1)
        self.power = nn.Parameter(torch.tensor([2.0, 3.0, 4.0, 6.0]).log())
        self.ridge = nn.Parameter(torch.tensor([0.05, 0.1, 0.3, 1.0]).log())
        self.floor = nn.Parameter(torch.tensor(0.3).log())

    def forward(self, near: Tensor, far: Tensor, points: Points) -> tuple[Tensor, Tensor]:
        """(estimates (B, heads, h, w), log distance in cells to the nearest points (B, 1, h, w))"""
        batch, _, height, width = near.shape
        features = F.relu(self.near(near) + _resize(self.far(far), near.shape[-2:]))
        queries = self._per_head(self.query(features))
        keys = self._per_head(self.key(features))
        at, value, known = self._cells(points, height, width)
        seen = known.any(0)
        if not bool(seen.any()):
            return near.new_zeros(batch, FIT_HEADS, height, width).float(), near.new_full(
                (batch, 1, height, width), 5.0
            ).float()
        keys, at, value, known = keys[:, :, seen], at[:, :, seen], value[:, seen], known[:, seen]
        centres = _cell_grid(height, width, value).flatten(1)
        middle = centres.mean(1, keepdim=True)  # small numbers keep the moments exact
        centres, at = centres - middle, at - middle
        # The moments are small differences of large sums, which bfloat16 would leave nothing of.
        with torch.autocast(value.device.type, enabled=False):
            parts = [
                self._fit(queries[:, :, i : i + FIT_CHUNK], centres[:, i : i + FIT_CHUNK], keys,
                          at, value, known)
                for i in range(0, height * width, FIT_CHUNK)
            ]  # fmt: skip
        estimates = torch.cat([part[0] for part in parts], dim=-1)
        distance = torch.cat([part[1] for part in parts], dim=-1)
        return estimates.view(batch, -1, height, width), distance.view(batch, 1, height, width)

    @staticmethod
    def _per_head(x: Tensor) -> Tensor:
        """(B, heads, cells, key) in float32."""
        return x.float().reshape(len(x), FIT_HEADS, FIT_KEY, -1).transpose(2, 3)

    @staticmethod
    def _cells(points: Points, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
        """Mean place (B, 2, cells), mean value (B, cells) of the points of each cell, and if any"""
        mask = points.mask
        pixel = (_cell_grid(mask.shape[-2], mask.shape[-1], mask) / 16.0).unsqueeze(0) * mask
        share, value, at = (F.avg_pool2d(x, 16) for x in (mask, points.value, pixel))
        safe = share.clamp(min=1e-6)
        return (at / safe).flatten(2), (value / safe).flatten(1), (share > 0).flatten(1)

    def _fit(
        self, queries: Tensor, centres: Tensor, keys: Tensor, at: Tensor, value: Tensor,
        known: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Estimates (B, heads, cells) and log distance (B, cells) for some of the cells."""
        square = torch.cdist(centres.t().expand(at.shape[0], -1, -1), at.transpose(1, 2)).square()
        absent = ~known.unsqueeze(1)
        far = torch.log(square + self.floor.exp()).masked_fill(absent, -MASKED)
        alike = queries @ keys.transpose(2, 3) / FIT_KEY**0.5
        weight = (alike - self.power.exp().view(1, -1, 1, 1) * far.unsqueeze(1)).softmax(-1)
        y, x = at.unbind(1)
        products = torch.stack([y, x, value, y * y, x * x, x * y, y * value, x * value], -1)
        moments = weight @ products.unsqueeze(1)
        my, mx, mz, yy, xx, xy, yz, xz = moments.unbind(-1)
        yy, xx, xy = (yy - my * my).clamp(min=0.0), (xx - mx * mx).clamp(min=0.0), xy - mx * my
        yz, xz = yz - my * mz, xz - mx * mz
        damping = self.ridge.exp().view(1, -1, 1) * (yy + xx) + 1e-2
        yy, xx = yy + damping, xx + damping
        determinant = (yy * xx - xy * xy).clamp(min=1e-4)
        slope_y, slope_x = (xx * yz - xy * xz) / determinant, (yy * xz - xy * yz) / determinant
        tilt = slope_y * (centres[0] - my) + slope_x * (centres[1] - mx)
        # far outside the points a plane runs away: half a unit of log depth is as far as it may go
        estimate = mz + 0.5 * torch.tanh(tilt / 0.5)
        nearest = square.masked_fill(absent, 1e6).amin(-1)
        return estimate, 0.5 * torch.log(nearest + 0.1)


def _resize(x: Tensor, size: torch.Size | tuple[int, int]) -> Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=False)


def _neighbours(x: Tensor) -> Tensor:
    """The 3 x 3 neighbourhood of a map (B, 1, h, w) as channels (B, 9, h, w), edges repeated."""
    height, width = x.shape[-2:]
    padded = F.pad(x, (1, 1, 1, 1), mode="replicate")
    shifts = [(i, j) for i in range(3) for j in range(3)]
    return torch.cat([padded[..., i : i + height, j : j + width] for i, j in shifts], dim=1)


def _bilinear_logits() -> Tensor:
    """Logits (36,) that make a softmax over 3 x 3 neighbours enlarge twofold bilinearly."""
    ends = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.75, 0.25]])  # of the two halves of a cell
    weights = torch.einsum("ai,bj->ijab", ends, ends).reshape(9, 4)
    return weights.clamp(min=1e-3).log().flatten()


class Block(nn.Module):
    """One level's features, (B, out, h, w), from everything known at that level."""

    def __init__(self, channels: int, out: int):
        super().__init__()
        self.enter = nn.Conv2d(channels, out, 3, padding=1)
        self.first = nn.Conv2d(out, out, 3, padding=1)
        self.second = nn.Conv2d(out, out, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.enter(x))
        return F.relu(x + self.second(F.relu(self.first(x))))


class Head(nn.Module):
    """How the features of a level move its depth: which neighbours to follow, and a rest."""

    def __init__(self, channels: int, candidates: int):
        super().__init__()
        self.candidates = candidates
        self.weigh = nn.Conv2d(channels, candidates + 1 + 10 + 1, 1)
        nn.init.normal_(self.weigh.weight, std=1e-2)
        bias = torch.zeros(candidates + 12)
        bias[0] = KEEP if candidates == 9 else 0.0
        bias[candidates + 1 : -1] = torch.tensor((STAY, *NEIGHBOURS))
        self.weigh.bias = nn.Parameter(bias)

    def forward(
        self, features: Tensor, before: Tensor, candidates: Tensor, residual: Tensor, share: Tensor
    ) -> Tensor:
        """The depth of the level, (B, 1, h, w): `before` moved towards what the weights choose.

        candidates (B, n, h, w) are depths; residual and share (B, 1, h, w) are of `Points`.
        """
        weights = self.weigh(features).float()
        follow, correct, rest = weights.tensor_split((self.candidates + 1, self.candidates + 11), 1)
        moved = (follow.softmax(1)[:, 1:] * (candidates - before)).sum(1, keepdim=True)
        nothing = torch.zeros_like(share)
        absent = torch.cat([nothing, (_neighbours(share) <= 0) * MASKED], dim=1)
        corrections = torch.cat([nothing, _neighbours(residual)], dim=1)
        corrected = ((correct + absent).softmax(1) * corrections).sum(1, keepdim=True)
        return cast(Tensor, before + moved + corrected + rest)


class Compact(nn.Module):
    """Dense depth (B, 1, H, W) in metres from rgb (B, 3, H, W) and sparse (B, 1, H, W) metres.

    H and W are multiples of 32; 0 in `sparse` is unknown. Without any point the answer is
    finite, with median depth taken as 1 m.
    """

    def __init__(self) -> None:
        super().__init__()
        width, deep = DECODER_CHANNELS, ENCODER_CHANNELS
        self.encoder = Encoder()
        self.fit = PointFit()
        hints = 4  # depth so far, residual, its spread, share of known pixels
        self.decoder = nn.ModuleDict(
            {
                "s32": Block(deep["s32"], width["s32"]),
                "s16": Block(width["s32"] + deep["s16"] + hints + FIT_HEADS + 1, width["s16"]),
                "s8": Block(width["s16"] + deep["s8"] + hints + 1, width["s8"]),
                "s4": Block(width["s8"] + deep["s4"] + hints, width["s4"]),
                "s2": Block(width["s2"] + deep["s2"] + hints + 12, width["s2"]),
            }
        )
        self.narrow = nn.Conv2d(width["s4"], width["s2"], 1)
        self.heads = nn.ModuleDict(
            {
                level: Head(width[level], FIT_HEADS if level == "s16" else 9)
                for level in ("s16", "s8", "s4", "s2")
            }
        )
        self.enlarge = nn.Conv2d(width["s2"], 36, 1)
        nn.init.normal_(self.enlarge.weight, std=1e-2)
        self.enlarge.bias = nn.Parameter(_bilinear_logits())

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        return self.pyramid(rgb, sparse)[-1]

    def pyramid(self, rgb: Tensor, sparse: Tensor) -> list[Tensor]:
        """Depths in metres at 1/16, 1/8, 1/4, 1/2 and full size; training looks at all of them."""
        points = Points(sparse)
        image = self.encoder(rgb)
        estimates, distance = self.fit(image["s16"], image["s32"], points)
        features = self.decoder["s32"](image["s32"])
        depth = estimates.mean(1, keepdim=True)
        extra = [estimates - depth, distance]
        depths = []
        for level, stride in STRIDES.items():
            size = image[level].shape[-2:]
            if level == "s16":
                before, candidates = depth, estimates
            else:
                before = _resize(depth, size)
                candidates = F.interpolate(_neighbours(depth), scale_factor=2.0, mode="nearest")
            residual, spread, share = points.residual(before, stride)
            hints = [before, residual, spread, torch.log1p(share * stride * stride)]
            parts = [_resize(features, size), image[level], *hints, *extra]
            features = self.decoder[level](torch.cat([x.to(features.dtype) for x in parts], 1))
            depth = self.heads[level](features, before, candidates, residual, share)
            depths.append(depth)
            if self.training:  # every level answers for its own step only
                depth = depth.detach()
            extra = [_resize(distance, (size[0] * 2, size[1] * 2))] if level == "s16" else []
            if level == "s4":
                extra, features = [F.pixel_unshuffle(rgb, 2)], self.narrow(features)
        depths.append(self._enlarge(features, depth))
        return [torch.exp(depth + points.median) for depth in depths]

    def _enlarge(self, features: Tensor, depth: Tensor) -> Tensor:
        """Full size: every pixel a mixture of the 3 x 3 depths at 1/2 around it."""
        weights = self.enlarge(features).float()
        weights = weights.reshape(len(depth), 9, 4, *depth.shape[-2:]).softmax(1)
        mixed = (weights * _neighbours(depth).unsqueeze(2)).sum(1)
        return F.pixel_shuffle(mixed, 2)


definitions = {
    "compact": ModelDefinition(
        name="compact",
        summary="the program's own network, trained on rendered scenes only",
        licence="Apache-2.0",
        input_kind="rgb+sparse",
        size=Multiple(32, longest=1280),
        static_graph=True,
        normalisation=Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
        output_kind="depth",
        layers=("decoder.s32", "decoder.s16", "decoder.s8", "decoder.s4", "decoder.s2"),
        defaults=RefineDefaults(layer="decoder.s8", lr="3%"),
        build=Compact,
        checkpoint=Path(__file__).parent / "weights" / "compact.safetensors",
    ),
}
