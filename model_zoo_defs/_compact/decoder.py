"""The coarse-to-fine decoder: features of a level, its change of depth, and the error."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._compact.fit import FIT_HEADS, PriorFit
from model_zoo_defs._compact.points import MASKED, Residual, resize
from model_zoo_defs._compact.prior import Prior

DECODER_CHANNELS = {"s2": 16, "s4": 32, "s8": 64, "s16": 96, "s32": 96}
STRIDES = {"s16": 16, "s8": 8, "s4": 4, "s2": 2}
# Channels of the prior, besides the features. At 1/16: estimates, their standard deviations,
# reliability, value and validity. At the other levels: value, validity, and the residual of the
# points against it with its standard deviation.
PRIOR_HINTS = {"s16": 3 * FIT_HEADS + 2, "s8": 4, "s4": 4, "s2": 4}
# Untrained, a prior is followed where the points' residuals against it have a much smaller std
# than the points: logit = bias + gain * reliability, less for neighbours than for the own cell.
PRIOR_GAIN = 4.5
PRIOR_BIAS = -3.0
PRIOR_SIDE = -2.0
# The initial weights (as logits) make the untrained network a fair interpolator: follow the depth
# so far, correct it by the residual of the own cell, else of the nearest ones.
KEEP = 4.0
STAY = -2.0
STAY_PUT = 6.0
PULL = -4.0
# Updates of spatial propagation at a level.
PROPAGATION_STEPS = 6
# Of the residuals in the 3×3 cells: the own one, then the four beside it, then the corners.
NEIGHBOURS = (-0.5, 0.5, -0.5, 0.5, 2.5, 0.5, -0.5, 0.5, -0.5)


def neighbours(x: Tensor) -> Tensor:
    """The 3 x 3 neighbourhood of a map (B, 1, h, w) as channels (B, 9, h, w), edges repeated."""
    height, width = x.shape[-2:]
    padded = F.pad(x, (1, 1, 1, 1), mode="replicate")
    shifts = [(i, j) for i in range(3) for j in range(3)]
    return torch.cat([padded[..., i : i + height, j : j + width] for i, j in shifts], dim=1)


def bilinear_logits() -> Tensor:
    """Logits (36,) that make a softmax over 3 x 3 neighbours enlarge twofold bilinearly."""
    ends = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.75, 0.25]])  # of the two halves of a cell
    weights = torch.einsum("ai,bj->ijab", ends, ends).reshape(9, 4)
    return weights.clamp(min=1e-3).log().flatten()


class Block(nn.Module):
    """One level's features, (B, out, h, w), from all inputs of the level and hints of a prior."""

    def __init__(self, channels: int, out: int, hints: int = 0):
        super().__init__()
        self.enter = nn.Conv2d(channels, out, 3, padding=1)
        self.first = nn.Conv2d(out, out, 3, padding=1)
        self.second = nn.Conv2d(out, out, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        if hints:
            self.enter_prior = nn.Conv2d(hints, out, 3, padding=1, bias=False)
            nn.init.zeros_(self.enter_prior.weight)

    def forward(self, x: Tensor, hints: Tensor | None = None) -> Tensor:
        x = self.enter(x) if hints is None else self.enter(x) + self.enter_prior(hints)
        x = F.relu(x)
        return F.relu(x + self.second(F.relu(self.first(x))))


class Head(nn.Module):
    """How the features of a level move its depth: weights of candidates, and a remainder."""

    def __init__(self, channels: int, candidates: int):
        super().__init__()
        self.candidates = candidates
        self.weigh = nn.Conv2d(channels, candidates + 1 + 10 + 1, 1)
        nn.init.normal_(self.weigh.weight, std=1e-2)
        bias = torch.zeros(candidates + 12)
        bias[0] = KEEP if candidates == 9 else 0.0
        bias[candidates + 1 : -1] = torch.tensor((STAY, *NEIGHBOURS))
        self.weigh.bias = nn.Parameter(bias)
        self.weigh_prior = nn.Conv2d(channels, candidates, 1)
        nn.init.zeros_(self.weigh_prior.weight)
        side = torch.full((candidates,), PRIOR_SIDE if candidates == 9 else 0.0)
        if candidates == 9:
            side[4] = 0.0
        self.weigh_prior.bias = nn.Parameter(PRIOR_BIAS + side)
        self.gain_prior = nn.Parameter(torch.tensor(PRIOR_GAIN))

    def forward(
        self, features: Tensor, before: Tensor, candidates: Tensor, residual: Residual,
        of_prior: tuple[Tensor, Tensor, Tensor] | None = None,
    ) -> Tensor:  # fmt: skip
        """The depth of the level, (B, 1, h, w): `before` moved towards the weighted candidates.

        candidates (B, n, h, w) are depths; of_prior: as many more from the prior, where they are
        known, and the reliability of the prior.
        """
        weights = self.weigh(features).float()
        follow, correct, rest = weights.tensor_split((self.candidates + 1, self.candidates + 11), 1)
        if of_prior is not None:
            more, valid, reliability = of_prior
            candidates = torch.cat([candidates, more], 1)
            logits = self.weigh_prior(features).float() + self.gain_prior * reliability
            logits = torch.where(valid > 0, logits, MASKED)
            follow = torch.cat([follow, logits], 1)
        moved = (follow.softmax(1)[:, 1:] * (candidates - before)).sum(1, keepdim=True)
        nothing = torch.zeros_like(residual.density)
        reliability = torch.cat([nothing, neighbours(residual.reliability)], dim=1)
        corrections = torch.cat([nothing, neighbours(residual.mean)], dim=1)
        corrected = ((correct + reliability).softmax(1) * corrections).sum(1, keepdim=True)
        return cast(Tensor, before + moved + corrected + rest)


class SpatialPropagation(nn.Module):
    """Propagation of depth among 3 x 3 neighbours, several times with the same weights.

    After every step the depth is pulled to the points of its cell, by at most their inlier weight
    (Cheng et al., "Depth estimation via affinity learned with convolutional spatial propagation
    network", ECCV 2018). Untrained, depth hardly changes.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.weigh = nn.Conv2d(channels, 9 + 1, 3, padding=1)
        nn.init.normal_(self.weigh.weight, std=1e-2)
        bias = torch.zeros(10)
        bias[4], bias[9] = STAY_PUT, PULL
        self.weigh.bias = nn.Parameter(bias)

    def forward(self, features: Tensor, depth: Tensor, moments: Tensor, stride: int) -> Tensor:
        """The propagated depth (B, 1, h, w) of a level; `moments` as `Points.moments`."""
        weights = self.weigh(features).float()
        follow = weights[:, :9].softmax(1)
        if stride > 2:
            moments = F.avg_pool2d(moments, stride // 2)
        count, density, value, _ = moments.chunk(4, dim=1)
        at_points = value / density.clamp(min=1e-6)
        pull = torch.sigmoid(weights[:, 9:]) * density / count.clamp(min=1e-6)
        for _ in range(PROPAGATION_STEPS):
            depth = (follow * neighbours(depth)).sum(1, keepdim=True)
            depth = depth + pull * (at_points - depth)
        return depth


class SigmaHead(nn.Module):
    """The expected absolute error of log depth at full size, from features at 1/2."""

    def __init__(self, channels: int):
        super().__init__()
        self.enter = nn.Conv2d(channels, 16, 3, padding=1)
        self.leave = nn.Conv2d(16, 1, 1)
        nn.init.zeros_(self.leave.weight)
        self.leave.bias = nn.Parameter(torch.tensor([-3.0]))

    def forward(self, features: Tensor, hints: Tensor) -> Tensor:
        x = torch.cat([features, hints.to(features.dtype)], 1)
        log_scale = self.leave(F.relu(self.enter(x))).float()
        size = (2 * x.shape[-2], 2 * x.shape[-1])
        return torch.exp(resize(log_scale, size).clamp(-7.0, 2.0))


def prior_hints(prior: Prior, fit: PriorFit, before: Tensor, level: str) -> Tensor:
    """The prior as a level's features see it, (B, PRIOR_HINTS[level], h, w)."""
    if level != "s16":
        return prior.hints(before, STRIDES[level])
    value, valid = prior.at(16)
    fits = [(fit.estimates - before) * fit.valid, fit.std * fit.valid, fit.reliability]
    return torch.cat([*fits, (value - before) * valid, valid], 1)


class PriorCandidates(NamedTuple):
    """Depths (B, n, h, w) that follow a prior."""

    depth: Tensor
    known: Tensor
    reliability: Tensor


def prior_candidates(prior: Prior, fit: PriorFit, depth: Tensor, level: str) -> PriorCandidates:
    """The depths that follow the prior at a level, where they are known, and its reliability.

    At 1/16 the fits; elsewhere the depths of the coarser neighbours plus the change of the prior
    from there to here.
    """
    if level == "s16":
        return PriorCandidates(fit.estimates, fit.valid, fit.reliability)
    stride = STRIDES[level]
    value, valid = prior.at(stride)
    coarse, known = prior.at(2 * stride)
    both = torch.cat([neighbours(depth - coarse), neighbours(known)], 1)
    offset, known = F.interpolate(both, scale_factor=2.0, mode="nearest").chunk(2, 1)
    reliability = resize(fit.reliability.mean(1, keepdim=True), value.shape[-2:])
    return PriorCandidates(value + offset, valid * known, reliability)
