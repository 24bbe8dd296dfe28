"""Better depth from any depth network and sparse depth, without training.

The public Python API; everything else in this package may change between versions.

    network = load_network("compact")
    refined = refine(network, rgb, sparse)          # arrays in, arrays out
    with Refiner(network) as refiner:               # stays open over frames
        depths = [refiner.refine(rgb, sparse).depth for rgb, sparse in frames]

Names are imported when they are first used, so that `import pnpdepth_cli` does not import torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pnpdepth_cli.version import __version__

if TYPE_CHECKING:
    from pnpdepth_cli.api import *  # noqa: F403

_NAMES = (
    "load_network",
    "refine",
    "score",
    "Refiner",
    "Refined",
    "Settings",
    "Scores",
    "Network",
    "ModelDefinition",
    "Normalisation",
    "Fixed",
    "Multiple",
    "Near",
    "Split",
    "SparsePoints",
    "Camera",
    "Alignment",
    "ImageRegistration",
    "Validation",
    "UsedNetwork",
    "DepthMap",
    "Pair",
    "Registration",
    "Unit",
    "PnpDepthError",
    "UsageError",
    "InputError",
    "NoPointsError",
    "ModelError",
    "DivergedError",
    "DeviceError",
    "OutputError",
)
"""The public names, which `api` has."""

__all__ = ["__version__", *_NAMES]


def __getattr__(name: str) -> Any:
    """Returns a public name of `api`, which is imported when the first of these is asked for."""
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.api"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
