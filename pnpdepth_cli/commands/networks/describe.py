"""What networks there are, whether one can be cut and refined, and where: `models` and `layers`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.commands.refinement.refine_request import NetworkChoice
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.errors import ModelError, UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Near
from pnpdepth_cli.models.frame_map import synthetic_camera, synthetic_frame
from pnpdepth_cli.models.measure_layers import MeasuredLayer, measure_layers
from pnpdepth_cli.models.network import Network, load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.models.registry import families
from pnpdepth_cli.points import SparsePoints

DEFAULT_SIZE = (240, 320)
"""Rows and columns of the synthetic frame of a network without a size of its own."""


def list_models() -> list[dict[str, Any]]:
    """Returns every network that can be named, in the order of `registry.names`.

    Most values are those of `ModelDefinition`. `family` is the file or entry point that defines it.
    """
    listed: dict[str, dict[str, Any]] = {}
    for family, definitions in families().items():
        for definition in definitions.values():
            listed.setdefault(definition.name, _describe(definition, family))
    return list(listed.values())


def _describe(definition: ModelDefinition, family: str) -> dict[str, Any]:
    # On the meta device counting needs no memory.
    with wrap_user_errors(f"build of network {definition.name!r}"), torch.device("meta"):
        module = definition.build()
    defaults, path = definition.defaults.closed(), definition.checkpoint
    return {
        "name": definition.name,
        "family": family,
        "summary": definition.summary,
        "paper": definition.paper,
        "licence": definition.licence,
        "input_kind": definition.input_kind,
        "size": _size(definition.size),
        "output_kind": definition.output_kind,
        "parameters": sum(parameter.numel() for parameter in module.parameters()),
        "checkpoint": str(path) if path and path.is_file() else None,
        "layers": definition.layers,
        "layer": definition.default_layer,
        "iterations": defaults.iterations,
        "lr": defaults.lr,
        "loss": defaults.loss,
        "update": defaults.update,
    }


def _size(size: Fixed | Multiple | Near) -> str:
    if isinstance(size, Fixed):
        return f"{size.height}×{size.width} ({size.fit})"
    if isinstance(size, Near):
        return f"any, resized to {size.height}×{size.width}" if size.height else "any, resized"
    return "any" if size.longest is None else f"any, shrunk to {size.longest}"


def check_model(model: str, checkpoint: Path | None, image: Path | None) -> dict[str, Any]:
    """Loads a network, runs it once, and cuts it at every layer of its definition.

    At each layer the cut network must return what the whole one does, bit for bit, and a gradient
    must come back.

    Args:
        model: Name or file of the network, as `pnpdepth_cli.models.registry.find_definition` takes
            it.
        checkpoint: Weights of the network; None takes those of the definition.
        image: The rgb image to run it on; None runs it on a synthetic frame.

    Returns:
        input, output: rows and columns. range: least and greatest value of the prediction as the
        network returns it, where it is finite. layers: by name "ok", or why the network cannot be
        cut there. notes: what was assumed, fitted or verified.

    Raises:
        ModelError: The network cannot be run or verified.
        CheckpointError: Its weights cannot be loaded.
        DeviceError: The device is missing or too small.
        InputError: The image cannot be read.
    """
    network = load_network(model, checkpoint)
    definition = network.definition
    with out_of_memory_is_a_device_error(network.device):
        prepared = prepare(
            network, _synthetic(_own_size(network)) if image is None else _read(image)
        )
        arguments = prepared.arguments
        notes = [*network.notes, *network.verify(arguments)]
        with torch.no_grad():
            raw = network.raw_of(network.module(*arguments))
        known = raw[raw.isfinite()]
        layers = {name: _check_layer(network, name, arguments, raw) for name in definition.layers}
    return {
        "name": definition.name,
        "input": list(prepared.map.network),
        "output": list(raw.shape[-2:]),
        "output_kind": definition.output_kind,
        "output_scale": definition.output_scale,
        "range": [float(known.min()), float(known.max())] if len(known) else [],
        "parameters": sum(p.numel() for p in network.module.parameters()),
        "layers": layers,
        "notes": notes,
    }


def _own_size(network: Network) -> tuple[int, int]:
    size = network.definition.size
    return (size.height, size.width) if isinstance(size, Fixed) else DEFAULT_SIZE


def _synthetic(size: tuple[int, int]) -> Frame:
    rgb, points = synthetic_frame(size)
    return Frame(rgb=rgb[0], points=points, camera=synthetic_camera(size))


def _read(image: Path) -> Frame:
    rgb = torch.from_numpy(read_rgb(image).values).permute(2, 0, 1).contiguous()
    height, width = rgb.shape[-2:]
    no_points = SparsePoints(xy=torch.zeros(0, 2), depth=torch.zeros(0), size=(height, width))
    return Frame(rgb=rgb, points=no_points, camera=synthetic_camera((height, width)))


def _check_layer(network: Network, name: str, arguments: tuple[Tensor, ...], whole: Tensor) -> str:
    """ "ok", or why the network cannot be cut at the layer."""
    try:
        with Split(network.module, name) as split:
            with torch.no_grad():
                z = split.front(*arguments)
            z.requires_grad_(True)
            raw = network.raw_of(split.rear(z)).nan_to_num()
            if not torch.equal(raw.detach(), whole.nan_to_num()):
                return "the cut network gives something else than the whole one"
            gradient = gradient_at(z, raw.sum())
    except ModelError as error:
        return str(error)
    if gradient is None:
        return "no gradient comes back from the prediction"
    return "ok" if bool(gradient.isfinite().all()) else "the gradient is not finite"


def list_layers(
    choice: NetworkChoice,
    *,
    every: bool,
    on_layer: Callable[[int, int], None] = lambda done, of: None,
) -> list[MeasuredLayer]:
    """Returns the layers that a network can be cut at, measured on a synthetic frame.

    They are in the order of the definition, or of the network's submodules.

    Args:
        choice: The network, its weights and device.
        every: Whether all submodules are listed, not only the layers of the definition.
        on_layer: Callback after each layer with the number of layers done and of all.

    Raises:
        UsageError: The definition lists no layers.
        ModelError, CheckpointError, DeviceError: As in loading.
    """
    network = load_network(choice.model, choice.checkpoint, choice.device)
    names = list(network.definition.layers)
    if every:
        names = [name for name, _ in network.module.named_modules() if name]
    if not names:
        raise UsageError(
            f"the definition of {network.definition.name!r} lists no layers; --all lists every one"
        )
    with out_of_memory_is_a_device_error(network.device):
        prepared = prepare(network, _synthetic(_own_size(network)))
        return measure_layers(network, names, prepared.arguments, prepared.map.network, on_layer)
