"""Passes of a cut network: learning which calls of submodules can be cached, then by a recording.

A pass by a recording returns saved outputs in front of the cut, and z at it.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.tensors import SavedTensors, map_tensors, tensors_in
from pnpdepth_cli.core.split.watch import Watch
from pnpdepth_cli.errors import ModelError, PnpDepthError

Run = Callable[[], object]
"""Runs a call of a submodule; returns its output."""

Handler = Callable[[nn.Module, object, Run], object]
"""Called with a submodule, its inputs (args, kwargs) and a function that runs it."""


@contextmanager
def intercepted(modules: Iterable[nn.Module], handler: Handler) -> Iterator[None]:
    """Inside, calls of the submodules go to the handler; afterwards to their own `forward`."""
    own = {module: module.__dict__.get("forward") for module in modules}
    try:
        for module in own:
            module.__dict__["forward"] = _stand_in(module, module.forward, handler)
        yield
    finally:
        for module, own_forward in own.items():
            module.__dict__["forward"] = own_forward
            if own_forward is None:
                del module.__dict__["forward"]


def _stand_in(
    module: nn.Module, original: Callable[..., object], handler: Handler
) -> Callable[..., object]:
    @functools.wraps(original)
    def forward(*args: object, **kwargs: object) -> object:
        return handler(module, (args, kwargs), lambda: original(*args, **kwargs))

    return forward


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """The calls of a pass in their order, up to the cut or to the end."""

    calls: Mapping[tuple[nn.Module, int], int] = field(default_factory=dict)
    """Index of the call by its submodule and the number of its recorded calls before it. Recorded
    are calls that are cached, or that contain the cut or calls of their own."""
    cut: int | None = None  # index of the call that is the cut; None before it was reached
    path: tuple[str, ...] = ()  # path of z in the output of that call
    shapes: object = None  # shapes and other properties of the arguments for which this holds
    static_graph: bool = True  # whether it holds for all arguments of these shapes, as far as known
    complete: bool = False  # whether the calls behind the cut are in it, too

    def holds_for(self, arguments: tuple[object, ...]) -> bool:
        """Whether a pass with these arguments makes the same calls."""
        return self.complete and self.static_graph and self.shapes == shapes_of(arguments)


def shapes_of(arguments: object) -> object:
    """Returns what arguments must share for a network without branches to treat them alike."""
    tensors = [(t.shape, t.dtype, t.device) for _, t in tensors_in(arguments)]
    return tensors, repr(map_tensors(arguments, lambda _, t: t.new_empty(0)))


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
        """Output of each recorded call: None where not cached, of value None before it ran."""
        self.z0: Tensor | None = None
        self.z: Tensor | None = None
        self.calls: Counter[nn.Module] = Counter()
        """How often each submodule was called in the last pass."""
        self.recorder: Recorder | None = None
        self.in_pass = False
        self._fills = False  # inside a call whose output will be saved as a whole

    def next_frame(self, arguments: Sequence[object]) -> None:
        """Forgets the frame at hand; `arguments` are those of the next one."""
        self.arguments = SavedTensors(_copies(arguments), self.arguments.copied)
        self.outputs = [saved and SavedTensors(copied=saved.copied) for saved in self.outputs]
        self.z0 = self.z = None

    @property
    def has_front(self) -> bool:
        """Whether the front of the frame at hand has run, and no rear yet."""
        return self.z0 is not None and self.z is None

    def end_of_front(self) -> PnpDepthError:
        """Returns what ends the front's pass; a network that catches it gets it again."""
        return PnpDepthError(f"layer {self._cut.layer!r} was reached, where the network is cut")

    def handle(self, module: nn.Module, inputs: object, run: Run) -> object:
        """Returns the output of a call: saved, with z in it, or of the submodule."""
        if not self.in_pass:
            return self._handle_outside(module, run)
        if self._fills:
            return run()
        if self.has_front:
            raise self.end_of_front()
        if self.recorder is not None:
            run = functools.partial(self.recorder.run, module, run)
        index = self.recording.calls.get((module, self.calls[module]))
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

    def _handle_outside(self, module: nn.Module, run: Run) -> object:
        """The output of a call between passes, with z if checkpointing repeats the cut."""
        in_backward = torch._C._current_graph_task_id() != -1
        is_cut = module is self._cut.module and self.calls[module] == 1
        return self._output_with_z(run) if in_backward and is_cut else run()

    def _saved_output(self, index: int, run: Run) -> object:
        """The saved output of a recorded call. A call that may be saved runs once, others always.

        Calls inside the one that runs are not replayed meanwhile (`_fills`).
        """
        saved = self.outputs[index]
        if saved is None:
            return run()
        if saved.value is not None:
            return saved.fresh()
        self._fills = True
        try:
            output = run()
        finally:
            self._fills = False
        self.outputs[index] = SavedTensors.of(output, copied=saved.copied)
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


class Recorder:
    """Notes the calls of one pass that the replay's recording does not know yet.

    Args:
        watch: Sees the operations of the pass.
        replay: Handles the pass; gets the longer recording when the pass is over.
        uncacheable: Submodules that contain something which forbids to cache them as a whole;
            more are added. Their submodules are then recorded one by one.
    """

    def __init__(
        self, cut: CutPoint, watch: Watch, replay: Replay, uncacheable: set[nn.Module]
    ) -> None:
        self.watch, self.ran = watch, set[nn.Module]()
        self._cut, self._replay, self._uncacheable = cut, replay, uncacheable
        self._calls = [module for module, _ in replay.recording.calls]
        self._saved = list(replay.outputs)  # of each call; None where it cannot be cached
        self._known = len(self._calls)  # before this pass; in the rear's, those up to the cut
        self._inside_one = False  # in a submodule that is to be cached as a whole

    def run(self, module: nn.Module, run: Run) -> object:
        """Runs a submodule, watched."""
        with self.watch.seeing_escapes_of(module):
            return run()

    def record(self, module: nn.Module, inputs: object, run: Run) -> object:
        """Runs a call and notes it; it is cached if its output can stand for all that it does."""
        if self._inside_one and module is not self._cut.module:
            return run()
        self.ran.add(module)
        index, since = len(self._calls), self.watch.now()
        self._calls.append(module)
        self._saved.append(None)
        before = list(tensors_in(inputs))
        outer, self._inside_one = self._inside_one, self._may_be_one(module)
        try:
            output = run()
        finally:
            tried, self._inside_one = self._inside_one, outer
        if self._replay.has_front:  # the network has caught the end of the front
            return output
        if (
            self.watch.can_stand_for(since, inputs, output)
            and module not in self._cut.around_hooks
            # and has not changed the lists or dicts among its inputs
            and [(path, id(t)) for path, t in before]
            == [(path, id(t)) for path, t in tensors_in(inputs)]
        ):
            self._drop_from(index + 1)
            self._saved[index] = saved = SavedTensors.of(output)
            self.watch.protect(saved)
        elif tried and next(module.children(), None) is not None:
            self._uncacheable.add(module)
        if self._is_cut(module):
            path, z0 = self._cut.choose(output)
            self._replay.z0 = z0
            self._replay.recording = Recording(cut=index, path=path)
            raise self._replay.end_of_front()
        return output

    def finish_rear(self) -> None:
        """Gives the replay the whole recording.

        Raises:
            ModelError: The cut is ambiguous, or its output cannot be replaced.
        """
        layer, calls = self._cut.layer, self._replay.calls[self._cut.module]
        if self._cut.call is None and calls > 1:
            choices = ", ".join(f"{layer}#{call}" for call in range(1, calls + 1))
            raise ModelError(f"layer {layer!r} is called {calls} times; say which call: {choices}")
        if self.watch.torn:  # z shares memory with a tensor that the network changes
            raise ModelError(
                f"layer {layer!r}: its output lies in the memory of an earlier tensor, and the"
                " network changes one in place and reads the other; cut one layer later"
            )
        # Another z may take another path behind the cut, unless the definition says otherwise. So
        # no call there is recorded, and saved outputs stay whole, as it may read or change them.
        if self.watch.data_dependent:
            self._drop_from(self._known)
            for saved in self._saved:
                if saved is not None:
                    saved.copied = True
        self.finish(complete=True)

    def finish(self, *, complete: bool) -> None:
        """Gives the replay the recording, up to the cut or complete."""
        replay, calls = self._replay, self._calls
        replay.outputs = self._saved
        replay.recording = replace(
            replay.recording,
            calls={(m, calls[:index].count(m)): index for index, m in enumerate(calls)},
            shapes=shapes_of(replay.arguments.value),
            # No value may reach Python in front of the cut or behind it.
            static_graph=replay.recording.static_graph and not self.watch.escaped,
            complete=complete,
        )

    def _is_cut(self, module: nn.Module) -> bool:
        reached = self._replay.recording.cut is not None
        chosen = self._cut.call in (None, self._replay.calls[module])
        return not reached and module is self._cut.module and chosen

    def _may_be_one(self, module: nn.Module) -> bool:
        """True if it ends before the cut, so that what is inside needs no record."""
        apart = (self._cut.containers, self._cut.around_hooks, self._uncacheable)
        return self._replay.recording.cut is None and not any(module in group for group in apart)

    def _drop_from(self, first: int) -> None:
        for saved in self._saved[first:]:
            if saved is not None:
                saved.value = None  # the watch would hold its tensors
        del self._calls[first:], self._saved[first:]
