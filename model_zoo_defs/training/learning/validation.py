"""Errors of a network relative to linear interpolation, on fixed frames with fixed points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from model_zoo_defs.training.learning import priors
from model_zoo_defs.training.learning.dataset import Frames, normalised
from model_zoo_defs.training.learning.patterns import keep, outliers, scan_lines, uniform
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.points import SparsePoints

Depth = NDArray[np.float32]

PATTERNS: dict[str, Callable[[np.random.Generator, Depth], Depth]] = {
    "uniform100": lambda rng, depth: keep(depth, uniform(rng, depth, 100)),
    "uniform500": lambda rng, depth: keep(depth, uniform(rng, depth, 500)),
    "lidar": scan_lines,
}


class Case(NamedTuple):
    """One frame with points."""

    pattern: str
    """Name of the pattern of the points, and of what was changed."""
    rgb: Tensor
    """(1, 3, H, W), normalised."""
    sparse: Tensor
    """(1, 1, H, W) metres, 0 = unknown."""
    depth: Depth
    """Ground truth (H, W) in metres, 0 = unknown."""
    linear: Depth
    """Linear interpolation (H, W) of the points before outliers were added."""
    prior: Tensor | None = None
    """(1, 1, H, W) metres, 0 = unknown; None without."""


def linear_interpolation(sparse: Depth) -> Depth:
    """Returns the linear interpolation of a map's known pixels, (H, W) metres."""
    rows, columns = np.nonzero(sparse)
    points = SparsePoints(
        xy=torch.from_numpy(np.stack([columns, rows], axis=1).astype(np.float32)),
        depth=torch.from_numpy(sparse[rows, columns].astype(np.float32)),
        size=(sparse.shape[0], sparse.shape[1]),
    )
    return linear(points).numpy()


def cases(folder: Path, count: int) -> list[Case]:
    """Returns cases of `count` evenly spaced frames of the folder, with every pattern each."""
    frames = Frames(folder)
    chosen = np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int)
    chosen_cases: list[Case] = []
    for index in chosen:
        rgb, depth = frames[int(index)]
        image = normalised(torch.from_numpy(rgb).permute(2, 0, 1).float() / 255.0)[None]
        for pattern, draw in PATTERNS.items():
            sparse = draw(np.random.default_rng(int(index)), depth)
            if np.count_nonzero(sparse) >= 3:
                at = torch.from_numpy(sparse)[None, None]
                case = Case(pattern, image, at, depth, linear_interpolation(sparse))
                other = frames[(int(index) + 17) % len(frames)][1]
                rng = np.random.default_rng((int(index), len(pattern)))
                chosen_cases += [case, *_variants(rng, case, rgb, other)]
    return chosen_cases


def _variants(
    rng: np.random.Generator, case: Case, rgb: NDArray[np.uint8], other: Depth
) -> list[Case]:
    """Returns the case with a damaged prior, with an unrelated prior, and with 20 % outliers.

    Args:
        rng: Random numbers.
        case: The case.
        rgb: Its image (H, W, 3).
        other: Depth of another frame.
    """
    sparse = case.sparse[0, 0].numpy()
    grey = (rgb.mean(-1) / 255.0).astype(np.float32)

    def with_prior(kind: str, prior: Depth) -> Case:
        """Returns the case with a prior, aligned to its points."""
        dense = priors.aligned(prior, sparse, affine=False)
        return case._replace(
            pattern=f"{case.pattern}_{kind}", prior=torch.from_numpy(dense)[None, None]
        )

    variants = [with_prior("prior", priors.damaged(rng, case.depth, grey))]
    if case.pattern == "uniform500":
        variants.append(with_prior("nonsense", priors.nonsense(rng, case.depth.shape, other)))
        with_outliers = torch.from_numpy(outliers(rng, sparse, 0.2))[None, None]
        variants.append(case._replace(pattern="uniform500_wrong", sparse=with_outliers))
    return variants


@torch.no_grad()
def scores(network: nn.Module, some: list[Case], device: torch.device) -> dict[str, float]:
    """Returns MAE and RMSE in per cent of those of linear interpolation, PATTERN_mae and _rmse."""
    network.eval()
    ratios: dict[str, list[tuple[float, float]]] = {}
    for case in some:
        inputs = [case.rgb, case.sparse, *([] if case.prior is None else [case.prior])]
        predicted = network(*(x.to(device) for x in inputs)).float().cpu()
        known = case.depth > 0
        ours = np.abs(predicted[0, 0].numpy() - case.depth)[known]
        theirs = np.abs(case.linear - case.depth)[known]
        ratios.setdefault(case.pattern, []).append(
            (
                float(ours.mean() / theirs.mean()),
                float(np.sqrt((ours**2).mean() / (theirs**2).mean())),
            )
        )
    # The geometric mean over frames: every frame counts alike, however far its walls are.
    per_cent = {}
    for pattern, pairs in ratios.items():
        mae, rmse = np.exp(np.log(np.array(pairs) + 1e-9).mean(0)) * 100.0
        per_cent[f"{pattern}_mae"] = float(mae)
        per_cent[f"{pattern}_rmse"] = float(rmse)
    return per_cent
