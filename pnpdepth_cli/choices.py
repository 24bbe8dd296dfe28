"""Every list of names that a user can choose from. Imports nothing heavy.

An `OpenList` is open: one line here with the location of an object, or one file in a folder, adds
an entry, and so does an entry point of an installed package. Closed lists are tuples.
"""

from __future__ import annotations

import functools
import importlib.util
import pkgutil
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal, get_args

from pnpdepth_cli import protocols
from pnpdepth_cli.errors import PnpDepthError, UsageError, describe


class OpenList(Mapping[str, Any]):
    """The entries of an open list by name; listing the names imports none of them.

    An entry is an object in a module, which its location names as an entry point does: the module,
    or `module:object`. This package's own entries are stated, or are the files of a folder; those
    of other packages are their entry points in the group `pnpdepth.<group>`. The own ones win.

    Args:
        group: Name of what the entries are, in the plural, such as "losses".
        names: Locations of this package's entries, by their names.
        folder: A package each of whose files is an entry; `package:object` is an object in each
            file. A "-" in a name is "_" in the file. Files that start with "_", and subpackages,
            are no entries.
        in_file: With it, the path of a user's Python file is a name too, and its entry is the
            object of this name in the file.
    """

    def __init__(
        self,
        group: str,
        *,
        names: Mapping[str, str] | None = None,
        folder: str | None = None,
        in_file: str | None = None,
    ) -> None:
        self._group = group
        self._names = names or {}
        self._folder = folder
        self._in_file = in_file

    def __getitem__(self, name: str) -> Any:
        """Returns the entry of a name, which is imported, or the function in a user's Python file.

        Raises:
            UsageError: There is no such name, another package's entry cannot be imported, or the
                file cannot be run or has no such function.
        """
        if name in self._entries:
            return self._load(self._entries[name])
        if self._in_file is not None and name in self:
            return _from_file(name, self._in_file)
        raise UsageError(f"{name!r} is none of the {self._group} {', '.join(self)}")

    def __contains__(self, name: object) -> bool:
        """Whether the name is one of the list, or a Python file where users may give one."""
        is_file = self._in_file is not None and str(name).endswith(".py")
        return is_file or name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def _load(self, entry: EntryPoint) -> Any:
        """The object at an entry's location; UsageError if that of another package has none."""
        try:
            return entry.load()
        except Exception as error:  # another package's code may raise anything
            if entry.group == self._group or isinstance(error, PnpDepthError):
                raise
            raise UsageError(
                f"entry point {entry.name} = {entry.value} of {entry.group} cannot be loaded:"
                f" {describe(error)}; correct or uninstall its package"
            ) from error

    @functools.cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        """The entries of this package in their order, then those of other packages by name."""
        locations = dict(self._names)
        if self._folder is not None:
            locations |= _locations_in(self._folder)
        entries = {
            name: EntryPoint(name, location, self._group) for name, location in locations.items()
        }
        installed = {point.name: point for point in entry_points(group=f"pnpdepth.{self._group}")}
        new_names = sorted(installed.keys() - entries.keys())
        return entries | {name: installed[name] for name in new_names}


def _locations_in(folder: str) -> dict[str, str]:
    """The locations of the entries in the files of a package, by name.

    Args:
        folder: Name of the package, or `package:object`, as `OpenList` takes it.
    """
    package, colon, attribute = folder.partition(":")
    spec = importlib.util.find_spec(package)
    if spec is None:
        raise ModuleNotFoundError(f"there is no package {package}", name=package)
    return {
        module.name.replace("_", "-"): f"{package}.{module.name}{colon}{attribute}"
        for module in pkgutil.iter_modules(spec.submodule_search_locations)
        if not module.name.startswith("_") and not module.ispkg
    }


@functools.cache
def _from_file(path: str, attribute: str) -> object:
    """The function that a user's Python file defines; the file is run once.

    Args:
        path: The file.
        attribute: Name of the function in it.

    Raises:
        UsageError: The file cannot be run, or defines no such function.
    """
    namespace: dict[str, object] = {"__name__": Path(path).stem, "__file__": path}
    try:
        exec(compile(Path(path).read_bytes(), path, "exec"), namespace)
    except Exception as error:  # a user's code may raise anything
        raise UsageError(f"{path} cannot be run: {type(error).__name__}: {error}") from None
    if not callable(namespace.get(attribute)):
        raise UsageError(f"{path} defines no function {attribute!r}")
    return namespace[attribute]


LOSSES = OpenList(
    "losses",
    names={
        "l1": "pnpdepth_cli.core.losses:l1",
        "l2": "pnpdepth_cli.core.losses:l2",
        "huber": "pnpdepth_cli.core.losses:huber",
        "berhu": "pnpdepth_cli.core.losses:berhu",
        "cauchy": "pnpdepth_cli.core.losses:cauchy",
    },
    in_file="loss",
)
"""L: (N,) predicted and (N,) measured depth to a scalar."""

UPDATES = OpenList(
    "updates",
    names={
        "sign": "pnpdepth_cli.core.update_rules:sign",
        "sgd": "pnpdepth_cli.core.update_rules:sgd",
        "normalised": "pnpdepth_cli.core.update_rules:normalised",
        "momentum": "pnpdepth_cli.core.update_rules:momentum",
        "adam": "pnpdepth_cli.core.update_rules:adam",
    },
    in_file="update_rule",
)
"""U: each entry creates a rule that turns gradients into directions of z."""

SCHEDULES = OpenList(
    "schedules",
    names={
        "constant": "pnpdepth_cli.core.update_rules:constant",
        "linear": "pnpdepth_cli.core.update_rules:linear",
    },
)
"""Factor of α at each update, from the fraction of the updates already made."""

PROPAGATIONS = OpenList(
    "propagations",
    names={
        "gp": "pnpdepth_cli.completion.propagation:by_gaussian_process",
        "local": "pnpdepth_cli.completion.propagation:by_lines",
    },
)
"""How the residual at the points is propagated: `pnpdepth_cli.completion.propagation`."""

BASELINES = OpenList(
    "baselines",
    names={
        "nearest": "pnpdepth_cli.completion.baselines:by_nearest",
        "linear": "pnpdepth_cli.completion.baselines:by_linear",
        "linear-log": "pnpdepth_cli.completion.baselines:by_linear_log",
        "median": "pnpdepth_cli.completion.baselines:by_median",
        "scale": "pnpdepth_cli.completion.baselines:by_scale",
        "affine": "pnpdepth_cli.completion.baselines:by_affine",
        "scale-disparity": "pnpdepth_cli.completion.baselines:by_scale_of_disparity",
        "affine-disparity": "pnpdepth_cli.completion.baselines:by_affine_of_disparity",
        "local": "pnpdepth_cli.completion.baselines:align_locally",
    },
)
"""Dense depth without refinement: `pnpdepth_cli.completion.baselines`."""

NETWORKS = OpenList("models", folder="model_zoo_defs")
"""The networks' files in `model_zoo_defs`, and what other packages enter as `pnpdepth.models`."""

NORMALISATIONS = OpenList(
    "normalisations",
    names={
        "unit": "pnpdepth_cli.models.definition:UNIT",
        "imagenet": "pnpdepth_cli.models.definition:IMAGENET",
        "symmetric": "pnpdepth_cli.models.definition:SYMMETRIC",
        "bytes": "pnpdepth_cli.models.definition:BYTES",
    },
)
"""Ranges of the image that a network may want: `pnpdepth_cli.models.definition.Normalisation`."""

SENSORS = OpenList(
    "sensors",
    names={
        "vlp-16": "pnpdepth_cli.sensors.simulation:VLP_16",
        "vlp-32c": "pnpdepth_cli.sensors.simulation:VLP_32C",
        "hdl-32e": "pnpdepth_cli.sensors.simulation:HDL_32E",
        "hdl-64e": "pnpdepth_cli.sensors.simulation:HDL_64E",
        "paper-vlp-16": "pnpdepth_cli.sensors.simulation:PAPER_VLP_16",
        "paper-vlp-32c": "pnpdepth_cli.sensors.simulation:PAPER_VLP_32C",
        "paper-hdl-32e": "pnpdepth_cli.sensors.simulation:PAPER_HDL_32E",
        "paper-hdl-64e": "pnpdepth_cli.sensors.simulation:PAPER_HDL_64E",
    },
)
"""Scanners by data sheet, and as the paper has them: `pnpdepth_cli.sensors.simulation.Lidar`."""

FORMATS = OpenList(
    "formats",
    names={
        "png": "pnpdepth_cli.io.depth:PNG",
        "exr": "pnpdepth_cli.io.depth:EXR",
        "npy": "pnpdepth_cli.io.depth:NPY",
        "npz": "pnpdepth_cli.io.depth:NPZ",
        "pfm": "pnpdepth_cli.io.depth:PFM",
        "tiff": "pnpdepth_cli.io.depth:TIFF",
    },
)
"""Depth file formats: `pnpdepth_cli.io.formats.DepthFormat`."""

LAYOUTS = OpenList(
    "layouts",
    names={
        "manifest": "pnpdepth_cli.dataset.layouts.manifest:MANIFEST",
        "kitti-odometry": "pnpdepth_cli.dataset.layouts.kitti:ODOMETRY",
        "kitti-object": "pnpdepth_cli.dataset.layouts:KITTI_OBJECT",
        "kitti-depth": "pnpdepth_cli.dataset.layouts.kitti:DEPTH",
        "kitti-raw": "pnpdepth_cli.dataset.layouts.kitti:RAW",
        "tum": "pnpdepth_cli.dataset.layouts.indexed:TUM",
        "7scenes": "pnpdepth_cli.dataset.layouts:SEVEN_SCENES",
        "eth3d": "pnpdepth_cli.dataset.layouts:ETH3D",
        "colmap": "pnpdepth_cli.dataset.layouts.indexed:COLMAP",
        "void": "pnpdepth_cli.dataset.layouts:VOID",
        "diode": "pnpdepth_cli.dataset.layouts:DIODE",
        "ibims": "pnpdepth_cli.dataset.layouts:IBIMS",
        "scannet": "pnpdepth_cli.dataset.layouts:SCANNET",
        "arkitscenes": "pnpdepth_cli.dataset.layouts:ARKITSCENES",
        "stray-scanner": "pnpdepth_cli.dataset.layouts.indexed:STRAY_SCANNER",
        "record3d": "pnpdepth_cli.dataset.layouts.indexed:RECORD3D",
        "pairs": "pnpdepth_cli.dataset.layouts:PAIRS",
        "image-depth": "pnpdepth_cli.dataset.layouts:IMAGE_DEPTH",
    },
)
"""Data set layouts, in the order in which they are guessed (`dataset.layouts.Layout`)."""

EXPORTS = OpenList("exports", folder="pnpdepth_cli.commands.exports:EXPORT")
"""Files for reconstruction programs: `pnpdepth_cli.commands.exports.Export`."""

MEASURES = OpenList(
    "measures",
    names={
        "boundary_f1": "pnpdepth_cli.measures:BOUNDARY_F1",
        "boundary_f1_1px": "pnpdepth_cli.measures:BOUNDARY_F1_1PX",
        "boundary_f1_2px": "pnpdepth_cli.measures:BOUNDARY_F1_2PX",
        "boundary_f1_3px": "pnpdepth_cli.measures:BOUNDARY_F1_3PX",
    },
)
"""Measures that `eval` computes only on request: `pnpdepth_cli.measures.Measure`."""

# The method
UNKNOWN = ("keep", "zero")  # depth that no points support, in the depth file
POSE_KINDS = ("camera-to-world", "world-to-camera", "opengl")  # what rows of poses are
METHODS = ("fused", "alone", "paper")  # without and with the included network; the paper's

FITS = ("none", "median", "scale", "affine")
"""Parameters of the fit of a network's output to the points."""

READINGS = ("depth", "disparity", "log", "inverted-disparity", "power")
"""What a network's output can be read as: `pnpdepth_cli.completion.alignment`."""

ALIGNMENTS = (*FITS, "auto", *READINGS)
"""What can be stated of the alignment; the points decide what is not."""

# Networks
Space = Literal["depth", "inverse", "log"]
SPACES: tuple[Space, ...] = get_args(Space)
"""The quantities in which depth is predicted, fitted or interpolated."""

OutputKind = Literal[Space, "unknown"]
"""What the numbers of a network's output are."""

OutputScale = Literal["metric", "scale", "affine", "unknown"]
"""Up to what a network's output is known: metres, a factor, or a factor and a shift."""

InputKind = Literal["rgb", "sparse", "rgb+sparse", "map"]
"""What a network takes as input; "map" is a depth map of the frame, which it returns."""

Fit = Literal["stretch", "crop"]
"""How an image is brought to a network's fixed input size."""

# Files and sensors
REGISTRATIONS = ("auto", "off")  # whether the image is moved to the points

LENSES = ("radial-tangential", "fisheye")
"""Lens distortions: `pnpdepth_cli.sensors.lens`."""

# Evaluation
PROTOCOLS = tuple(protocols.PROTOCOLS)
"""How frames are cut, given points and scored: `pnpdepth_cli.protocols`."""

SCALINGS = ("none", "median", "affine", "affine-disparity")  # of each image to its truth
