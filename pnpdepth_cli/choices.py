"""Every list of names that a user can choose from. Imports nothing heavy.

Open lists are `Table`s: one file in a folder of this package adds one entry, and an entry point of
an installed package adds another. Closed lists are tuples.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import UsageError

_PACKAGE = Path(__file__).parent


class Table(Mapping[str, Any]):
    """The entries of an open list by name; listing the names imports none of them.

    An entry is the object `attribute` of the module `folder/<name>.py` ("-" in a name is "_" in the
    file), or an entry point `<name>` in the group `pnpdepth.<group>`. Modules whose name starts
    with "_" are no entries. The package's own entries win over entry points of the same name.

    Args:
        folder: Path of the modules relative to `pnpdepth_cli`, such as "core/losses".
        attribute: Name of the object in each module.
        group: Last part of the entry point group.
        noun: What one entry is called in messages.
        first: Names listed before the others, which follow in alphabetical order.
    """

    def __init__(
        self, folder: str, attribute: str, *, group: str, noun: str, first: tuple[str, ...] = ()
    ) -> None:
        self.folder, self.attribute, self.group, self.noun = folder, attribute, group, noun
        self._first = first

    def __getitem__(self, name: str) -> Any:
        """Returns the entry. Raises UsageError, with near matches, for an unknown name."""
        if name in self._modules:
            module = importlib.import_module(self._modules[name])
            return getattr(module, self.attribute)
        if name in self._entry_points:
            return self._entry_points[name].load()
        near = difflib.get_close_matches(name, list(self), n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(self)}"
        raise UsageError(f"unknown {self.noun} {name!r}; {hint}")

    def __contains__(self, name: object) -> bool:
        return name in self._modules or name in self._entry_points

    def __iter__(self) -> Iterator[str]:
        names = {**self._modules, **self._entry_points}
        order = {name: place for place, name in enumerate(self._first)}
        return iter(sorted(names, key=lambda name: (order.get(name, len(order)), name)))

    def __len__(self) -> int:
        return len({**self._modules, **self._entry_points})

    @functools.cached_property
    def _modules(self) -> dict[str, str]:
        package = ".".join(("pnpdepth_cli", *self.folder.split("/")))
        found = pkgutil.iter_modules([str(_PACKAGE / self.folder)])
        return {
            module.name.replace("_", "-"): f"{package}.{module.name}"
            for module in found
            if not module.name.startswith("_")
        }

    @functools.cached_property
    def _entry_points(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=f"pnpdepth.{self.group}")}


ALIGNMENTS = ("none", "median", "scale", "affine", "auto")
"""How the network's output is fitted to the sparse points."""
FORMATS = ("png", "exr", "npy", "npz", "pfm", "tiff")
"""File formats of dense depth."""
LOSSES = ("l1", "l2", "huber", "berhu", "inverse", "log", "cauchy")
"""Losses between prediction and sparse points."""
NORMALISATIONS = ("unit", "imagenet", "symmetric", "bytes")
"""Ranges of the rgb input of a network."""
OUTPUT_KINDS = ("depth", "inverse", "log")
"""What the numbers of a network are."""
PARAMETERS = ("elements", "channels")
"""What of z is updated."""
PRECISIONS = ("fp32", "bf16", "fp16")
"""Precisions of a network's convolutions and matrix products."""
PROPAGATIONS = ("none", "gp", "diffusion")
"""How the residual at the points is propagated."""
SCHEDULES = ("constant", "linear")
"""How the step size falls over the updates."""
UPDATES = ("sign", "sgd", "normalised", "momentum", "adam", "lbfgs")
"""Update rules of z."""
