"""What the user and the definition leave open, resolved: input range, layer, settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from pnpdepth_cli.choices import NORMALISATIONS
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
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.models.shapes import run_by_shapes
from pnpdepth_cli.points import METRES
from pnpdepth_cli.settings import PAPER, ClosedSettings, Settings
from pnpdepth_cli.spent import spent_on

UPDATES = 5
"""Most updates of z in the default method. More fit what propagation fits anyway."""
_CLEARLY_BETTER = 0.6
"""Error of another input range over that of 0…1, below which it is taken in place of 0…1.

FastDepth, whose range is 0…1, has ratios down to 0.61 in 13 frames of 7-Scenes and ICL-NUIM.
"""

GAPS = 6.0
"""Gaps between points that the influential field of the default layer should span.

The paper's rule of thumb is that the field of a point should reach the next points, so that updates
reach all pixels. On real frames fields several gaps wide, and at least half the image, were better:
a network's error is smooth over surfaces, and later layers follow each point and its noise."""
LEAST_FRACTION = 0.5
"""Fraction of the image's shorter side that a field should span in any case. `GAPS` and this are
the best of several for FastDepth on even frames of ICL-NUIM, 7-Scenes and KITTI, 100 points to
LiDAR."""


def with_input_range(network: Network, name: str | None) -> Network:
    """Returns the network with the input range of a name; None leaves its own.

    Args:
        network: The network.
        name: A name of `NORMALISATIONS`: how rgb in 0…1 is scaled before the network gets it.
    """
    if name is None:
        return network
    definition = replace(network.definition, normalisation=NORMALISATIONS[name])
    return replace(network, definition=definition)


def resolve_definition(
    network: Network, frame: Frame, more_frames: Callable[[], Sequence[Frame]] = tuple
) -> Network:
    """Returns the network with all that its definition leaves open decided, and notes on that.

    An open input range becomes the one whose prediction fits the points best, in the mean over the
    frames (`choose_input_range`).

    Args:
        network: The network.
        frame: The first frame, its image moved to its points.
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
    """Returns the name of the rgb range that a network is given; None if that has no name.

    None also for a network that takes no rgb image.
    """
    if "rgb" not in definition.input_kind:
        return None
    for name, normalisation in NORMALISATIONS.items():
        if normalisation == definition.normalisation:
            return name
    return None


def default_layer(network: Network, size: tuple[int, int], point_count: int) -> str | None:
    """Returns the layer whose output z is updated if no option names one; None if there is none.

    It is the definition's default, if it states one. Else it is the last of the definition's layers
    that has a wide enough influential field: the part of the depth map that changes when one point
    changes z. The last one costs least. If no field is wide enough, it is the layer of the widest.

    Args:
        network: The network.
        size: (H, W) of the image.
        point_count: Number of points, taken as spread evenly over the image. Without any, the
            definition's first layer is taken.
    """
    definition = network.definition
    to_network = FrameMap.fit(definition.size, *size)
    is_stated = definition.defaults.layer is not None
    if is_stated or len(definition.layers) < 2 or not point_count:
        return definition.default_layer  # there is nothing to choose, or nothing to choose by
    # No field is wider than the image as the network sees it, (h, w) `to_network.network`.
    enough_px = min(wanted_field(to_network.network, point_count), *to_network.network)

    def decide() -> list[str]:
        """The layer that is chosen, in a list of one, which is the form that is remembered."""
        with out_of_memory_is_a_device_error(network.device):
            arguments = network.synthetic_arguments(to_network)
            fields = fields_of(network, arguments, definition.layers)
            ordered = _by_preference(definition.layers, fields, enough_px)
            first_usable = partial(_first_usable, ordered)
            layer = run_by_shapes(network.module, arguments, first_usable)
            return [definition.layers[0] if layer is None else layer]

    # What was decided for this question in an earlier run is not decided again.
    question = f"layer of {definition.layers} for {enough_px:.6g} pixels of {to_network.network}"
    with spent_on("layer"):
        return recall_or_decide_layers(network.module, network.definition, question, decide)[0]


def _first_usable(
    layers: Sequence[str], module: nn.Module, arguments: tuple[Tensor, ...]
) -> str | None:
    """The first of the layers that a network can be cut at; None if it can be cut at none.

    Args:
        layers: Names of submodules, as `Split` takes them.
        module: The network.
        arguments: Its arguments for a frame.
    """
    for layer in layers:
        # `Split` raises ModelError where it cannot cut, and then the next layer is tried.
        with suppress(ModelError), Split(module, layer) as split, torch.no_grad():
            split.rear(split.front(*arguments))
            return layer
    return None


def fields_of(
    network: Network, arguments: tuple[Tensor, ...], layers: Sequence[str]
) -> dict[str, Field]:
    """Returns how far one point reaches through z at each of some layers (`influential_fields`).

    Args:
        network: The network.
        arguments: Arguments of its forward for a frame.
        layers: Names of the layers.

    Returns:
        The field of each layer by its name; layers that cannot be cut at are left out.
    """

    def measured(module: nn.Module, arguments: tuple[Tensor, ...]) -> dict[str, Field]:
        """The field of each layer by its name, of this network, or of its copy without values."""
        return influential_fields(module, arguments, layers, network.map_of)

    return run_by_shapes(network.module, arguments, measured)


def _by_preference(
    layers: Sequence[str], fields: Mapping[str, Field], enough_px: float
) -> list[str]:
    """The layers whose field is wide enough, from the last one, then the others, widest first.

    Of others whose fields are equally wide, the one whose point reaches the larger patch of z comes
    first, then the later one.

    Args:
        layers: Names of the layers, from the image to the depth.
        fields: How far one point reaches by each layer, in z and in the depth map, by name; layers
            without such a field are left out.
        enough_px: Width in pixels of the depth map from which on a field is wide enough.
    """
    wide: list[str] = []
    narrow: dict[
        str, tuple[int, float]
    ] = {}  # widths of the field and of the patch of z, in pixels
    for name in reversed(layers):
        if name not in fields:
            continue
        field = fields[name]
        width_px = min(field.in_output)
        if width_px >= enough_px:
            wide.append(name)
        else:
            patch_px = 0.0
            if field.in_z is not None:  # `stride` is the pixels of depth for an element of z
                patch_px = field.stride * min(field.in_z)
            narrow[name] = (width_px, patch_px)
    # Sorting keeps the order of equal ones, which is from the last layer on.
    widest_first = sorted(narrow, key=narrow.__getitem__, reverse=True)
    return [*wide, *widest_first]


def wanted_field(size: tuple[int, int], point_count: int) -> float:
    """Returns how wide the influential field of the default layer should be, in pixels.

    The field is the part of the depth map that changes when the gradient of one point changes z.

    Args:
        size: (height, width) in pixels.
        point_count: Number of points, even over these pixels.
    """
    height, width = size
    spacing_px = math.sqrt(height * width / point_count)
    return max(GAPS * spacing_px, LEAST_FRACTION * min(size))


def resolve_layer(definition: ModelDefinition, layer: str | None) -> str:
    """Returns the name of the layer to cut at.

    Args:
        definition: The network's definition, with its layers from the image to the depth.
        layer: Name, or fraction 0…1 of these layers as text, such as "0.5". None: the default.

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
    except ValueError:  # of `float`: it is a name
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
    """Returns a value of each setting: the user's, else the network's default, else the paper's.

    Another update rule than the network's starts from the paper's step size, schedule and blur,
    because those of the network were tuned for its own rule. Where the points are in another unit
    than metres, metres from an image alone are scaled to them.

    Args:
        definition: The network's definition, with its defaults.
        settings: Settings that the user gives.
        metric: Whether the points are in metres.

    Raises:
        UsageError: The settings contradict each other.
    """
    defaults = definition.defaults
    if settings.is_paper:
        settings = settings.over(PAPER)
    # None leaves a default open, for the paper's value.
    if settings.update not in (None, defaults.closed().update):
        defaults = replace(defaults, lr=None, schedule=None, blur=None)
    # Metres from an image alone cannot be the unit of these points.
    alignment = definition.default_alignment
    if not metric and alignment == "none" and definition.input_kind == "rgb":
        alignment = "scale"
    return settings.over(replace(defaults, align=alignment)).closed()


def resolve_member(network: Network, frame: Frame, asked: Settings) -> OpenNetwork:
    """Returns a network of the method with its layer and a value of each of its settings.

    What the user gives replaces the network's own value. The paper's method takes the rest from the
    paper. The other methods propagate the residual, and take for the rest what serves that: at most
    `UPDATES` updates of z, none of a network that takes the points but no prior, and none of a
    depth map. They also align a network that gives metres from the image alone, where the points
    tell that its metres are off.

    Args:
        network: The network, its definition with nothing left open.
        frame: The first frame, its image moved to its points.
        asked: Settings that the user gives for this network.
    """
    # The layer, and the settings that every method has.
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
    # What serves a result whose residual is propagated.
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
    """The network with the input range of `choose_input_range`, and a note on that choice.

    Args:
        network: The network, whose definition leaves its input range open.
        frames: Frames with images, by which it is chosen.
    """
    candidates = {name: with_input_range(network, name) for name in NORMALISATIONS}
    misfits = {
        name: _mean_alignment_error(candidate, frames) for name, candidate in candidates.items()
    }
    chosen, rival = choose_input_range(misfits)
    listed = ", ".join(f"{name} {error:.1%}" for name, error in misfits.items())
    if len(frames) > 1:
        listed += f", mean of {len(frames)} frames"
    doubt = ""
    hint = "`normalise` changes it"
    if rival is not None:
        doubt = ", unsure"
        hint = f"`normalise` {chosen} confirms it, {rival} is the next likely"
    note = f"input: rgb range {chosen!r}{doubt} (error after alignment: {listed}); {hint}"
    return candidates[chosen], note


def choose_input_range(misfits: Mapping[str, float]) -> tuple[str, str | None]:
    """Returns the name of the input range of a network that states none, and that of a rival.

    The range 0…1, "unit", is chosen unless another one fits far better. Which of them fits a single
    frame best is mostly chance. The rival is the best of the others; None if the chosen one is
    clearly better.

    Args:
        misfits: Relative errors at the points after alignment, by the names of `NORMALISATIONS`.
    """
    chosen = "unit"
    best = min(misfits, key=misfits.__getitem__)
    if misfits[best] < _CLEARLY_BETTER * misfits["unit"]:
        chosen = best
    others = [name for name in misfits if name != chosen]
    rival = min(others, key=misfits.__getitem__)
    is_unsure = misfits[chosen] > _CLEARLY_BETTER * misfits[rival]
    if not is_unsure:
        return chosen, None
    return chosen, rival


def _mean_alignment_error(network: Network, frames: Sequence[Frame]) -> float:
    """The relative error at the points after the best alignment, in the mean over the frames.

    A point where the network predicts nothing finite counts as an error of 1. Frames without points
    that the network sees are left out. Infinite without any other frame, or if the network fails.

    Args:
        network: The network, with the input range that is tried.
        frames: Frames with images.
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
            fraction_lost = 1 - float(at_points.isfinite().float().mean())
            best_alignment = align_output(definition, at_points, points, "auto")[0]
            misfits.append(best_alignment.error + fraction_lost)
        except NoPointsError:  # the network sees none of this frame's points
            continue
        except ModelError:  # it fails with this input range
            return math.inf
    if not misfits:
        return math.inf
    return sum(misfits) / len(misfits)
