"""`pnpdepth models check`: can this network be run, trusted, cut and refined?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.prepare import prepare
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.definition import Fixed
from pnpdepth_cli.models.made_up import made_up_frame
from pnpdepth_cli.models.network import load_network, out_of_memory_is_a_device_error
from pnpdepth_cli.points import SparsePoints

_SIZE = (240, 320)


def check_model(
    model: str, checkpoint: Path | None, image: Path | None, device: str = "cpu"
) -> dict[str, Any]:
    """What the network is, what it gives for the image, and how each of its layers does.

    Every listed layer is cut: the cut network must give what the whole one does, to the bit, and
    a gradient must come back. Raises the errors of loading and of verification.
    """
    network = load_network(model, checkpoint, device)
    definition = network.definition
    notes = list(network.notes)
    with out_of_memory_is_a_device_error(network.device):
        if image is None:
            size = definition.size
            own = (size.height, size.width) if isinstance(size, Fixed) else _SIZE
            rgb, points = made_up_frame(own)
            prepared = prepare(network, Frame(rgb=rgb[0], points=points))
        else:
            values = torch.from_numpy(read_rgb(image).values).permute(2, 0, 1).contiguous()
            height, width = values.shape[-2:]
            points = SparsePoints(xy=torch.zeros(0, 2), depth=torch.zeros(0), size=(height, width))
            prepared = prepare(network, Frame(rgb=values, points=points))
        arguments = prepared.arguments
        notes += network.verified(arguments)
        with torch.no_grad():
            raw = network.raw_of(network.module(*arguments))
        layers = {
            name: _layer(network.module, name, arguments, network.raw_of, raw)
            for name in definition.layers
        }
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


def _layer(
    module: torch.nn.Module, name: str, arguments: tuple[Any, ...], raw_of: Any, whole: torch.Tensor
) -> str:
    """ "ok", or why not."""
    try:
        with Split(module, name) as split:
            with torch.no_grad():
                z = split.front(*arguments)
            z.requires_grad_(True)
            raw = raw_of(split.rear(z))
            if not torch.equal(raw.detach(), whole):
                return "the cut network gives something else than the whole one"
            gradient = gradient_at(z, raw.sum())
    except ModelError as error:
        return str(error)
    if gradient is None:
        return "no gradient comes back from the prediction"
    return "ok" if bool(gradient.isfinite().all()) else "the gradient is not finite"
