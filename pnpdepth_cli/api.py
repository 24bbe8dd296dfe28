"""The public Python API: arrays in, arrays out. Its names are imported from `pnpdepth_cli`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from numpy.typing import ArrayLike
from torch import nn

from pnpdepth_cli.camera import Camera as Camera
from pnpdepth_cli.completion.alignment import Alignment as Alignment
from pnpdepth_cli.completion.image_registration import ImageRegistration as ImageRegistration
from pnpdepth_cli.core.split import Split as Split
from pnpdepth_cli.errors import DeviceError as DeviceError
from pnpdepth_cli.errors import DivergedError as DivergedError
from pnpdepth_cli.errors import InputError as InputError
from pnpdepth_cli.errors import ModelError as ModelError
from pnpdepth_cli.errors import NoPointsError as NoPointsError
from pnpdepth_cli.errors import OutputError as OutputError
from pnpdepth_cli.errors import PnpDepthError as PnpDepthError
from pnpdepth_cli.errors import UsageError as UsageError
from pnpdepth_cli.frames.frame import DepthMap as DepthMap
from pnpdepth_cli.frames.frame import Refined as Refined
from pnpdepth_cli.frames.frame import Registration as Registration
from pnpdepth_cli.frames.frame import UsedNetwork as UsedNetwork
from pnpdepth_cli.frames.frame import Validation as Validation
from pnpdepth_cli.measures import DELTA_THRESHOLDS, with_thresholds
from pnpdepth_cli.measures import Scores as Scores
from pnpdepth_cli.measures import score as score_tensors
from pnpdepth_cli.models import network as networks
from pnpdepth_cli.models.definition import Fixed as Fixed
from pnpdepth_cli.models.definition import ModelDefinition as ModelDefinition
from pnpdepth_cli.models.definition import Multiple as Multiple
from pnpdepth_cli.models.definition import Near as Near
from pnpdepth_cli.models.definition import Normalisation as Normalisation
from pnpdepth_cli.models.definition import assume_definition
from pnpdepth_cli.models.network import Network as Network
from pnpdepth_cli.points import SparsePoints as SparsePoints
from pnpdepth_cli.refiner import Pair as Pair
from pnpdepth_cli.refiner import Refiner as Refiner
from pnpdepth_cli.refiner import Unit as Unit
from pnpdepth_cli.refiner import in_metres
from pnpdepth_cli.settings import Settings as Settings


def load_network(
    spec: str | Path | nn.Module = "compact",
    checkpoint: str | Path | None = None,
    *,
    definition: ModelDefinition | None = None,
    device: str = "cpu",
) -> Network:
    """Returns a network in eval mode with its weights.

    Args:
        spec: A name of `pnpdepth models`, an ONNX or torch.export file, a Hugging Face folder, or a
            Python file (which is run), as `--model` of the command line; or a module, which is put
            into eval mode, its parameters without gradients.
        checkpoint: Weights. None takes those of the network's definition.
        definition: Definition of a module. None: the module takes an rgb image, and its layers and
            what its output means are decided by the first frame.
        device: torch device, such as "cpu" or "cuda:1".

    Raises:
        UsageError: `spec` is of another type, or a definition is given for a name or a file.
        ModelError: There is no such network, it cannot be built, or its weights do not fit.
        DeviceError: The device cannot be used.
    """
    path = None if checkpoint is None else Path(checkpoint)
    if isinstance(spec, nn.Module):
        if definition is None:
            definition = assume_definition(name=type(spec).__name__, build=lambda: spec)
        # The module is there already; without a checkpoint it has its weights, too.
        definition = replace(definition, build=lambda: spec, complete=path is None)
        return networks.load_network(definition, path, device)
    if not isinstance(spec, str | Path):
        raise UsageError(f"spec must be a name, a path or a module, not {type(spec).__name__}")
    if definition is not None:
        raise UsageError("definition is for a module; a name or a file has its own")
    return networks.load_network(str(spec), path, device)


def refine(
    network: Network,
    image: ArrayLike | None,
    sparse: ArrayLike | SparsePoints,
    settings: Settings | None = None,
    *,
    unit: Unit | None = None,
    depth: ArrayLike | Sequence[ArrayLike] = (),
    camera: ArrayLike | Camera | None = None,
    stages: bool = False,
    uncertainty: bool = False,
    keep_measured: bool = False,
    registration: Registration = "auto",
) -> Refined:
    """Returns the refined depth of one frame.

    Args:
        network: Network from `load_network`.
        image: Image as `Refiner.refine` takes it; None for a network that takes sparse depth only.
        sparse: Depth map, rows of x, y and depth, or SparsePoints, as `Refiner.refine` takes them.
        settings: The method and values for its steps; what they leave open, the network decides.
        unit: Unit of the depth of an array, "m" or "mm".
        depth: Depth map (H, W) of any other network for this image, or several in a list, as
            `Refiner.refine` takes them; with the network `compact`, that one refines the map.
        camera: Intrinsics (3, 3) in pixels of the image, or a Camera.
        stages: Whether the depth after each step is returned too, as `Refined.stages`.
        uncertainty: Whether the standard deviation of the depth is estimated too.
        keep_measured: Whether the depth of points at whole pixels is kept there exactly.
        registration: Whether the image is moved to the points: "auto", "off", or (zoom, right,
            down).

    Raises:
        InputError: Image, points or camera cannot be used.
        DivergedError: The loss became non-finite; `last_good` is the Refined before that.
    """
    with Refiner(
        network,
        settings,
        uncertainty=uncertainty,
        keep_measured=keep_measured,
        registration=registration,
    ) as refiner:
        return refiner.refine(image, sparse, unit=unit, depth=depth, camera=camera, stages=stages)


def score(
    depth: ArrayLike,
    ground_truth: ArrayLike,
    *,
    unit: Unit | None = None,
    thresholds: tuple[float, float, float] = DELTA_THRESHOLDS,
) -> Scores:
    """Returns the errors of a depth map at all pixels with known ground truth and known depth.

    Args:
        depth: Predicted depth, any shape, metres.
        ground_truth: Ground truth of the same shape. Zero, negative and non-finite values are
            unknown, in both.
        unit: Unit of the ground truth, "m" or "mm"; needed where it is of integers.
        thresholds: Thresholds of δ1, δ2 and δ3.

    Raises:
        InputError: The shapes differ, or the unit is not given and may be another than metres.
    """
    predicted = in_metres(depth, "the predicted depth")
    truth = in_metres(ground_truth, "the ground truth", unit)
    if predicted.shape != truth.shape:
        raise InputError(f"depth is {predicted.shape} but ground truth is {truth.shape}")
    return score_tensors(
        torch.from_numpy(predicted), torch.from_numpy(truth), with_thresholds(thresholds)
    )
