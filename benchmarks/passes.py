"""How often a network runs for one frame: `python -m benchmarks.passes [--models fcrn-tiny]`.

One frame of the indoor sample is refined with a user's network, fused with `compact` and alone, and
every pass of the two is counted by the step that makes it: whole passes, passes of the front, of
the rear with and without a gradient, and backward passes. Beside them stand the processor's seconds
of the whole frame, those spent in each network, and those of one bare pass of each. The second
frame of a network that stays open is that of a batch.

The bound of a frame is what 20 updates and 3 passes of the user's network take, and 15 % of that,
and what the frame spends in `compact`. A network of random weights is updated in `fused` only if
the user says so: `--iterations 5`.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import nn

from benchmarks.first_result import SAMPLE, anything_small
from benchmarks.frames import EvalFrame, drawn_inputs, print_row
from pnpdepth_cli.core import refine_z as updating
from pnpdepth_cli.core.split import Split, gradient_at
from pnpdepth_cli.frames import experts, method, refine_frame, resolve, validation
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.open_network import OpenNetwork, prepare
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

KINDS = ("whole", "front", "rear", "rear, grad", "backward")
STEPS = {
    (resolve, "_with_best_input_range"): "input range",
    (resolve, "default_layer"): "layer",
    (refine_frame, "without_outliers"): "outliers",
    (refine_frame, "with_mirrored"): "mirrored",
    (experts, "_with_blind_expert"): "grey",
}
"""Functions whose passes are a step by themselves."""
ANYTHING = "anything-small"
"""A Hugging Face folder of random weights with the shape of Depth Anything V2 Small."""
RUNS = 3  # of a bare pass or an update, whose median is taken
BOUND_UPDATES = 20
BOUND_PASSES = 3
BOUND_REST = 1.15
"""What a frame may take over these updates and passes, beside `compact`."""


class Passes:
    """Counts the passes of networks, and the processor's seconds in them, while it watches."""

    def __init__(self) -> None:
        self.names: dict[nn.Module, str] = {}
        self.counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
        """How often each kind of pass was made, by network and step."""
        self.seconds: Counter[str] = Counter()
        self._step = ["other"]
        self._last = ""  # network of the last pass
        self._within: list[tuple[str, nn.Module]] = []  # the part of a cut network that runs
        self._kept: SparsePoints | None = None
        self._split_frame = validation.split_frame

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Inside, passes are counted."""
        with ExitStack() as open_:
            for (module, name), step in STEPS.items():
                patched = self._as_step(getattr(module, name), step)
                open_.enter_context(mock.patch.object(module, name, patched))
            for owner, name, stand_in in (
                (OpenNetwork, "refine", self._refine(OpenNetwork.refine)),
                (Split, "front", self._part(Split.front, "front")),
                (Split, "rear", self._part(Split.rear, "rear")),
                (updating, "gradient_at", self._backward(updating.gradient_at)),
                (refine_frame, "split_frame", self._split),
            ):
                open_.enter_context(mock.patch.object(owner, name, stand_in))
            # Hooks of single modules would change what is cached of a cut network.
            hook = nn.modules.module.register_module_forward_pre_hook(self._count)
            open_.callback(hook.remove)
            yield

    def _as_step(self, function: Callable[..., Any], step: str) -> Callable[..., Any]:
        """Returns the function with its passes counted under the name of this step."""

        def run(*args: Any, **kwargs: Any) -> Any:
            self._step.append(step)
            try:
                return function(*args, **kwargs)
            finally:
                self._step.pop()

        return run

    def _split(self, *args: Any, **kwargs: Any) -> Any:
        """Splits off the validation points, and remembers the points that remain."""
        split_frame = self._split_frame(*args, **kwargs)
        self._kept = split_frame.kept.points if len(split_frame.points) else None
        return split_frame

    def _refine(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Returns `OpenNetwork.refine` with its seconds summed up and its passes counted.

        They are counted under the step that calls it. Outside of `STEPS`, "validation points" is
        the step that refines without the validation points, "all points" the one that refines with
        them.
        """

        def run(network: OpenNetwork, frame: Frame, *, updates: bool = True) -> Any:
            step = self._step[-1]
            if step == "other":
                step = "validation points" if frame.points is self._kept else "all points"
                if frame.prior is not None:
                    step += ", prior"
            self._step.append(step)
            start = time.process_time()
            try:
                return function(network, frame, updates=updates)
            finally:
                self.seconds[network.name] += time.process_time() - start
                self._step.pop()

        return run

    def _part(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """Returns a method of `Split` whose passes count as those of this part of the network."""

        def run(split: Split, *args: Any) -> Any:
            self._within.append((part, split._network))
            try:
                return function(split, *args)
            finally:
                self._within.pop()

        return run

    def _backward(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Returns `gradient_at` with each call counted as a backward pass."""

        def run(*args: Any) -> Any:
            self.counts[self._last, self._step[-1]]["backward"] += 1
            return function(*args)

        return run

    def _count(self, module: nn.Module, _inputs: object) -> None:
        """Counts a forward pass; torch calls this before the forward pass of every module."""
        name = self.names.get(module)
        if name is None:
            return
        kind = self._within[-1][0] if self._within else "whole"
        if kind == "rear" and torch.is_grad_enabled():
            kind = "rear, grad"
        self._last = name
        self.counts[name, self._step[-1]][kind] += 1


def sample(count: int) -> Frame:
    """Returns the indoor sample with so many points of its ground truth."""
    gt = read_depth(SAMPLE / "gt.png").values
    return drawn_inputs(EvalFrame("indoor", read_rgb(SAMPLE / "rgb.png").values, gt), count, 0)


def bare_seconds(network: Network, frame: Frame) -> float:
    """Returns the processor's seconds of one forward pass of the network; the median of `RUNS`."""
    arguments = prepare(network, frame).arguments
    spent = list[float]()
    for _ in range(RUNS):
        start = time.process_time()
        with torch.no_grad():
            network.module(*arguments)
        spent.append(time.process_time() - start)
    return statistics.median(spent)


def update_seconds(member: OpenNetwork, frame: Frame) -> float:
    """Returns the processor's seconds of one update of z; the median of `RUNS`.

    An update is a pass of the rear, the part of the network behind the cut, and a backward pass.
    """
    network = member.network
    spent = list[float]()
    with network.cut_at(member.layer) as split:
        z0 = split.front(*prepare(network, frame).arguments)
        # The first pass of the rear is watched operation by operation, so it is not timed.
        with torch.no_grad():
            split.rear(z0)
        for _ in range(RUNS):
            z = z0.detach().requires_grad_()
            start = time.process_time()
            gradient_at(z, network.map_of(split.rear(z)).mean())
            spent.append(time.process_time() - start)
    return statistics.median(spent)


def report(title: str, network: Network, frame: Frame, settings: Settings) -> None:
    """Prints the passes of a first and of a second frame, and the seconds."""
    passes = Passes()
    companion = load_network(method.COMPANION, None)
    passes.names = {network.module: "own", companion.module: "compact"}
    with ExitStack() as open_:
        open_.enter_context(mock.patch.object(method, "load_network", return_value=companion))
        open_.enter_context(passes.watched())
        refiner = open_.enter_context(Method([network], settings, frame))
        spent_on_frame = dict[str, tuple[float, Counter[str]]]()
        for which in ("first", "second"):
            passes.seconds.clear()
            start = time.process_time()
            refiner.refine(frame)
            spent = time.process_time() - start
            for (name, step), counted in passes.counts.items():
                print_row(title, which, name, step, *(counted[kind] or "" for kind in KINDS))
            spent_on_frame[which] = spent, passes.seconds.copy()
            passes.counts.clear()
        member = refiner.members[0]
    # The seconds, beside those of one pass, one update, and the bound.
    bare = bare_seconds(network, frame)
    update = update_seconds(member, frame)
    of_compact = bare_seconds(companion, frame)
    empty = [""] * len(KINDS)
    for which, (spent, seconds) in spent_on_frame.items():
        own = seconds[network.definition.name]
        most = BOUND_REST * (BOUND_UPDATES * update + BOUND_PASSES * bare)
        most += seconds[companion.definition.name]
        times = f"{spent:.2f} s; in the user's network {own:.2f} s; bound {most:.2f} s"
        print_row(title, which, "seconds", times, *empty)
        times = f"{spent / of_compact:.1f} passes of compact"
        print_row(title, which, "seconds", times, *empty)
    print_row(title, "", "one pass", f"{bare:.2f} s, of compact {of_compact:.2f} s", *empty)
    print_row(title, "", "one update", f"{update:.2f} s", *empty)


def main() -> None:
    """Counts the passes of each network, method and number of points, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[20, 100, 500])
    parser.add_argument("--methods", nargs="+", default=["fused", "alone"])
    parser.add_argument("--iterations", type=int, help="updates of z that the user states")
    parser.add_argument("--models", nargs="+", default=["fcrn-tiny", ANYTHING])
    args = parser.parse_args()
    print_row("frame", "", "network", "step", *KINDS, head=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in args.models:
            model = name
            if name == ANYTHING:
                model = anything_small(Path(folder) / "small")
            for chosen in args.methods:
                for count in args.points:
                    network = load_network(model, None)
                    settings = Settings(method=chosen, iterations=args.iterations)
                    title = f"{Path(name).name}, {chosen}, {count}"
                    report(title, network, sample(count), settings)


if __name__ == "__main__":
    main()
