"""`pnpdepth models check`: can this network be run, verified, cut and refined?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.frame import synthetic_frame
from pnpdepth_cli.models.network import Network, load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.points import SparsePoints

_SIZE = (240, 320)


def check_model(
    model: str, checkpoint: Path | None, image: Path | None, device: str = "cpu"
) -> dict[str, Any]:
    """Loads a network, runs it once, and cuts it at every layer of its definition.

    At each layer the cut network must return what the whole one does, bit for bit, and a gradient
    must come back.

    Args:
        model: See `pnpdepth_cli.models.registry.find_definition`.
        checkpoint: Its weights; None takes those of the definition.
        image: The rgb image to run it on; None runs it on a synthetic frame.
        device: Name of a torch device.

    Returns:
        input, output: rows and columns. range: least and greatest value of the prediction as the
        network returns it. layers: by name "ok", or why the network cannot be cut there. notes:
        what was assumed, fitted or verified.

    Raises:
        ModelError: The network cannot be run or verified.
        CheckpointError: Its weights cannot be loaded.
        DeviceError: The device is missing or too small.
        InputError: The image cannot be read.
    """
    network = load_network(model, checkpoint, device)
    definition = network.definition
    with out_of_memory_is_a_device_error(network.device):
        prepared = prepare(network, _synthetic(network) if image is None else _read(image))
        arguments = prepared.arguments
        notes = [*network.notes, *network.verified(arguments)]
        with torch.no_grad():
            raw = network.raw_of(network.module(*arguments))
        layers = {name: _check_layer(network, name, arguments, raw) for name in definition.layers}
    return {
        "name": definition.name,
        "input": list(prepared.map.network),
        "output": list(raw.shape[-2:]),
        "output_kind": definition.output_kind,
        "output_scale": definition.output_scale,
        "range": [float(raw.min()), float(raw.max())],
        "parameters": sum(p.numel() for p in network.module.parameters()),
        "layers": layers,
        "notes": notes,
    }


def _synthetic(network: Network) -> Frame:
    size = network.definition.size
    rgb, points = synthetic_frame((size.height, size.width) if isinstance(size, Fixed) else _SIZE)
    return Frame(rgb=rgb[0], points=points)


def _read(image: Path) -> Frame:
    rgb = torch.from_numpy(read_rgb(image).values).permute(2, 0, 1).contiguous()
    height, width = rgb.shape[-2:]
    no_points = SparsePoints(xy=torch.zeros(0, 2), depth=torch.zeros(0), size=(height, width))
    return Frame(rgb=rgb, points=no_points)


def _check_layer(network: Network, name: str, arguments: tuple[Tensor, ...], whole: Tensor) -> str:
    """ "ok", or why the network cannot be cut at the layer."""
    try:
        with Split(network.module, name) as split:
            with torch.no_grad():
                z = split.front(*arguments)
            z.requires_grad_(True)
            raw = network.raw_of(split.rear(z))
            if not torch.equal(raw.detach(), whole):
                return "the cut network gives something else than the whole one"
            gradient = gradient_at(z, raw.sum())
    except ModelError as error:
        return str(error)
    if gradient is None:
        return "no gradient comes back from the prediction"
    return "ok" if bool(gradient.isfinite().all()) else "the gradient is not finite"
