"""What the user and the definition leave open, resolved: input range, layer, settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.influence import Field, influential_fields
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import (
    ModelError,
    NoPointsError,
    UsageError,
    out_of_memory_is_a_device_error,
)
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.open_network import OpenNetwork, prepare
from pnpdepth_cli.models.aligned_depth import align_output
from pnpdepth_cli.models.decisions import recall_or_decide_layers
from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    ModelDefinition,
    Normalisation,
)
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.models.shapes import run_by_shapes
from pnpdepth_cli.points import METRES
from pnpdepth_cli.settings import PAPER, ClosedSettings, Settings
from pnpdepth_cli.spent import spent_on

NORMALISATIONS = {
    "unit": Normalisation(),
    "imagenet": Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
    "symmetric": Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)),
    "bytes": Normalisation(std=(1 / 255, 1 / 255, 1 / 255)),
}
"""rgb as the network may want it: 0…1, ImageNet's mean and deviation, −1…1, 0…255."""

UPDATES = 5
"""Most updates of z in the default method. More fit what propagation fits anyway."""
_CLEARLY_BETTER = 0.6
"""Error of an input range over that of 0…1 below which it is taken.

FastDepth, whose range is 0…1, has ratios down to 0.61 in 13 frames of 7-Scenes and ICL-NUIM.
"""

GAPS = 6.0
"""Gaps between points that the influential field of the default layer should span.

The paper's rule of thumb is that the field of a point should reach the next points, so that updates
reach all pixels. On real frames fields several gaps wide, and at least half the image, were better:
a network's error is smooth over surfaces, and later layers follow each point and its noise."""
LEAST_FRACTION = 0.5
"""Fraction of the image's shorter side that a field should span in any case. Both are the best of
several for FastDepth on even frames of ICL-NUIM, 7-Scenes and KITTI, 100 points to LiDAR."""


def with_input_range(network: Network, name: str | None) -> Network:
    """Returns the network with the input range of this name; None leaves its own."""
    if name is None:
        return network
    definition = replace(network.definition, normalisation=NORMALISATIONS[name])
    return replace(network, definition=definition)


def resolve_definition(
    network: Network, frame: Frame, more_frames: Callable[[], Sequence[Frame]] = tuple
) -> Network:
    """Returns the network with a definition that leaves nothing open, and notes on the decisions.

    An open input range is the one whose prediction fits the points best, in the mean over the
    frames.

    Args:
        more_frames: Function of further frames; called only where the input range is open.

    Raises:
        ModelError: The network's own check fails.
    """
    definition = network.definition
    notes = list(network.notes)
    with out_of_memory_is_a_device_error(network.device):
        if definition.normalisation is None and frame.rgb is not None:
            with spent_on("input range"):
                network, note = _with_best_input_range(network, [frame, *more_frames()])
            notes.append(note)
        if definition.verify is not None:
            notes += network.verify(prepare(network, frame).arguments)
    return replace(network, notes=tuple(notes))


def normalisation_name(definition: ModelDefinition) -> str | None:
    """Returns the name of the rgb range that the network is given; None if it has none."""
    names = (name for name, how in NORMALISATIONS.items() if how == definition.normalisation)
    return None if "rgb" not in definition.input_kind else next(names, None)


def default_layer(network: Network, size: tuple[int, int], point_count: int) -> str | None:
    """Returns the layer whose output z is updated if no option names one.

    It is the definition's own, if it states one. Else it is the last of its layers whose
    influential field in the depth map is wide enough for so many even points in an image of this
    size (rows, columns), because that costs least; or the one with the widest field. All fields
    follow from one pass. None if the definition has no layers.
    """
    definition = network.definition
    frame = FrameMap.fit(definition.size, *size)
    if definition.defaults.layer is not None or len(definition.layers) < 2 or not point_count:
        return definition.default_layer
    enough = min(wanted_field(frame.network, point_count), *frame.network)

    def decide() -> list[str]:
        with out_of_memory_is_a_device_error(network.device):
            arguments = network.synthetic_arguments(frame)
            fields = fields_of(network, arguments, definition.layers)
            ordered = _by_preference(definition.layers, fields, enough)
            first = partial(_first_usable, ordered)
            return [run_by_shapes(network.module, arguments, first) or definition.layers[0]]

    question = f"layer of {definition.layers} for {enough:.6g} pixels of {frame.network}"
    with spent_on("layer"):
        return recall_or_decide_layers(network.module, network.definition, question, decide)[0]


def _first_usable(
    layers: Sequence[str], module: nn.Module, arguments: tuple[Tensor, ...]
) -> str | None:
    """The first of the layers that the network can be cut at."""
    for layer in layers:
        with suppress(ModelError), Split(module, layer) as split, torch.no_grad():
            split.rear(split.front(*arguments))
            return layer
    return None


def fields_of(
    network: Network, arguments: tuple[Tensor, ...], layers: Sequence[str]
) -> dict[str, Field]:
    """Returns the influential fields of layers in a frame with these arguments of the network.

    See `influential_fields`.
    """

    def measured(module: nn.Module, arguments: tuple[Tensor, ...]) -> dict[str, Field]:
        return influential_fields(module, arguments, layers, network.map_of)

    return run_by_shapes(network.module, arguments, measured)


def _by_preference(layers: Sequence[str], fields: Mapping[str, Field], enough: float) -> list[str]:
    """The layers whose field is wide enough, from the last one, then the others, widest first."""
    # No field is wider than the image. Of equally wide ones, that of the larger patch of z is
    # taken, and then the last.
    widths = {
        name: (min(field.in_output), field.stride * min(field.in_z or (0,)))
        for name in reversed(layers)
        if (field := fields.get(name)) is not None
    }
    wide = [name for name, (width, _) in widths.items() if width >= enough]
    others = [name for name in widths if name not in wide]
    return [*wide, *sorted(others, key=widths.__getitem__, reverse=True)]


def wanted_field(size: tuple[int, int], point_count: int) -> float:
    """Returns how wide an influential field should be, in pixels, for so many even points."""
    spacing = math.sqrt(size[0] * size[1] / point_count)
    return max(GAPS * spacing, LEAST_FRACTION * min(size))


def resolve_layer(definition: ModelDefinition, layer: str | None) -> str:
    """Returns the name of the layer to cut at.

    Args:
        layer: A name, a fraction 0…1 of the definition's layers, or None for its default.

    Raises:
        UsageError: There is no default, or a fraction is out of range.
    """
    wanted = layer if layer is not None else definition.default_layer
    if wanted is None:
        raise UsageError(
            f"network {definition.name!r} has no default layer; name one of those that"
            " `pnpdepth layers` lists"
        )
    try:
        fraction = float(wanted)
    except ValueError:
        return wanted
    if not 0 <= fraction <= 1 or not definition.layers:
        raise UsageError(
            f"layer {wanted!r}: a number is a fraction 0…1 of the {len(definition.layers)} layers"
            f" in the definition of {definition.name!r}; give one of these, or a layer's name"
        )
    return definition.layers[round(fraction * (len(definition.layers) - 1))]


def resolve_settings(
    definition: ModelDefinition, settings: Settings, *, metric: bool = True
) -> ClosedSettings:
    """Returns settings with nothing open: the user's, else the network's defaults.

    Another update rule than the network's starts from the paper's step size, schedule and blur,
    because those of the network were tuned for its own rule. The output of a network of metres from
    an image alone is scaled to points in another unit.

    Args:
        metric: Whether the points are in metres.

    Raises:
        UsageError: The settings contradict each other.
    """
    defaults = definition.defaults
    if settings.is_paper:
        settings = settings.over(PAPER)
    if settings.update not in (None, defaults.closed().update):
        defaults = replace(defaults, lr=None, schedule=None, blur=None)
    alignment = definition.default_alignment
    if not metric and alignment == "none" and definition.input_kind == "rgb":
        alignment = "scale"
    return settings.over(replace(defaults, align=alignment)).closed()


def resolve_member(network: Network, frame: Frame, asked: Settings) -> OpenNetwork:
    """Returns a network, where it is cut, and its settings, with nothing left open.

    What the user gives replaces the network's own value. What is left open is, but with the
    paper's method, what serves a result whose residual is propagated: few updates, and none of a
    network that takes the points but no prior; and a network of metres is aligned too, where the
    points say that it should be.

    Args:
        network: The network.
        frame: The first frame.
        asked: Settings that the user gives for this network.
    """
    layer = asked.layer
    if layer is None and not asked.is_paper:
        layer = default_layer(network, frame.size, len(frame.points))
    layer = resolve_layer(network.definition, layer)
    settings = resolve_settings(network.definition, asked, metric=frame.unit == METRES)
    if asked.is_paper:
        return OpenNetwork(network, layer, settings, always_updated=True)
    definition = network.definition
    if definition.input_kind == "map":  # no network behind z spreads an update
        return OpenNetwork(network, layer, replace(settings, iterations=0))
    takes_points = "sparse" in definition.input_kind
    if asked.iterations is None:
        is_updated = definition.takes_prior or not takes_points
        iterations = min(settings.iterations, UPDATES) if is_updated else 0
        settings = replace(settings, iterations=iterations)
    if asked.align is None and settings.align == "none" and not takes_points:
        settings = replace(settings, align="auto")
    return OpenNetwork(
        network,
        layer,
        settings,
        # The smaller depth is computed from the network's own layer, not from any other.
        coarse=asked.layer is None,
        always_updated=asked.iterations is not None,
        tuned=bool(asked.of_updates),
    )


def _with_best_input_range(network: Network, frames: Sequence[Frame]) -> tuple[Network, str]:
    """The network with the input range whose prediction fits the points best, and a line on it."""
    candidates = {name: with_input_range(network, name) for name in NORMALISATIONS}
    misfits = {
        name: _mean_alignment_error(candidate, frames) for name, candidate in candidates.items()
    }
    chosen, rival = choose_input_range(misfits)
    listed = ", ".join(f"{name} {error:.1%}" for name, error in misfits.items())
    if len(frames) > 1:
        listed += f", mean of {len(frames)} frames"
    unsure = ""
    hint = "`normalise` changes it"
    if rival is not None:
        hint = f"`normalise` {chosen} confirms it, {rival} is the next likely"
        unsure = ", unsure"
    note = f"input: rgb range {chosen!r}{unsure} (error after alignment: {listed}); {hint}"
    return candidates[chosen], note


def choose_input_range(misfits: Mapping[str, float]) -> tuple[str, str | None]:
    """Returns the input range of a network that states none, and a rival where that is unsure.

    The range 0…1 stays unless another one fits far better. Which of them fits a single frame best
    is mostly chance.

    Args:
        misfits: Relative error after alignment by the names of `NORMALISATIONS`.
    """
    best = min(misfits, key=lambda name: misfits[name])
    chosen = best if misfits[best] < _CLEARLY_BETTER * misfits["unit"] else "unit"
    rival = min((name for name in misfits if name != chosen), key=lambda name: misfits[name])
    unsure = misfits[chosen] > _CLEARLY_BETTER * misfits[rival]
    return chosen, rival if unsure else None


def _mean_alignment_error(network: Network, frames: Sequence[Frame]) -> float:
    """The relative error at the points after the best alignment, in the mean over the frames.

    Frames without points in the network's view are left out; infinite where the network fails.
    """
    definition = network.definition
    misfits = list[float]()
    for frame in frames:
        try:
            prepared = prepare(network, frame)
            with torch.no_grad():
                output = network.module(*prepared.arguments)
            points = prepared.points.tensors()
            at_points = points.sample(network.raw_of(output).cpu())
            lost = 1 - float(at_points.isfinite().float().mean())  # each counts as quite wrong
            misfits.append(align_output(definition, at_points, points, "auto")[0].error + lost)
        except NoPointsError:
            continue
        except ModelError:
            return float("inf")
    return sum(misfits) / len(misfits) if misfits else float("inf")
