"""Every list of names that a user can choose from. Imports nothing heavy.

Open lists are `Table`s: one function, or one file in a folder, adds one entry, and an entry point
of an installed package adds another. Closed lists are tuples.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal, get_args

from pnpdepth_cli.errors import UsageError


class Table(Mapping[str, Any]):
    """The entries of an open list by name; listing the names imports none of them.

    An entry of this package is the object `attribute` of the module `path/<name>.py` ("-" in a name
    is "_" in the file); subpackages and modules whose name starts with "_" are no entries. With
    `names` it is `TABLE[name]` of the module `path.py`. An entry of another package is its entry
    point `<name>` in the group `pnpdepth.<group>`. The package's own entries win over entry points
    of the same name.

    Args:
        path: Path of the folder or the module relative to `package`, such as "io/formats".
        attribute: Name of the object in each module; None makes the entry the module itself.
        group: Last part of the entry point group.
        noun: What one entry is called in messages.
        names: All names in the module's table, in the order of their listing.
        first: Names listed before the others, which follow in alphabetical order.
        package: The package that `path` belongs to.
    """

    def __init__(
        self,
        path: str,
        attribute: str | None = None,
        *,
        group: str,
        noun: str,
        names: tuple[str, ...] = (),
        first: tuple[str, ...] = (),
        package: str = "pnpdepth_cli",
    ) -> None:
        self.group, self.noun = group, noun
        self._path, self._attribute, self._package = path, attribute, package
        self._names, self._first = names, names or first

    def __getitem__(self, name: str) -> Any:
        """Returns the entry. Raises UsageError, with near matches, for an unknown name."""
        if name in self._modules:
            module = importlib.import_module(self._modules[name])
            if self._names:
                return module.TABLE[name]
            return module if self._attribute is None else getattr(module, self._attribute)
        if name in self._entry_points:
            return self._entry_points[name].load()
        near = difflib.get_close_matches(name, list(self), n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(self)}"
        raise UsageError(f"unknown {self.noun} {name!r}; {hint}")

    def __contains__(self, name: object) -> bool:
        return name in self._modules or name in self._entry_points

    def __iter__(self) -> Iterator[str]:
        names = {**self._modules, **self._entry_points}
        order = {name: index for index, name in enumerate(self._first)}
        return iter(sorted(names, key=lambda name: (order.get(name, len(order)), name)))

    def __len__(self) -> int:
        return len({**self._modules, **self._entry_points})

    @functools.cached_property
    def _modules(self) -> dict[str, str]:
        package = ".".join((self._package, *filter(None, self._path.split("/"))))
        if self._names:
            return dict.fromkeys(self._names, package)
        roots = importlib.import_module(self._package).__path__
        modules = pkgutil.iter_modules([str(Path(root, self._path)) for root in roots])
        return {
            module.name.replace("_", "-"): f"{package}.{module.name}"
            for module in modules
            if not module.name.startswith("_") and not module.ispkg
        }

    @functools.cached_property
    def _entry_points(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=f"pnpdepth.{self.group}")}


LOSSES = Table(
    "core/losses",
    group="losses",
    noun="loss",
    names=("l1", "l2", "huber", "berhu", "inverse", "log", "cauchy"),
)
"""L: (N,) predicted and (N,) measured depth to a scalar."""

UPDATES = Table(
    "core/update_rules",
    group="updates",
    noun="update rule",
    names=("sign", "sgd", "normalised", "momentum", "adam", "adam-short", "lbfgs"),
)
"""U: each entry creates a rule that turns gradients into directions of z."""

Schedule = Literal["constant", "linear", "cosine"]
SCHEDULES: tuple[Schedule, ...] = get_args(Schedule)
"""How the step size changes over the updates of z."""

Parameters = Literal["elements", "channels"]
PARAMETERS: tuple[Parameters, ...] = get_args(Parameters)
"""What is updated of z: every element, or a scale and a shift of each channel."""

Target = Literal["given", "masked"]
TARGETS: tuple[Target, ...] = get_args(Target)
"""Which points the loss is taken at: those the network was given, or points hidden from it."""

Mask = Literal["points", "blocks", "lines"]
MASKS: tuple[Mask, ...] = get_args(Mask)
"""What is hidden as a whole: single points, blocks of the frame, or scan lines."""

Precision = Literal["fp32", "bf16", "fp16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
"""The number format of the network's convolutions and matrix products."""

Align = Literal["none", "median", "scale", "affine", "auto"]
ALIGNMENTS: tuple[Align, ...] = get_args(Align)
"""How the network's output is fitted to the sparse points."""

PRESETS = ("paper",)
"""Methods by one name: `pnpdepth_cli.settings.PAPER`."""

Space = Literal["depth", "inverse", "log"]
SPACES: tuple[Space, ...] = get_args(Space)
"""The quantities in which depth is predicted, fitted or interpolated."""

OutputKind = Literal[Space, "unknown"]
OUTPUT_KINDS: tuple[OutputKind, ...] = get_args(OutputKind)
"""What the numbers of a network's output are."""

OutputScale = Literal["metric", "scale", "affine", "unknown"]
OUTPUT_SCALES: tuple[OutputScale, ...] = get_args(OutputScale)
"""Up to what a network's output is known: metres, a factor, or a factor and a shift."""

InputKind = Literal["rgb", "sparse", "rgb+sparse"]
INPUT_KINDS: tuple[InputKind, ...] = get_args(InputKind)
"""What a network takes as input."""

Fit = Literal["stretch", "crop"]
FITS: tuple[Fit, ...] = get_args(Fit)
"""How an image is brought to a network's fixed input size."""

NORMALISATIONS = ("unit", "imagenet", "symmetric", "bytes")
"""The rgb ranges a network may expect: 0…1, ImageNet's mean and deviation, −1…1, 0…255."""

NETWORKS = Table(
    "",
    None,
    group="models",
    noun="network",
    first=(
        *("compact", "eigen", "fcrn", "sfmlearner", "sparseconv", "adnn", "sparse2dense"),
        *("latefusion", "nconv", "pncnn"),
    ),
    package="model_zoo_defs",
)
"""The networks' files in `model_zoo_defs`, and what other packages enter as `pnpdepth.models`."""

FORMATS = Table(
    "io/formats",
    "FORMAT",
    group="formats",
    noun="depth format",
    first=("png", "exr", "npy", "npz", "pfm", "tiff"),
)
"""Depth file formats: `pnpdepth_cli.io.formats.DepthFormat`."""

EXPORTS = Table(
    "commands/exports",
    "EXPORT",
    group="exports",
    noun="export",
    first=("colmap", "nerfstudio", "gaussian-splatting"),
)
"""Files for reconstruction programs: `pnpdepth_cli.commands.exports.Export`."""

PROPAGATIONS = Table(
    "completion/propagations",
    group="propagations",
    noun="propagation",
    names=("gp", "diffusion"),
)
"""How the residual at the points is propagated: `pnpdepth_cli.completion.propagations`."""

BASELINES = Table(
    "completion/baselines",
    group="baselines",
    noun="baseline",
    names=(
        *("nearest", "linear", "linear-log", "idw", "morphological", "median", "scale", "affine"),
        *("scale-disparity", "affine-disparity", "local"),
    ),
)
"""Dense depth without refinement: `pnpdepth_cli.completion.baselines`."""

LAYOUTS = Table(
    "io/layouts",
    group="layouts",
    noun="layout",
    names=(
        *("manifest", "nyu-mat", "kitti-odometry", "kitti-object", "kitti-depth", "kitti-raw"),
        *("tum", "7scenes", "synthia", "colmap", "void", "diode", "ibims", "scannet"),
        *("arkitscenes", "hypersim", "nuscenes", "ddad", "pairs", "image-depth", "nyu-h5"),
    ),
)
"""Data set layouts, in the order in which they are guessed: `pnpdepth_cli.io.layouts.Layout`."""

STORES = {
    "s3": "s3fs",
    "gs": "gcsfs",
    "hf": "huggingface_hub",
    "https": "aiohttp",
    "http": "aiohttp",
    "file": "nothing",
}
"""Stores of files by the scheme of their addresses, with the package that fsspec needs."""

COLORS = ("blue-orange", "paper")
"""Colours of what became better and worse: blue and orange, or the paper's red and green."""

PREVIEWS = ("all", "worst", "none")
"""Which frames get images of their result; worst: those worse than linear interpolation."""

FRAME_PROTOCOLS = ("whole", "nyu", "kitti-odometry", "kitti-depth")
"""What of a frame the paper's experiments use: `pnpdepth_cli.io.dataset.PROTOCOLS`."""

PATTERNS = ("uniform", "bernoulli", "grid", "lines", "features", "edges", "region")
"""Which pixels of dense depth become sparse points: `pnpdepth_cli.sensors.samplers`."""

SENSORS = ("vlp-16", "vlp-32c", "hdl-32e", "hdl-64e")
"""LiDARs by data sheet; `pnpdepth_cli.sensors.LIDARS` has the paper's of each as "paper-<name>"."""

LENSES = (
    *("radial-tangential", "fisheye", "fov", "thin-prism-fisheye", "rad-tan-thin-prism-fisheye"),
    *("division", "eucm"),
)
"""Lens distortions: `pnpdepth_cli.sensors.lens`."""

EVAL_PROTOCOLS = ("paper", "nyu-eigen", "kitti", "kitti-devkit", "eigen", "garg")
"""Published protocols of scoring depth: `pnpdepth_cli.commands.evaluation.protocols.PROTOCOLS`."""

PLOT_FORMATS = ("png", "svg", "pdf")
"""Files that `sweep` plots to."""

MEASURE_GROUPS = Table(
    "commands/evaluation/measures",
    group="measures",
    noun="group of measures",
    names=("area", "cloud", "distance", "edges", "flicker", "normals"),
)
"""Measures that `eval` computes only on request."""

AVERAGES = ("per-image", "pooled")
"""How errors are averaged: every image or every pixel has equal weight."""

RESIZES = ("nearest", "bilinear")
"""How a prediction of another size is resized to the ground truth."""

MISSING = ("skip", "min", "max", "fail")
"""Empty predictions are not scored, scored as the lower or the upper bound, or refused."""

SCALINGS = ("none", "median", "affine", "affine-disparity", "log")
"""How the prediction of an image is scaled to its ground truth: `commands.evaluation.scaling`."""

PREDICTION_KINDS = ("depth", "disparity")
"""What the files of a prediction hold."""
