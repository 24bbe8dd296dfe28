"""The contract between the program and a network: one frozen dataclass says all there is to know.

A user's own network is a Python file with such an object in it, named `definition`:

    from pnpdepth_cli.models.definition import Metric, ModelDefinition, Multiple

    definition = ModelDefinition(
        name="my-net", input_kind="rgb", size=Multiple(32), build=MyNet, layers=("decoder.up1",)
    )

Nothing here imports torch, so that listing networks stays cheap. A field with a value that makes no
sense raises ModelError as soon as the object is made.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnpdepth_cli import choices
from pnpdepth_cli.choices import Align, Fit, OutputKind, OutputScale, Schedule
from pnpdepth_cli.choices import InputKind as InputKind  # for definition files
from pnpdepth_cli.models import validity

if TYPE_CHECKING:
    from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Fixed:
    """The network takes pictures of one size only.

    `stretch` resizes the whole picture to it, `crop` cuts the largest centred part of its aspect
    ratio first; pixels outside the crop then have no depth.
    """

    height: int
    width: int
    fit: Fit = "stretch"

    def __post_init__(self) -> None:
        validity.whole(self, "height", least=1)
        validity.whole(self, "width", least=1)
        validity.one_of(self, "fit", choices.FITS)


@dataclass(frozen=True)
class Multiple:
    """The network takes any picture whose sides are multiples of `of`.

    The picture is padded at the right and the bottom (edge pixels repeated); a longest side above
    `longest` is shrunk first.
    """

    of: int
    longest: int | None = None

    def __post_init__(self) -> None:
        validity.whole(self, "of", least=1)
        if self.longest is not None:
            validity.whole(self, "longest", least=1)


@dataclass(frozen=True, kw_only=True)
class Near:
    """The picture is resized to sides that are multiples of `of`, about in its own proportions.

    Towards height × width, whichever of the two asks for less change; with neither, its own size.
    """

    of: int
    height: int | None = None
    width: int | None = None

    def __post_init__(self) -> None:
        validity.whole(self, "of", least=1)
        for side in ("height", "width"):
            if getattr(self, side) is not None:
                validity.whole(self, side, least=1)


@dataclass(frozen=True, kw_only=True)
class Normalisation:
    """(rgb in 0..1 − mean) / std, per channel; the default hands 0..1 to the network."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        validity.per_channel(self, "mean")
        validity.per_channel(self, "std", positive=True)


@dataclass(frozen=True, kw_only=True)
class RefineDefaults:
    """How the network is refined when nobody says otherwise.

    `lr` is a number (absolute, as in the paper) or a text like "3%" (of the standard deviation of
    z_0). `schedule` and `blur` are those of `pnpdepth_cli.core.refine.RefineSettings`. `layer`
    None is the definition's first layer. `align` None is "none" for a metric network and "auto" for
    any other. The values here are the paper's.
    """

    layer: str | None = None
    iterations: int = 5
    lr: float | str = 0.01
    loss: str = "l1"
    update: str = "sign"
    schedule: Schedule = "constant"
    blur: float = 0.0
    align: Align | None = None
    spread: float | None = None
    """Deprecated name of `blur`."""

    def __post_init__(self) -> None:
        if self.spread is not None:
            warnings.warn("RefineDefaults.spread is now blur", DeprecationWarning, stacklevel=3)
            object.__setattr__(self, "blur", self.spread)
            object.__setattr__(self, "spread", None)
        if self.layer is not None:
            validity.instance(self, "layer", str, "the name of a layer")
        validity.whole(self, "iterations", least=0)
        validity.step(self, "lr")
        validity.one_of(self, "loss", choices.LOSSES)
        validity.one_of(self, "update", choices.UPDATES)
        validity.one_of(self, "schedule", choices.SCHEDULES)
        validity.at_least_zero(self, "blur")
        if self.align is not None:
            validity.one_of(self, "align", choices.ALIGNMENTS)


FOREIGN = RefineDefaults(
    iterations=20, lr="25%", loss="cauchy", update="normalised", schedule="linear", blur=1.0
)
"""For networks that nobody here has tuned: steps that follow the feature map's own scale.

Chosen with FastDepth on rendered rooms; Adam with steps of 3 % left a quarter more of the error.
"""


def _inputs_as_named(
    input_kind: InputKind, rgb: Tensor | None, sparse: Tensor | None
) -> tuple[Tensor, ...]:
    wanted = {"rgb": (rgb,), "sparse": (sparse,), "rgb+sparse": (rgb, sparse)}[input_kind]
    present = tuple(tensor for tensor in wanted if tensor is not None)
    if len(present) != len(wanted):
        raise ValueError(f"a network with input kind {input_kind!r} needs all of its inputs")
    return present


@dataclass(frozen=True, kw_only=True)
class ModelDefinition:
    """Everything the program needs to know of a network.

    name, summary, paper, licence: what `pnpdepth models` shows.
    input_kind: what the network looks at.
    size: which picture sizes it takes.
    normalisation: of the rgb input.
    output_kind: what its numbers are; depth is out, 1/out or exp(out).
    output_scale: whether that is in metres, or up to a scale, or a scale and a shift, which are
        then fitted to the sparse points.
    layers: the layers worth cutting at, from shallow to deep (`pnpdepth layers` lists them).
    defaults: the settings of refinement.
    build: makes the network (weights not loaded); called without arguments.
    checkpoint: the weights that come with the definition, or None where the user brings them.
    static_graph: the network runs the same submodules in the same order for all images of one size,
        even where values of tensors reach Python code. Then the cut is learned only once.
    same_path: deprecated name of static_graph.
    complete: `build` gives the network with its weights, `checkpoint` is only where they lie.
    read_checkpoint: renames or reshapes the tensors of a published checkpoint into the state
        dict of the network.
    arguments: how to call the network; given rgb (1, 3, H, W) normalised and sparse depth
        (1, 1, H, W) in metres with 0 = unknown (None where the network does not take it),
        returns the positional arguments. Default: in the order of `input_kind`.
    output: picks the prediction, (1, 1, h, w) or (1, h, w), out of what the network returns;
        default: the tensor itself, the only tensor of a structure.
    verify: called with the network and its arguments for the first frame; returns what to say, if
        anything, or raises ModelError where the network cannot be trusted.
    normalisation None: which one is decided from the first frame's points.
    assumed: what this definition takes for granted because nobody said; it is printed.
    """

    name: str
    input_kind: InputKind
    size: Fixed | Multiple | Near
    build: Callable[[], nn.Module]
    summary: str = ""
    paper: str = ""
    licence: str = ""
    normalisation: Normalisation | None = Normalisation()
    output_kind: OutputKind = "depth"
    output_scale: OutputScale = "metric"
    layers: tuple[str, ...] = ()
    defaults: RefineDefaults = RefineDefaults()
    checkpoint: Path | None = None
    complete: bool = False
    static_graph: bool = False
    same_path: bool = False
    read_checkpoint: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]] | None = None
    arguments: Callable[[Tensor | None, Tensor | None], tuple[Tensor, ...]] | None = None
    output: Callable[[Any], Tensor] | None = None
    verify: Callable[[nn.Module, tuple[Tensor, ...]], str | None] | None = None
    assumed: str = ""

    def __post_init__(self) -> None:
        if self.same_path:
            warnings.warn(
                "ModelDefinition.same_path is now static_graph", DeprecationWarning, stacklevel=3
            )
            object.__setattr__(self, "static_graph", True)
            object.__setattr__(self, "same_path", False)
        validity.instance(self, "name", str, "a text")
        validity.one_of(self, "input_kind", choices.INPUT_KINDS)
        size = "Fixed(height, width), Multiple(of) or Near(of=…)"
        validity.instance(self, "size", (Fixed, Multiple, Near), size)
        validity.function(self, "build")
        if self.normalisation is not None:
            validity.instance(self, "normalisation", Normalisation, "Normalisation(mean=…, std=…)")
        validity.one_of(self, "output_kind", choices.OUTPUT_KINDS)
        validity.one_of(self, "output_scale", choices.OUTPUT_SCALES)
        validity.names(self, "layers")
        validity.instance(self, "defaults", RefineDefaults, "RefineDefaults(…)")
        if self.checkpoint is not None:
            validity.instance(self, "checkpoint", Path, "a pathlib.Path")
        for hook in ("read_checkpoint", "arguments", "output", "verify"):
            if getattr(self, hook) is not None:
                validity.function(self, hook)

    @property
    def default_layer(self) -> str | None:
        """The layer to cut at when nobody says otherwise."""
        return self.defaults.layer or (self.layers[0] if self.layers else None)

    @property
    def default_alignment(self) -> str:
        """How the output is aligned with the points when nobody says otherwise."""
        metric = self.output_scale == "metric" and self.output_kind != "unknown"
        return self.defaults.align or ("none" if metric else "auto")

    def call_arguments(self, rgb: Tensor | None, sparse: Tensor | None) -> tuple[Tensor, ...]:
        """The positional arguments of the network for one frame."""
        if self.arguments is not None:
            return self.arguments(rgb, sparse)
        return _inputs_as_named(self.input_kind, rgb, sparse)
