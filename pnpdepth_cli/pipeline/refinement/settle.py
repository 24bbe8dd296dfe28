"""What a network leaves open, settled on its first frame: input range, output kind, trust."""

from __future__ import annotations

from dataclasses import replace

import torch

from pnpdepth_cli.choices import SPACES
from pnpdepth_cli.completion.alignment import align
from pnpdepth_cli.errors import ModelError, NoPointsError, UsageError
from pnpdepth_cli.models.definition import IMAGENET_MEAN, IMAGENET_STD, Normalisation
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.request import RefineRequest

NORMALISATIONS = {
    "unit": Normalisation(),
    "imagenet": Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD),
    "symmetric": Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)),
    "bytes": Normalisation(std=(1 / 255, 1 / 255, 1 / 255)),
}
"""rgb as the network may want it: 0…1, ImageNet's mean and deviation, −1…1, 0…255."""


def settled(network: Network, inputs: Inputs, request: RefineRequest) -> Network:
    """The network with nothing left open, and notes on what was decided.

    The user's word goes first, then the definition's; an input range that neither states is the
    one whose prediction fits the points best. ModelError if the network cannot be trusted.
    """
    definition = network.definition
    if request.output_kind is not None:
        if request.output_kind not in SPACES:
            raise UsageError(f"output kind {request.output_kind!r} is not one of {SPACES}")
        definition = replace(definition, output_kind=request.output_kind)
    notes = list(network.notes)
    if request.normalise is not None:
        if request.normalise not in NORMALISATIONS:
            raise UsageError(f"normalise {request.normalise!r} is none of {list(NORMALISATIONS)}")
        definition = replace(definition, normalisation=NORMALISATIONS[request.normalise])
    network = replace(network, definition=definition)
    with out_of_memory_is_a_device_error(network.device):
        if definition.normalisation is None and inputs.rgb is not None:
            network, note = _with_decided_range(network, inputs)
            notes.append(note)
        if definition.verify is not None:
            frame = FrameMap.fit(definition.size, *inputs.size)
            points = frame.points_to_network(inputs.points)
            arguments = network.arguments(frame, inputs.rgb_tensor(), points)
            notes += network.verified(arguments)
    return replace(network, notes=tuple(notes))


def _with_decided_range(network: Network, inputs: Inputs) -> tuple[Network, str]:
    errors: dict[str, float] = {}
    tried = {
        name: replace(network, definition=replace(network.definition, normalisation=how))
        for name, how in NORMALISATIONS.items()
    }
    for name, candidate in tried.items():
        try:
            errors[name] = _misfit(candidate, inputs)
        except (ModelError, NoPointsError):
            errors[name] = float("inf")
    best = min(errors, key=lambda name: errors[name])
    said = ", ".join(f"{name} {error:.1%}" for name, error in errors.items())
    return tried[best], (
        f"input: rgb range {best!r} fits the points best (error after alignment: {said});"
        " --normalise says otherwise"
    )


def _misfit(network: Network, inputs: Inputs) -> float:
    """The relative error at the points after the best alignment."""
    definition = network.definition
    frame = FrameMap.fit(definition.size, *inputs.size)
    points = frame.points_to_network(inputs.points)
    with torch.no_grad():
        output = network.module(*network.arguments(frame, inputs.rgb_tensor(), points))
    at_points = points.sample(network.raw_of(output).cpu())
    stated = definition.output_kind
    spaces = (stated,) if stated in SPACES else ("depth", "inverse")
    return align(at_points, points, spaces, "auto").error
