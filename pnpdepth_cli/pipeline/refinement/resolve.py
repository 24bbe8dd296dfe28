"""What the request and the definition leave open, resolved: input range, output kind, settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from pnpdepth_cli.choices import PARAMETERS, SPACES
from pnpdepth_cli.completion.alignment import align
from pnpdepth_cli.core.masks import MaskSettings
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.weights import rank_of
from pnpdepth_cli.errors import ModelError, NoPointsError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    WEIGHTS_DEFAULTS,
    WEIGHTS_DENSE_DEFAULTS,
    ModelDefinition,
    Normalisation,
    RefineDefaults,
)
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.refinement.request import HoldOut, MethodOptions, NetworkChoice

NORMALISATIONS = {
    "unit": Normalisation(),
    "imagenet": Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
    "symmetric": Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)),
    "bytes": Normalisation(std=(1 / 255, 1 / 255, 1 / 255)),
}
"""rgb as the network may want it: 0…1, ImageNet's mean and deviation, −1…1, 0…255."""

_CLEARLY_BETTER = 0.6
"""Error of an input range over that of 0…1 below which it is taken.

FastDepth, whose range is 0…1, has ratios down to 0.61 in 13 frames of 7-Scenes and ICL-NUIM.
"""


def resolve_definition(
    network: Network,
    frame: Frame,
    choice: NetworkChoice,
    more_frames: Callable[[], Sequence[Frame]] = tuple,
) -> Network:
    """Returns the network with a definition that leaves nothing open, and notes on the decisions.

    The user's choice wins over the definition. An input range that neither states is the one whose
    prediction fits the points best, in the mean over the frames.

    Args:
        network: The network.
        frame: The first frame.
        choice: What the user chose.
        more_frames: Gives further frames; called only where the input range is open.

    Raises:
        UsageError: The choice is not one of the possible values.
        ModelError: The network's own check fails.
    """
    definition = network.definition
    if choice.output_kind is not None:
        if choice.output_kind not in SPACES:
            raise UsageError(f"output kind {choice.output_kind!r} is not one of {SPACES}")
        definition = replace(definition, output_kind=choice.output_kind)
    notes = list(network.notes)
    if choice.normalise is not None:
        if choice.normalise not in NORMALISATIONS:
            raise UsageError(f"normalise {choice.normalise!r} is none of {list(NORMALISATIONS)}")
        definition = replace(definition, normalisation=NORMALISATIONS[choice.normalise])
    network = replace(network, definition=definition)
    with out_of_memory_is_a_device_error(network.device):
        if definition.normalisation is None and frame.rgb is not None:
            network, note = _with_best_input_range(network, [frame, *more_frames()])
            notes.append(note)
        if definition.verify is not None:
            notes += network.verified(prepare(network, frame).arguments)
    return replace(network, notes=tuple(notes))


def normalisation_name(definition: ModelDefinition) -> str | None:
    """Returns the name of the rgb range that the network is given; None if it has none."""
    names = (name for name, how in NORMALISATIONS.items() if how == definition.normalisation)
    return None if "rgb" not in definition.input_kind else next(names, None)


def resolve_layer(definition: ModelDefinition, layer: str | None) -> str:
    """Returns the name of the layer to cut at.

    Args:
        definition: Of the network.
        layer: A name, a fraction 0…1 of the definition's layers, or None for its default.

    Raises:
        UsageError: There is no default, or a fraction is out of range.
    """
    wanted = layer if layer is not None else definition.default_layer
    if wanted is None:
        raise UsageError(f"network {definition.name!r} has no default layer; name one with --layer")
    try:
        fraction = float(wanted)
    except ValueError:
        return wanted
    if not 0 <= fraction <= 1 or not definition.layers:
        raise UsageError(
            f"layer {wanted!r}: a number is a fraction between 0 and 1 of the layers that the"
            f" definition of {definition.name!r} lists ({len(definition.layers)} of them)"
        )
    return definition.layers[round(fraction * (len(definition.layers) - 1))]


def resolve_settings(
    definition: ModelDefinition,
    method: MethodOptions,
    hold_out: HoldOut | None = None,
    *,
    metric: bool = True,
    dense: bool = False,
) -> RefineSettings:
    """Returns the settings of refinement: the user's, else the network's defaults.

    Another update rule than the network's default starts from the paper's step size, schedule and
    blur, because those of the network were tuned for its own rule. The output of a network of
    metres from an image alone is scaled to points in another unit.

    Args:
        definition: Of the network.
        method: What the user chose.
        hold_out: For the seed and the time budget; None takes their defaults.
        metric: Whether the points are in metres.
        dense: Whether the points lie as close as a LiDAR's; see `is_dense`.

    Raises:
        UsageError: A value is out of range, or goes with another target.
    """
    hold_out = hold_out or HoldOut()
    of_weights = moves_weights(method)
    defaults = _defaults_of(definition, method, dense=dense)
    iterations = defaults.iterations if method.iterations is None else method.iterations
    if iterations < 0:
        raise UsageError(f"iterations {iterations} is negative; 0 gives the plain prediction")
    update = method.update or defaults.update
    steps = defaults if update == defaults.update else RefineDefaults()
    blur = steps.blur if method.blur is None else method.blur
    if not 0 <= blur < math.inf:
        raise UsageError(f"blur {blur} is no distance; give 0 or more spacings of the points")
    if not 0 <= method.proximity < math.inf:
        raise UsageError(f"proximity {method.proximity} is no weight; give 0 or more")
    alignment = definition.default_alignment
    if not metric and alignment == "none" and definition.input_kind == "rgb":
        alignment = "scale"
    settings = RefineSettings(
        iterations=iterations,
        lr=steps.lr if method.lr is None else method.lr,
        loss=method.loss or defaults.loss,
        update=update,
        schedule=method.schedule or steps.schedule,
        blur=blur,
        parameters=method.parameters or defaults.parameters,
        target=method.target,
        mask=_resolve_mask(defaults, method, hold_out.seed),
        proximity=method.proximity,
        line_search=method.line_search,
        keep_best=method.keep_best,
        align=method.align or alignment,
        align_every=method.align_every,
        time_budget_s=hold_out.time_budget_s if of_weights else None,
    )
    if of_weights:
        _check_weights(definition, method, settings)
    return settings


def _defaults_of(
    definition: ModelDefinition, method: MethodOptions, *, dense: bool
) -> RefineDefaults:
    """The settings where no option sets them, by what is updated and by which points."""
    if method.target == "masked":
        return definition.masked_dense if dense else definition.masked
    if moves_weights(method):
        return WEIGHTS_DENSE_DEFAULTS if dense else WEIGHTS_DEFAULTS
    return definition.defaults


def moves_weights(method: MethodOptions) -> bool:
    """Whether weights are updated instead of z."""
    return method.target == "masked" or method.parameters not in (None, *PARAMETERS)


def _resolve_mask(defaults: RefineDefaults, method: MethodOptions, seed: int) -> MaskSettings:
    for name in ("mask", "mask_fraction", "mask_scale"):
        if method.target != "masked" and getattr(method, name) is not None:
            flag = "--" + name.replace("_", "-")
            raise UsageError(f"{flag} is for points hidden from the input; add --target masked")
    if method.target != "masked":
        return MaskSettings()
    fraction = defaults.mask_fraction if method.mask_fraction is None else method.mask_fraction
    if not 0 < fraction < 1:
        raise UsageError(f"mask fraction {fraction} is not between 0 and 1, such as 0.5")
    scale = defaults.mask_scale if method.mask_scale is None else method.mask_scale
    if not 0 < scale <= 1:
        raise UsageError(f"mask scale {scale} is not above 0 and 1 at most, such as 0.5")
    return MaskSettings(
        kind=method.mask or defaults.mask, fraction=fraction, scale=scale, seed=seed
    )


def _check_weights(
    definition: ModelDefinition, method: MethodOptions, settings: RefineSettings
) -> None:
    """Raises UsageError where weights move and an option concerns z."""
    if not settings.moves_weights:
        raise UsageError(
            f"--target masked updates weights, not {settings.parameters} of z; take --parameters"
            " weights or lora:8"
        )
    rank_of(settings.parameters)
    if method.preset is not None:
        raise UsageError(
            f"--preset {method.preset} updates z; it goes with neither --target masked nor weights"
        )
    if method.target == "masked" and "sparse" not in definition.input_kind:
        raise UsageError(
            f"network {definition.name!r} takes no sparse depth, so no points can be hidden from"
            " it; take --target given"
        )
    if method.target == "masked" and method.layer is not None:
        raise UsageError(
            "--layer is where z is; with --target masked the network is cut at its sparse depth"
        )
    concern_z = ("blur", "proximity", "line_search", "keep_best", "align_every")
    if wrong := [name for name in concern_z if getattr(method, name)]:
        flag = "--" + wrong[0].replace("_", "-")
        raise UsageError(f"{flag} is for updates of z; weights are updated here")


def _with_best_input_range(network: Network, frames: Sequence[Frame]) -> tuple[Network, str]:
    candidates = {
        name: replace(network, definition=replace(network.definition, normalisation=how))
        for name, how in NORMALISATIONS.items()
    }
    errors = {name: _mean_alignment_error(each, frames) for name, each in candidates.items()}
    chosen, rival = chosen_input_range(errors)
    listed = ", ".join(f"{name} {error:.1%}" for name, error in errors.items())
    if len(frames) > 1:
        listed += f", mean of {len(frames)} frames"
    if rival is None:
        return candidates[chosen], (
            f"input: rgb range {chosen!r} (error after alignment: {listed}); --normalise changes it"
        )
    return candidates[chosen], (
        f"input: rgb range {chosen!r}, unsure (error after alignment: {listed}); --normalise"
        f" {chosen} confirms it, --normalise {rival} is the next likely"
    )


def chosen_input_range(errors: Mapping[str, float]) -> tuple[str, str | None]:
    """Returns the input range of a network that states none, and a rival where that is unsure.

    0…1 is kept unless another range fits far better: which range fits a single frame best is
    mostly chance.

    Args:
        errors: Relative error after alignment by the names of `NORMALISATIONS`.
    """
    best = min(errors, key=lambda name: errors[name])
    chosen = best if errors[best] < _CLEARLY_BETTER * errors["unit"] else "unit"
    rival = min((name for name in errors if name != chosen), key=lambda name: errors[name])
    unsure = errors[chosen] > _CLEARLY_BETTER * errors[rival]
    return chosen, rival if unsure else None


def _mean_alignment_error(network: Network, frames: Sequence[Frame]) -> float:
    """The mean over frames with points in the network's view; infinite where the network fails."""
    errors = []
    for frame in frames:
        try:
            errors.append(_alignment_error(network, frame))
        except NoPointsError:
            continue
        except ModelError:
            return float("inf")
    return sum(errors) / len(errors) if errors else float("inf")


def _alignment_error(network: Network, frame: Frame) -> float:
    """Returns the relative error at the points after the best alignment."""
    prepared = prepare(network, frame)
    points = prepared.points.tensors()
    with torch.no_grad():
        output = network.module(*prepared.arguments)
    at_points = points.sample(network.raw_of(output).cpu())
    stated = network.definition.output_kind
    spaces = (stated,) if stated in SPACES else ("depth", "inverse")
    return align(at_points, points, spaces, "auto").error
