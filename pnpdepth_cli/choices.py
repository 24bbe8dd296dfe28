"""Every list of names that a user can choose from. Imports nothing heavy.

An `OpenList` is open: one function, or one file in a folder, adds one entry, and an entry point
of an installed package adds another. Closed lists are tuples.
"""

from __future__ import annotations

import functools
import importlib.util
import pkgutil
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal, get_args

from pnpdepth_cli import measures, protocols
from pnpdepth_cli.errors import UsageError


class OpenList(Mapping[str, Any]):
    """The entries of an open list by name; listing the names imports none of them.

    With `names`, an entry is `TABLE[name]` of the module. Without, the module is a package, and an
    entry is a file of it, or the object `attribute` in the file. A "-" in a name is "_" in the
    file. Files that start with "_", and subpackages, are no entries.

    An entry of another package is its entry point `<name>` in the group `pnpdepth.<group>`. The
    package's own entries win. With `in_file`, the path of a user's Python file is a name, too, and
    the entry is the object of that name in it.
    """

    def __init__(
        self,
        module: str,
        *,
        group: str,
        names: tuple[str, ...] = (),
        attribute: str | None = None,
        in_file: str | None = None,
    ) -> None:
        self._module, self._group, self._names = module, group, names
        self._attribute, self._in_file = attribute, in_file

    def __getitem__(self, name: str) -> Any:
        """Returns the entry. Raises UsageError for an unknown name."""
        if name in self._entries:
            entry = self._entries[name].load()
            return entry[name] if name in self._names else entry
        if name in self:
            return _from_file(name, str(self._in_file))
        raise UsageError(f"{name!r} is none of the {self._group} {', '.join(self)}")

    def __contains__(self, name: object) -> bool:
        is_file = self._in_file is not None and str(name).endswith(".py")
        return is_file or name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    @functools.cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        """The package's own, in their order, then those of others by name."""
        places = dict.fromkeys(self._names, f"{self._module}:TABLE")
        if not self._names:
            package = importlib.util.find_spec(self._module)
            assert package is not None
            for file in pkgutil.iter_modules(package.submodule_search_locations):
                if not file.name.startswith("_") and not file.ispkg:
                    place = f"{self._module}.{file.name}"
                    if self._attribute is not None:
                        place += f":{self._attribute}"
                    places[file.name.replace("_", "-")] = place
        own = {name: EntryPoint(name, place, self._group) for name, place in places.items()}
        others = {point.name: point for point in entry_points(group=f"pnpdepth.{self._group}")}
        return own | {name: others[name] for name in sorted(others.keys() - own.keys())}


@functools.cache
def _from_file(path: str, attribute: str) -> object:
    """The object in a Python file, which is run. UsageError if there is none."""
    values: dict[str, object] = {"__name__": Path(path).stem, "__file__": path}
    try:
        exec(compile(Path(path).read_bytes(), path, "exec"), values)
    except Exception as error:
        fact = f"{type(error).__name__}: {error}"
        raise UsageError(f"{path} cannot be run: {fact}") from None
    if not callable(values.get(attribute)):
        raise UsageError(f"{path} defines no function {attribute!r}")
    return values[attribute]


LOSSES = OpenList(
    "pnpdepth_cli.core.losses",
    in_file="loss",
    group="losses",
    names=("l1", "l2", "huber", "berhu", "cauchy"),
)
"""L: (N,) predicted and (N,) measured depth to a scalar."""

UPDATES = OpenList(
    "pnpdepth_cli.core.update_rules",
    in_file="update_rule",
    group="updates",
    names=("sign", "sgd", "normalised", "momentum", "adam"),
)
"""U: each entry creates a rule that turns gradients into directions of z."""

PROPAGATIONS = OpenList(
    "pnpdepth_cli.completion.propagation", group="propagations", names=("gp", "local")
)
"""How the residual at the points is propagated: `pnpdepth_cli.completion.propagation`."""

BASELINES = OpenList(
    "pnpdepth_cli.completion.baselines",
    group="baselines",
    names=(
        *("nearest", "linear", "linear-log", "median", "scale", "affine"),
        *("scale-disparity", "affine-disparity", "local"),
    ),
)
"""Dense depth without refinement: `pnpdepth_cli.completion.baselines`."""

NETWORKS = OpenList("model_zoo_defs", group="models")
"""The networks' files in `model_zoo_defs`, and what other packages enter as `pnpdepth.models`."""

FORMATS = OpenList(
    "pnpdepth_cli.io.depth", group="formats", names=("png", "exr", "npy", "npz", "pfm", "tiff")
)
"""Depth file formats: `pnpdepth_cli.io.formats.DepthFormat`."""

LAYOUTS = OpenList(
    "pnpdepth_cli.dataset.layouts",
    group="layouts",
    names=(
        *("manifest", "kitti-odometry", "kitti-object", "kitti-depth", "kitti-raw"),
        *("tum", "7scenes", "eth3d", "colmap", "void", "diode", "ibims", "scannet"),
        *("arkitscenes", "stray-scanner", "record3d", "pairs", "image-depth"),
    ),
)
"""Data set layouts, in the order in which they are guessed (`dataset.layouts.Layout`)."""

EXPORTS = OpenList("pnpdepth_cli.commands.exports", attribute="EXPORT", group="exports")
"""Files for reconstruction programs: `pnpdepth_cli.commands.exports.Export`."""

MEASURES = OpenList("pnpdepth_cli.measures", group="measures", names=tuple(measures.TABLE))
"""Measures that `eval` computes only on request: `pnpdepth_cli.measures.Measure`."""

# The method
UNKNOWN = ("keep", "zero")  # depth that no points support, in the depth file
POSE_KINDS = ("camera-to-world", "world-to-camera", "opengl")  # what rows of poses are
METHODS = ("fused", "alone", "paper")  # without and with the included network; the paper's
SCHEDULES = ("constant", "linear")  # of the step size over the updates

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

NORMALISATIONS = ("unit", "imagenet", "symmetric", "bytes")  # rgb as 0…1, mean and std, −1…1, 0…255

# Files and sensors
REGISTRATIONS = ("auto", "off")  # whether the image is moved to the points

SENSORS = (
    *("vlp-16", "vlp-32c", "hdl-32e", "hdl-64e"),
    *("paper-vlp-16", "paper-vlp-32c", "paper-hdl-32e", "paper-hdl-64e"),
)
"""LiDARs by data sheet, and as the paper has them: `pnpdepth_cli.sensors.simulation`."""

LENSES = ("radial-tangential", "fisheye")
"""Lens distortions: `pnpdepth_cli.sensors.lens`."""

# Evaluation
PROTOCOLS = tuple(protocols.PROTOCOLS)
"""How frames are cut, given points and scored: `pnpdepth_cli.protocols`."""

SCALINGS = ("none", "median", "affine", "affine-disparity")  # of each image to its truth
