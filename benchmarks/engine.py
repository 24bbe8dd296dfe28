"""How close a refinement comes to one cut by hand: `python -m benchmarks.engine [--runs 15]`.

In one process, in turn: a plain forward pass, its front and rear, refinement with a hand-written
front and rear, ours, and a hook that replaces the layer's output and re-runs the whole network.
K = 5, fp32. The limit is (front + 11·rear)/(front + rear). Peak memory of each is measured in a
process of its own, above that of a plain forward pass.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

from benchmarks.networks import CASES, Case
from pnpdepth_cli.core.points import SparsePoints
from pnpdepth_cli.core.refine import RefineSettings, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.pipeline.stopwatch import peak_memory_mb

ITERATIONS, STEP = 5, 0.01


def setup(case: Case) -> tuple[nn.Module, Tensor, SparsePoints]:
    """The network in eval mode, an input, and 500 points."""
    torch.manual_seed(0)
    network = case.build().eval().requires_grad_(False)
    height, width = case.shape[2:]
    pixels = torch.randperm(height * width)[:500]
    points = SparsePoints(
        xy=torch.stack([pixels % width, pixels // width], dim=1).float(),
        depth=1 + 4 * torch.rand(500),
        size=(height, width),
    )
    return network, torch.rand(case.shape), points


def loop(z: Tensor, rear: Callable[[Tensor], Tensor], points: SparsePoints) -> Tensor:
    """Equation 3 with sign steps, written out."""
    for _ in range(ITERATIONS):
        z = z.detach().requires_grad_(True)
        loss = (points.sample(rear(z)) - points.depth).abs().mean()
        z = z.detach() - STEP * torch.autograd.grad(loss, z)[0].sign()
    with torch.no_grad():
        return rear(z)


def by_hand(network: nn.Module, x: Tensor, points: SparsePoints) -> Tensor:
    """Refinement with the network's own `front` and `rear`."""
    with torch.no_grad():
        z, kept = network.front(x)
    return loop(z, lambda z: network.rear(z, kept), points)


def ours(case: Case, network: nn.Module, x: Tensor, points: SparsePoints) -> Tensor:
    """Refinement by `Split`."""
    settings = RefineSettings(iterations=ITERATIONS, lr=STEP)
    with Split(network, case.layer) as split:
        return refine(split, (x,), points, settings, depth_of=lambda output: output).after


def by_hook(case: Case, network: nn.Module, x: Tensor, points: SparsePoints) -> Tensor:
    """Refinement by a hook that replaces the layer's output, re-running the whole network."""
    layer, seen = network.get_submodule(case.layer), []
    with torch.no_grad():
        handle = layer.register_forward_hook(lambda *call: seen.append(call[2]))
        network(x)
        handle.remove()

    def rear(z: Tensor) -> Tensor:
        handle = layer.register_forward_hook(lambda *_: z.clone())
        try:
            return network(x)
        finally:
            handle.remove()

    return loop(seen[0], rear, points)


def ways(case: Case) -> dict[str, Callable[[], object]]:
    """What is timed, by name."""
    network, x, points = setup(case)
    with torch.no_grad():
        z, kept = network.front(x)
    no_grad = torch.no_grad()
    return {
        "forward": no_grad(lambda: network(x)),
        "front": no_grad(lambda: network.front(x)),
        "rear": no_grad(lambda: network.rear(z, kept)),
        "by hand": lambda: by_hand(network, x, points),
        "ours": lambda: ours(case, network, x, points),
        "by hook": lambda: by_hook(case, network, x, points),
    }


def measure(case: Case, runs: int) -> dict[str, float | str]:
    """Medians in seconds of every way, taken in turn, and the ratios."""
    todo = ways(case)
    a, b, c = (todo[name]() for name in ("by hand", "ours", "by hook"))
    assert torch.equal(a, b)
    assert torch.equal(a, c)
    spent: dict[str, list[float]] = {name: [] for name in todo}
    for _ in range(runs):
        for name, run in todo.items():
            start = time.perf_counter()
            run()
            spent[name].append(time.perf_counter() - start)
    median = {name: statistics.median(times) for name, times in spent.items()}
    limit = (median["front"] + (2 * ITERATIONS + 1) * median["rear"]) / (
        median["front"] + median["rear"]
    )
    ratio = {name: median[name] / median["forward"] for name in ("by hand", "ours", "by hook")}
    paired = [o / h for o, h in zip(spent["ours"], spent["by hand"], strict=True)]
    forward = peak_mb(case, "forward")
    extra = {name: peak_mb(case, name) - forward for name in ("by hand", "ours")}
    return {
        "network": case.name,
        "forward_s": median["forward"],
        "limit": limit,
        **{f"{name} / forward": value for name, value in ratio.items()},
        "ours / limit": ratio["ours"] / limit,
        "ours / by hand": statistics.median(paired),
        "extra MB by hand": extra["by hand"],
        "extra MB ours": extra["ours"],
        "extra memory ours / by hand": extra["ours"] / extra["by hand"],
    }


def peak_mb(case: Case, way: str) -> float:
    """Peak resident memory of a new process that does this once after a forward pass."""
    command = [sys.executable, "-m", "benchmarks.engine", "--peak", case.name, way]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--peak", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.peak:
        todo = ways(next(case for case in CASES if case.name == args.peak[0]))
        todo["forward"]()
        todo[args.peak[1]]()
        print(peak_memory_mb(torch.device("cpu"))["process"])
        return
    results = [measure(case, args.runs) for case in CASES]
    if args.json:
        print(json.dumps(results, indent=2))
        return
    print(
        f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads,"
        f" torch {torch.__version__}, fp32, K = {ITERATIONS}, {args.runs} runs, medians\n"
    )
    print("| " + " | ".join(results[0]) + " |")
    print("|" + "---|" * len(results[0]))
    for row in results:
        cells = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values())
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
