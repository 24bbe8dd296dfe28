"""One setting changed at a time: what it does to the result of each method.

`python -m benchmarks.one_setting DATA` prints, for each network and setting, the mean over frames
of the MAE with that setting over the MAE without any, for the methods `alone` and `fused`. A
setting tunes one step of the method, so that no row should be far from 1.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.frames import (
    EvalFrame,
    drawn_inputs,
    frames_of,
    opened,
    print_row,
    without_occluded,
)
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.measures import score
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.settings import Settings

NETWORKS = {
    "7scenes": ("fastdepth", "fcrn-tiny", "eigen-tiny", "sparse2dense-tiny", "compact"),
    "icl_nuim": ("fastdepth", "fcrn-tiny", "eigen-tiny", "latefusion-tiny", "compact"),
    "kitti_dc": ("sfmlearner-tiny", "sparse2dense-tiny-kitti", "adnn-tiny", "compact"),
}
METHODS = ("alone", "fused")
RULES = ("sign", "sgd", "normalised", "momentum", "adam")
LOSSES = ("l1", "l2", "huber", "berhu", "cauchy")


def settings_of(network: Network) -> Iterator[dict[str, Any]]:
    """Yields the settings that are changed, one at a time."""
    yield from ({"iterations": count} for count in (5, 10, 40))
    lr = str(network.definition.defaults.closed().lr)
    value = float(lr.removesuffix("%"))
    unit = "%" if lr.endswith("%") else ""
    yield from ({"lr": f"{factor * value:g}{unit}"} for factor in (0.5, 2))
    yield from ({"loss": loss} for loss in LOSSES)
    yield from ({"update": rule} for rule in RULES)
    if len(network.definition.layers) > 1:
        yield from ({"layer": fraction} for fraction in ("0", "0.5", "1"))


def mae_of(
    network: Network, frame: EvalFrame, count: int | None, settings: Settings
) -> float | None:
    """Returns the MAE in metres; None where the refinement diverged."""
    inputs = drawn_inputs(frame, count, 0)
    with Method([network], settings, inputs) as method:
        refined = method.refine(inputs)
    if refined.diverged is not None:
        return None
    return score(torch.from_numpy(refined.depth), torch.from_numpy(frame.gt))["mae"]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, help="folder with the sets")
    parser.add_argument("--frames", type=int, default=2, help="frames a set")
    parser.add_argument("--points", type=int, default=100, help="points of a room")
    parser.add_argument("--networks", nargs="*", help="only these networks")
    args = parser.parse_args()
    print_row("set", "network", "method", "setting", "MAE / MAE without", head=True)
    for name, networks in NETWORKS.items():
        frames = frames_of(name, args.data, args.frames)
        count = args.points
        if name == "kitti_dc":
            frames = [without_occluded(frame) for frame in frames]
            count = None
        for network_name in networks:
            if args.networks and network_name not in args.networks:
                continue
            network = opened(network_name, args.data)
            for (method, setting), ratios in ratios_of(network, frames, count).items():
                print_row(name, network_name, method, setting, f"{np.mean(ratios):.3f}")


def ratios_of(
    network: Network, frames: Sequence[EvalFrame], count: int | None
) -> dict[tuple[str, str], list[float]]:
    """Returns each frame's MAE with a setting over its MAE without any, by method and setting.

    It is NaN where the refinement diverged. `count` is the number of points; None: all of a LiDAR.
    """
    ratios = defaultdict[tuple[str, str], list[float]](list)
    for frame in frames:
        for method in METHODS:
            plain = Settings(method=method)
            before = mae_of(network, frame, count, plain)
            for changed in settings_of(network):
                after = mae_of(network, frame, count, replace(plain, **changed))
                ((setting, value),) = changed.items()
                ratio = np.nan if before is None or after is None else after / before
                ratios[method, f"{setting} {value}"].append(ratio)
    return ratios


if __name__ == "__main__":
    main()
