"""A network ready to run: built, with its weights, on its device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.split.structure import tensors_in
from pnpdepth_cli.core.split.user_code import is_out_of_memory, wrap_user_errors
from pnpdepth_cli.errors import CheckpointError, DeviceError, ModelError, UsageError
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Normalisation
from pnpdepth_cli.models.formats.python_file import importing_beside
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.made_up import made_up_arguments
from pnpdepth_cli.models.precision import dtype_of, lower
from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.models.suggest_layers import outline
from pnpdepth_cli.models.weights.checkpoint import load_checkpoint
from pnpdepth_cli.points import SparsePoints

FARTHEST_DEPTH = 1e4
"""Metres; inverse depth below 1/FARTHEST_DEPTH reads as this depth."""

_OUTLINED = 128  # pixels a side of the frame that layers are looked for with


@dataclass(frozen=True, kw_only=True)
class Network:
    """A definition and its module in eval mode; `checkpoint` is the file the weights came from."""

    definition: ModelDefinition
    module: nn.Module
    device: torch.device
    checkpoint: Path | None
    notes: tuple[str, ...] = ()

    def cut_at(self, layer: str) -> Split:
        """The network cut at the layer, to be opened. LayerError where there is none."""
        return Split(self.module, layer, static_graph=self.definition.static_graph)

    def arguments(
        self, frame: FrameMap, rgb: Tensor | None, points: SparsePoints
    ) -> tuple[Tensor, ...]:
        """The network's arguments for an image (1, 3, H, W) in 0..1 and points in its own frame."""
        kind = self.definition.input_kind
        picture = sparse = None
        if "rgb" in kind:
            if rgb is None:
                raise UsageError(
                    f"network {self.definition.name!r} looks at a picture; name one before --sparse"
                )
            normalise = self.definition.normalisation or Normalisation()
            mean = rgb.new_tensor(normalise.mean).reshape(1, 3, 1, 1)
            std = rgb.new_tensor(normalise.std).reshape(1, 3, 1, 1)
            picture = ((frame.rgb_to_network(rgb) - mean) / std).to(self.device)
        if "sparse" in kind:
            sparse = points.scatter().to(self.device)
        with wrap_user_errors(f"arguments of network {self.definition.name!r}"):
            arguments = self.definition.call_arguments(picture, sparse)
        if not isinstance(arguments, tuple):
            raise ModelError(
                f"arguments of network {self.definition.name!r} gives a"
                f" {type(arguments).__name__}, where a tuple is expected"
            )
        return arguments

    def verified(self, arguments: tuple[Tensor, ...]) -> tuple[str, ...]:
        """What the definition's `verify` has to say. ModelError if it raises or has no trust."""
        if self.definition.verify is None:
            return ()
        with wrap_user_errors(f"verify of network {self.definition.name!r}"):
            said = self.definition.verify(self.module, arguments)
        return (str(said),) if said else ()

    def depth_of(self, output: Any) -> Tensor:
        """Depth (1, 1, h, w) in float32 of what the module returns, taken to be in metres."""
        tensor = self.raw_of(output)
        if self.definition.output_kind == "inverse":
            return tensor.clamp_min(1 / FARTHEST_DEPTH).reciprocal()
        return tensor.exp() if self.definition.output_kind == "log" else tensor

    def raw_of(self, output: Any) -> Tensor:
        """The prediction (1, 1, h, w) in float32 as the network gives it. ModelError if none."""
        given = self._tensor_of(output)
        tensor = given.float()
        if tensor.ndim == 3:
            tensor = tensor[:, None]
        if tensor.ndim == 2:
            tensor = tensor[None, None]
        if tensor.ndim != 4 or tuple(tensor.shape[:2]) != (1, 1):
            raise ModelError(
                f"network {self.definition.name!r} gives a tensor of shape {tuple(given.shape)},"
                " where one depth map (1, 1, h, w) is expected; pick it by the definition's output"
            )
        return tensor

    def _tensor_of(self, output: Any) -> Tensor:
        if self.definition.output is not None:
            with wrap_user_errors(f"output of network {self.definition.name!r}"):
                chosen = self.definition.output(output)
            if not isinstance(chosen, Tensor):
                raise ModelError(
                    f"output of network {self.definition.name!r} gives a"
                    f" {type(chosen).__name__}, where a tensor is expected"
                )
            return chosen
        found: list[tuple[tuple[str, ...], Tensor]] = list(tensors_in(output))
        if not found:
            raise ModelError(
                f"network {self.definition.name!r} returns a {type(output).__name__} without a"
                " tensor in it; its forward, or `output` of its definition, must give the depth"
            )
        if len(found) != 1:
            names = ", ".join(".".join(path) for path, _ in found)
            raise ModelError(
                f"network {self.definition.name!r} returns {len(found)} tensors ({names}); its"
                " definition must pick the depth with `output`"
            )
        return found[0][1]


def load_network(
    spec: str,
    checkpoint: Path | None,
    device: str = "cpu",
    *,
    precision: str = "fp32",
    untrained: bool = False,
) -> Network:
    """The network named by `spec`, with the weights of `checkpoint` or the definition's own.

    untrained: where there are none, random weights, which is noted, will do; without it they never
    do. precision: see `pnpdepth_cli.models.precision`. Raises ModelError, CheckpointError or
    DeviceError.
    """
    on = find_device(device)
    dtype = dtype_of(precision, on)
    definition = find_definition(spec)
    path = checkpoint or definition.checkpoint
    module = _built(definition, spec)
    notes: list[str] = []
    if definition.complete and checkpoint is not None:
        raise UsageError(
            f"network {definition.name!r} comes with its weights; --checkpoint does not go with it"
        )
    if definition.complete:
        notes = []
    elif path is not None:
        notes = load_checkpoint(module, definition, path)
    elif untrained:
        notes = ["weights: random, for none are given; times are right, depths are not"]
    elif module.state_dict():
        raise CheckpointError(
            f"network {definition.name!r} comes without weights; name them with --checkpoint, or,"
            " where its build loads them itself, say complete=True in a definition"
        )
    module.eval().requires_grad_(False)
    with out_of_memory_is_a_device_error(on):
        module.to(on)
    if dtype is not None:
        lower(module, dtype, on)
    notes = [f"model: {definition.assumed}", *notes] if definition.assumed else notes
    network = Network(
        definition=definition, module=module, device=on, checkpoint=path, notes=tuple(notes)
    )
    return network if definition.layers or definition.defaults.layer else _outlined(network)


def _built(definition: ModelDefinition, spec: str) -> nn.Module:
    """What `build` makes; it may import what lies beside the model file."""
    if isinstance(definition.build, nn.Module):
        raise ModelError(
            f"build of network {definition.name!r} is a {type(definition.build).__name__} that is"
            " made already; a class or a function that makes it is expected, as in lambda: net"
        )
    with wrap_user_errors(f"build of network {definition.name!r}"), importing_beside(spec):
        module = definition.build()
    if not isinstance(module, nn.Module):
        raise ModelError(f"build of {definition.name!r} gives no torch module")
    return module


def _outlined(network: Network) -> Network:
    """The network with layers to cut at, where its definition lists none."""
    size = network.definition.size
    if isinstance(size, Fixed):
        height, width = size.height, size.width
    else:
        height = width = -(-_OUTLINED // size.of) * size.of
    with out_of_memory_is_a_device_error(network.device):
        arguments = made_up_arguments(network, FrameMap.fit(size, height, width))
        layers = outline(network.module, arguments, network.raw_of)
    if not layers:
        return network
    return replace(
        network,
        definition=replace(network.definition, layers=layers),
        notes=(
            *network.notes,
            f"layers: none are named for {network.definition.name!r}; by their shapes"
            f" {', '.join(layers)} are worth a cut, the first is the bottleneck",
        ),
    )


def find_device(name: str) -> torch.device:
    """The torch device of that name. DeviceError if it is not there."""
    try:
        device = torch.device(name)
        float(torch.zeros(1, device=device))  # "meta" has no values
    except Exception as error:  # every backend has its own way to say that it is not there
        reason = (str(error).splitlines() or [""])[0][:120]
        raise DeviceError(f"device {name!r} cannot be used: {reason}; try --device cpu") from None
    return device


@contextmanager
def out_of_memory_is_a_device_error(device: torch.device) -> Iterator[None]:
    """Running out of memory becomes a DeviceError."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise DeviceError(
            f"device {str(device)!r} is out of memory; use a smaller image or another device"
        ) from None
