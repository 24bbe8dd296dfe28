"""What a network returns, read in metres: aligned with the sparse points when first read."""

from __future__ import annotations

import math

from torch import Tensor

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion.alignment import Alignment, align
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints

_OFF = 1.5
"""A prediction that is this factor off the points at the median gets a word of warning."""
_NO_BETTER = 0.98
"""Misfit over that of a constant from which on a network is said to know nothing of the scene."""
_ENOUGH = 20
"""Fewer points do not say so."""
_MOST_LOST = 0.5
"""Fraction of the points that may lie where the prediction is unknown, without a warning."""


class AlignedDepth:
    """Called with what the network returns, gives depth (1, 1, h, w) in metres.

    The alignment is fitted at the first call, which is the plain prediction's, and kept.
    """

    def __init__(self, network: Network, points: SparsePoints, kind: str) -> None:
        self._network, self._points, self._kind = network, points, kind
        self._read = False
        self.alignment: Alignment | None = None
        self.notes: tuple[str, ...] = ()

    def __call__(self, output: object) -> Tensor:
        """Returns depth in metres, (1, 1, h, w), from the network's output; NaN where unknown."""
        plain = self._kind == "none"
        raw = self._network.depth_of(output) if plain else self._network.raw_of(output)
        if not self._read:
            self._read = True
            self._fit(raw.detach())
        return raw if self.alignment is None else self.alignment.depth(raw)

    def _fit(self, raw: Tensor) -> None:
        """Fits the alignment to the plain prediction, and notes what a person should know of it."""
        at_points = self._points.sample(raw)
        seen = at_points.isfinite()
        self.notes = self._unknown_notes(raw, seen)
        if bool(seen.any()):
            self._points, at_points = self._points.select(seen), at_points[seen]
        if self._kind == "none":
            self.notes += self._plain_notes(at_points)
            return
        stated = self._network.definition.output_kind
        spaces = (stated,) if stated in SPACES else ("depth", "inverse")
        self.alignment = align(at_points, self._points, spaces, self._kind)
        self.notes += self._notes(self.alignment, raw)

    def _unknown_notes(self, raw: Tensor, seen: Tensor) -> tuple[str, ...]:
        """Where the network says nothing, such as of the sky, and how many points lie there."""
        unknown, lost = float(raw.isnan().cpu().double().mean()), int((~seen).sum())
        if not unknown:
            return ()
        note = (
            f"prediction: {unknown:.2%} of the image is inf or NaN, so it is unknown there; left"
            f" {lost:,} of {len(seen):,} sparse points there out of the loss"
        )
        doubt = "; are the network's weights and input range (normalise) right?"
        return (f"warning: {note}{doubt}" if lost > _MOST_LOST * len(seen) else note,)

    def _notes(self, fit: Alignment, raw: Tensor) -> tuple[str, ...]:
        decided = " (decided from the points)" if self._kind == "auto" else ""
        notes = [
            f"alignment: {fit}{decided}; {fit.points:,} points, off by {fit.error:.1%} of depth"
            f" over the best 70 %, {fit.outliers:.0%} outliers"
        ]
        beyond = fit.beyond(raw)
        if beyond > 0:
            near, far = fit.bounds
            notes.append(
                f"alignment: {beyond:.2%} of the image came out nearer than {near:.3g} m or"
                f" farther than {far:.3g} m, or at no depth at all, and reads as these bounds"
            )
        stated = self._network.definition.output_kind in SPACES
        if stated and fit.scale < 0:
            notes.append(
                "warning: the network's output falls where its kind says it should rise; is it"
                f" {fit.space!r}? its definition can say otherwise"
            )
        # What the misfit is for the median depth of the points everywhere.
        log_depth = self._points.depth.cpu().double().log()
        of_median = float((log_depth - log_depth.median()).abs().clamp(max=1.0).mean())
        if len(log_depth) >= _ENOUGH and fit.misfit > _NO_BETTER * of_median:
            notes.append(
                f"warning: network {self._network.definition.name!r} says nothing about this scene:"
                f" aligned, it is off by {fit.misfit:.1%} at the points, their median depth by"
                f" {of_median:.1%}; check the network, its input range (normalise) and the image"
            )
        return tuple(notes)

    def _plain_notes(self, at_points: Tensor) -> tuple[str, ...]:
        ratio = float((at_points / self._points.depth).median())
        if ratio > 0 and abs(math.log(ratio)) < math.log(_OFF):
            return ()
        return (
            f"warning: the prediction is {ratio:.3g} × the sparse depth at the median; align auto"
            " fits its scale (and shift) to the points",
        )
