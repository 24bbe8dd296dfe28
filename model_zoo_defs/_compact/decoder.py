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
    """Returns the 3 x 3 neighbours in a map (B, 1, h, w) as channels (B, 9, h, w), edges repeated.

    Row after row: channel 0 is the neighbour above and to the left, 4 the cell itself.
    """
    height, width = x.shape[-2:]
    padded = F.pad(x, (1, 1, 1, 1), mode="replicate")
    corners = [(top, left) for top in range(3) for left in range(3)]
    shifted = [padded[..., top : top + height, left : left + width] for top, left in corners]
    return torch.cat(shifted, dim=1)


def bilinear_logits() -> Tensor:
    """Returns logits (36,) with which a softmax over 3 x 3 neighbours enlarges bilinearly.

    That is to twice the size: 9 neighbours for each of the 2 x 2 pixels of a cell.
    """
    # Weights of the neighbours along one axis, for the first and the second half of a cell.
    halves = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.75, 0.25]])
    weights = torch.einsum("ai,bj->ijab", halves, halves).reshape(9, 4)
    return weights.clamp(min=1e-3).log().flatten()


class Block(nn.Module):
    """One level's features from all inputs of the level and hints of a prior.

    Args:
        channels: Channels of the inputs.
        out: Channels of the features.
        hints: Channels of the prior's hints; 0 for a level that sees none.
    """

    def __init__(self, channels: int, out: int, hints: int = 0):
        super().__init__()
        self.enter = nn.Conv2d(channels, out, 3, padding=1)
        self.first = nn.Conv2d(out, out, 3, padding=1)
        # Untrained, neither the second convolution nor a prior changes the features.
        self.second = nn.Conv2d(out, out, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        if hints:
            self.enter_prior = nn.Conv2d(hints, out, 3, padding=1, bias=False)
            nn.init.zeros_(self.enter_prior.weight)

    def forward(self, x: Tensor, hints: Tensor | None = None) -> Tensor:
        """Returns (B, out, h, w) from inputs (B, channels, h, w), and hints (B, hints, h, w)."""
        x = self.enter(x) if hints is None else self.enter(x) + self.enter_prior(hints)
        x = F.relu(x)
        return F.relu(x + self.second(F.relu(self.first(x))))


class Head(nn.Module):
    """How the features of a level move its depth: weights of candidates, and a remainder.

    Args:
        channels: Channels of the features.
        candidates: Number of depths that a cell chooses among: 9 of its neighbourhood, or the
            planes at 1/16.
    """

    def __init__(self, channels: int, candidates: int):
        super().__init__()
        self.candidates = candidates
        are_neighbours = candidates == 9
        # Logits of the depth so far and of the candidates, logits of no correction and of the
        # residuals in 3 x 3 cells, and a remainder.
        self.weigh = nn.Conv2d(channels, candidates + 1 + 10 + 1, 1)
        nn.init.normal_(self.weigh.weight, std=1e-2)
        bias = torch.zeros(candidates + 12)
        bias[0] = KEEP if are_neighbours else 0.0
        bias[candidates + 1 : -1] = torch.tensor((STAY, *NEIGHBOURS))
        self.weigh.bias = nn.Parameter(bias)
        # Logits of as many candidates that follow a prior.
        self.weigh_prior = nn.Conv2d(channels, candidates, 1)
        nn.init.zeros_(self.weigh_prior.weight)
        side = torch.full((candidates,), PRIOR_SIDE if are_neighbours else 0.0)
        if are_neighbours:
            side[4] = 0.0  # the cell's own
        self.weigh_prior.bias = nn.Parameter(PRIOR_BIAS + side)
        self.gain_prior = nn.Parameter(torch.tensor(PRIOR_GAIN))

    def forward(
        self, features: Tensor, before: Tensor, candidates: Tensor, residual: Residual,
        of_prior: tuple[Tensor, Tensor, Tensor] | None = None,
    ) -> Tensor:  # fmt: skip
        """Returns the depth of the level: the one so far, moved and corrected by the points.

        All depths are log depth minus the median.

        Args:
            features: Features of the level (B, channels, h, w).
            before: Depth so far (B, 1, h, w).
            candidates: Depths that a cell chooses among (B, n, h, w).
            residual: Residuals of the points against the depth so far.
            of_prior: As many candidates that follow the prior, where they are known, and the
                prior's reliability; None without one.
        """
        weights = self.weigh(features).float()
        follow, correct, remainder = weights.tensor_split(
            (self.candidates + 1, self.candidates + 11), 1
        )
        if of_prior is not None:
            more, valid, reliability = of_prior
            candidates = torch.cat([candidates, more], 1)
            logits = self.weigh_prior(features).float() + self.gain_prior * reliability
            logits = torch.where(valid > 0, logits, MASKED)
            follow = torch.cat([follow, logits], 1)
        # Towards the candidates; the first weight is that of the depth so far.
        move = (follow.softmax(1)[:, 1:] * (candidates - before)).sum(1, keepdim=True)
        # By the residuals in 3 x 3 cells; the first weight is that of no correction.
        nothing = torch.zeros_like(residual.density)
        reliability = torch.cat([nothing, neighbours(residual.reliability)], dim=1)
        corrections = torch.cat([nothing, neighbours(residual.mean)], dim=1)
        correction = ((correct + reliability).softmax(1) * corrections).sum(1, keepdim=True)
        return cast(Tensor, before + move + correction + remainder)


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
        bias[4] = STAY_PUT  # the cell's own weight
        bias[9] = PULL
        self.weigh.bias = nn.Parameter(bias)

    def forward(self, features: Tensor, depth: Tensor, moments: Tensor, stride: int) -> Tensor:
        """Returns the propagated depth (B, 1, h, w) of a level.

        Args:
            features: Features of the level (B, channels, h, w).
            depth: Log depth minus the median (B, 1, h, w).
            moments: (B, 4, H / 2, W / 2), see `Points.moments`.
            stride: Side of the level's cells in pixels.
        """
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
        # Untrained, the error is the same everywhere: exp(-3), 5 % of the depth.
        nn.init.zeros_(self.leave.weight)
        self.leave.bias = nn.Parameter(torch.tensor([-3.0]))

    def forward(self, features: Tensor, hints: Tensor) -> Tensor:
        """Returns the error (B, 1, H, W) from features and hints (B, c, H / 2, W / 2)."""
        x = torch.cat([features, hints.to(features.dtype)], 1)
        log_scale = self.leave(F.relu(self.enter(x))).float()
        size = (2 * x.shape[-2], 2 * x.shape[-1])
        return torch.exp(resize(log_scale, size).clamp(-7.0, 2.0))


def prior_hints(prior: Prior, fit: PriorFit, before: Tensor, level: str) -> Tensor:
    """Returns the prior as a level's features see it, (B, PRIOR_HINTS[level], h, w).

    Args:
        prior: The prior.
        fit: Fit of the points' residuals against it, at 1/16.
        before: Log depth so far minus the median, (B, 1, h, w).
        level: Name of the level, of `STRIDES`.
    """
    if level != "s16":
        return prior.hints(before, STRIDES[level])
    value, valid = prior.at(16)
    fits = [(fit.estimates - before) * fit.valid, fit.std * fit.valid, fit.reliability]
    return torch.cat([*fits, (value - before) * valid, valid], 1)


class PriorCandidates(NamedTuple):
    """Depths that follow a prior, n for each cell."""

    depth: Tensor
    """Log depth minus the median (B, n, h, w)."""
    known: Tensor
    """(B, n, h, w), above 0 where the depth is known."""
    reliability: Tensor
    """How much better the prior predicts than the points do, (B, n or 1, h, w) (`PriorFit`)."""


def prior_candidates(prior: Prior, fit: PriorFit, depth: Tensor, level: str) -> PriorCandidates:
    """Returns the depths that follow the prior at a level.

    At 1/16 the fits; elsewhere the depths of the coarser neighbours plus the change of the prior
    from there to here.

    Args:
        prior: The prior.
        fit: Fit of the points' residuals against it, at 1/16.
        depth: Log depth minus the median of the coarser level.
        level: Name of the level, of `STRIDES`.
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
