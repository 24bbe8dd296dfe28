"""Coverage of the standard deviation: python -m benchmarks.uncertainty DATA.

The fraction of the ground truth within ± 1 to ± 4 standard deviations of the depth, with the
default choice and with `--preset fast`, on odd frames; the constants were chosen on even frames.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.accuracy import opened
from benchmarks.frames import (
    SETS,
    EvalFrame,
    drawn_inputs,
    without_occluded,
)
from pnpdepth_cli.auto.auto import refine_automatically
from pnpdepth_cli.auto.predictions import OpenNetworks
from pnpdepth_cli.auto.uncertainty import uncertainty
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.load_refiner import refiner_of
from pnpdepth_cli.pipeline.refinement.request import HoldOut, MethodOptions, RefineRequest

MULTIPLES = (1, 2, 3, 4)
FRAMES = {"kitti_dc": (1, 3, 5), "7scenes": (5, 25, 45), "icl_nuim": (1, 9, 17)}
CASES = (
    *(("kitti_dc", "compact", None, preset) for preset in (None, "fast")),
    *(
        (name, network, count, preset)
        for name in ("7scenes", "icl_nuim")
        for count in (100, 500)
        for network, preset in (("fastdepth", None), ("compact", "fast"))
    ),
)


def coverage(
    network: Network, frame: EvalFrame, count: int | None, preset: str | None
) -> list[float]:
    """Fractions of the ground truth within ± 1, 2, 3 and 4 σ."""
    if count is None:
        frame = without_occluded(frame)
    inputs = drawn_inputs(frame, count, 0)
    request = RefineRequest(method=MethodOptions(preset=preset), hold_out=HoldOut(uncertainty=True))
    refiner = refiner_of(request, [network], inputs)
    assert refiner.competition is not None
    with OpenNetworks(refiner.networks) as networks:
        result = refine_automatically(networks, refiner.competition, inputs.frame())
        sigma = uncertainty(result, result.frame.after).sigma
    known = frame.gt > 0
    ratio = np.abs(frame.gt - result.frame.after)[known] / sigma[known]
    return [float((ratio <= multiple).mean()) for multiple in MULTIPLES]


def rows(data: Path) -> Iterator[str]:
    """A line of the table for each case."""
    for name, network_name, count, preset in CASES:
        network = opened(network_name, data)
        frames = list(SETS[name](data))
        means = np.mean(
            [coverage(network, frames[each], count, preset) for each in FRAMES[name]], axis=0
        )
        method = "default" if preset is None else f"--preset {preset}"
        yield (
            f"| {name} | {count or 'LiDAR'} | {network_name}, {method} |"
            + "".join(f" {mean:.0%} |" for mean in means)
        )


def main() -> None:
    """Print the table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with kitti_dc, 7scenes, icl_nuim")
    within = "".join(f" within ± {multiple} σ |" for multiple in MULTIPLES)
    print(f"| set | points | network, method |{within}\n|---|---|---|" + "---|" * len(MULTIPLES))
    for row in rows(parser.parse_args().data):
        print(row, flush=True)


if __name__ == "__main__":
    main()
