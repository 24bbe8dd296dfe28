"""How close a refinement comes to one cut by hand, and how far ahead of the paper's code it is.

    python -m benchmarks.engine [--runs 15] [--only NAME …]

For the paper's seven networks at full size, random weights, K = 5, in one process, in turn: a plain
forward pass, its front and rear, refinement with a hand-written front and rear, ours (a network
that stays open from frame to frame, as in a batch), ours opened anew for one frame, a hook that
replaces the layer's output and re-runs the whole network, and a loop written after the description
of the paper's PyTorch code: the front with gradients on, `create_graph=True`. The limit is
(front + 11·rear)/(front + rear).
"""

from __future__ import annotations

import argparse
import contextlib
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.frames import print_row
from benchmarks.hand_cuts import ZOO, Case
from pnpdepth_cli.core.refine_z import refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings

ITERATIONS = 5
"""K of the paper."""
STEP = 0.01
"""α of the paper."""
POINTS = 500
"""Points that the loss is taken at, as in most rows of the paper's tables."""
SETTINGS = ClosedSettings(iterations=ITERATIONS, lr=STEP)
COMPARED = ("by hand", "ours", "ours, one frame", "by hook", "paper's code")
"""What gives the same, bit for bit."""

Inputs = tuple[Tensor, ...]


class Prepared(NamedTuple):
    """What all variants refine."""

    network: nn.Module  # in eval mode
    inputs: Inputs
    points: SparsePoints


def setup(case: Case) -> Prepared:
    """Returns the network, random inputs, and 500 points of random depth, 1 to 5 m."""
    torch.manual_seed(0)
    network = case.network()
    height, width = case.size
    pixels = torch.randperm(height * width)[:POINTS]
    points = SparsePoints(
        xy=torch.stack([pixels % width, pixels // width], dim=1).float(),
        depth=1 + 4 * torch.rand(POINTS),
        size=case.size,
    )
    inputs = tuple(
        points.scatter() if channels == 1 else torch.rand(1, channels, *case.size)
        for channels in case.channels
    )
    return Prepared(network, inputs, points)


def loss_at(points: SparsePoints) -> Callable[[Tensor], Tensor]:
    """Returns a function from the network's output to its mean |error| at the points, in metres.

    The output may be of another size than the image.
    """
    return lambda output: (points.sample(output) - points.depth).abs().mean()


def loop(
    z: Tensor, rear: Callable[[Tensor], Tensor], loss_of: Callable[[Tensor], Tensor]
) -> Tensor:
    """Returns the output after K sign steps that lower the loss, equation 3 of the paper.

    Args:
        z: Output of the cut layer, to start from.
        rear: Function from z to the network's output.
        loss_of: Function from the output to the loss.
    """
    for _ in range(ITERATIONS):
        z = z.detach().requires_grad_(True)
        z = z.detach() - STEP * torch.autograd.grad(loss_of(rear(z)), z)[0].sign()
    with torch.no_grad():
        return rear(z)


def by_hand(case: Case, network: nn.Module, inputs: Inputs, points: SparsePoints) -> Tensor:
    """Returns the output, refined with a front and a rear that are written for this network."""
    with torch.no_grad():
        z, kept = case.front(network, *inputs)
    return loop(z, lambda z: case.rear(network, z, kept), loss_at(points))


def by_split(split: Split, inputs: Inputs, points: SparsePoints) -> Tensor:
    """Returns the output, refined with a cut network that stays open from frame to frame."""
    return refine(split, inputs, points, SETTINGS, depth_of=lambda output: output.float()).after


def by_new_split(case: Case, network: nn.Module, inputs: Inputs, points: SparsePoints) -> Tensor:
    """Returns the output, refined with a network that is cut for this frame alone."""
    with Split(network, case.layer) as split:
        return by_split(split, inputs, points)


def by_hook(case: Case, network: nn.Module, inputs: Inputs, points: SparsePoints) -> Tensor:
    """Returns the output, refined by a hook that replaces the layer's output by z.

    Each step runs the whole network again.
    """
    # The hook is on the module; "[0]" names the first of the outputs that it returns.
    layer = network.get_submodule(case.layer.removesuffix("[0]"))
    outputs: list[object] = []

    def replaced(output: object, z: Tensor) -> object:
        """Returns z in the place of the output, or of the first of several."""
        return (z, *output[1:]) if isinstance(output, tuple) else z

    with torch.no_grad():
        # A hook is called with the module, its inputs and its output.
        handle = layer.register_forward_hook(lambda *call: outputs.append(call[2]))
        network(*inputs)
        handle.remove()

    def rear(z: Tensor) -> Tensor:
        """Returns what the network gives if its layer gives z."""
        # A copy, as the network may change it in place.
        handle = layer.register_forward_hook(lambda *call: replaced(call[2], z.clone()))
        try:
            return network(*inputs)
        finally:
            handle.remove()

    z0 = outputs[0][0] if isinstance(outputs[0], tuple) else outputs[0]
    assert isinstance(z0, Tensor)
    return loop(z0, rear, loss_at(points))


def by_papers_code(case: Case, network: nn.Module, inputs: Inputs, points: SparsePoints) -> Tensor:
    """Returns the output, refined as the authors' PyTorch code does it.

    That code makes one update less than it is told, by mistake; here all K are made.

    The network's parameters ask for gradients, the front's graph is built, and each gradient is
    taken with `create_graph`.
    """
    loss_of = loss_at(points)
    network.requires_grad_(True)
    try:
        z, kept = case.front(network, *inputs)
        for _ in range(ITERATIONS):
            z = z.detach().requires_grad_(True)
            output = case.rear(network, z, kept)
            gradient = torch.autograd.grad([loss_of(output)], [z], create_graph=True)[0]
            z = z - STEP * gradient.sign()
        return case.rear(network, z.detach().requires_grad_(True), kept).detach()
    finally:
        network.requires_grad_(False)


@contextlib.contextmanager
def variants(case: Case) -> Iterator[dict[str, Callable[[], object]]]:
    """Gives what is timed: functions without arguments, each of which runs once, by name.

    The names are those of `COMPARED`, which refine, and the forward pass, the front and the rear.
    """
    network, inputs, points = setup(case)
    # As a decorator: the function that it returns runs without gradients.
    no_grad = torch.no_grad()
    with torch.no_grad():
        z, kept = case.front(network, *inputs)
    # A network is intercepted as long as its cut is open: a copy, so that the others are not.
    twin = case.network()
    twin.load_state_dict(network.state_dict())
    with Split(twin, case.layer) as split:
        arguments = (case, network, inputs, points)
        yield {
            "forward": no_grad(lambda: network(*inputs)),
            "front": no_grad(lambda: case.front(network, *inputs)),
            "rear": no_grad(lambda: case.rear(network, z, kept)),
            "by hand": lambda: by_hand(*arguments),
            "ours": lambda: by_split(split, inputs, points),
            "ours, one frame": lambda: by_new_split(*arguments),
            "by hook": lambda: by_hook(*arguments),
            "paper's code": lambda: by_papers_code(*arguments),
        }


def measure(case: Case, runs: int) -> dict[str, float | str]:
    """Returns a row of the table: the median of so many runs of each variant, and their ratios."""
    with variants(case) as todo:
        # All variants give the same, bit for bit.
        results = [todo[name]() for name in COMPARED]
        for name, result in zip(COMPARED, results, strict=True):
            assert torch.equal(results[0], result), f"{case.name}: {name} differs"
        spent = in_turn(todo, runs)
    # Times over that of a forward pass, and paired with each other.
    median = {name: statistics.median(times) for name, times in spent.items()}
    limit = (median["front"] + (2 * ITERATIONS + 1) * median["rear"]) / (
        median["front"] + median["rear"]
    )
    ratio = {name: median[name] / median["forward"] for name in COMPARED}

    def paired(one: str, other: str) -> float:
        """Returns the median ratio of the times of two variants, run by run."""
        pairs = zip(spent[one], spent[other], strict=True)
        return statistics.median(a / b for a, b in pairs)

    return {
        "network": f"{case.name}, {case.size[0]}×{case.size[1]}",
        "forward, ms": 1000 * median["forward"],
        "limit": limit,
        **ratio,
        "ours / limit": ratio["ours"] / limit,
        "ours / by hand": paired("ours", "by hand"),
        "ours / paper's code": paired("ours", "paper's code"),
        "one frame / paper's code": paired("ours, one frame", "paper's code"),
    }


def in_turn(todo: Mapping[str, Callable[[], object]], runs: int) -> dict[str, list[float]]:
    """Returns the seconds of every run of each function, without those of a first round.

    They run in turn, so that other load on the machine slows all of them alike.
    """
    spent: dict[str, list[float]] = {name: [] for name in todo}
    for number in range(-1, runs):
        for name, run in todo.items():
            start = time.perf_counter()
            run()
            if number >= 0:
                spent[name].append(time.perf_counter() - start)
    return spent


def main() -> None:
    """Measures the networks in turn, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=15, help="runs of each variant")
    all_names = [case.name for case in ZOO]
    parser.add_argument("--only", nargs="+", default=all_names, help="only these networks")
    args = parser.parse_args()
    results = []
    for case in ZOO:
        if case.name in args.only:
            print(case.name, file=sys.stderr)
            results.append(measure(case, args.runs))
    print(
        f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads,"
        f" torch {torch.__version__}, fp32, K = {ITERATIONS}, {args.runs} runs, medians; in units"
        " of a forward pass unless noted\n"
    )
    for number, row in enumerate(results):
        # The head is the names of the first row's cells.
        if number == 0:
            print_row(*row, head=True)
        cells = [f"{cell:.3g}" if isinstance(cell, float) else cell for cell in row.values()]
        print_row(*cells)


if __name__ == "__main__":
    main()
