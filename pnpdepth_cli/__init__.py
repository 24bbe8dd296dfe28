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

__version__ = "2.0.0"

if TYPE_CHECKING:
    from pnpdepth_cli.api import load_network as load_network
    from pnpdepth_cli.api import refine as refine
    from pnpdepth_cli.api import score as score
    from pnpdepth_cli.core.metrics import Scores as Scores
    from pnpdepth_cli.core.split import Split as Split
    from pnpdepth_cli.errors import CheckpointError as CheckpointError
    from pnpdepth_cli.errors import DeviceError as DeviceError
    from pnpdepth_cli.errors import DivergedError as DivergedError
    from pnpdepth_cli.errors import InputError as InputError
    from pnpdepth_cli.errors import LayerError as LayerError
    from pnpdepth_cli.errors import ModelError as ModelError
    from pnpdepth_cli.errors import NoPointsError as NoPointsError
    from pnpdepth_cli.errors import PnpDepthError as PnpDepthError
    from pnpdepth_cli.errors import SizeError as SizeError
    from pnpdepth_cli.errors import UsageError as UsageError
    from pnpdepth_cli.frames.refined import Refined as Refined
    from pnpdepth_cli.frames.refiner import Refiner as Refiner
    from pnpdepth_cli.models.definition import Fixed as Fixed
    from pnpdepth_cli.models.definition import ModelDefinition as ModelDefinition
    from pnpdepth_cli.models.definition import Multiple as Multiple
    from pnpdepth_cli.models.definition import Near as Near
    from pnpdepth_cli.models.definition import Normalisation as Normalisation
    from pnpdepth_cli.models.network import Network as Network
    from pnpdepth_cli.points import SparsePoints as SparsePoints
    from pnpdepth_cli.settings import Settings as Settings

_NAMES = {
    "api": ("load_network", "refine", "score"),
    "frames.refiner": ("Refiner",),
    "frames.refined": ("Refined",),
    "settings": ("Settings",),
    "core.metrics": ("Scores",),
    "core.split": ("Split",),
    "models.network": ("Network",),
    "models.definition": ("ModelDefinition", "Normalisation", "Fixed", "Multiple", "Near"),
    "points": ("SparsePoints",),
    "errors": (
        *("PnpDepthError", "UsageError", "InputError", "SizeError", "NoPointsError"),
        *("ModelError", "LayerError", "CheckpointError", "DivergedError", "DeviceError"),
    ),
}
"""The public names of each module."""
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
