"""What networks there are, whether one can be cut and refined, and where: `models` and `layers`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from pnpdepth_cli import errors
from pnpdepth_cli.core.influence import Field
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.cut_layers import fields_of
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Near
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.registry import all_definitions

DEFAULT_SIZE = (240, 320)  # rows and columns of the synthetic frame


def list_models() -> list[dict[str, object]]:
    """Returns every network that can be named: values of `ModelDefinition`, and parameters."""
    by_name = {definition.name: definition for definition in all_definitions().values()}
    return [_describe(definition) for definition in by_name.values()]


def _describe(definition: ModelDefinition) -> dict[str, object]:
    # On the meta device counting needs no memory.
    with errors.wrap_user_errors(f"build of network {definition.name!r}"), torch.device("meta"):
        module = definition.build()
    defaults, path = definition.defaults.closed(), definition.checkpoint
    stated = ("name", "summary", "paper", "licence", "input_kind", "output_kind", "layers")
    return {
        **{key: getattr(definition, key) for key in stated},
        "size": _size(definition.size),
        "parameters": _parameters_of(module),
        "checkpoint": str(path) if path and path.is_file() else None,
        "layer": definition.default_layer,
        **{key: getattr(defaults, key) for key in ("iterations", "lr", "loss", "update")},
    }


def _size(size: Fixed | Multiple | Near) -> str:
    if isinstance(size, Fixed):
        return f"{size.height}×{size.width} ({size.fit})"
    if isinstance(size, Near):
        return f"any, resized to {size.height}×{size.width}" if size.height else "any, resized"
    return "any" if size.longest is None else f"any, shrunk to {size.longest}"


def _parameters_of(module: torch.nn.Module) -> int:
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
    network = load_network(model, checkpoint)
    definition, rgb = network.definition, None
    if image is not None:
        rgb = torch.from_numpy(read_rgb(image).values).permute(2, 0, 1).contiguous()[None]
    frame = FrameMap.fit(definition.size, *(DEFAULT_SIZE if rgb is None else rgb.shape[-2:]))
    with errors.out_of_memory_is_a_device_error(network.device):
        arguments = network.synthetic_arguments(frame, rgb)
        notes = [*network.notes, *network.verify(arguments)]
        if "rgb" in definition.input_kind and definition.normalisation is None:
            notes.append("input: rgb range 'unit' is assumed; --normalise of refine states one")
        with torch.no_grad():
            raw = network.raw_of(network.module(*arguments))
        known = raw[raw.isfinite()]
        if not len(known):
            notes.append(
                "warning: the prediction is inf or NaN at every pixel; are the network's weights,"
                " its input range (`normalise`) and precision right?"
            )
        layers = {name: _check_layer(network, name, arguments, raw) for name in definition.layers}
    return {
        "name": definition.name,
        "input": list(frame.network),
        "output": list(raw.shape[-2:]),
        "output_kind": definition.output_kind,
        "output_scale": definition.output_scale,
        "range": [float(known.min()), float(known.max())] if len(known) else [],
        "parameters": _parameters_of(network.module),
        "layers": layers,
        "notes": notes,
    }


def _check_layer(network: Network, name: str, arguments: tuple[Tensor, ...], whole: Tensor) -> str:
    """ "ok", or why the network cannot be cut at the layer."""
    try:
        with Split(network.module, name) as split:
            with torch.no_grad():
                z = split.front(*arguments)
            z.requires_grad_(True)
            raw = network.known_of(split.rear(z))
            if not torch.equal(raw.detach(), whole.nan_to_num()):
                return "the cut network gives something else than the whole one"
            gradient = gradient_at(z, raw.sum())
    except errors.ModelError as error:
        return str(error)
    reached = gradient is not None and bool(gradient.isfinite().all())
    return "ok" if reached else "no finite gradient comes back from the prediction"


@dataclass(frozen=True, kw_only=True)
class MeasuredLayer:
    """A layer and what a cut there costs and reaches; all but the name is None with a problem.

    stride: network pixels per element of z; None if z has no two spatial axes. cost_behind:
    fraction of the network's floating-point operations behind the cut, which every update repeats.
    Fields: rows and columns that one point influences, see `influential_fields`.
    """

    name: str
    shape: tuple[int, ...] | None = None
    stride: float | None = None
    cost_behind: float | None = None
    field_in_z: tuple[int, int] | None = None
    field_in_output: tuple[int, int] | None = None
    problem: str | None = None


def list_layers(
    model: str,
    checkpoint: Path | None,
    *,
    every: bool,
    on_layer: Callable[[int, int], None] = lambda done, of: None,
) -> list[MeasuredLayer]:
    """Returns the layers that a network can be cut at, measured on a synthetic frame.

    They are in the order of the definition, or of the network's submodules.

    Args:
        model: The network.
        checkpoint: Its weights.
        every: Whether all submodules are listed, not only the layers of the definition.
        on_layer: Callback after each layer with the number of layers done and of all.

    Raises:
        UsageError: The definition lists no layers.
        ModelError, DeviceError: As in loading.
    """
    network = load_network(model, checkpoint)
    submodules = [name for name, _ in network.module.named_modules() if name]
    names = submodules if every else list(network.definition.layers)
    if not names:
        raise errors.UsageError(
            f"the definition of {network.definition.name!r} lists no layers; --all lists every one"
        )
    frame, measured = FrameMap.fit(network.definition.size, *DEFAULT_SIZE), []
    with errors.out_of_memory_is_a_device_error(network.device):
        arguments = network.synthetic_arguments(frame)
        with torch.no_grad(), FlopCounterMode(display=False) as whole:
            network.depth_of(network.module(*arguments))
        fields = fields_of(network, arguments, names)
        for done, name in enumerate(names, start=1):
            flops = whole.get_total_flops()
            measured.append(_measure(network, name, arguments, frame, flops, fields.get(name)))
            on_layer(done, len(names))
    return measured


def _measure(
    network: Network,
    name: str,
    arguments: tuple[Tensor, ...],
    frame: FrameMap,
    whole_flops: int,
    field: Field | None,
) -> MeasuredLayer:
    try:
        with Split(network.module, name) as split, torch.no_grad():
            z = split.front(*arguments)
            split.rear(z)  # the first pass learns the cut
            with FlopCounterMode(display=False) as behind:
                split.rear(z)
    except errors.ModelError as error:
        return MeasuredLayer(name=name, problem=str(error))
    return MeasuredLayer(
        name=name,
        shape=tuple(z.shape),
        stride=frame.network[0] / z.shape[-2] if z.ndim == 4 else None,
        cost_behind=behind.get_total_flops() / whole_flops if whole_flops else None,
        field_in_z=None if field is None else field.in_z,
        field_in_output=None if field is None else field.in_output,
    )
