"""The output of a network as depth in metres, and what a person should know of the fit.

A network may give disparity, log depth, or depth up to a scale. `AlignedDepth` fits its output to
the sparse depth, and warns where the two do not go together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from pnpdepth_cli.choices import FITS, READINGS
from pnpdepth_cli.completion.alignment import (
    READING_OF_KIND,
    Alignment,
    alignments,
    candidates,
)
from pnpdepth_cli.completion.outliers import off_together
from pnpdepth_cli.completion.robust_line import MAX_ERROR
from pnpdepth_cli.completion.two_depths import is_reversed, rank_correlation
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints

_FARTHER = {
    "depth": 1,
    "log": 1,
    "inverted-disparity": 1,
    "inverse": -1,
    "disparity": -1,
}
"""Whether larger numbers of this kind are farther (1) or nearer (-1), by the name that a definition
or --align states."""
_OFF = 1.5
"""Factor between prediction and points, at the median, from which on a network that is said to give
metres gets a warning."""
_NO_BETTER = 0.95
"""Misfit over that of a constant from which on a network is said to know nothing of the scene."""
_ENOUGH_POINTS = 20
"""Points from which on the errors there say that a network knows nothing, or that many are off."""
_MANY_OUTLIERS = 0.25
"""Fraction of the points that may be far off the aligned prediction without a warning."""
_REVERSED = -0.8
"""Rank correlation of a network's output and the points below which one of them is no depth. The
three weakest networks of the zoo come down to −0.69 in 91 frames of seven sets."""
_FITS_WELL = 0.05
"""Error of log depth over the best 70 % of the points up to which a network fits them."""
_STANDS_OUT = 10.0
"""A point stands out if its error of log depth is this many times that of the best 70 %."""
_NEVER_STANDS_OUT = 0.2
"""Error of log depth below which no point stands out."""
_ALWAYS_STANDS_OUT = 0.35
"""Error of log depth above which every point stands out."""
_ORDERED = 0.9
"""Rank correlation with the points that do not stand out, from which on a network knows which is
farther: a weak one fits the points of a wall, too."""
_LARGE_GROUP = 0.06
"""Fraction of the points that contradict such a network together, from which on it is said. Of 34
predictions of strong networks with 200 or 500 points each, 5.5 % at most do."""
_OTHER_MAP = 0.03
"""Mean difference of log depth over the image from which on two readings give different maps."""
_COMPARED_PIXELS = 10_000
"""Pixels that this mean is over."""
_MOST_LOST = 0.5
"""Fraction of the points that may lie where the prediction is unknown, without a warning."""
_FEW_UNKNOWN = 1e-4
"""Fraction of the image below which nothing is said of unknown pixels without a point."""


class AlignedDepth:
    """A function from what the network's forward returns to depth (1, 1, h, w) in metres.

    The alignment is fitted to the points once, at the first call. So the first output must be the
    network's own, before z or weights are updated.

    Args:
        network: The network whose output it takes.
        points: Points of the same field of view as the output, on its device.
        align: How the output is aligned, one of `choices.ALIGNMENTS`; "none" takes it as metres, in
            the space (depth, inverse or log depth) that the definition states.
    """

    def __init__(self, network: Network, points: SparsePoints, align: str) -> None:
        self._network = network
        self._points = points
        self._align = align
        self._is_fitted = False
        self.alignment: Alignment | None = None
        """The fit of the first output; None before it, and always if `align` is "none"."""
        self.notes: tuple[str, ...] = ()
        """What a person should know of the first output and its fit, a text each."""

    def __call__(self, output: object) -> Tensor:
        """Returns depth in metres, (1, 1, h, w), from the network's output; NaN where unknown."""
        if self._align == "none":
            prediction = self._network.depth_of(output)
        else:
            prediction = self._network.raw_of(output)
        if not self._is_fitted:
            self._is_fitted = True
            self._fit(prediction.detach())
        return prediction if self.alignment is None else self.alignment.depth(prediction)

    def _fit(self, prediction: Tensor) -> None:
        """Sets `alignment` and `notes` by the first prediction, (1, 1, h, w), NaN where unknown."""
        definition = self._network.definition
        # Points where the prediction is unknown take no part, unless it is unknown at all of them.
        points = self._points
        at_points = points.sample(prediction)
        is_predicted = at_points.isfinite()
        self.notes = _unknown_notes(prediction, is_predicted)
        if bool(is_predicted.any()):
            points = points.select(is_predicted)
            at_points = at_points[is_predicted]
        self.notes += _order_notes(definition, self._align, at_points, points)
        # Metres are not fitted, only compared with the points.
        if self._align == "none":
            self.notes += _metric_notes(at_points, points)
            return
        # The best fit, and others that explain the points as well.
        fits = align_output(definition, at_points, points, self._align)
        self.alignment = fits[0]
        self.notes += _fit_notes(self.alignment, self._align, prediction)
        self.notes += _misfit_notes(self.alignment, definition, points)
        # Where neither option nor definition says what the output is, it may be something else.
        stated_readings = {self._align, READING_OF_KIND.get(definition.output_kind)}
        if self.alignment.reading not in stated_readings:
            self.notes += _ambiguity_notes(fits, prediction)
        self.notes += _group_notes(self.alignment, definition, at_points, points)


def align_output(
    definition: ModelDefinition, at_points: Tensor, points: SparsePoints, align: str
) -> list[Alignment]:
    """Returns the best alignment of a network's output with the points, then equally good ones.

    The latter take the output as something else (disparity and not depth, say), and explain the
    points as well.

    Args:
        definition: Definition of the network, which may state what its output is.
        at_points: (N,) the network's output at the points.
        points: The N points.
        align: One of `choices.ALIGNMENTS`, but "none".

    Raises:
        NoPointsError: There are too few points.
        ModelError: The output does not vary, or is not finite.
    """
    if align == "auto" and len(points) == 1:
        align = "scale"  # one point shows no shift
    tried = candidates(align, definition.output_kind, definition.output_scale)
    return alignments(at_points, points, tried)


def _unknown_notes(prediction: Tensor, is_predicted: Tensor) -> tuple[str, ...]:
    """Returns a note on how much of the image has no prediction; none if almost all of it has.

    Args:
        prediction: (1, 1, h, w), NaN where the network says nothing, such as of the sky.
        is_predicted: (N,) bool, whether the prediction is known at each point.
    """
    unknown_fraction = float(prediction.isnan().cpu().double().mean())
    lost_points = int((~is_predicted).sum())
    if lost_points == 0 and unknown_fraction < _FEW_UNKNOWN:
        return ()
    note = f"prediction: {unknown_fraction:.2%} of the image is inf or NaN, so it is unknown there"
    if lost_points:
        note += (
            f"; {lost_points:,} of {len(is_predicted):,} sparse points are there, and not in the"
            " loss"
        )
    if lost_points > _MOST_LOST * len(is_predicted):
        return (f"warning: {note}; are the network's weights and input range (`normalise`) right?",)
    return (note,)


def _order_notes(
    definition: ModelDefinition, align: str, at_points: Tensor, points: SparsePoints
) -> tuple[str, ...]:
    """Returns a warning if what is nearer by the points is farther by the network; else none.

    Then the points may hold disparity, or the network's output is not what it is said to be.

    Args:
        definition: Definition of the network.
        align: One of `choices.ALIGNMENTS`.
        at_points: (N,) the prediction at the points; metres if `align` is "none".
        points: The N points.
    """
    if "sparse" in definition.input_kind:
        return ()  # the output of a network that takes the points follows them
    # Whether larger numbers are said to be farther, 1, or nearer, −1; where nothing is said, any
    # order is right.
    stated = align if align in READINGS else definition.output_kind
    direction = 1 if align == "none" else _FARTHER.get(stated, 0)
    farness = direction * at_points.cpu().double().numpy()
    rank = rank_correlation(farness, points.depth.cpu().double().numpy())
    # Few points may have any order by chance.
    if rank > _REVERSED or not is_reversed(rank, len(points)):
        return ()
    return (
        f"warning: what is nearer by the {len(points):,} points is farther by network"
        f" {definition.name!r} (rank correlation {rank:.2f}): if the points hold disparity or"
        " 1/depth, --sparse-kind reads them; if the network gives another kind of depth than is"
        " stated, --align states it",
    )


def _metric_notes(at_points: Tensor, points: SparsePoints) -> tuple[str, ...]:
    """Returns a warning if metres (N,) of a network are far off the N points; else none."""
    ratio = float((at_points / points.depth).median())
    if ratio > 0 and abs(math.log(ratio)) < math.log(_OFF):
        return ()
    return (
        f"warning: the prediction is {ratio:.3g} × the sparse depth at the median; align auto"
        " fits its scale (and shift) to the points",
    )


def _fit_notes(fit: Alignment, align: str, prediction: Tensor) -> tuple[str, ...]:
    """Returns a note on how the output is aligned, and one if pixels are out of the fit's bounds.

    Args:
        fit: Alignment of the network's output with the points.
        align: One of `choices.ALIGNMENTS`.
        prediction: (1, 1, h, w) the network's own numbers, NaN where unknown.
    """
    decided = " (decided from the points)" if align not in FITS else ""
    alignment_note = (
        f"alignment: {fit}{decided}; {fit.points:,} points, off by {fit.error:.1%} of depth"
        f" over the best 70 %, {fit.outliers:.0%} outliers"
    )
    fraction_beyond = fit.beyond(prediction)
    if fraction_beyond == 0:
        return (alignment_note,)
    near, far = fit.bounds
    bounds_note = (
        f"alignment: {fraction_beyond:.2%} of the image came out nearer than {near:.3g} m or"
        f" farther than {far:.3g} m, or at no depth at all, and reads as these bounds"
    )
    return (alignment_note, bounds_note)


def _misfit_notes(
    fit: Alignment, definition: ModelDefinition, points: SparsePoints
) -> tuple[str, ...]:
    """Returns warnings for many outliers, a level fit, and a fit no better than a constant depth.

    Args:
        fit: Alignment with the points.
        definition: Definition of the network.
        points: The points that it was fitted to.
    """
    warnings = list[str]()
    if fit.points >= _ENOUGH_POINTS and fit.outliers > _MANY_OUTLIERS:
        warnings.append(
            f"warning: {fit.outliers:.0%} of {fit.points:,} points are far off the aligned"
            " prediction; are they in metres, in the frame of this image, and is the network's"
            " output read as what it is? --align can state it"
        )
    if fit.scale == 0:
        warnings.append(
            f"warning: at the {fit.points:,} points the network's output does not follow the"
            " depth in the direction that is stated, so it reads as one depth everywhere; check"
            " the network, the points, and whether it gives depth or disparity"
        )
    # What the misfit would be if the prediction were the median depth of the points everywhere.
    log_depth = points.depth.cpu().double().log()
    of_median = float((log_depth - log_depth.median()).abs().clamp(max=MAX_ERROR).mean())
    if len(points) >= _ENOUGH_POINTS and fit.misfit > _NO_BETTER * of_median:
        warnings.append(
            f"warning: network {definition.name!r} says nothing about this scene:"
            f" aligned, it is off by {fit.misfit:.1%} at the points, their median depth by"
            f" {of_median:.1%}; check the network, its input range (`normalise`) and the image"
        )
    return tuple(warnings)


def _ambiguity_notes(fits: Sequence[Alignment], prediction: Tensor) -> tuple[str, ...]:
    """Returns a note naming other fits that give another depth map; none if there are no such.

    Args:
        fits: The best alignment, then those that explain the points as well (`align_output`).
        prediction: (1, 1, h, w) the network's own numbers, NaN where unknown.
    """
    best = fits[0]
    # Every k-th known pixel is enough to tell whether two maps differ.
    pixels = prediction[prediction.isfinite()].cpu().double()
    pixels = pixels[:: max(1, len(pixels) // _COMPARED_PIXELS)]
    best_log_depth = best.depth(pixels).log()
    rivals = []
    for rival in fits[1:]:
        difference = float((rival.depth(pixels).log() - best_log_depth).abs().mean())
        if difference > _OTHER_MAP:
            rivals.append(
                f"{rival.title} ({rival.reading}, off by {rival.error:.1%} against"
                f" {best.error:.1%}, and the map differs by {difference:.0%})"
            )
    if not rivals:
        return ()
    return (
        f"note: the {best.points:,} points are explained as well by {' and by '.join(rivals)};"
        " --align states what is right",
    )


def _group_notes(
    fit: Alignment, definition: ModelDefinition, at_points: Tensor, points: SparsePoints
) -> tuple[str, ...]:
    """Returns a warning if neighbouring points together contradict a good network; else none.

    A mirror or a window pane makes such points: the sensor measures what is reflected or behind.

    Args:
        fit: Alignment of the network's output with the points.
        definition: Definition of the network.
        at_points: (N,) the network's output at the points.
        points: The N points.
    """
    # The output of a network that takes the points follows them, and only many points that it fits
    # well tell a good network.
    takes_points = "sparse" in definition.input_kind
    if takes_points or len(points) < _ENOUGH_POINTS or fit.error > _FITS_WELL:
        return ()
    # Neighbours that are off by about the same factor, by log measured − log predicted depth.
    points = points.tensors()  # on the CPU
    log_error = points.depth.log() - fit.depth(at_points.cpu().double()).log().float()
    least = max(_STANDS_OUT * fit.error, _NEVER_STANDS_OUT)
    least = min(least, _ALWAYS_STANDS_OUT)
    in_group = off_together(points, log_error, least)
    count = int(in_group.sum())
    if count < _LARGE_GROUP * len(points):
        return ()
    # The network must order all other points by depth, with numbers that grow or shrink.
    outside = ~in_group
    numbers = at_points.cpu().double()[outside].numpy()
    if abs(rank_correlation(numbers, points.depth[outside].double().numpy())) < _ORDERED:
        return ()
    times_as_far = math.exp(float(log_error[in_group].median()))
    column, row = points.xy[in_group].median(dim=0).values.tolist()
    return (
        f"warning: {count:,} of {len(points):,} points, around ({column:.0f}, {row:.0f}), agree"
        f" with each other but are {times_as_far:.2g} times as far as network"
        f" {definition.name!r} says, which fits the others to {fit.error:.1%}: a"
        " mirror, or a surface behind a pane? They count as depth; --sparse-mask leaves points"
        " out",
    )
