"""A network ready to run: built, with its weights, on its device; and its output in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from pnpdepth_cli.budget import check_claim, max_network_pixels
from pnpdepth_cli.choices import FITS, READINGS
from pnpdepth_cli.completion.alignment import (
    READING_OF_KIND,
    Alignment,
    alignments,
    candidates,
)
from pnpdepth_cli.completion.outliers import off_together
from pnpdepth_cli.completion.two_depths import is_reversed, rank_correlation
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
from pnpdepth_cli.models.decisions import recalled_layers
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

_OFF = 1.5  # a prediction that is this factor off the points at the median gets a word of warning
_NO_BETTER = 0.95
"""Misfit over that of a constant from which on a network is said to know nothing of the scene."""
_ENOUGH = 20
"""Points from which on the errors there say that a network knows nothing, or that many are off."""
_MANY_OUTLIERS = 0.25
"""Fraction of the points that may be far off the aligned prediction without a warning."""
_REVERSED = -0.8
"""Rank correlation of a network's output and the points below which one of them is no depth. The
three weakest networks of the zoo come down to −0.69 in 91 frames of seven sets."""
_FARTHER = {
    "depth": 1,
    "log": 1,
    "inverted-disparity": 1,
    "inverse": -1,
    "disparity": -1,
}
"""The direction of what a definition or --align states: 1 where larger numbers are farther."""
_FITS_REST = 0.05
"""Error of log depth over the best 70 % of the points up to which a network fits them."""
_STANDS_OUT = (0.2, 10.0, 0.35)
"""Error of log depth from which on a point stands out: so many times that of the best 70 %, but not
below the first nor above the last."""
_ORDERED = 0.9
"""Rank correlation with the other points, from which on a network knows which is farther: a weak
one fits the points of a wall, too."""
_GROUP = 0.06
"""Fraction of the points that contradict such a network together, from which on it is said. Of 34
predictions of strong networks with 200 or 500 points each, 5.5 % at most do."""
_OTHER_MAP = 0.03
"""Mean difference of log depth over the image from which on two readings give different maps."""
_COMPARED = 10_000
"""Pixels that this mean is over."""
_MOST_LOST = 0.5
"""Fraction of the points that may lie where the prediction is unknown, without a warning."""
_FEW_UNKNOWN = 1e-4
"""Fraction of the image below which nothing is said of unknown pixels without a point."""
_SUGGESTION_SIDE = 128  # pixels of the synthetic frame that suggests layers


@dataclass(frozen=True, kw_only=True, repr=False)
class Network:
    """A network with its weights on its device, in eval mode, its parameters without gradients.

    notes: what was assumed or done when it was loaded, to be printed.
    """

    definition: ModelDefinition
    module: nn.Module
    device: torch.device
    checkpoint: Path | None
    notes: tuple[str, ...] = ()

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
        """Returns the image as the network takes it, (1, 3, h, w); None if it takes none.

        Args:
            frame: Map from pixels of the image to those of the network.
            rgb: (1, 3, H, W) in 0…1, the whole image; None if there is none.

        Raises:
            UsageError: The network takes an rgb image and there is none.
        """
        if "rgb" not in self.definition.input_kind:
            return None
        if rgb is None:
            raise UsageError(f"network {self.definition.name!r} takes an rgb image; give one")
        normalise = self.definition.normalisation or Normalisation()
        mean = rgb.new_tensor(normalise.mean).reshape(1, 3, 1, 1)
        std = rgb.new_tensor(normalise.std).reshape(1, 3, 1, 1)
        return ((frame.rgb_to_network(rgb) - mean) / std).to(self.device)

    def arguments_of(
        self,
        image: Tensor | None,
        points: SparsePoints,
        prior: Tensor | None = None,
        intrinsics: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Returns the positional arguments of the network's forward.

        Args:
            image: Image from `image_of`.
            points: Points at pixel coordinates of the network.
            prior: (1, 1, h, w) metres, 0 = unknown, for a network that takes one; None without.
            intrinsics: (1, 3, 3) in pixels of the network. None: unknown.

        Raises:
            ModelError: The definition's `arguments` raises or does not return a tuple.
            UsageError: The network takes intrinsics, and they are unknown.
        """
        definition = self.definition
        name = f"network {self.definition.name!r}"
        sparse = points.scatter().to(self.device) if "sparse" in definition.input_kind else None
        camera = None
        if definition.takes_intrinsics:
            if intrinsics is None:
                raise UsageError(f"{name} takes the camera's intrinsics; give a camera")
            camera = intrinsics.to(self.device)
        with wrap_user_errors(f"arguments of {name}"):
            arguments = definition.call_arguments(image, sparse, camera)
        if not isinstance(arguments, tuple):
            kind = type(arguments).__name__
            raise ModelError(f"arguments of {name} gives a {kind}, where a tuple is expected")
        return arguments if prior is None else (*arguments, prior)

    def synthetic_arguments(self, frame: FrameMap, rgb: Tensor | None = None) -> tuple[Tensor, ...]:
        """Returns the arguments for synthetic points and camera, and a synthetic image.

        Args:
            frame: Map from pixels of the image to those of the network.
            rgb: (1, 3, H, W) in 0…1, an image instead of the synthetic one.
        """
        synthetic, points, camera = synthetic_frame(frame.image)
        return self.arguments_of(
            self.image_of(frame, synthetic if rgb is None else rgb),
            frame.points_to_network(points),
            intrinsics=frame.intrinsics_to_network(camera),
        )

    def verify(self, arguments: tuple[Tensor, ...]) -> tuple[str, ...]:
        """Returns the notes of the definition's `verify` on the network's arguments for a frame.

        Raises:
            ModelError: The network cannot be verified, or `verify` itself raises.
        """
        if self.definition.verify is None:
            return ()
        with wrap_user_errors(f"verify of network {self.definition.name!r}"):
            note = self.definition.verify(self.module, arguments)
        return (str(note),) if note else ()

    def depth_of(self, output: object) -> Tensor:
        """Returns depth (1, 1, h, w) of what a module returns whose output needs no alignment."""
        tensor = self.raw_of(output)
        if self.definition.output_kind == "inverse":
            return tensor.clamp_min(1 / FARTHEST_DEPTH).reciprocal()
        return tensor.exp() if self.definition.output_kind == "log" else tensor

    def raw_of(self, output: object) -> Tensor:
        """Returns the prediction (1, 1, h, w) in float32, in the network's own numbers.

        NaN where it is not finite, as networks say of the sky. No gradient comes from there.

        Raises:
            ModelError: It holds no prediction, or several tensors that `output` of the definition
                does not choose from.
        """
        tensor = self.map_of(output)
        # Where it is not finite, it is NaN, and no gradient comes from there.
        known = tensor.isfinite()
        if bool(known.all()):
            return tensor
        _read_nan_gradients_as_zero(tensor)
        return torch.where(known, tensor, torch.nan)

    def map_of(self, output: object) -> Tensor:
        """Returns the prediction as `raw_of` does, but not finite where it is not.

        Raises:
            ModelError: It holds no prediction, or several tensors, as `raw_of` says.
        """
        # The definition's `output` picks the depth, or it is the only tensor.
        name = f"network {self.definition.name!r}"
        if self.definition.output is not None:
            with wrap_user_errors(f"output of {name}"):
                output = self.definition.output(output)
        tensors: list[tuple[tuple[str, ...], Tensor]] = list(tensors_in(output))
        if len(tensors) != 1:
            paths = ", ".join(".".join(path) for path, _ in tensors)
            raise ModelError(
                f"{name} gives a {type(output).__name__} with {len(tensors)} tensors in it"
                f" ({paths}); pick the depth as FILE:[0], or by `output` of its definition"
            )
        # One map, with or without axes of batch and channel.
        tensor = tensors[0][1].float()
        shape = tuple(tensor.shape)
        if shape[:-2] not in ((), (1,), (1, 1)) or len(shape) < 2:
            raise ModelError(
                f"{name} gives a tensor of shape {shape}, where one depth map (1, 1, h, w) is"
                " expected; pick a channel as FILE:[0], z of points as FILE:[z], or by `output` of"
                " its definition"
            )
        return tensor.reshape(1, 1, *shape[-2:])

    def known_of(self, output: object) -> Tensor:
        """Returns `raw_of` the output, 0 where it is not finite."""
        return self.raw_of(output).nan_to_num()


def _read_nan_gradients_as_zero(tensor: Tensor) -> None:
    """Makes 0 of NaN in the gradients behind a tensor, which are 0 times an infinite slope."""
    seen = set()
    nodes = [tensor.grad_fn]
    while nodes:
        node = nodes.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        node.register_hook(
            lambda gradients, _: tuple(
                None if gradient is None else gradient.nan_to_num(0.0, math.inf, -math.inf)
                for gradient in gradients
            )
        )
        nodes += [before for before, _ in node.next_functions]


class AlignedDepth:
    """Called with what the network returns, gives depth (1, 1, h, w) in metres.

    The alignment is fitted at the first call, which is the plain prediction's, and kept.
    """

    def __init__(self, network: Network, points: SparsePoints, kind: str) -> None:
        self._network, self._points, self._kind = network, points, kind
        self._read = False
        self.alignment: Alignment | None = None
        self.notes: tuple[str, ...] = ()

    def __call__(self, output: object) -> Tensor:
        """Returns depth in metres, (1, 1, h, w), from the network's output; NaN where unknown."""
        plain = self._kind == "none"
        raw = self._network.depth_of(output) if plain else self._network.raw_of(output)
        if not self._read:
            self._read = True
            self._fit(raw.detach())
        return raw if self.alignment is None else self.alignment.depth(raw)

    def _fit(self, raw: Tensor) -> None:
        """Fits the alignment to the plain prediction, and notes what a person should know of it."""
        at_points = self._points.sample(raw)
        seen = at_points.isfinite()
        self.notes = self._unknown_notes(raw, seen)
        if bool(seen.any()):
            self._points = self._points.select(seen)
            at_points = at_points[seen]
        definition = self._network.definition
        self.notes += self._order_notes(at_points)
        if self._kind == "none":
            self.notes += self._plain_notes(at_points)
            return
        fits = align_output(definition, at_points, self._points, self._kind)
        self.alignment = fits[0]
        self.notes += self._notes(self.alignment, raw)
        self.notes += self._alike_notes(fits, raw)
        self.notes += self._group_notes(self.alignment, at_points)

    def _unknown_notes(self, raw: Tensor, seen: Tensor) -> tuple[str, ...]:
        """Where the network says nothing, such as of the sky, and how many points lie there."""
        unknown = float(raw.isnan().cpu().double().mean())
        lost = int((~seen).sum())
        if not lost and unknown < _FEW_UNKNOWN:
            return ()
        note = f"prediction: {unknown:.2%} of the image is inf or NaN, so it is unknown there"
        if lost:
            note += f"; {lost:,} of {len(seen):,} sparse points are there, and not in the loss"
        doubt = "; are the network's weights and input range (`normalise`) right?"
        return (f"warning: {note}{doubt}" if lost > _MOST_LOST * len(seen) else note,)

    def _order_notes(self, at_points: Tensor) -> tuple[str, ...]:
        """A warning if what is nearer by the points is farther by a network of the image alone."""
        definition = self._network.definition
        if "sparse" in definition.input_kind:
            return ()  # its output follows the points
        stated = self._kind if self._kind in READINGS else definition.output_kind
        direction = _FARTHER.get(stated, 0)
        if self._kind == "none":
            direction = 1  # its numbers have been made metres
        numbers = direction * at_points.cpu().double().numpy()
        rank = rank_correlation(numbers, self._points.depth.cpu().double().numpy())
        if rank > _REVERSED or not is_reversed(rank, len(numbers)):
            return ()
        return (
            f"warning: what is nearer by the {len(numbers):,} points is farther by network"
            f" {definition.name!r} (rank correlation {rank:.2f}): if the points hold disparity or"
            " 1/depth, --sparse-kind reads them; if the network gives another kind of depth than is"
            " stated, --align states it",
        )

    def _alike_notes(self, fits: Sequence[Alignment], raw: Tensor) -> tuple[str, ...]:
        """Which readings explain the points as well as the chosen one, and give other maps.

        None where the chosen one is stated.
        """
        best, *others = fits
        stated = READING_OF_KIND.get(self._network.definition.output_kind)
        if best.reading in (self._kind, stated):
            return ()
        numbers = raw[raw.isfinite()].cpu().double()
        numbers = numbers[:: max(1, len(numbers) // _COMPARED)]
        log_depth = best.depth(numbers).log()
        texts = []
        for other in others:
            differs = float((other.depth(numbers).log() - log_depth).abs().mean())
            if differs > _OTHER_MAP:
                texts.append(
                    f"{other.title} ({other.reading}, off by {other.error:.1%} against"
                    f" {best.error:.1%}, and the map differs by {differs:.0%})"
                )
        if not texts:
            return ()
        return (
            f"note: the {best.points:,} points are explained as well by {' and by '.join(texts)};"
            " --align states what is right",
        )

    def _group_notes(self, fit: Alignment, at_points: Tensor) -> tuple[str, ...]:
        """A warning if points agree with each other, and a network that fits the rest does not."""
        of_points = "sparse" in self._network.definition.input_kind
        if of_points or len(at_points) < _ENOUGH or fit.error > _FITS_REST:
            return ()
        points = self._points.tensors()
        error = points.depth.log() - fit.depth(at_points.cpu().double()).log().float()
        lowest, times_error, highest = _STANDS_OUT
        least = min(max(times_error * fit.error, lowest), highest)
        together = off_together(points, error, least)
        count = int(together.sum())
        if count < _GROUP * len(points):
            return ()
        others = ~together
        numbers = at_points.cpu().double()[others].numpy()
        if abs(rank_correlation(numbers, points.depth[others].double().numpy())) < _ORDERED:
            return ()
        times = math.exp(float(error[together].median()))
        column, row = points.xy[together].median(dim=0).values.tolist()
        return (
            f"warning: {count:,} of {len(points):,} points, around ({column:.0f}, {row:.0f}), agree"
            f" with each other but are {times:.2g} times as far as network"
            f" {self._network.definition.name!r} says, which fits the others to {fit.error:.1%}: a"
            " mirror, or a surface behind a pane? They count as depth; --sparse-mask leaves points"
            " out",
        )

    def _notes(self, fit: Alignment, raw: Tensor) -> tuple[str, ...]:
        decided = " (decided from the points)" if self._kind not in FITS else ""
        notes = [
            f"alignment: {fit}{decided}; {fit.points:,} points, off by {fit.error:.1%} of depth"
            f" over the best 70 %, {fit.outliers:.0%} outliers"
        ]
        beyond = fit.beyond(raw)
        if beyond > 0:
            near, far = fit.bounds
            notes.append(
                f"alignment: {beyond:.2%} of the image came out nearer than {near:.3g} m or"
                f" farther than {far:.3g} m, or at no depth at all, and reads as these bounds"
            )
        if fit.points >= _ENOUGH and fit.outliers > _MANY_OUTLIERS:
            notes.append(
                f"warning: {fit.outliers:.0%} of {fit.points:,} points are far off the aligned"
                " prediction; are they in metres, in the frame of this image, and is the network's"
                " output read as what it is? --align can state it"
            )
        if fit.scale == 0:
            notes.append(
                f"warning: at the {fit.points:,} points the network's output does not follow the"
                " depth in the direction that is stated, so it reads as one depth everywhere; check"
                " the network, the points, and whether it gives depth or disparity"
            )
        # What the misfit is for the median depth of the points everywhere.
        log_depth = self._points.depth.cpu().double().log()
        of_median = float((log_depth - log_depth.median()).abs().clamp(max=1.0).mean())
        if len(log_depth) >= _ENOUGH and fit.misfit > _NO_BETTER * of_median:
            notes.append(
                f"warning: network {self._network.definition.name!r} says nothing about this scene:"
                f" aligned, it is off by {fit.misfit:.1%} at the points, their median depth by"
                f" {of_median:.1%}; check the network, its input range (`normalise`) and the image"
            )
        return tuple(notes)

    def _plain_notes(self, at_points: Tensor) -> tuple[str, ...]:
        ratio = float((at_points / self._points.depth).median())
        if ratio > 0 and abs(math.log(ratio)) < math.log(_OFF):
            return ()
        return (
            f"warning: the prediction is {ratio:.3g} × the sparse depth at the median; align auto"
            " fits its scale (and shift) to the points",
        )


def align_output(
    definition: ModelDefinition, x: Tensor, points: SparsePoints, asked: str
) -> list[Alignment]:
    """Returns the alignment of a network's numbers with the points, of all that it can have.

    Those of other readings that explain the points as well follow.

    Args:
        definition: What is stated of the numbers.
        x: (N,) the numbers at the points.
        points: The points.
        asked: One of `choices.ALIGNMENTS`, but "none".

    Raises:
        NoPointsError: There are too few points.
        ModelError: The numbers do not vary, or are not finite.
    """
    if asked == "auto" and len(points) == 1:
        asked = "scale"  # one point shows no shift
    tried = candidates(asked, definition.output_kind, definition.output_scale)
    return alignments(x, points, tried)


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
    if network.definition.layers or network.definition.defaults.layer:
        return network
    with spent_on("layer"):
        return _with_suggested_layers(network)


def _load(spec: str | ModelDefinition, checkpoint: Path | None, device: str) -> Network:
    """The network without layers that its definition does not name."""
    torch_device = find_device(device)
    definition = find_definition(spec) if isinstance(spec, str) else spec
    name = f"network {definition.name!r}"
    # `build` may import modules beside the model file.
    beside = importing_beside(spec) if isinstance(spec, str) else nullcontext()
    with wrap_user_errors(f"build of {name}"), beside:
        # A module is called as well, but it is made already.
        module = None if isinstance(definition.build, nn.Module) else definition.build()
    if not isinstance(module, nn.Module):
        raise ModelError(
            f"build of {name} gives no torch module; a class or a function that makes one is"
            " expected, as in lambda: net"
        )
    if not isinstance(size := definition.size, Multiple):
        height, width = size.height or size.width or 1, size.width or size.height or 1
        claim = f"{name} takes images of {width}×{height} pixels"
        way_out = "allow more with --max-pixels"
        check_claim(claim, height * width, max_network_pixels(), error=ModelError, way_out=way_out)
    path = checkpoint or definition.checkpoint
    notes = [f"model: {definition.assumed}"] if definition.assumed else []
    if definition.complete and checkpoint is not None:
        raise UsageError(f"{name} comes with its weights; leave out `checkpoint`")
    if not definition.complete:
        notes += _load_weights(module, definition, path)
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


def _load_weights(module: nn.Module, definition: ModelDefinition, path: Path | None) -> list[str]:
    """Loads the weights; returns notes. Never random weights."""
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
    """The network with layers to cut at, for a definition that lists none."""
    frame = FrameMap.fit(network.definition.size, _SUGGESTION_SIDE, _SUGGESTION_SIDE)

    def suggest() -> list[str]:
        with out_of_memory_is_a_device_error(network.device):
            arguments = network.synthetic_arguments(frame)
            return [*suggest_layers(network.module, arguments, network.map_of)]

    question = f"layers, of {frame.network}"
    layers = tuple(recalled_layers(network.module, network.definition, question, suggest))
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
        reason = (str(error).splitlines() or [""])[0][:120]
        raise DeviceError(f"device {name!r} cannot be used: {reason}; try device cpu") from None
    return device
