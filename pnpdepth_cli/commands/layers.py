"""`pnpdepth layers`: the layers a network can be cut at, and what a cut costs and reaches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from pnpdepth_cli.core.influence import Field
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError, UsageError, out_of_memory_is_a_device_error
from pnpdepth_cli.frames.resolve import fields_of
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network, load_network

_SYNTHETIC_SIZE = (240, 320)
"""Rows and columns of the synthetic frame."""


@dataclass(frozen=True, kw_only=True)
class MeasuredLayer:
    """A layer, and what a cut there costs and reaches; all but the name is None with a problem.

    z is the output of the layer.
    """

    name: str
    """Name of the submodule."""
    shape: tuple[int, ...] | None = None
    """Shape of z."""
    stride: float | None = None
    """Rows of the network's input for each row of z. None: z has no two spatial axes."""
    cost_behind: float | None = None
    """Fraction of the network's floating-point operations behind the cut, which every update
    repeats. None: they cannot be counted."""
    field_in_z: tuple[int, int] | None = None
    """Rows and columns of z that the gradient of one sparse point reaches. None: unknown."""
    field_in_output: tuple[int, int] | None = None
    """Rows and columns of the output that change when that part of z does. None: unknown."""
    problem: str | None = None
    """Why the network cannot be cut here. None: it can."""


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
        ModelError: The network cannot be loaded or run.
        DeviceError: The memory does not suffice.
    """
    # The layers to measure.
    network = load_network(model, checkpoint)
    submodules = [name for name, _ in network.module.named_modules() if name]
    names = submodules if every else list(network.definition.layers)
    if not names:
        raise UsageError(
            f"the definition of {network.definition.name!r} lists no layers; --all lists every one"
        )
    # What a whole pass costs, then what lies behind each cut.
    frame = FrameMap.fit(network.definition.size, *_SYNTHETIC_SIZE)
    measured = []
    with out_of_memory_is_a_device_error(network.device):
        arguments = network.synthetic_arguments(frame)
        with torch.no_grad(), FlopCounterMode(display=False) as whole:
            network.depth_of(network.module(*arguments))
        whole_flops = whole.get_total_flops()
        fields = fields_of(network, arguments, names)
        for done, name in enumerate(names, start=1):
            field = fields.get(name)
            measured.append(_measure(network, name, arguments, frame, whole_flops, field))
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
    """The layer with its z and its costs, or with the reason why the network is not cut there.

    Args:
        network: The network.
        name: Name of the layer.
        arguments: What the network takes for the frame.
        frame: Size of the frame, and of the network's input.
        whole_flops: Floating-point operations of a whole pass.
        field: What one point influences through the layer. None: that is not known.
    """
    try:
        with Split(network.module, name) as split, torch.no_grad():
            z = split.front(*arguments)
            split.rear(z)  # the first pass learns the cut
            with FlopCounterMode(display=False) as behind:
                split.rear(z)
    except ModelError as error:
        return MeasuredLayer(name=name, problem=str(error))
    return MeasuredLayer(
        name=name,
        shape=tuple(z.shape),
        stride=frame.network[0] / z.shape[-2] if z.ndim == 4 else None,
        cost_behind=behind.get_total_flops() / whole_flops if whole_flops else None,
        field_in_z=None if field is None else field.in_z,
        field_in_output=None if field is None else field.in_output,
    )
