"""`compact`, the network that comes with the program: an image and some depths in, dense depth out.

Everything happens in log depth minus the median log depth of the points, so depths ten times
larger give an answer ten times larger. The depth is built from coarse to fine:

1. `InlierWeights` weighs every point by its agreement with the points around it, which counts more
   where the colours are similar.
2. `PointFit` fits a plane through the points around every 1/16 cell, once per head; the weight of
   a point depends on its distance and on how similar the image features of the two cells are.
3. At 1/16, 1/8, 1/4 and 1/2 the residuals at the points (against the depth so far) are averaged
   over cells. The features of the level weigh the residuals of the neighbouring cells and the
   depths of the neighbouring coarser cells.
4. At the finest levels the depth is propagated among neighbouring cells and pulled to the points.
5. The last step to full size mixes the 3 x 3 neighbours with weights predicted from the features.

A prior, the dense depth of any other network aligned to the points, adds candidates: at 1/16
the prior plus a plane through the points' residuals against it, and at each finer level the
coarser depths plus the change of the prior between the two cells. Where the prior is unknown its
candidates are masked, and without a prior none of these layers runs. A prior that does not
help to predict the points from each other (`prior.explains`) is unknown everywhere.

A point is evidence, never copied: depth depends smoothly on the features of every level, which
is what refinement moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._compact.cloud import Cloud
from model_zoo_defs._compact.decoder import (
    DECODER_CHANNELS,
    PRIOR_BIAS,
    PRIOR_GAIN,
    PRIOR_HINTS,
    STRIDES,
    Block,
    Head,
    SigmaHead,
    SpatialPropagation,
    bilinear_logits,
    neighbours,
    prior_candidates,
    prior_hints,
)
from model_zoo_defs._compact.encoder import ENCODER_CHANNELS, Encoder
from model_zoo_defs._compact.fit import FIT_HEADS, Fit, PointFit, PriorFit
from model_zoo_defs._compact.inliers import InlierWeights
from model_zoo_defs._compact.points import Points, residual_of, resize
from model_zoo_defs._compact.prior import Prior
from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    ModelDefinition,
    Multiple,
    Normalisation,
    Settings,
)

PROPAGATED = ("s4", "s2")
"""Levels at which depth is also propagated among neighbouring cells."""


class Outputs(NamedTuple):
    """Everything the network computes; training looks at all of it."""

    depths: list[Tensor]
    """Metres (B, 1, h, w) at 1/16, 1/8, 1/4, 1/2 and full size."""
    features: Tensor
    """(B, 16, H / 2, W / 2)."""
    hints: Tensor
    """(B, 4, H / 2, W / 2): log depth so far, mean and std of the points' residuals, density."""


class Level(NamedTuple):
    """What the decoder gives at one size (h, w)."""

    depth: Tensor
    """Metres (B, 1, h, w)."""
    features: Tensor
    """(B, c, h, w); at full size those of 1/2."""
    hints: Tensor
    """(B, 4, h, w): log depth so far, mean and std of the points' residuals, density; likewise."""


@dataclass(frozen=True)
class Start:
    """What the decoder starts from."""

    median: Tensor
    """Median log depth of the points (B, 1, 1, 1)."""
    moments: Tensor
    """Sums over the points (B, 4, H / 2, W / 2), see `Points.moments`."""
    fit: Fit
    """Planes through the points, at 1/16."""
    guide: Prior | None
    """The other network's depth; None without."""


class Stage(nn.Module):
    """Runs a function as a submodule, so that a cut behind it remembers what it gave."""

    def forward(self, run: Callable[..., Any], *inputs: Any) -> Any:
        """Returns run(*inputs)."""
        return run(*inputs)


class Compact(nn.Module):
    """Dense depth (B, 1, H, W) in metres from rgb (B, 3, H, W) and sparse (B, 1, H, W) metres.

    H and W are multiples of 32; 0 in `sparse` is unknown. Without any point the answer is
    finite, with median depth taken as 1 m.
    """

    def __init__(self) -> None:
        super().__init__()
        # Features of the image, and the first depth through the points.
        width = DECODER_CHANNELS
        deep = ENCODER_CHANNELS
        self.encoder = Encoder()
        self.inlier_weights = InlierWeights()
        self.fit = PointFit()
        # The decoder. Each level sees the coarser features, those of the image, the hints, and what
        # else there is: planes at 1/16, their distance to 1/8, the image's own pixels at 1/2.
        hints = 4  # depth so far, residual, its std, fraction of known pixels
        channels = {
            "s32": deep["s32"],
            "s16": width["s32"] + deep["s16"] + hints + FIT_HEADS + 1,
            "s8": width["s16"] + deep["s8"] + hints + 1,
            "s4": width["s8"] + deep["s4"] + hints,
            "s2": width["s2"] + deep["s2"] + hints + 12,
        }
        self.decoder = nn.ModuleDict(
            {
                level: Block(count, width[level], PRIOR_HINTS.get(level, 0))
                for level, count in channels.items()
            }
        )
        self.narrow = nn.Conv2d(width["s4"], width["s2"], 1)
        self.heads = nn.ModuleDict(
            {
                level: Head(width[level], FIT_HEADS if level == "s16" else 9)
                for level in ("s16", "s8", "s4", "s2")
            }
        )
        # The step to full size: weights of 3 x 3 depths for each of 2 x 2 pixels.
        self.enlarge = nn.Conv2d(width["s2"], 36, 1)
        nn.init.normal_(self.enlarge.weight, std=1e-2)
        self.enlarge.bias = nn.Parameter(bilinear_logits())
        # how far the last step follows the change of the prior from 1/2 to full size
        self.enlarge_prior = nn.Conv2d(width["s2"], 4, 1)
        nn.init.zeros_(self.enlarge_prior.weight)
        self.enlarge_prior.bias = nn.Parameter(torch.full((4,), PRIOR_BIAS))
        self.gain_prior = nn.Parameter(torch.tensor(PRIOR_GAIN))
        self.propagation = nn.ModuleDict(
            {level: SpatialPropagation(width[level]) for level in PROPAGATED}
        )
        self.scale = SigmaHead(width["s2"] + hints)
        self.start = Stage()
        self._full_size: list[Tensor] | None = None

    def forward(self, rgb: Tensor, sparse: Tensor, prior: Tensor | None = None) -> Tensor:
        """Returns depth in metres at full size; inside `coarse`, at 1/4.

        Args:
            rgb: (B, 3, H, W), normalised as ImageNet is.
            sparse: (B, 1, H, W) metres, 0 = unknown.
            prior: Another network's depth (B, 1, H, W) in metres, aligned to the points, 0 where
                unknown; None without.
        """
        # The levels are computed one by one, as they are asked for.
        levels = self._levels(rgb, sparse, prior)
        if self._full_size is None:
            *_, finest = levels
            return finest.depth
        at_quarter = next(islice(levels, list(STRIDES).index("s4"), None))
        is_first = not self._full_size
        if is_first or not torch.is_grad_enabled():
            with torch.no_grad():
                *_, finest = levels
            self._full_size.append(finest.depth)
        return at_quarter.depth

    @contextmanager
    def coarse(self) -> Iterator[list[Tensor]]:
        """Inside, forward returns the depth at 1/4; the first and those without gradients go on.

        A step there takes a third of the time. On 16 even frames of 7-Scenes and ICL-NUIM with 500
        points two steps lower the MAE by 3.4 %, at full size by 2.8 %.

        Yields:
            The depths at full size of the forwards that went on, in their order.
        """
        self._full_size = []
        try:
            yield self._full_size
        finally:
            self._full_size = None

    def sigma(self, outputs: Outputs) -> Tensor:
        """Returns the expected |error| of log depth (B, 1, H, W); no gradient reaches the depth.

        Args:
            outputs: Outputs of the frame, by `outputs`.
        """
        return cast(Tensor, self.scale(outputs.features.detach(), outputs.hints.detach()))

    def outputs(self, rgb: Tensor, sparse: Tensor, prior: Tensor | None = None) -> Outputs:
        """Returns the depths of all levels and what σ is computed from; arguments as of forward."""
        levels = list(self._levels(rgb, sparse, prior))
        finest = levels[-1]
        return Outputs([level.depth for level in levels], finest.features, finest.hints)

    def _levels(self, rgb: Tensor, sparse: Tensor, prior: Tensor | None) -> Iterator[Level]:
        """Yields the decoder's levels at 1/16, 1/8, 1/4, 1/2 and full size.

        The arguments are those of forward. Inside, depth is log depth minus the points' median.
        """
        # Features of the image and of the points; planes at 1/16 are the first depth.
        image = self.encoder(rgb)
        start = self.start(self._started, rgb, sparse, prior, image["s16"], image["s32"])
        moments = start.moments
        fit = start.fit
        guide = start.guide
        features = self.decoder["s32"](image["s32"])
        depth = fit.estimates.mean(1, keepdim=True)
        extra = [fit.estimates - depth, fit.distance]
        for level, stride in STRIDES.items():
            # The depth so far, and the depths that a cell chooses among.
            size = image[level].shape[-2:]
            if level == "s16":
                before = depth
                candidates = fit.estimates
            else:
                before = resize(depth, size)
                candidates = F.interpolate(neighbours(depth), scale_factor=2.0, mode="nearest")
            # What the points say against it.
            residual = residual_of(moments, before, stride)
            density = torch.log1p(residual.density * stride * stride)
            hints = [before, residual.mean, residual.std, density]
            maps = [resize(features, size), image[level], *hints, *extra]
            inputs = [torch.cat([values.to(features.dtype) for values in maps], 1)]
            # What the prior says, if there is one.
            of_prior = None
            if guide is not None and fit.of_prior is not None:
                hints_of_prior = prior_hints(guide, fit.of_prior, before, level)
                inputs.append(hints_of_prior.to(features.dtype))
                of_prior = prior_candidates(guide, fit.of_prior, depth, level)
            # The depth of this level, spread to neighbours at the finer ones.
            features = self.decoder[level](*inputs)
            depth = self.heads[level](features, before, candidates, residual, of_prior)
            if level in self.propagation:
                depth = self.propagation[level](features, depth, moments, stride)
            yield Level(torch.exp(depth + start.median), features, torch.cat(hints, 1))
            # Further inputs of the next level.
            extra = [resize(fit.distance, (size[0] * 2, size[1] * 2))] if level == "s16" else []
            if level == "s4":
                extra = [F.pixel_unshuffle(rgb, 2)]
                features = self.narrow(features)
        # Full size.
        depth = self._enlarge(features, depth, guide, fit.of_prior)
        yield Level(torch.exp(depth + start.median), features, torch.cat(hints, 1))

    def _started(
        self, rgb: Tensor, sparse: Tensor, prior: Tensor | None, near: Tensor, far: Tensor
    ) -> Start:
        """Returns what the decoder starts from: weighed points, and planes through them.

        Args:
            rgb: As of forward.
            sparse: As of forward.
            prior: As of forward.
            near: Features of the image at 1/16.
            far: Features of the image at 1/32.
        """
        points = Points(sparse)
        cloud = Cloud.of(points, rgb)
        points.weigh(self.inlier_weights(points, cloud))
        guide = None if prior is None else Prior.of(prior, points, cloud)
        return Start(points.median, points.moments(), self.fit(near, far, points, guide), guide)

    def _enlarge(
        self, features: Tensor, depth: Tensor, prior: Prior | None, fit: PriorFit | None
    ) -> Tensor:
        """Returns depth at full size (B, 1, H, W): each pixel a mixture of 3 x 3 depths at 1/2.

        The change of the prior from the same mixture of its own values is added in part.

        Args:
            features: Features at 1/2.
            depth: Log depth at 1/2 minus the median, (B, 1, H / 2, W / 2).
            prior: The other network's depth; None without.
            fit: Fit of the points' residuals against it; None without.
        """
        # (B, 9, 4, H / 2, W / 2): weights of the neighbours for each of the 2 x 2 pixels.
        weights = self.enlarge(features).float()
        weights = weights.reshape(len(depth), 9, 4, *depth.shape[-2:]).softmax(1)
        mixed = (weights * neighbours(depth).unsqueeze(2)).sum(1)
        if prior is not None and fit is not None:
            value, valid = prior.at(2)
            reliability = resize(fit.reliability.mean(1, keepdim=True), depth.shape[-2:])
            logit = self.enlarge_prior(features).float() + self.gain_prior * reliability
            blurred = (weights * neighbours(value).unsqueeze(2)).sum(1)
            change = F.pixel_unshuffle(prior.value, 2) - blurred
            # Where the pixel and all of its neighbours at 1/2 are known.
            are_neighbours_known = -F.max_pool2d(-valid, 3, 1, 1)
            are_known = are_neighbours_known * F.pixel_unshuffle(prior.valid, 2)
            mixed = mixed + torch.sigmoid(logit) * are_known * change
        return F.pixel_shuffle(mixed, 2)


definitions = {
    "compact": ModelDefinition(
        name="compact",
        summary="the program's own network, trained on rendered scenes only",
        licence="Apache-2.0",
        input_kind="rgb+sparse",
        size=Multiple(32, longest=1280),
        takes_prior=True,
        weighs_points=True,
        static_graph=True,
        image_encoder="encoder",
        coarse=Compact.coarse,
        normalisation=Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
        output_kind="depth",
        layers=("decoder.s32", "decoder.s16", "decoder.s8", "decoder.s4", "decoder.s2"),
        defaults=Settings(layer="decoder.s8", iterations=2, lr="5%", schedule="linear"),
        build=Compact,
        checkpoint=Path(__file__).parent / "weights" / "compact.safetensors",
    )
}
