"""Coverage of the standard deviation: python -m benchmarks.uncertainty DATA.

The fraction of the ground truth within ± 1 to ± 4 standard deviations of the depth, with the
default method, on odd frames; the constants were chosen on even frames.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.frames import (
    SETS,
    EvalFrame,
    by_default,
    drawn_inputs,
    opened,
    print_row,
    without_occluded,
)
from pnpdepth_cli.frames.uncertainty import with_uncertainty
from pnpdepth_cli.models.network import Network

MULTIPLES = (1, 2, 3, 4)
LARGE_ERROR = 0.25  # of the depth
FRAMES = {"kitti_dc": (1, 3, 5), "7scenes": (5, 25, 45), "icl_nuim": (1, 9, 17)}
CASES = (
    ("kitti_dc", "compact", None),
    *(
        (name, network, count)
        for name in ("7scenes", "icl_nuim")
        for count in (100, 500)
        for network in ("fastdepth", "compact")
    ),
)


def coverage(network: Network, frame: EvalFrame, count: int | None) -> list[float]:
    """Fractions of the ground truth within ± 1, 2, 3 and 4 σ, of large errors masked, and kept."""
    if count is None:
        frame = without_occluded(frame)
    result = by_default(network, drawn_inputs(frame, count, 0))
    result = with_uncertainty(result)
    sigma, valid = result.sigma, result.valid
    assert sigma is not None
    assert valid is not None
    known = frame.gt > 0
    ratio = np.abs(frame.gt - result.after)[known] / sigma[known]
    wrong = known & (np.abs(frame.gt - result.after) > LARGE_ERROR * frame.gt)
    caught = float((~valid[wrong]).mean()) if wrong.any() else 1.0
    within = [float((ratio <= multiple).mean()) for multiple in MULTIPLES]
    return [*within, caught, float(valid[known].mean())]


def main() -> None:
    """Print the table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with kitti_dc, 7scenes, icl_nuim")
    data = parser.parse_args().data
    within = (f"within ± {multiple} σ" for multiple in MULTIPLES)
    print_row("set", "points", "network", *within, "errors masked", "kept", head=True)
    for name, network_name, count in CASES:
        network, frames = opened(network_name, data), list(SETS[name](data))
        means = np.mean([coverage(network, frames[n], count) for n in FRAMES[name]], axis=0)
        print_row(name, count or "LiDAR", network_name, *(f"{mean:.0%}" for mean in means))


if __name__ == "__main__":
    main()
