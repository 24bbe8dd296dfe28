"""What torch.compile would gain: refinement cut by hand, eager and compiled, fp32 and bf16.

    python -m benchmarks.compiled [--runs 9] [--only NAME ...] [--batch 8]

For the paper's seven networks at full size, random weights, K = 5: milliseconds of a refinement
with a hand-written front and rear, eager and with both compiled (torch's inductor, its C++ on a
CPU), the seconds that compiling took, and after how many frames they are won back. In bf16 both run
under autocast. `difference` is that of the depth, relative, where the updates may differ in sign.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from benchmarks.engine import CPU, loop, output_points, print_rows, setup
from benchmarks.hand_cuts import ZOO
from benchmarks.networks import Case
from pnpdepth_cli.models.precision import lower
from pnpdepth_cli.pipeline.bench import in_turn


def refined(
    case: Case, precision: str, batch: int, wrap: Callable[[Any], Any]
) -> Callable[[], Tensor]:
    """A refinement of a batch of equal frames, front and rear wrapped."""
    network, inputs, points = setup(case)
    if precision == "bf16":
        lower(network, torch.bfloat16, CPU)
    inputs = tuple(one.expand(batch, *one.shape[1:]).contiguous() for one in inputs)
    loss_of = output_points(case, points)
    front, rear = wrap(case.front), wrap(case.rear)

    def cast() -> AbstractContextManager[Any]:
        return torch.autocast("cpu", torch.bfloat16) if precision == "bf16" else nullcontext()

    def loss(output: Tensor) -> Tensor:
        return torch.stack([loss_of(one[None]) for one in output.float()]).sum()

    def run() -> Tensor:
        with cast():
            with torch.no_grad():
                z, kept = front(network, *inputs)
            return loop(z.float(), lambda z: rear(network, z, kept), loss)

    return run


def measure(case: Case, precision: str, batch: int, runs: int) -> dict[str, object]:
    eager = refined(case, precision, batch, lambda part: part)
    torch._dynamo.reset()
    compiled = refined(case, precision, batch, lambda part: torch.compile(part, dynamic=False))
    expected = eager()
    began = time.perf_counter()
    measured = compiled()
    compiling = time.perf_counter() - began
    spent = in_turn(
        {
            "eager": eager,
            "compiled": compiled,
        },
        runs,
        CPU,
    )
    one, other = (statistics.median(spent[name]) for name in ("eager", "compiled"))
    won = batch * compiling / (one - other) if one > other else float("inf")
    return {
        "network": case.name,
        "precision": precision,
        "eager, ms": 1000 * one,
        "compiled, ms": 1000 * other,
        "eager / compiled": one / other,
        "compiling, s": compiling,
        "won back after frames": won,
        "difference": float(
            ((measured - expected).abs() / expected.abs().clamp(min=1e-3)).median()
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[case.name for case in ZOO])
    args = parser.parse_args()
    rows = []
    for case in ZOO:
        for precision in ("fp32", "bf16") if case.name in args.only else ():
            print(case.name, precision, file=sys.stderr)
            rows.append(measure(case, precision, args.batch, args.runs))
            print(rows[-1], file=sys.stderr)
    print_rows(rows)


if __name__ == "__main__":
    main()
