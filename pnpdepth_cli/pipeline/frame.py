"""Refinement of one frame in memory, from the image frame and back to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.alignment import Alignment
from pnpdepth_cli.core.points import SparsePoints
from pnpdepth_cli.core.refine import Refinement, RefineSettings, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DivergedError, NoPointsError, UsageError
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network, out_of_memory_is_a_device_error
from pnpdepth_cli.pipeline.inputs import Inputs


@dataclass(frozen=True, kw_only=True)
class RefinedFrame:
    """Depth before and after, (H, W) float32 metres in the image frame, 0 = unknown.

    alignment: of the network's output with the points, None where it is taken as it is.
    """

    before: NDArray[np.float32]
    after: NDArray[np.float32]
    used: SparsePoints
    held_out: SparsePoints
    refinement: Refinement
    diverged: DivergedError | None
    alignment: Alignment | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class PointError:
    """Error at sparse points in metres."""

    points: int
    mae: float
    rmse: float


def split_points(
    points: SparsePoints, holdout: float, seed: int
) -> tuple[SparsePoints, SparsePoints]:
    """(used, held out): a random share `holdout` of the points is held out, at least one of each.

    UsageError if the share is not in 0…1 or there are too few points for it.
    """
    if not 0 <= holdout < 1:
        raise UsageError(f"holdout {holdout} is not a share of the points; give 0 ≤ F < 1")
    mask = torch.zeros(len(points), dtype=torch.bool)
    if holdout > 0:
        if len(points) < 2:
            raise UsageError("holdout needs at least two sparse points")
        count = min(max(1, round(holdout * len(points))), len(points) - 1)
        order = np.random.default_rng(seed).permutation(len(points))
        mask[torch.from_numpy(order[:count])] = True
    return points.select(~mask), points.select(mask)


def refine_frame(
    network: Network,
    layer: str,
    settings: RefineSettings,
    inputs: Inputs,
    used: SparsePoints,
    held_out: SparsePoints,
    *,
    on_iteration: Callable[[int, float], None] = lambda done, loss: None,
) -> RefinedFrame:
    """Refinement of one frame in memory; a divergence with a last good depth is returned in it."""
    frame = FrameMap.fit(network.definition.size, *inputs.size)
    points = frame.points_to_network(used)
    if not len(points):
        raise NoPointsError(
            f"none of the {len(used)} sparse points lies inside the part of the image that network"
            f" {network.definition.name!r} sees (rows and columns {frame.crop})"
        )
    diverged: DivergedError | None = None
    with out_of_memory_is_a_device_error(network.device):
        arguments = network.arguments(frame, inputs.rgb_tensor(), points)
        at = points.to(network.device)
        depth_of = AlignedDepth(network, at, settings.align, every=settings.align_every)
        with Split(network.module, layer) as split:
            try:
                result = refine(
                    split,
                    arguments,
                    at,
                    settings,
                    depth_of=depth_of,
                    on_iteration=lambda iteration, loss: on_iteration(iteration + 1, loss),
                )
            except DivergedError as error:
                if error.last_good is None:
                    raise
                result, diverged = error.last_good, error
    return RefinedFrame(
        before=_to_image(frame, result.before),
        after=_to_image(frame, result.after),
        used=used,
        held_out=held_out,
        refinement=result,
        diverged=diverged,
        alignment=depth_of.alignment,
        notes=depth_of.notes,
    )


def _to_image(frame: FrameMap, depth: torch.Tensor) -> NDArray[np.float32]:
    image = frame.depth_to_image(depth).cpu().numpy()
    known = np.isfinite(image) & (image > 0)
    return np.where(known, image, 0).astype(np.float32)


def point_error(depth: NDArray[np.float32], points: SparsePoints) -> PointError | None:
    """Error of a dense map (H, W) at points of its frame where it has depth; None without any."""
    predicted = points.sample(torch.from_numpy(depth))
    error = (predicted - points.depth)[predicted > 0].double()
    if not len(error):
        return None
    return PointError(
        points=len(error), mae=float(error.abs().mean()), rmse=float(error.square().mean().sqrt())
    )
