"""Passes of a cut network by a recording: saved outputs in front of the cut, z at it."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.recording import Recording
from pnpdepth_cli.core.split.saved import SavedTensors
from pnpdepth_cli.core.split.structure import map_tensors, tensors_in

if TYPE_CHECKING:
    from pnpdepth_cli.core.split.recorder import Recorder


class CutReached(BaseException):
    """Ends the front's pass at the cut; no Exception, so that networks do not catch it."""


class Replay:
    """The saved tensors of the frame at hand, and the handler of intercepted calls.

    In the learning passes, calls that the recording does not know go to the `recorder`.

    Args:
        cut: Where the network is cut.
        arguments: Of the network, for the first frame.
    """

    def __init__(self, cut: CutPoint, arguments: Sequence[Any]) -> None:
        self._cut = cut
        self.recording = Recording()
        self.arguments = SavedTensors(_copies(arguments))
        self.outputs: list[SavedTensors | None] = []
        """Of each recorded call; None where it is not cached or did not run yet."""
        self.z0: Tensor | None = None
        self.z: Tensor | None = None
        self.calls: Counter[nn.Module] = Counter()
        """How often each submodule was called in the last pass."""
        self.recorder: Recorder | None = None
        self._fills = False  # inside a call whose output will be saved as a whole

    def next_frame(self, arguments: Sequence[Any]) -> None:
        """Forgets the frame at hand; `arguments` are those of the next one."""
        self.arguments = SavedTensors(_copies(arguments), self.arguments.copied)
        self.outputs, self.z0, self.z = [None] * len(self.recording.calls), None, None

    def change_arguments(self, arguments: Sequence[Any]) -> None:
        """Replaces the arguments of the frame at hand; saved outputs stay."""
        self.arguments = SavedTensors(_copies(arguments), self.arguments.copied)

    def handle(self, module: nn.Module, inputs: Any, run: Callable[[], Any]) -> Any:
        """Returns the output of a call in a pass: saved, with z in it, or of the submodule."""
        if self._fills:
            return run()
        if self.recorder is not None:
            run = functools.partial(self.recorder.run, module, inputs, run)
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
            raise CutReached
        return output

    def handle_outside(self, module: nn.Module, inputs: Any, run: Callable[[], Any]) -> Any:
        """Returns the output of a call between passes, with z if checkpointing repeats the cut."""
        in_backward = torch._C._current_graph_task_id() != -1
        is_cut = module is self._cut.module and self.calls[module] == 1
        return self._output_with_z(run) if in_backward and is_cut else run()

    def _saved_output(self, index: int, run: Callable[[], Any]) -> Any:
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
        self.outputs[index] = call.save(output)
        return output

    def _output_with_z(self, run: Callable[[], Any]) -> Any:
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


def _copies(arguments: Sequence[Any]) -> Any:
    """The network may change its arguments in place; the caller's must not change."""
    return map_tensors(tuple(arguments), lambda _, t: t.detach().clone())
