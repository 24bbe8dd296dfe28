"""Passes of a cut network by a recording: saved outputs in front of the cut, z at it."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.tensors import SavedTensors, map_tensors, tensors_in
from pnpdepth_cli.errors import PnpDepthError

if TYPE_CHECKING:
    from pnpdepth_cli.core.split.recorder import Recorder


Run = Callable[[], object]
"""Runs a call of a submodule; returns its output."""

Handler = Callable[[nn.Module, object, Run], object]
"""Called with a submodule, its inputs (args, kwargs) and a function that runs it."""


class Interception:
    """Replaces `forward` of submodules, and puts their own back.

    Args:
        modules: The submodules, each once.
    """

    def __init__(self, modules: Iterable[nn.Module]) -> None:
        self._handler: Handler = _run_only
        self._own = {module: module.__dict__.get("forward") for module in modules}
        for module in self._own:
            module.__dict__["forward"] = self._stand_in(module, module.forward)

    def close(self) -> None:
        """Gives every submodule its own forward back, and lets go of the handler."""
        for module, own_forward in self._own.items():
            module.__dict__["forward"] = own_forward
            if own_forward is None:
                del module.__dict__["forward"]
        self._handler = _run_only

    @contextmanager
    def handled_by(self, during: Handler, afterwards: Handler) -> Iterator[None]:
        """Sets the handler of intercepted calls during and after the block."""
        self._handler = during
        try:
            yield
        finally:
            self._handler = afterwards

    def _stand_in(
        self, module: nn.Module, original: Callable[..., object]
    ) -> Callable[..., object]:
        @functools.wraps(original)
        def forward(*args: object, **kwargs: object) -> object:
            return self._handler(module, (args, kwargs), lambda: original(*args, **kwargs))

        return forward


def _run_only(module: nn.Module, inputs: object, run: Run) -> object:
    return run()


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedCall:
    """One call of a submodule that every pass makes."""

    module: nn.Module
    cached: bool  # whether later passes return its saved output instead of running it
    copied: bool = False  # whether the network changes that output in place


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """The calls of a pass in their order, up to the cut or to the end."""

    calls: tuple[RecordedCall, ...] = ()
    """The calls that are cached, or that contain the cut or calls of their own."""
    cut: int | None = None  # index of the call that is the cut; None before it was reached
    path: tuple[str, ...] = ()  # path of z in the output of that call
    shapes: object = None  # shapes and other properties of the arguments for which this holds
    static_graph: bool = False  # whether it holds for all arguments of these shapes
    complete: bool = False  # whether the calls behind the cut are in it, too

    def index(self, module: nn.Module, count: int) -> int | None:
        """Returns the index of the module's call after `count` earlier ones of a pass."""
        indices = self._indices.get(module, ())
        return indices[count] if count < len(indices) else None

    def holds_for(self, arguments: Sequence[object]) -> bool:
        """Whether a pass with these arguments makes the same calls."""
        return self.complete and self.static_graph and self.shapes == shapes_of(arguments)

    @functools.cached_property
    def _indices(self) -> dict[nn.Module, list[int]]:
        indices: dict[nn.Module, list[int]] = {}
        for index, call in enumerate(self.calls):
            indices.setdefault(call.module, []).append(index)
        return indices


def shapes_of(arguments: Sequence[object]) -> object:
    """Returns what arguments must share for a network without branches to treat them alike."""
    tensors = [(t.shape, t.dtype, t.device) for _, t in tensors_in(tuple(arguments))]
    return tensors, repr(map_tensors(tuple(arguments), lambda _, t: t.new_empty(0)))


class CutReached(PnpDepthError):
    """Ends the front's pass at the cut. A network that catches it gets it at the next submodule."""


class Replay:
    """The saved tensors of the frame at hand, and the handler of intercepted calls.

    In the learning passes, calls that the recording does not know go to the `recorder`.

    Args:
        arguments: Arguments of the network for the first frame.
    """

    def __init__(self, cut: CutPoint, arguments: Sequence[object]) -> None:
        self._cut = cut
        self.recording = Recording()
        self.arguments = SavedTensors(_copies(arguments))
        self.outputs: list[SavedTensors | None] = []
        """Output of each recorded call; None where it is not cached or did not run yet."""
        self.z0: Tensor | None = None
        self.z: Tensor | None = None
        self.calls: Counter[nn.Module] = Counter()
        """How often each submodule was called in the last pass."""
        self.recorder: Recorder | None = None
        self._fills = False  # inside a call whose output will be saved as a whole

    def next_frame(self, arguments: Sequence[object]) -> None:
        """Forgets the frame at hand; `arguments` are those of the next one."""
        self.arguments = SavedTensors(_copies(arguments), self.arguments.copied)
        self.outputs, self.z0, self.z = [None] * len(self.recording.calls), None, None

    @property
    def has_front(self) -> bool:
        """Whether the front of the frame at hand has run, and no rear yet."""
        return self.z0 is not None and self.z is None

    def end_of_front(self) -> CutReached:
        """Returns the exception that ends the front's pass."""
        return CutReached(f"layer {self._cut.layer!r} was reached, where the network is cut")

    def handle(self, module: nn.Module, inputs: object, run: Run) -> object:
        """Returns the output of a call in a pass: saved, with z in it, or of the submodule."""
        if self._fills:
            return run()
        if self.has_front:
            raise self.end_of_front()
        if self.recorder is not None:
            run = functools.partial(self.recorder.run, module, run)
        index = self.recording.index(module, self.calls[module])
        self.calls[module] += 1
        if index is None:
            return run() if self.recorder is None else self.recorder.record(module, inputs, run)
        is_cut = index == self.recording.cut
        if is_cut and self.z0 is not None:
            return self._output_with_z(run)
        output = self._saved_output(index, run)
        if is_cut:
            self.z0 = dict(tensors_in(output))[self.recording.path].detach()
            raise self.end_of_front()
        return output

    def handle_outside(self, module: nn.Module, inputs: object, run: Run) -> object:
        """Returns the output of a call between passes, with z if checkpointing repeats the cut."""
        in_backward = torch._C._current_graph_task_id() != -1
        is_cut = module is self._cut.module and self.calls[module] == 1
        return self._output_with_z(run) if in_backward and is_cut else run()

    def _saved_output(self, index: int, run: Run) -> object:
        """The saved output of a recorded call. A call that may be saved runs once, others always.

        Calls inside the one that runs are not replayed meanwhile (`_fills`).
        """
        saved, call = self.outputs[index], self.recording.calls[index]
        if saved is not None:
            return saved.fresh()
        if not call.cached:
            return run()
        self._fills = True
        try:
            output = run()
        finally:
            self._fills = False
        self.outputs[index] = SavedTensors.of(output, copied=call.copied)
        return output

    def _output_with_z(self, run: Run) -> object:
        assert self.z is not None
        assert self.z0 is not None
        assert self.recording.cut is not None
        # A copy, because the network may go on in place and z may be a leaf.
        z = self.z.to(self.z0.dtype, copy=True)
        saved = self.outputs[self.recording.cut]
        # Without a saved output the layer runs for what else it does, as changing its input.
        output = run() if saved is None else saved.fresh()
        if self.recorder is not None:
            original = None if saved else dict(tensors_in(output))[self.recording.path]
            self.recorder.watch.injected(z, original)
        return map_tensors(output, lambda path, t: z if path == self.recording.path else t)


def _copies(arguments: Sequence[object]) -> object:
    """The network may change its arguments in place; the caller's must not change."""
    return map_tensors(tuple(arguments), lambda _, t: t.detach().clone())
