"""What `pnpdepth refine` gives without options: `python -m benchmarks.default --data PATH`.

For each network, set and number of points, means over frames and seeds of the MAE and the RMSE in
metres: linear interpolation, the network's own refinement without any choice, the default, plain
`compact`, and the candidate that is best of all single ones in the mean of the cell: the networks,
their refinements, propagation of these, and the baselines. All are scored on the same pixels, those
with ground truth. `worse` is the fraction of frames where the MAE of the default is above that of
linear interpolation.

Constants of the default were chosen on the even frames of each set (`--half even`); the odd ones
are for reporting.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.accuracy import Case, Errors, errors_of, opened
from benchmarks.frames import (
    REGISTRATIONS,
    SETS,
    EvalFrame,
    drawn_inputs,
    refined,
    registered,
    without_occluded,
)
from pnpdepth_cli.auto.auto import AutoRefined, refine_automatically
from pnpdepth_cli.auto.candidates import Candidate
from pnpdepth_cli.auto.predictions import OpenNetworks
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.load_refiner import refiner_of
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_settings

ROOMS = ("7scenes", "icl_nuim")
COUNTS = (20, 100, 500)
OF_ROOMS = ("fastdepth", "compact", "fcrn-tiny", "eigen-tiny")
OF_STREETS = ("fastdepth", "compact", "sparse2dense-tiny-kitti", "sfmlearner-tiny")
BASELINES = ("linear", "linear-log", "idw", "local")
"""Baselines among the single candidates; the others were nowhere the best."""


def cells() -> Iterator[Case]:
    """All that is measured."""
    for frames in ROOMS:
        for points in COUNTS:
            yield from (Case(network, frames, points) for network in OF_ROOMS)
    yield from (Case(network, "kitti_dc", None) for network in OF_STREETS)


def measure(network: Network, frame: EvalFrame, count: int | None, seed: int) -> dict[str, object]:
    """MAE and RMSE of every column on one frame, the choice, and its time."""
    if count is None:  # as the commands read a projected scan
        frame = without_occluded(frame)
    inputs = drawn_inputs(frame, count, seed)
    refiner = refiner_of(RefineRequest(), [network], inputs)
    assert refiner.competition is not None
    start = time.process_time()
    with OpenNetworks(refiner.networks) as networks:
        auto = refine_automatically(networks, refiner.competition, inputs.frame(), seed=seed)
        seconds = time.process_time() - start
        depths = dict(single_candidates(auto))
    settings = resolve_settings(network.definition, MethodOptions())
    plain = refined(network, refiner.layer, settings, inputs)
    depths |= {
        "unguarded": torch.from_numpy(plain.after),
        "default": torch.from_numpy(auto.frame.after),
    }
    return {
        "errors": errors_of(depths, torch.from_numpy(frame.gt)),
        "choice": str(auto.choice),
        "cpu_s": seconds,
    }


def single_candidates(auto: AutoRefined) -> Iterator[tuple[str, Tensor]]:
    """Depth (H, W) of the candidates that are no mean of several, from all points."""
    for scored in auto.choice.scored:
        candidate = scored.candidate
        of_network = candidate.config is not None
        if of_network or (candidate in {Candidate(baseline=name) for name in BASELINES}):
            yield str(candidate), auto.depths.dense(candidate)


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Means over the frames of a cell."""
    errors: list[Errors] = [row["errors"] for row in rows]  # type: ignore[misc]
    names = [name for name in errors[0] if all(name in each for each in errors)]
    mean = {n: tuple(float(np.mean([e[n][k] for e in errors])) for k in (0, 1)) for n in names}
    singles = [name for name in names if name not in ("default", "unguarded")]
    worse = [each["default"][0] > each["linear"][0] for each in errors]
    return {
        "frames": len(rows),
        "mean": mean,
        "best": min(singles, key=lambda name: mean[name][0]),
        "worse": float(np.mean(worse)),
        "cpu_s": float(np.median([row["cpu_s"] for row in rows])),
        "choices": [row["choice"] for row in rows],
    }


HEAD = (
    "network", "set, runs", "points", "linear", "unguarded", "`compact`", "best single candidate",
    "default", "default / linear", "default / best", "worse",
)  # fmt: skip


def table_row(cell: Case, measured: dict[str, object]) -> str:
    """A line of the table."""
    mean: dict[str, tuple[float, float]] = measured["mean"]  # type: ignore[assignment]
    best = str(measured["best"])

    def pair(name: str) -> str:
        return f"{mean[name][0]:.4f} / {mean[name][1]:.3f}" if name in mean else "–"

    short = best if len(best) < 40 else best.split("(")[0] + "…" + best.split(")")[-1]
    cells_ = [
        *(cell.network, f"{cell.frames}, {measured['frames']}", str(cell.points or "LiDAR")),
        *(pair("linear"), pair("unguarded"), pair("compact")),
        f"{pair(best)} ({short})",
        f"**{pair('default')}**",
        *(f"{mean['default'][0] / mean[name][0]:.3f}" for name in ("linear", best)),
        f"{measured['worse']:.0%}",
    ]
    return "| " + " | ".join(cells_) + " |"


def frames_of(name: str, data: Path, half: str, count: int) -> list[EvalFrame]:
    """`count` evenly spaced frames of one half of a set."""
    frames = list(SETS[name](data))[{"even": 0, "odd": 1}[half] :: 2]
    return [frames[round(i)] for i in np.linspace(0, len(frames) - 1, min(count, len(frames)))]


def main() -> None:
    """Measure, and print a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--half", choices=("even", "odd"), default="odd")
    parser.add_argument("--frames", type=int, default=3, help="frames of each set")
    parser.add_argument("--seeds", type=int, default=1, help="draws of the points of each frame")
    parser.add_argument("--networks", nargs="+", help="only these")
    parser.add_argument("--sets", nargs="+", help="only these")
    parser.add_argument("--points", nargs="+", type=int, help="only these numbers of points")
    parser.add_argument("--registration", choices=REGISTRATIONS, default="frame")
    parser.add_argument("--json", type=Path, help="everything, to this file")
    args = parser.parse_args()
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    networks: dict[str, Network] = {}
    everything = []
    for cell in cells():
        if args.networks and cell.network not in args.networks:
            continue
        if args.sets and cell.frames not in args.sets:
            continue
        if args.points and cell.points is not None and cell.points not in args.points:
            continue
        network = networks.setdefault(cell.network, opened(cell.network, args.data))
        frames = frames_of(cell.frames, args.data, args.half, args.frames)
        seeds = range(args.seeds if cell.points else 1)
        rows = [
            measure(network, frame, cell.points, seed)
            for seed in seeds
            for frame in registered(frames, cell.points, seed, args.registration)
        ]
        measured = summary(rows)
        print(table_row(cell, measured), flush=True)
        everything.append({"cell": vars(cell), "summary": measured, "frames": rows})
        if args.json:
            args.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
