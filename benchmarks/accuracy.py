"""The default against everything simple: `python -m benchmarks.accuracy --data PATH [--every 5]`.

For each network, set and number of points, MAE and RMSE in metres, means over frames and seeds of
each frame's error: the network as it is, aligned with the points, refined at the paper's setting,
every baseline of `pnpdepth_cli.choices.BASELINES`, and what `refine` gives without options. The
same network, points and pixels for all: those with known ground truth in the network's crop. Two
columns count frames where the default is not above the aligned network, and at most 3 per cent
above the frame's best baseline. `--outliers 0.2` gives that fraction of the points random depths;
the last column is the default on the inliers alone, as if the outliers were known. `--sigma` adds
the fraction of the ground truth within ± one standard deviation of `--uncertainty`, which should be
68 %. `--render FOLDER` takes frames rendered by this project instead. Even frames of the real sets
were used to choose constants: `--every 4 --first 1` takes odd ones.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.foreign import COMPLETION, as_fastdepth_sees_it, nyu
from benchmarks.frames import (
    SETS,
    EvalFrame,
    frame_inputs,
    frame_pixels,
    points_on_grid,
    refined,
)
from model_zoo_defs.training.learning.dataset import Frames
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.frames.uncertainty import uncertainty
from pnpdepth_cli.models.definition import Normalisation
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

PAPER = Settings()
COUNTS: tuple[int | None, ...] = (20, 100, 500)
ROOMS = ("7scenes", "icl_nuim", "nyu")
RGB = ("compact", "fastdepth", "eigen-tiny", "fcrn-tiny")
STREETS = ("pncnn", "nconv", "sparse2dense-tiny-kitti", "compact")
DEFAULT, INLIERS_ONLY = "default", "default, outliers known"
Errors = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Case:
    """A network on a set of frames with so many points, None for the set's own."""

    network: str
    frames: str
    points: int | None


def cases() -> Iterator[Case]:
    """All that is measured by default."""
    for network in (*RGB, "sparse2dense-tiny", "latefusion-tiny"):
        for frames in ROOMS:
            for points in COUNTS:
                yield Case(network, frames, points)
    for network in STREETS:
        yield Case(network, "kitti_dc", None)


def opened(name: str, data: Path) -> Network:
    """The network with its published or shipped weights."""
    if name == "fastdepth":
        network = load_network(str(data / "weights" / "fastdepth_nyu.onnx"), None)
        definition = replace(network.definition, normalisation=Normalisation())
        return replace(network, definition=definition)
    return load_network(name, (data / "weights" / w) if (w := dict(COMPLETION).get(name)) else None)


def frames_of(
    name: str, data: Path, network: str, every: int = 1, first: int = 0
) -> list[EvalFrame]:
    """Every n-th frame of a set, for FastDepth cut as its own evaluation does; all of NYU."""
    if name == "nyu":
        return nyu(data)
    if name in SETS:
        frames = list(SETS[name](data))[first::every]
        return [as_fastdepth_sees_it(f) for f in frames] if network == "fastdepth" else frames
    shards = Frames(Path(name))
    numbers = range(first, len(shards), every)
    return [EvalFrame(str(n), shards[n][0].astype(np.float32) / 255, shards[n][1]) for n in numbers]


def with_outliers(
    points: SparsePoints, fraction: float, seed: int
) -> tuple[SparsePoints, torch.Tensor]:
    """So many of the points at random depths, from half the nearest to twice the farthest.

    And which they are, (N,) bool.
    """
    generator = torch.Generator().manual_seed(seed)
    outlier = torch.rand(len(points), generator=generator) < fraction
    low, high = float(points.depth.min()) / 2, float(points.depth.max()) * 2
    random = low + (high - low) * torch.rand(len(points), generator=generator)
    depth = torch.where(outlier, random, points.depth)
    return SparsePoints(xy=points.xy, depth=depth, size=points.size), outlier


def measure(
    network: Network,
    frame: EvalFrame,
    count: int | None,
    seed: int,
    outliers: float,
    with_sigma: bool = False,
) -> dict[str, object]:
    """Errors of every variant on one frame, and what the default cost."""
    rows, columns, depth = frame_pixels(frame, count, seed)
    points = points_on_grid(rows, columns, depth, frame.gt.shape)
    points, outlier = with_outliers(points, outliers, seed)
    inputs = frame_inputs(frame.rgb, points, frame.gt)
    definition = network.definition
    layer = resolve_layer(definition, None)
    settings = resolve_settings(definition, Settings())
    start = time.perf_counter()
    raw = refined(network, layer, replace(settings, iterations=0), inputs)
    plain_s = time.perf_counter() - start
    align = "auto" if settings.align == "none" else settings.align
    paper = replace(PAPER, align=settings.align)
    aligned = refined(network, layer, replace(settings, iterations=0, align=align), inputs)
    prediction = torch.from_numpy(raw.before)
    depths = {
        "raw": prediction,
        "aligned": torch.from_numpy(aligned.before),
        "paper": torch.from_numpy(refined(network, layer, paper, inputs).after),
        "tuned": torch.from_numpy(refined(network, layer, settings, inputs).after),
    }
    depths |= {name: baseline.depth(points, prediction) for name, baseline in BASELINES.items()}
    start = time.perf_counter()
    default = by_default(network, inputs)
    default_s = time.perf_counter() - start
    depths[DEFAULT] = torch.from_numpy(default.after)
    if bool(outlier.any()):
        right = points.select(~outlier)
        of_right = frame_inputs(frame.rgb, right, frame.gt)
        inliers_only = by_default(network, of_right)
        depths[INLIERS_ONLY] = torch.from_numpy(inliers_only.after)
    within = {}
    if with_sigma:
        sigma = uncertainty(default).sigma
        known = (frame.gt > 0) & (default.after > 0)
        inside = np.abs(frame.gt - default.after)[known] <= sigma[known]
        within = {"within_sigma": float(inside.mean())}
    return within | {
        "errors": errors_of(depths, torch.from_numpy(frame.gt)),
        "plain_s": plain_s,
        "default_s": default_s,
    }


def by_default(network: Network, inputs: Inputs, seed: int = 0) -> Refined:
    """The frame as `pnpdepth refine` gives it by default."""
    with Refiner(network, Settings(seed=seed)) as refiner:
        return refiner.refine_frame(inputs)


def errors_of(depths: dict[str, torch.Tensor], gt: torch.Tensor) -> Errors:
    """(MAE, RMSE) over the pixels with ground truth where all are known."""
    seen = torch.stack([depth > 0 for depth in depths.values()]).all(dim=0)
    gt = torch.where(seen, gt, 0.0)
    scores = {name: score(depth, gt) for name, depth in depths.items()}
    return {name: (s.mae, s.rmse) for name, s in scores.items()}


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Means over frames of a case, and how often the default is not worse."""
    errors: list[Errors] = [row["errors"] for row in rows]  # type: ignore[misc]
    mean = {
        name: tuple(float(np.mean([each[name][k] for each in errors])) for k in (0, 1))
        for name in errors[0]
    }
    default = np.array([each[DEFAULT][0] for each in errors])
    aligned = np.array([each["aligned"][0] for each in errors])
    best = np.array([min(each[name][0] for name in BASELINES) for each in errors])
    return {
        "frames": len(rows),
        "mean": mean,
        "not above aligned": float((default <= aligned * (1 + 1e-6)).mean()),
        "within 3 % of the best baseline": float((default <= 1.03 * best).mean()),
        "default_s": float(np.median([row["default_s"] for row in rows])),
        "plain_s": float(np.median([row["plain_s"] for row in rows])),
        "within_sigma": float(np.mean([row.get("within_sigma", np.nan) for row in rows])),
    }


def table_row(case: Case, measured: dict[str, object]) -> str:
    """A line of the table."""
    mean: dict[str, tuple[float, float]] = measured["mean"]  # type: ignore[assignment]
    lowest = min(BASELINES, key=lambda name: mean[name][0])
    columns = ("raw", "aligned", "paper", "tuned", "linear", lowest, DEFAULT)
    cells = [f"{mean[name][0]:.3f} / {mean[name][1]:.3f}" for name in columns]
    cells[5] = f"{lowest} {cells[5]}"
    gains = [
        f"{100 * (mean[DEFAULT][0] / mean[name][0] - 1):+.0f} %" for name in ("paper", "linear")
    ]
    wins = [
        f"{measured[name]:.0%}" for name in ("not above aligned", "within 3 % of the best baseline")
    ]
    below = sum(
        mean[DEFAULT][k] < mean[name][k] for name in (*BASELINES, "aligned") for k in (0, 1)
    )
    points = case.points or "LiDAR"
    cost = f"{measured['default_s']:.2f} s ({measured['plain_s']:.2f})"
    head = [case.network, f"{Path(case.frames).name}, {measured['frames']}", str(points)]
    tally = f"{below}/{2 * (len(BASELINES) + 1)}"
    within = f"{measured['within_sigma']:.0%}"
    inliers_only = (
        f"{mean[INLIERS_ONLY][0]:.3f} / {mean[INLIERS_ONLY][1]:.3f}" if INLIERS_ONLY in mean else ""
    )
    return (
        "| " + " | ".join([*head, *cells, *gains, tally, *wins, cost, within, inliers_only]) + " |"
    )


HEAD = (
    "network", "set, frames", "points", "raw", "aligned", "paper's setting", "tuned", "linear",
    "best baseline", DEFAULT, "vs paper", "vs linear", "below", "≤ aligned", "≤ best +3 %",
    "default (plain)", "± 1 σ", INLIERS_ONLY,
)  # fmt: skip


def main() -> None:
    """Measure, and print a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--networks", nargs="+", help="only these")
    parser.add_argument("--sets", nargs="+", help="only these")
    parser.add_argument("--render", type=Path, nargs="+", help="folders of rendered frames instead")
    parser.add_argument("--points", type=int, nargs="+", help="only so many")
    parser.add_argument("--every", type=int, default=5, help="use every n-th frame")
    parser.add_argument("--first", type=int, default=0, help="begin with this frame")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--sigma", action="store_true", help="the standard deviation's coverage")
    parser.add_argument("--json", type=Path, help="everything, to this file")
    args = parser.parse_args()
    wanted = list(cases())
    if args.render:
        wanted = [
            Case(network, str(folder), points)
            for network in args.networks or RGB
            for folder in args.render
            for points in COUNTS
        ]
    wanted = [
        case
        for case in wanted
        if (not args.networks or case.network in args.networks)
        and (not args.sets or case.frames in args.sets)
        and (not args.points or case.points in args.points)
    ]
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    networks: dict[str, Network] = {}
    everything = []
    for case in wanted:
        network = networks.setdefault(case.network, opened(case.network, args.data))
        frames = frames_of(case.frames, args.data, case.network, args.every, args.first)
        seeds = range(args.seeds if case.points else 1)
        runs = [(frame, seed) for seed in seeds for frame in frames]
        rows = [
            measure(network, frame, case.points, seed, args.outliers, args.sigma)
            for frame, seed in tqdm(runs, leave=False, desc=f"{case.network} {case.frames}")
        ]
        measured = summary(rows)
        print(table_row(case, measured), flush=True)
        everything.append({"case": vars(case), "summary": measured, "frames": rows})
        if args.json:
            args.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
