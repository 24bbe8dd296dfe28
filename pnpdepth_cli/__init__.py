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

__version__ = "0.1.0"

if TYPE_CHECKING:
    from pnpdepth_cli.api import Refined as Refined
    from pnpdepth_cli.api import Refiner as Refiner
    from pnpdepth_cli.api import load_network as load_network
    from pnpdepth_cli.api import refine as refine
    from pnpdepth_cli.api import score as score
    from pnpdepth_cli.core.metrics import Scores as Scores
    from pnpdepth_cli.core.refine import RefineSettings as RefineSettings
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
    from pnpdepth_cli.models.network import Network as Network
    from pnpdepth_cli.points import SparsePoints as SparsePoints

_HOMES = {
    "load_network": "api",
    "refine": "api",
    "Refiner": "api",
    "Refined": "api",
    "score": "api",
    "Scores": "core.metrics",
    "RefineSettings": "core.refine",
    "Split": "core.split",
    "Network": "models.network",
    "SparsePoints": "points",
    "PnpDepthError": "errors",
    "UsageError": "errors",
    "InputError": "errors",
    "SizeError": "errors",
    "NoPointsError": "errors",
    "ModelError": "errors",
    "LayerError": "errors",
    "CheckpointError": "errors",
    "DivergedError": "errors",
    "DeviceError": "errors",
}
"""The module of each public name."""

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
