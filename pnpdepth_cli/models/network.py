"""A network ready to run: built, with its weights, on its device.

`load_network` makes one. `models.aligned_depth` turns its output into metres.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from pnpdepth_cli.budget import check_claim, max_network_pixels
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.split.tensors import tensors_in
from pnpdepth_cli.errors import (
    DeviceError,
    ModelError,
    UsageError,
    out_of_memory_is_a_device_error,
    wrap_user_errors,
)
from pnpdepth_cli.models.cut_layers import suggest_layers
from pnpdepth_cli.models.decisions import recall_or_decide_layers
from pnpdepth_cli.models.definition import (
    ModelDefinition,
    Multiple,
    Normalisation,
    file_and_part,
)
from pnpdepth_cli.models.frame_map import FrameMap, synthetic_frame
from pnpdepth_cli.models.registry import find_definition, importing_beside
from pnpdepth_cli.models.weights import load_checkpoint
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.spent import spent_on

FARTHEST_DEPTH = 1e4
"""Metres; inverse depth below 1/FARTHEST_DEPTH reads as this depth."""

_SUGGESTION_SIDE = 128
"""Height and width in pixels of the synthetic image that suggests layers."""

_MAX_REASON = 120
"""Characters of a backend's message that are shown."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Network:
    """A network with its weights on its device, in eval mode, its parameters without gradients."""

    definition: ModelDefinition
    module: nn.Module
    device: torch.device
    checkpoint: Path | None
    """File or folder of its weights; None if it has none, or `build` loads them unnamed."""
    notes: tuple[str, ...] = ()
    """What was assumed or done when it was loaded, a text each, to be printed."""

    def __repr__(self) -> str:
        count = sum(parameter.numel() for parameter in self.module.parameters())
        return f"Network({self.definition.name!r}, {count:,} parameters, {str(self.device)!r})"

    def cut_at(self, layer: str) -> Split:
        """Returns the network cut at a layer, to be opened by `with`.

        Raises:
            ModelError: The network has no such layer.
        """
        return Split(self.module, layer, static_graph=self.definition.static_graph)

    def image_of(self, frame: FrameMap, rgb: Tensor | None) -> Tensor | None:
        """Returns the image as the network takes it: (1, 3, h, w), normalised, on its device.

        None if the network takes no image.

        Args:
            frame: Map from pixels of the image (H, W) to those of the network (h, w).
            rgb: (1, 3, H, W) in 0…1, the whole image; None if there is none.

        Raises:
            UsageError: The network takes an rgb image and there is none.
        """
        if "rgb" not in self.definition.input_kind:
            return None
        if rgb is None:
            raise UsageError(f"network {self.definition.name!r} takes an rgb image; give one")
        # A normalisation that is still to be chosen leaves 0…1.
        normalisation = self.definition.normalisation or Normalisation()
        mean = rgb.new_tensor(normalisation.mean).reshape(1, 3, 1, 1)
        std = rgb.new_tensor(normalisation.std).reshape(1, 3, 1, 1)
        return ((frame.rgb_to_network(rgb) - mean) / std).to(self.device)

    def arguments_of(
        self,
        image: Tensor | None,
        points: SparsePoints,
        prior: Tensor | None = None,
        intrinsics: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Returns the positional arguments of the network's forward, on its device.

        Args:
            image: Image (1, 3, h, w) from `image_of`, None if the network takes none.
            points: Points at pixel coordinates of the network.
            prior: Dense depth (1, 1, h, w) in metres, 0 = unknown, for a network that takes a
                prior; it becomes the last argument. None leaves that out.
            intrinsics: Camera matrix (1, 3, 3) in pixels of the network; None if it is unknown.

        Raises:
            ModelError: The definition's `arguments` raises or does not return a tuple.
            UsageError: The network takes intrinsics, and they are unknown.
        """
        definition = self.definition
        title = f"network {definition.name!r}"
        # Sparse depth and camera, for a network that takes them.
        sparse = None
        if "sparse" in definition.input_kind:
            sparse = points.scatter().to(self.device)
        camera = None
        if definition.takes_intrinsics:
            if intrinsics is None:
                raise UsageError(f"{title} takes the camera's intrinsics; give a camera")
            camera = intrinsics.to(self.device)
        # In the order of forward, by the definition's own function if it has one.
        with wrap_user_errors(f"arguments of {title}"):
            arguments = definition.call_arguments(image, sparse, camera)
        if not isinstance(arguments, tuple):
            kind = type(arguments).__name__
            raise ModelError(f"arguments of {title} gives a {kind}, where a tuple is expected")
        return arguments if prior is None else (*arguments, prior)

    def synthetic_arguments(self, frame: FrameMap, rgb: Tensor | None = None) -> tuple[Tensor, ...]:
        """Returns the arguments of forward for a made-up frame, with which a network is tried.

        Args:
            frame: Map from pixels of the image to those of the network.
            rgb: Image (1, 3, H, W) in 0…1; None takes a synthetic one. The points and the camera
                are synthetic in any case.
        """
        synthetic = synthetic_frame(frame.image)
        return self.arguments_of(
            self.image_of(frame, synthetic.rgb if rgb is None else rgb),
            frame.points_to_network(synthetic.points),
            intrinsics=frame.intrinsics_to_network(synthetic.camera),
        )

    def verify(self, arguments: tuple[Tensor, ...]) -> tuple[str, ...]:
        """Returns what the definition's own check says of the network: one note, or none.

        Args:
            arguments: Arguments of forward for a frame, from `arguments_of`.

        Raises:
            ModelError: The network cannot be verified, or `verify` itself raises.
        """
        if self.definition.verify is None:
            return ()
        with wrap_user_errors(f"verify of network {self.definition.name!r}"):
            note = self.definition.verify(self.module, arguments)
        return (str(note),) if note else ()

    def depth_of(self, output: object) -> Tensor:
        """Returns depth (1, 1, h, w) in metres, by the definition alone; NaN where it is unknown.

        Args:
            output: What forward returned, of a network that is said to give metres, as depth,
                inverse depth or log depth.

        Raises:
            ModelError: It holds no one depth map, as for `raw_of`.
        """
        prediction = self.raw_of(output)
        match self.definition.output_kind:
            case "inverse":
                return prediction.clamp_min(1 / FARTHEST_DEPTH).reciprocal()
            case "log":
                return prediction.exp()
        return prediction

    def raw_of(self, output: object) -> Tensor:
        """Returns the prediction (1, 1, h, w) in float32, in the network's own numbers.

        NaN where the network gives NaN or infinity, as some do in the sky. No gradient flows back
        from these pixels.

        Args:
            output: What forward returned.

        Raises:
            ModelError: It holds no prediction, or several tensors that `output` of the definition
                does not choose from.
        """
        prediction = self.map_of(output)
        is_finite = prediction.isfinite()
        if bool(is_finite.all()):
            return prediction
        _zero_nan_gradients_behind(prediction)
        return torch.where(is_finite, prediction, torch.nan)

    def map_of(self, output: object) -> Tensor:
        """Returns the prediction (1, 1, h, w) in float32 as it is, with NaN and ±∞ as they come.

        Args:
            output: What forward returned.

        Raises:
            ModelError: It holds no one depth map, as for `raw_of`.
        """
        # The definition's `output` picks the depth, or it is the only tensor.
        title = f"network {self.definition.name!r}"
        if self.definition.output is not None:
            with wrap_user_errors(f"output of {title}"):
                output = self.definition.output(output)
        tensors: list[tuple[tuple[str, ...], Tensor]] = list(tensors_in(output))
        if len(tensors) != 1:
            paths = ", ".join(".".join(path) for path, _ in tensors)
            raise ModelError(
                f"{title} gives a {type(output).__name__} with {len(tensors)} tensors in it"
                f" ({paths}); pick the depth as FILE:[0], or by `output` of its definition"
            )
        # It is one map, with or without axes of batch and channel.
        tensor = tensors[0][1].float()
        shape = tuple(tensor.shape)
        if len(shape) < 2 or shape[:-2] not in ((), (1,), (1, 1)):
            raise ModelError(
                f"{title} gives a tensor of shape {shape}, where one depth map (1, 1, h, w) is"
                " expected; pick a channel as FILE:[0], z of points as FILE:[z], or by `output` of"
                " its definition"
            )
        return tensor.reshape(1, 1, *shape[-2:])

    def known_of(self, output: object) -> Tensor:
        """Returns the prediction of `raw_of`, (1, 1, h, w), with 0 where it is unknown."""
        return self.raw_of(output).nan_to_num()


def _zero_nan_gradients_behind(prediction: Tensor) -> None:
    """Makes NaN in any gradient on its way back from a prediction 0, by hooks on torch's graph.

    A pixel that is infinite has an infinite derivative somewhere. Its gradient is set to 0, but
    0 · ∞ is NaN, which would spread to all that the pixel was computed from.
    """

    def without_nan(gradients: tuple[Tensor | None, ...], _: object) -> tuple[Tensor | None, ...]:
        """Returns the gradients with 0 for NaN; torch calls this behind each operation."""
        return tuple(
            None if gradient is None else gradient.nan_to_num(0.0, math.inf, -math.inf)
            for gradient in gradients
        )

    # Every operation that the prediction was computed by.
    seen = set()
    operations = [prediction.grad_fn]
    while operations:
        operation = operations.pop()
        if operation is None or operation in seen:
            continue
        seen.add(operation)
        operation.register_hook(without_nan)
        operations += [earlier for earlier, _ in operation.next_functions]


def load_network(
    spec: str | ModelDefinition, checkpoint: Path | None, device: str = "cpu"
) -> Network:
    """Returns a network, built, with its weights, on its device.

    Args:
        spec: A name, file or folder, see `find_definition`; or a definition itself.
        checkpoint: The weights; None takes those of the definition.
        device: Name of a torch device.

    Raises:
        ModelError: There is no such network, it cannot be built, or its weights are missing or do
            not fit.
        DeviceError: The device is missing or too small.
        UsageError: A checkpoint is named for a network that brings its own weights.
    """
    with spent_on("weights"):
        network = _load(spec, checkpoint, device)
    # The definition may leave open where to cut.
    if network.definition.layers or network.definition.defaults.layer:
        return network
    with spent_on("layer"):
        return _with_suggested_layers(network)


def _load(spec: str | ModelDefinition, checkpoint: Path | None, device: str) -> Network:
    """Returns the network as `load_network` does, with the definition's own layers only."""
    torch_device = find_device(device)
    definition = find_definition(spec) if isinstance(spec, str) else spec
    title = f"network {definition.name!r}"
    # The module, unless its images would be larger than is allowed.
    module = _build(definition, spec if isinstance(spec, str) else None)
    _check_image_size(definition)
    # Its weights.
    notes = [f"model: {definition.assumed}"] if definition.assumed else []
    path = checkpoint or definition.checkpoint
    if definition.complete and checkpoint is not None:
        raise UsageError(f"{title} comes with its weights; leave out `checkpoint`")
    if not definition.complete:
        notes += _load_weights(module, definition, path)
    # Only z will require gradients.
    module.eval().requires_grad_(False)
    with out_of_memory_is_a_device_error(torch_device):
        module.to(torch_device)
    return Network(
        definition=definition,
        module=module,
        device=torch_device,
        checkpoint=None if path is None else file_and_part(path)[0],
        notes=tuple(notes),
    )


def _build(definition: ModelDefinition, spec: str | None) -> nn.Module:
    """Returns the module that the definition's `build` makes.

    Args:
        definition: Definition of the network.
        spec: Name or file of the network, from whose folder `build` may import modules; None for
            none.

    Raises:
        ModelError: `build` raises, or gives something else.
    """
    title = f"network {definition.name!r}"
    beside = nullcontext() if spec is None else importing_beside(spec)
    with wrap_user_errors(f"build of {title}"), beside:
        # A module can be called as well, but `build` must make one, not be one.
        module = None if isinstance(definition.build, nn.Module) else definition.build()
    if not isinstance(module, nn.Module):
        raise ModelError(
            f"build of {title} gives no torch module; a class or a function that makes one is"
            " expected, as in lambda: net"
        )
    return module


def _check_image_size(definition: ModelDefinition) -> None:
    """Raises ModelError if the one image size that a network takes is larger than is allowed."""
    size = definition.size
    if isinstance(size, Multiple):
        return  # it follows the image
    # `Near` may state one side, which then counts for both, or none.
    height = size.height or size.width or 1
    width = size.width or size.height or 1
    check_claim(
        f"network {definition.name!r} takes images of {width}×{height} pixels",
        height * width,
        max_network_pixels(),
        error=ModelError,
        way_out="allow more with --max-pixels",
    )


def _load_weights(module: nn.Module, definition: ModelDefinition, path: Path | None) -> list[str]:
    """Loads the weights into the module, and returns notes on how; they are never random.

    Args:
        module: Network that the definition built; its weights are replaced.
        definition: Definition of the network.
        path: File or folder of the weights; None if nobody named one, which only a network without
            parameters may lack.

    Raises:
        ModelError: The weights are not named, not there, or do not fit.
    """
    if path is None and module.state_dict():
        raise ModelError(
            f"network {definition.name!r} comes without weights; name them by `checkpoint`, or,"
            " where its build loads them itself, say complete=True in a definition"
        )
    if path is None:
        return []
    if path.parent.parent.name == "model_zoo_defs" and not path.is_file():
        raise ModelError(
            f"checkpoint {path} does not exist, as the package has the weights of few networks;"
            f" take {path.name} from the repository, and name it by `checkpoint`"
        )
    return load_checkpoint(module, definition, path)


def _with_suggested_layers(network: Network) -> Network:
    """Returns the network with layers to cut at that the shapes of its feature maps suggest.

    The network itself if they suggest none.
    """
    frame = FrameMap.fit(network.definition.size, _SUGGESTION_SIDE, _SUGGESTION_SIDE)

    def suggest() -> list[str]:
        """Returns the names of the layers, found by a pass of the network."""
        with out_of_memory_is_a_device_error(network.device):
            arguments = network.synthetic_arguments(frame)
            return list(suggest_layers(network.module, arguments, network.map_of))

    question = f"layers, of {frame.network}"
    layers = tuple(recall_or_decide_layers(network.module, network.definition, question, suggest))
    if not layers:
        return network
    note = (
        f"layers: the definition of {network.definition.name!r} lists none; suggested by shape:"
        f" {', '.join(layers)}; the first is the bottleneck"
    )
    definition = replace(network.definition, layers=layers)
    return replace(network, definition=definition, notes=(*network.notes, note))


def find_device(name: str) -> torch.device:
    """Returns the torch device of that name.

    Raises:
        DeviceError: The device is not there or does not work.
    """
    try:
        device = torch.device(name)
        float(torch.zeros(1, device=device))  # "meta" has no values
    except Exception as error:  # every backend raises another type if it is not there
        first_line = (str(error).splitlines() or [""])[0]
        reason = first_line[:_MAX_REASON]
        raise DeviceError(f"device {name!r} cannot be used: {reason}; try device cpu") from None
    return device
