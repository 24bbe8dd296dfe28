"""What the program knows of a network: one frozen dataclass, `ModelDefinition`.

Your own network is a Python file with such an object in it, named `definition`: see "A definition"
in docs/guides/your-network.md.

Every field has a line of description below it. `pnpdepth models check my_net.py` tries the
definition. The same file in `model_zoo_defs`, or its object as an entry point `pnpdepth.models` of
an installed package, makes the network one that can be named.

Nothing here imports torch, so that listing networks stays cheap. A field with a value that makes no
sense raises ModelError as soon as the object is made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from pnpdepth_cli.choices import Fit, OutputKind, OutputScale
from pnpdepth_cli.choices import InputKind as InputKind  # for definition files
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.file_record import file_and_part as file_and_part
from pnpdepth_cli.settings import Settings as Settings  # for definition files

if TYPE_CHECKING:
    from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

_MAX_SHOWN = 60  # characters of a wrong value that are shown
_MAX_SHAPES = 80  # characters of the shapes of a file's inputs that are shown


def _check(owner: object, field: str, is_valid: bool, wanted: str) -> None:
    """Raises ModelError unless a field's value is valid, or the default of the field.

    Args:
        owner: Dataclass object with the field.
        field: Name of the field.
        is_valid: Whether its value makes sense.
        wanted: What makes sense, for the message "FIELD=VALUE is not …".
    """
    value = getattr(owner, field)
    # A field's default is the class attribute of its name.
    is_default = hasattr(type(owner), field) and value is getattr(type(owner), field)
    if is_valid or is_default:
        return
    name = getattr(owner, "name", "")
    shown = " ".join(repr(value).split())
    title = type(owner).__name__
    if name:
        title += f" {name!r}"
    raise ModelError(f"{title[:_MAX_SHOWN]}: {field}={shown[:_MAX_SHOWN]} is not {wanted}")


def _check_choice(owner: object, field: str, literal: object) -> None:
    """Raises ModelError unless a field's value is one of a typing.Literal, or the default."""
    choices = get_args(literal)
    is_choice = getattr(owner, field) in choices
    _check(owner, field, is_choice, f"one of {', '.join(map(repr, choices))}")


def _check_positive(owner: object, *fields: str) -> None:
    """Raises ModelError unless each field's value is a whole number above 0, or the default."""
    for field in fields:
        value = getattr(owner, field)
        is_whole = isinstance(value, Integral) and not isinstance(value, bool)
        is_positive = is_whole and int(value) > 0
        _check(owner, field, is_positive, "a whole number of at least 1")


@dataclass(frozen=True)
class Fixed:
    """The network takes images of one size only."""

    height: int
    width: int
    fit: Fit = "stretch"
    """How an image of another size is brought to it.

    "stretch" resizes the whole image. "crop" first cuts out the largest centred part of the same
    aspect ratio; pixels outside it have no depth.
    """

    def __post_init__(self) -> None:
        _check_positive(self, "height", "width")
        _check_choice(self, "fit", Fit)


@dataclass(frozen=True)
class Multiple:
    """The network takes any image whose sides are multiples of a number."""

    of: int
    """Other images are padded at the right and the bottom by repeating edge pixels."""
    longest: int | None = None
    """Images with a longer side, in pixels, are shrunk to it first; None shrinks none."""

    def __post_init__(self) -> None:
        _check_positive(self, "of", "longest")


@dataclass(frozen=True, kw_only=True)
class Near:
    """The image is resized to sides that are multiples of a number, nearly in its aspect ratio."""

    of: int
    height: int | None = None
    """Rows to approach, or None. Of height and width, the one that needs less resizing is taken."""
    width: int | None = None
    """Columns to approach, or None. With neither, the image keeps about its own size."""

    def __post_init__(self) -> None:
        _check_positive(self, "of", "height", "width")


@dataclass(frozen=True, kw_only=True)
class Normalisation:
    """The network's input is (rgb − mean) / std with rgb in 0…1; by default rgb itself."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Above 0; 1/255 of each channel makes the input 0…255."""

    def __post_init__(self) -> None:
        for field, least in (("mean", -math.inf), ("std", 0.0)):
            value = getattr(self, field)
            numbers = list(value) if isinstance(value, Iterable) else []
            are_three = len(numbers) == 3 and all(isinstance(number, Real) for number in numbers)
            are_valid = are_three and all(least < number < math.inf for number in numbers)
            wanted = "a finite number each for red, green and blue, std above 0"
            _check(self, field, are_valid, wanted)


UNIT = Normalisation()
"""rgb as 0…1."""
IMAGENET = Normalisation(mean=IMAGENET_MEAN, std=IMAGENET_STD)
"""rgb less ImageNet's mean, over its standard deviation."""
SYMMETRIC = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
"""rgb as −1…1."""
BYTES = Normalisation(std=(1 / 255, 1 / 255, 1 / 255))
"""rgb as 0…255."""

UNTUNED_DEFAULTS = Settings(
    iterations=20, lr="25%", loss="cauchy", update="normalised", schedule="linear", blur=1.0
)
"""For networks that nobody here has tuned: steps that follow the feature map's own scale.

Chosen with FastDepth on rendered rooms; Adam with steps of 3 % left a quarter more of the error.
"""

ASSUMED_MULTIPLE = 32
"""Multiple of the sides of images, for a network that does not say what sizes it takes."""

DENSE_SPACING = 10.0
"""Mean spacing of the points in pixels below which they are dense, as those of a LiDAR are."""


@dataclass(frozen=True, kw_only=True)
class ModelDefinition:
    """Everything the program needs to know of a network."""

    name: str
    """What the network is called in messages and records."""
    input_kind: InputKind
    """What its forward takes: "rgb", "sparse" (depth with 0 = unknown), or both, "rgb+sparse".

    "map" is for depth maps on disk (`models.stored_map`)."""
    map_number: int = 0
    """Number of the frame's depth map, from 0, where `input_kind` is "map"."""
    size: Fixed | Multiple | Near
    """Which image sizes it takes."""
    build: Callable[[], nn.Module]
    """Returns the network, its weights not loaded; a class or function without arguments."""
    summary: str = ""
    """One line for `pnpdepth models`."""
    paper: str = ""
    """Authors, title, venue and year."""
    licence: str = ""
    """Licence of the weights."""
    normalisation: Normalisation | None = Normalisation()
    """How the rgb image is normalised; None chooses by the first frame's points."""
    output_kind: OutputKind = "depth"
    """What its numbers are: "depth", "inverse" depth, "log" depth, or "unknown" (the points
    decide)."""
    output_scale: OutputScale = "metric"
    """Up to what they are right: "metric" (nothing), a "scale", "affine" (a scale and a shift), or
    "unknown". What is missing is fitted to the points."""
    layers: tuple[str, ...] = ()
    """Names of the submodules worth cutting at, from the image to the depth.

    `pnpdepth layers` lists all. Without any, the shapes of the feature maps suggest them."""
    defaults: Settings = Settings()
    """Settings of refinement where no option sets them."""
    checkpoint: Path | None = None
    """The weights that come with the definition; None if the user names them."""
    complete: bool = False
    """True if `build` returns the network with its weights; `checkpoint` then only says where they
    are."""
    image_encoder: str | None = None
    """Name of a submodule whose output depends on the image alone. It runs once for several sets of
    points of one image."""
    coarse: Callable[[Any], AbstractContextManager[list[Any]]] | None = None
    """Function of the network that returns a context.

    Inside it, forward returns a smaller depth of the same field of view, sooner. The first forward,
    and each without gradients, also adds its full depth to the list. The default method takes the
    gradient of its updates of z there."""
    takes_prior: bool = False
    """True if forward takes one more argument, which may be left out: a dense prior (1, 1, H, W) in
    metres with 0 = unknown, such as another network's depth aligned with the points."""
    takes_intrinsics: bool = False
    """True if forward takes one more argument, the camera matrix (1, 3, 3) in pixels of its image,
    whole numbers at pixel centres."""
    weighs_points: bool = False
    """True if the network itself finds outliers among its points, so none is removed before."""
    static_graph: bool = False
    """True if the network runs the same submodules in the same order for all images of one size,
    even where values of tensors reach Python code. Then the cut is learned only once."""
    read_checkpoint: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]] | None = None
    """Renames or reshapes the tensors of a published checkpoint into the network's state dict."""
    arguments: Callable[..., tuple[Tensor, ...]] | None = None
    """Returns the positional arguments of forward.

    It gets rgb (1, 3, H, W), normalised, sparse depth (1, 1, H, W) in metres with 0 = unknown, each
    None if `input_kind` lacks it, and the intrinsics if the network takes them. By default they are
    passed in this order."""
    output: Callable[[Any], Tensor] | None = None
    """Returns the prediction, (1, 1, h, w) or (1, h, w), from what forward returns. By default that
    is the tensor itself, or the only tensor in it."""
    verify: Callable[[nn.Module, tuple[Tensor, ...]], str | None] | None = None
    """Called with the network and its arguments for the first frame; returns a note or None, or
    raises ModelError if the network cannot be verified."""
    assumed: str = ""
    """What was assumed where no definition was given; it is printed."""

    def __post_init__(self) -> None:
        # Fields with a list of choices, then the types of others, and those that are called.
        _check_choice(self, "input_kind", InputKind)
        _check_choice(self, "output_kind", OutputKind)
        _check_choice(self, "output_scale", OutputScale)
        for field, kinds, wanted in (
            ("name", str, "a text"),
            ("size", Fixed | Multiple | Near, "Fixed(height, width), Multiple(of) or Near(of=…)"),
            ("defaults", Settings, "Settings(…)"),
            ("normalisation", Normalisation | None, "Normalisation(mean=…, std=…)"),
            ("image_encoder", str, "the name of a submodule"),
            ("checkpoint", Path, "a pathlib.Path"),
        ):
            _check(self, field, isinstance(getattr(self, field), kinds), wanted)
        are_names = isinstance(self.layers, tuple | list) and all(
            isinstance(name, str) for name in self.layers
        )
        _check(self, "layers", are_names, "a tuple of texts, as in ('encoder', 'decoder.up1')")
        for hook in ("build", "read_checkpoint", "arguments", "output", "verify", "coarse"):
            _check(self, hook, callable(getattr(self, hook)), "a function or a class")

    @property
    def default_layer(self) -> str | None:
        """The layer to cut at where no option names one; None if the definition has none."""
        if self.defaults.layer:
            return self.defaults.layer
        return self.layers[0] if self.layers else None

    @property
    def default_alignment(self) -> str:
        """How the output is aligned if no option says it, one of `choices.ALIGNMENTS`."""
        if self.defaults.align:
            return self.defaults.align
        # Numbers that are said to be metres, as such or as their inverse or log, need no fit.
        is_metric = self.output_scale == "metric" and self.output_kind != "unknown"
        return "none" if is_metric else "auto"

    def call_arguments(
        self, rgb: Tensor | None, sparse: Tensor | None, intrinsics: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Returns the positional arguments of the network's forward for one frame.

        Args:
            rgb: Image (1, 3, H, W), normalised; None if the network takes none.
            sparse: Sparse depth (1, 1, H, W) in metres with 0 = unknown; None if it takes none.
            intrinsics: Camera matrix (1, 3, 3) in pixels of the image; None if it takes none.
        """
        # By the definition's own function; without one, in the order of `input_kind`.
        if self.arguments is not None and self.takes_intrinsics:
            return self.arguments(rgb, sparse, intrinsics)
        if self.arguments is not None:
            return self.arguments(rgb, sparse)
        by_name = {"rgb": rgb, "sparse": sparse}
        inputs = [by_name[name] for name in self.input_kind.split("+")]
        inputs.append(intrinsics)
        return tuple(tensor for tensor in inputs if tensor is not None)


def assume_definition(**fields: object) -> ModelDefinition:
    """Returns a definition for a network that brings no description of its numbers.

    It takes an rgb image, whose sides are padded to multiples of `ASSUMED_MULTIPLE`. The points
    decide its normalisation and what its output means.

    Args:
        **fields: Fields of `ModelDefinition` that are known. They replace what is assumed, and
            `name` and `build` must be among them.
    """
    assumed: dict[str, Any] = {
        "input_kind": "rgb",
        "size": Multiple(ASSUMED_MULTIPLE),
        "normalisation": None,
        "output_kind": "unknown",
        "output_scale": "unknown",
        "defaults": UNTUNED_DEFAULTS,
    }
    return ModelDefinition(**assumed | fields)


def graph_definition(
    shapes: Sequence[Sequence[object]], file: Path, stated: Mapping[str, object], **read: object
) -> ModelDefinition:
    """Returns the definition of a graph that was exported with its weights.

    Args:
        shapes: Shapes of its inputs, in their order; a side of any length is no whole number.
        file: File of the graph.
        stated: Fields of `ModelDefinition` that a definition file states of the network; they
            replace what the file says.
        **read: Fields that were read in the file; `build` must be among them.

    Raises:
        ModelError: The inputs are not those that are stated, or, where none are, not one rgb image.
    """
    # As many inputs as are stated, one rgb image where nothing is.
    kind = str(stated.get("input_kind", "rgb"))
    wanted = kind.split("+")
    if stated.get("takes_intrinsics"):
        wanted.append("intrinsics")
    # The size is that of the image, or of the sparse depth where there is none.
    size = _image_size(shapes, channels=3 if "rgb" in kind else 1)
    if size is None or len(shapes) != len(wanted):
        listed = ", ".join("×".join(map(str, shape)) for shape in shapes)
        raise ModelError(
            f"{file} has {len(shapes)} input(s), {listed[:_MAX_SHAPES]}, where"
            f" {' and '.join(wanted)} is expected, the image as 1×3×H×W or 1×H×W×3;"
            " `input_kind` of a definition says others"
        )
    height, width = size

    def arguments(*inputs: Tensor | None) -> tuple[Tensor, ...]:
        """Returns the inputs that the network takes, with the axes that its graph has."""
        tensors = [tensor for tensor in inputs if tensor is not None]
        return tuple(
            _with_axes_of(shape, tensor) for shape, tensor in zip(shapes, tensors, strict=True)
        )

    # What the graph says is known; the rest is assumed.
    fields: dict[str, object] = {**read}
    if "rgb" not in kind:
        fields["normalisation"] = Normalisation()
    if isinstance(height, int) and isinstance(width, int):
        fields["size"] = Fixed(height, width)
    fields |= {"name": file.stem, "complete": True, "checkpoint": file, "arguments": arguments}
    return assume_definition(**fields | dict(stated))


def _image_size(shapes: Sequence[Sequence[object]], channels: int) -> tuple[object, object] | None:
    """Returns (height, width) of the first shape 1×channels×H×W or 1×H×W×channels.

    A side of any length is no whole number, neither in the shapes nor in the result. None if there
    is no such shape.
    """
    for shape in shapes:
        if len(shape) != 4:
            continue
        batch, second, third, last = shape
        if isinstance(batch, int) and batch != 1:
            continue
        if second == channels:
            return third, last
        if last == channels:
            return second, third
    return None


def _with_axes_of(shape: Sequence[object], tensor: Tensor) -> Tensor:
    """Returns a tensor (1, c, H, W) or (1, 3, 3) without its batch axis if the shape has none.

    With its channels last if the shape has them there.
    """
    if tensor.ndim > len(shape):
        return tensor[0]
    is_channels_last = len(shape) == 4 and shape[3] in (1, 3) and shape[1] not in (1, 3)
    return tensor.permute(0, 2, 3, 1).contiguous() if is_channels_last else tensor
