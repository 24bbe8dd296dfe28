"""The default beside every fixed method and baseline: `python -m benchmarks.accuracy --data PATH`.

For each network, set and number of points, means over frames and seeds of the MAE and the RMSE in
metres, CPU seconds, and the fraction of frames whose MAE is above that of linear interpolation: the
network as it is and aligned with the points, refined at the paper's setting and with the settings
of its definition, every baseline, and what `refine` gives without options. All are scored on the
same pixels. Points are drawn from the ground truth; KITTI's are its own LiDAR's.
`--outliers 0.2` gives that fraction of the points random depths. Constants were chosen on even
frames: `--every 2 --first 1` takes odd ones.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.frames import (
    MORE_SETS,
    REGISTRATIONS,
    SETS,
    EvalFrame,
    as_fastdepth_sees_it,
    by_default,
    drawn_inputs,
    errors_of,
    opened,
    print_row,
    refined,
    registered,
    rendered,
    with_outliers,
    without_occluded,
)
from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.frames.frame import DepthMap, Frame
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.settings import PAPER, Settings

METHODS: Mapping[str, Settings] = {
    "aligned": Settings(iterations=0, align="auto"),
    "paper": PAPER,
    "tuned": Settings(),
}
"""What is refined how; of the paper's setting nothing is the network's own."""
NETWORKS = ("compact", "fastdepth", "eigen-tiny", "fcrn-tiny", "sparse2dense-tiny")
COUNTS = (20, 100, 500)


def by_method(network: Network, name: str, inputs: Frame, seed: int) -> tuple[DepthMap, DepthMap]:
    """The plain and the refined depth."""
    method = METHODS[name]
    if method is PAPER:
        own = network.definition.default_alignment
        layer = resolve_layer(network.definition, None)
        settings = replace(method, align=own).closed()
    else:
        layer = resolve_layer(network.definition, method.layer)
        settings = resolve_settings(network.definition, replace(method, seed=seed))
    result = refined(network, layer, settings, inputs)
    return result.before, (result.after if settings.iterations else result.before)


def measure(
    network: Network, frame: EvalFrame, count: int | None, seed: int, args: argparse.Namespace
) -> dict[str, dict[str, float]]:
    """MAE, RMSE and CPU seconds of everything on one frame."""
    inputs = drawn_inputs(frame, count, seed)
    inputs = replace(inputs, points=with_outliers(inputs.points, args.outliers, seed))
    depths, seconds = dict[str, torch.Tensor](), dict[str, float]()

    def timed(name: str, depth: Callable[[], torch.Tensor]) -> None:
        start = time.process_time()
        depths[name] = depth()
        seconds[name] = time.process_time() - start

    plain = by_method(network, "tuned", inputs, seed)[0]
    timed("plain", lambda: torch.from_numpy(plain))
    for name in args.methods:
        timed(name, lambda name=name: torch.from_numpy(by_method(network, name, inputs, seed)[1]))
    for name, baseline in BASELINES.items():
        timed(name, lambda fit=baseline: fit.depth(inputs.points, depths["plain"]))
    start = time.process_time()
    default = by_default(network, inputs)
    seconds["default"] = time.process_time() - start
    depths["default"] = torch.from_numpy(default.after)
    scores = errors_of(depths, torch.from_numpy(frame.gt))
    return {
        name: {"mae": mae, "rmse": rmse, "cpu_s": seconds[name]}
        for name, (mae, rmse) in scores.items()
    }


def frames_of(name: str, network: str, args: argparse.Namespace) -> list[EvalFrame]:
    """Every n-th frame of a set; FastDepth's are cut as in its own evaluation."""
    sets = SETS | MORE_SETS
    every = list(sets[name](args.data)) if name in sets else rendered(Path(name))
    frames = every[args.first :: args.every]
    if name == "kitti_dc":  # as the commands read a projected scan
        return [without_occluded(frame) for frame in frames]
    return [as_fastdepth_sees_it(frame) for frame in frames] if network == "fastdepth" else frames


def print_case(head: tuple[object, ...], frames: list[dict[str, dict[str, float]]]) -> None:
    """Prints a row for each method: means over the frames."""
    for name in frames[0]:
        mean = {k: float(np.mean([each[name][k] for each in frames])) for k in frames[0][name]}
        worse = np.mean([each[name]["mae"] > each["linear"]["mae"] for each in frames])
        cells = (f"{mean['mae']:.4f}", f"{mean['rmse']:.4f}", f"{mean['cpu_s']:.2f}")
        print_row(*head, len(frames), name, *cells, f"{worse:.0%}")


def main() -> None:
    """Measure, and print a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--networks", nargs="+", default=NETWORKS)
    parser.add_argument("--sets", nargs="+", default=list(SETS), help="or folders of rendered ones")
    parser.add_argument("--points", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["aligned", "paper"])
    parser.add_argument("--every", type=int, default=5, help="use every n-th frame")
    parser.add_argument("--first", type=int, default=0, help="begin with this frame")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--registration", choices=REGISTRATIONS, default="off")
    parser.add_argument("--json", type=Path, help="everything, to this file")
    args = parser.parse_args()
    head = ("network", "set", "points", "frames", "method", "MAE", "RMSE", "CPU s", "worse")
    print_row(*head, head=True)
    everything = []
    for name in args.networks:
        network = opened(name, args.data)
        for frames_name in args.sets:
            counts = (None,) if frames_name == "kitti_dc" else args.points
            for count in counts:
                rows = [
                    measure(network, frame, count, seed, args)
                    for seed in range(args.seeds if count else 1)
                    for frame in registered(
                        frames_of(frames_name, name, args), count, seed, args.registration
                    )
                ]
                case = (name, Path(frames_name).name, count or "LiDAR")
                print_case(case, rows)
                everything.append({"case": case, "frames": rows})
                if args.json:
                    args.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
