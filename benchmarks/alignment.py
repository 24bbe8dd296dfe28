"""What an alignment with few points gives: `python -m benchmarks.alignment --data PATH`.

For each set, network and number of points, geometric means over frames and draws of the MAE in
metres over all pixels with truth, divided by that of least squares in the quantity that the network
gives: aligned with a definition that states that quantity, and with an open one.

`--rendered` is a folder of shards of `model_zoo_defs.training.rendering.render`; `--outliers` makes
a fifth of the points wrong. `--trial` prints which value of each constant the other sets, and the
other networks, would choose, and what that choice costs on the one that is left out. Nothing is
chosen on stored predictions (`strong`) and on TUM.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.frames import OUTLIERS, EvalFrame, frames_of, opened, print_row
from benchmarks.simulated import as_outputs, weakened
from pnpdepth_cli.completion import alignment, robust_line
from pnpdepth_cli.completion.alignment import Candidate, align, candidates, to_space
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame, tensor_of
from pnpdepth_cli.frames.open_network import prepare
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.points import SparsePoints

COUNTS = (10, 20, 50, 100, 500)
DRAWS = 2
PIXELS = 8000
"""Most pixels of a frame that are scored, and that points are drawn from."""

FRAMES = {
    "7scenes": 6,
    "icl_nuim": 6,
    "nyu": 2,
    "kitti_dc": 6,
    "tum_fr1_rpy": 3,
    "tum_fr3_cabinet": 3,
}
ERRORS = (0.02, 0.04, 0.09)
"""Of the simulated networks."""

STATED = {
    "disparity": ("inverse", "affine"),
    "metric": ("depth", "metric"),
    "relative": ("depth", "affine"),
    "log": ("log", "affine"),
    "eigen-tiny": ("log", "metric"),
    "sfmlearner-tiny": ("inverse", "scale"),
}
"""`output_kind` and `output_scale` of the definitions, by what the numbers are, or by network."""

TRUE = {"metric": "depth", "relative": "depth", "sqrt": "power", "inverted": "inverted-disparity"}
"""The reading of least squares, where its name is another one."""

SHIPPED = {
    "fastdepth": "metric",
    "fcrn-tiny": "metric",
    "eigen-tiny": "log",
    "sfmlearner-tiny": "disparity",
}


@dataclass(frozen=True, kw_only=True)
class Case:
    """A frame's pixels: the network's numbers x (N,) and the true depth (N,) in metres."""

    set: str
    network: str
    output: str  # what the numbers are
    x: NDArray[np.float64]
    depth: NDArray[np.float64]

    def points(self, count: int, seed: int, outliers: str | None) -> tuple[NDArray, SparsePoints]:
        """Returns the numbers (count,) at random pixels, and the points there.

        The points' positions mean nothing. `outliers` is a kind of `OUTLIERS`, or None.
        """
        rng = np.random.default_rng([seed, count])
        chosen = rng.choice(len(self.x), count, replace=False)
        depth = torch.from_numpy(self.depth[chosen]).float()
        points = SparsePoints(xy=torch.zeros(count, 2), depth=depth, size=(1, 1))
        if outliers is not None:
            points = OUTLIERS[outliers](points, 0.2, seed)
        return self.x[chosen], points

    def mae(self, depth: NDArray[np.float64]) -> float:
        return float(np.abs(depth - self.depth).mean())


def least_squares(case: Case, x: NDArray[np.float64], points: SparsePoints) -> float:
    """Returns the MAE in metres of plain least squares in the quantity that the network gives.

    Args:
        case: The frame's pixels, which are scored.
        x: The network's numbers (N,) at the points.
        points: The points.
    """
    reading = alignment._READINGS[TRUE.get(case.output, case.output)]
    d = points.depth.double()
    low = float(d.min()) / 10
    high = float(d.max()) * 10
    at = to_space(torch.from_numpy(x), reading.x_space).numpy()
    scale, shift = np.polyfit(at, to_space(d, reading.depth_space).numpy(), 1)
    line = scale * to_space(torch.from_numpy(case.x), reading.x_space) + shift
    ends = sorted(
        to_space(torch.tensor([low, high], dtype=torch.float64), reading.depth_space).tolist()
    )
    return case.mae(alignment.from_space(line.clamp(*ends), reading.depth_space).numpy())


def aligned(case: Case, x: NDArray[np.float64], points: SparsePoints, *, stated: bool) -> float:
    """Returns the MAE in metres of the program's alignment.

    Args:
        case: The frame's pixels, which are scored.
        x: The network's numbers (N,) at the points.
        points: The points.
        stated: Whether the network's definition says what its numbers are; NaN if none can.
    """
    definition = STATED.get(case.network, STATED.get(case.output))
    if stated and definition is None:
        return math.nan
    tried = alignment.candidates("auto", *(definition if stated and definition else ()))
    fit = align(torch.from_numpy(x), points, tried)
    return case.mae(fit.depth(torch.from_numpy(case.x)).numpy())


def cases(data: Path, rendered: Path | None, most: int | None = None) -> Iterator[Case]:
    """Yields every network on every frame.

    Args:
        data: The folder of real frames.
        rendered: A folder of rendered shards; None: no such frames.
        most: Most frames of a set; None: those of `FRAMES`.
    """
    frames = {
        name: frames_of(name, data, count if most is None else min(count, most))
        for name, count in FRAMES.items()
    }
    if rendered is not None:
        frames["rendered"] = list(frames_of_shards(rendered))[:most]
    # Simulated networks, of every error and every kind of output.
    for name, of_set in frames.items():
        for number, frame in enumerate(of_set):
            for error in ERRORS:
                rng = np.random.default_rng([number, round(100 * error)])
                outputs = as_outputs(weakened(frame.gt, error, rng), rng)
                for output, x in outputs.items():
                    yield case_of(name, f"simulated {error:.0%}", output, x, frame.gt, rng)
    # Shipped networks, their numbers sampled at the pixels with truth.
    for network_name, output in SHIPPED.items():
        network = opened(network_name, data)
        for name, of_set in frames.items():
            for number, frame in enumerate(of_set):
                rng = np.random.default_rng(number)
                rows, columns = _drawn(frame.gt > 0, rng)
                xy = torch.from_numpy(np.stack([columns, rows], axis=1)).float()
                depth = torch.from_numpy(frame.gt[rows, columns])
                points = SparsePoints(xy=xy, depth=depth, size=frame.gt.shape)
                prepared = prepare(network, Frame(rgb=tensor_of(frame.rgb), points=points))
                with torch.no_grad():
                    raw = network.raw_of(network.module(*prepared.arguments))
                at = prepared.points.sample(raw).double().numpy()
                seen = prepared.points.depth.double().numpy()
                yield Case(set=name, network=network_name, output=output, x=at, depth=seen)
    # Stored predictions.
    for folder, output, x, gt in strong(data / "strong"):
        yield case_of("strong", folder, output, x, gt, np.random.default_rng(0))


def case_of(
    set_name: str, network: str, output: str, x: NDArray, gt: NDArray, rng: np.random.Generator
) -> Case:
    """The case of a network's map (H, W), NaN where unknown, and a frame's ground truth."""
    rows, columns = _drawn((gt > 0) & np.isfinite(x), rng)
    numbers = x[rows, columns].astype(float)
    depth = gt[rows, columns].astype(float)
    return Case(set=set_name, network=network, output=output, x=numbers, depth=depth)


def _drawn(known: NDArray[np.bool_], rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Returns rows and columns of up to `PIXELS` known pixels of a mask (H, W), at random."""
    rows, columns = np.nonzero(known)
    chosen = rng.choice(len(rows), min(PIXELS, len(rows)), replace=False)
    return rows[chosen], columns[chosen]


def frames_of_shards(folder: Path) -> Iterator[EvalFrame]:
    """Yields every second frame of a folder of rendered shards."""
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as shard:
            for rgb, depth in zip(shard["rgb"][::2], shard["depth"][::2], strict=True):
                yield EvalFrame(path.stem, rgb.astype(np.float32) / 255, depth)


def strong(root: Path) -> Iterator[tuple[str, str, NDArray, NDArray]]:
    """Yields stored predictions: network, what its numbers are, map (H, W), ground truth (H, W)."""

    def npy(name: str) -> NDArray:
        return np.load(root / name).astype(float)

    def png(name: str, scale: float) -> NDArray:
        return read_depth(root / name, scale=scale).values

    # 1/disparity of a network of a room.
    yield "prior_da", "inverted", npy("prior_da_nyu/0_pred.npy"), png("prior_da_nyu/0_gt.png", 1000)
    # Disparity, as given and as its inverse was stored.
    for path in sorted((root / "weison_kitti_dav2").glob("*_pred.npy")):
        frame = path.name.removesuffix("_pred.npy")
        disparity = np.load(path).astype(float)
        gt = png(f"weison_kitti_dav2/{frame}_gt.png", 256)
        yield "Depth Anything V2", "disparity", disparity, gt
        with np.errstate(divide="ignore"):
            stored = np.where(disparity > 0, np.clip(1 / disparity, 0.001, 10), 0.001)
        yield "Depth Anything V2, stored as 1/x", "inverted", stored, gt
    for path in sorted((root / "unidepth_nyu").glob("0_pred_*.npy")):
        yield "UniDepth", "metric", np.load(path).astype(float), png("unidepth_nyu/0_gt.png", 1000)
    for path in sorted((root / "mmaj1_synthetic_dptlarge").glob("*_pred.npy")):
        gt = np.load(path.with_name(path.name.replace("pred", "gt")))
        yield "DPT-Large", "disparity", np.load(path).astype(float), gt
    # Grey levels of pictures, clipped at both ends.
    for path in sorted((root / "nuscenes_composites").glob("*_pred_*.png")):
        frame, _, network = path.stem.split("_")
        levels = np.asarray(Image.open(path)).astype(float)
        levels[(levels == 0) | (levels == 255)] = np.nan  # clipped
        yield (
            f"nuScenes {network}",
            "relative",
            levels,
            png(f"nuscenes_composites/{frame}_gt.png", 256),
        )
    gt = png("adri721_realsense_zoe/0_gt.png", 1000)
    yield "ZoeDepth", "relative", npy("adri721_realsense_zoe/0_pred.npy"), gt
    for path in sorted((root / "eungihan_depthformer").glob("*_pred.npy")):
        frame = path.name.removesuffix("_pred.npy")
        gt = png(f"eungihan_depthformer/{frame}_gt.png", 256)
        yield "DepthFormer", "metric", np.load(path).astype(float), gt


def ratios(
    all_cases: Sequence[Case], counts: Iterable[int], draws: int, outliers: str | None
) -> dict[tuple[int, int, int, str], float]:
    """Returns log(MAE / MAE of least squares) by index of the case, count, seed and definition.

    The definition is "stated", which says what the numbers are, or "open", which does not. An
    alignment that is refused counts as least squares.
    """
    log_ratios = {}
    for number, case in enumerate(all_cases):
        for count in counts:
            # A frame with too few pixels for so many points.
            if count > 0.8 * len(case.x):
                continue
            for seed in range(draws):
                x, points = case.points(count, seed, outliers)
                plain = least_squares(case, x, points)
                for name, stated in (("stated", True), ("open", False)):
                    try:
                        mae = aligned(case, x, points, stated=stated)
                    except PnpDepthError:
                        mae = plain
                    if not math.isnan(mae):
                        log_ratios[number, count, seed, name] = math.log(mae / plain)
    return log_ratios


def table(all_cases: Sequence[Case], outliers: str | None) -> None:
    """Prints the ratios of every set and network."""
    found = ratios(all_cases, COUNTS, DRAWS, outliers)
    groups = defaultdict[tuple[str, str, str], dict[tuple[int, str], list[float]]](
        lambda: defaultdict(list)
    )
    for (number, count, _, name), value in found.items():
        case = all_cases[number]
        groups[case.set, case.network, case.output][count, name].append(value)
    heads = [f"{name}, {count}" for name in ("stated", "open") for count in COUNTS]
    print_row("set", "network", "its numbers", *heads, head=True)
    for group, values in groups.items():
        means = [np.mean(values[count, name]) if values[count, name] else None
                 for name in ("stated", "open") for count in COUNTS]  # fmt: skip
        print_row(*group, *("" if mean is None else f"{math.exp(mean):.2f}" for mean in means))


SHIPPED_BIC = alignment._bic


def _bic(price: float) -> Callable[[alignment.Alignment], float]:
    """Returns the criterion BIC with the price of a parameter multiplied by `price`."""

    def criterion(fit: alignment.Alignment) -> float:
        none = SHIPPED_BIC(replace(fit, kind="none"))
        return none + price * (SHIPPED_BIC(fit) - none)

    return criterion


def _error_by_freedom(fit: alignment.Alignment) -> float:
    """Returns the error of a fit over its degrees of freedom."""
    parameters = {"none": 0, "affine": 2}.get(fit.kind, 1)
    return max(fit.misfit, alignment._LEAST_ERROR) / (fit.points - parameters)


def _without_power(
    asked: str, output_kind: str = "unknown", output_scale: str = "unknown"
) -> tuple[Candidate, ...]:
    """The candidates, without the power of what is stated."""
    found = candidates(asked, output_kind, output_scale)
    return found if output_kind == "unknown" else tuple(c for c in found if c.reading != "power")


TRIALS: dict[str, tuple[object, str, dict[str, object]]] = {
    "bounds": (alignment, "BEYOND", {"2": 2.0, "3": 3.0, "5": 5.0, "10": 10.0}),
    "width of the loss": (
        robust_line,
        "_CAUCHY",
        {"0.5": 0.5, "1": 1.0, "1.5": 1.5, "2.385": 2.385, "1000 (least squares)": 1000.0},
    ),
    "price of a parameter": (
        alignment,
        "_bic",
        {
            "BIC": SHIPPED_BIC,
            "half of it": _bic(0.5),
            "twice of it": _bic(2.0),
            "error by degree of freedom": _error_by_freedom,
        },
    ),
    "stated kinds": (
        alignment,
        "candidates",
        {"with a power": candidates, "without": _without_power},
    ),
}
"""By constant: where it is, and the values that are tried."""


def trial(
    all_cases: Sequence[Case], constants: Iterable[str], outliers: Sequence[str | None]
) -> None:
    """Prints the value of each constant that is chosen with each set and network left out."""
    all_cases = [
        case for case in all_cases if case.set != "strong" and not case.set.startswith("tum")
    ]
    print_row("constant", "value", "ratio to the shipped value, by left out", head=True)
    # The log ratios of every case with each value of the constant.
    for constant in constants:
        module, attribute, values = TRIALS[constant]
        found = dict[str, dict[tuple, float]]()
        for value_name, value in values.items():
            with patch.object(module, attribute, value):
                found[value_name] = {
                    (kind, *key): ratio
                    for kind in outliers
                    for key, ratio in ratios(all_cases, COUNTS[:-1], 1, kind).items()
                }
        # Of each set and network: what the other ones choose, and what that costs on it.
        shipped = next(name for name, v in values.items() if v == getattr(module, attribute))
        for field in ("set", "network"):
            for left_out in sorted({getattr(case, field) for case in all_cases}):
                inside = {n for n, case in enumerate(all_cases) if getattr(case, field) == left_out}
                mean = {
                    name: [
                        np.mean([v for key, v in logs.items() if (key[1] in inside) == is_inside])
                        for is_inside in (False, True)
                    ]
                    for name, logs in found.items()
                }
                chosen = min(mean, key=lambda name: mean[name][0])
                cost = math.exp(mean[chosen][1] - mean[shipped][1])
                listed = ", ".join(
                    f"{name}: {math.exp(others - mean[shipped][0]):.4f}"
                    for name, (others, _) in mean.items()
                )
                print_row(constant, f"without {left_out}: {chosen}", f"{cost:.4f} there; {listed}")


def main() -> None:
    """Measure, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--rendered", type=Path, help="folder of rendered shards")
    parser.add_argument("--outliers", choices=OUTLIERS, help="make a fifth of the points wrong")
    parser.add_argument("--trial", nargs="+", choices=TRIALS, help="choose these constants again")
    parser.add_argument("--frames", type=int, help="at most so many frames of each set")
    parser.add_argument("--every", type=int, default=1, help="only every nth case")
    args = parser.parse_args()
    all_cases = list(cases(args.data, args.rendered, args.frames))[:: args.every]
    if args.trial:
        trial(all_cases, args.trial, (None, args.outliers) if args.outliers else (None,))
    else:
        table(all_cases, args.outliers)


if __name__ == "__main__":
    main()
