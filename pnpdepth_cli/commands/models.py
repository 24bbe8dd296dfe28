"""`pnpdepth models`: what networks there are, and whether one can be cut and refined."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.errors import ModelError, out_of_memory_is_a_device_error, wrap_user_errors
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Near
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.registry import all_definitions

_SYNTHETIC_SIZE = (240, 320)
"""Rows and columns of the synthetic frame."""


def list_models() -> list[dict[str, object]]:
    """Returns an entry for each network that can be named: its definition, size and defaults."""
    by_name = {definition.name: definition for definition in all_definitions().values()}
    return [_describe(definition) for definition in by_name.values()]


def _describe(definition: ModelDefinition) -> dict[str, object]:
    """The entry of a network: texts and numbers by name, as JSON can hold them.

    Raises:
        ModelError: The network cannot be built.
    """
    # On the meta device counting parameters needs no memory.
    with wrap_user_errors(f"build of network {definition.name!r}"), torch.device("meta"):
        module = definition.build()
    # The defaults, with the paper's values where the definition leaves one open.
    defaults = definition.defaults.closed()
    path = definition.checkpoint
    copied_fields = ("name", "summary", "paper", "licence", "input_kind", "output_kind", "layers")
    return {
        **{name: getattr(definition, name) for name in copied_fields},
        "size": _size_text(definition.size),
        "parameters": _parameters_of(module),
        "checkpoint": str(path) if path and path.is_file() else None,
        "layer": definition.default_layer,
        **{name: getattr(defaults, name) for name in ("iterations", "lr", "loss", "update")},
    }


def _size_text(size: Fixed | Multiple | Near) -> str:
    """The sizes (rows × columns) of images that a network takes, in a few words."""
    if isinstance(size, Fixed):
        return f"{size.height}×{size.width} ({size.fit})"
    if isinstance(size, Near):
        # Without a size to approach, images keep about their own.
        if size.height is None:
            return "any, resized"
        return f"any, resized to {size.height}×{size.width}"
    # Images whose sides are multiples of a number; those with a longer side than this are shrunk.
    if size.longest is None:
        return "any"
    return f"any, shrunk to {size.longest}"


def _parameters_of(module: torch.nn.Module) -> int:
    """The number of a network's parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def check_model(model: str, checkpoint: Path | None, image: Path | None) -> dict[str, object]:
    """Loads a network, runs it once, and cuts it at every layer of its definition.

    At each layer the cut network must return what the whole one does, bit for bit, and a gradient
    must come back.

    Args:
        model: Name or file of the network, as `pnpdepth_cli.models.registry.find_definition` takes
            it.
        checkpoint: Weights of the network; None takes those of the definition.
        image: The rgb image to run it on; None runs it on a synthetic one. Points are synthetic.

    Returns:
        input, output: rows and columns. range: least and greatest value of the prediction as the
        network returns it, where it is finite. layers: by name "ok", or why the network cannot be
        cut there. notes: what was assumed, fitted or verified.

    Raises:
        ModelError: The network cannot be run or verified, or its weights cannot be loaded.
        DeviceError: The device is missing or too small.
        InputError: The image cannot be read.
    """
    # The network, and a frame for it.
    network = load_network(model, checkpoint)
    definition = network.definition
    rgb = None
    if image is not None:
        rgb = torch.from_numpy(read_rgb(image).values).permute(2, 0, 1).contiguous()[None]
    height, width = _SYNTHETIC_SIZE if rgb is None else rgb.shape[-2:]
    frame = FrameMap.fit(definition.size, height, width)
    with out_of_memory_is_a_device_error(network.device):
        # One pass, and one with a cut at each layer.
        arguments = network.synthetic_arguments(frame, rgb)
        notes = [*network.notes, *network.verify(arguments)]
        with torch.no_grad():
            raw = network.raw_of(network.module(*arguments))
        layers = {name: _check_layer(network, name, arguments, raw) for name in definition.layers}
    # What the user should know of its input and output.
    if "rgb" in definition.input_kind and definition.normalisation is None:
        notes.append("input: rgb range 'unit' is assumed; --normalise of refine states one")
    finite = raw[raw.isfinite()]
    if not len(finite):
        notes.append(
            "warning: the prediction is inf or NaN at every pixel; are the network's weights,"
            " its input range (`normalise`) and precision right?"
        )
    return {
        "name": definition.name,
        "input": list(frame.network),
        "output": list(raw.shape[-2:]),
        "output_kind": definition.output_kind,
        "output_scale": definition.output_scale,
        "range": [float(finite.min()), float(finite.max())] if len(finite) else [],
        "parameters": _parameters_of(network.module),
        "layers": layers,
        "notes": notes,
    }


def _check_layer(network: Network, name: str, arguments: tuple[Tensor, ...], whole: Tensor) -> str:
    """The text "ok", or why the network cannot be cut at the layer.

    Args:
        network: The network.
        name: Name of the layer.
        arguments: What the network takes for a frame.
        whole: (1, 1, h, w) what it returns for them without a cut.
    """
    try:
        with Split(network.module, name) as split:
            with torch.no_grad():
                z = split.front(*arguments)
            z.requires_grad_(True)
            raw = network.known_of(split.rear(z))
            # What is not finite is 0 in both, as NaN equals nothing.
            if not torch.equal(raw.detach(), whole.nan_to_num()):
                return "the cut network gives something else than the whole one"
            gradient = gradient_at(z, raw.sum())
    except ModelError as error:
        return str(error)
    reached = gradient is not None and bool(gradient.isfinite().all())
    return "ok" if reached else "no finite gradient comes back from the prediction"
