"""Passes of a cut network: learning which calls of submodules can be cached, then replaying them.

A replayed pass returns saved outputs in front of the cut, and z at it.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.tensors import SavedTensors, map_tensors, tensors_in
from pnpdepth_cli.core.split.watch import Watch
from pnpdepth_cli.errors import ModelError, PnpDepthError

Run = Callable[[], object]
"""Runs a call of a submodule as the network made it; returns its output."""

Call = tuple[nn.Module, int]
"""A recorded call: its submodule, and how many recorded calls of that submodule were before it."""

Handler = Callable[[nn.Module, object, Run], object]
"""Called with a submodule, its inputs (args, kwargs) and a function that runs it."""


@contextmanager
def intercepted(modules: Iterable[nn.Module], handler: Handler) -> Iterator[None]:
    """Inside this context, calls of submodules return what the handler returns.

    Afterwards they go to their own `forward` again.

    Args:
        modules: The submodules; one may come several times.
        handler: Function called with a submodule, its inputs (args, kwargs) and a function that
            runs it.
    """
    # Few modules have a `forward` of their own; that of the others is their class's.
    own_forwards = {module: module.__dict__.get("forward") for module in modules}
    try:
        for module in own_forwards:
            module.__dict__["forward"] = _stand_in(module, module.forward, handler)
        yield
    finally:
        for module, own_forward in own_forwards.items():
            if own_forward is None:
                module.__dict__.pop("forward", None)
            else:
                module.__dict__["forward"] = own_forward


def _stand_in(
    module: nn.Module, original: Callable[..., object], handler: Handler
) -> Callable[..., object]:
    """A `forward` for a module that leaves the call to the handler; `original` is the module's."""

    @functools.wraps(original)
    def forward(*args: object, **kwargs: object) -> object:
        """What the handler returns for a call of the module with these arguments."""
        return handler(module, (args, kwargs), lambda: original(*args, **kwargs))

    return forward


def shapes_of(arguments: object) -> object:
    """Returns a value that is equal for arguments which differ by the values of tensors alone.

    It has the tensors' shapes, types and devices, and all that is no tensor. A network without
    branches on values treats such arguments alike.
    """
    tensors = [(tensor.shape, tensor.dtype, tensor.device) for _, tensor in tensors_in(arguments)]
    # The rest as text, in which empty tensors stand for all.
    return tensors, repr(map_tensors(arguments, lambda _, tensor: tensor.new_empty(0)))


class Replay:
    """Recorded calls, with the saved tensors of the frame at hand; handles intercepted calls.

    In the learning passes, calls that are not recorded yet go to the `recorder`.

    Args:
        cut: The layer where the network is cut.
        arguments: Arguments of the network for the first frame.
    """

    def __init__(self, cut: CutPoint, arguments: Sequence[object]) -> None:
        self._cut = cut
        self.arguments = SavedTensors(_copies(arguments))
        self._shapes = shapes_of(self.arguments.value)
        self.outputs: dict[Call, SavedTensors | None] = {}
        """Outputs of recorded calls, in the order in which calls begin. None: the call is not
        cached, so that it runs in every pass; it contains the cut or recorded calls, or works in
        place. An output of value None: the call has not run for the frame at hand."""
        self.cut_call: Call | None = None  # that is the cut; None before it was reached
        self.path: tuple[str, ...] = ()  # path of z in the output of that call
        self.static_graph = True  # whether arguments of the same shapes all make the same calls
        self.complete = False  # whether the calls behind the cut are recorded, too
        self.z0: Tensor | None = None  # None before the front has run for the frame at hand
        self.z: Tensor | None = None  # what the cut layer gives; None before the first rear
        self.calls: Counter[nn.Module] = Counter()
        """How often each submodule was called in the last pass."""
        self.recorder: Recorder | None = None  # of a learning pass; None in the others
        self.in_pass = False  # whether the network's forward runs
        self._fills = False  # inside a call whose output will be saved as a whole

    def holds_for(self, arguments: tuple[object, ...]) -> bool:
        """Whether a pass with these arguments makes the recorded calls."""
        return self.complete and self.static_graph and self._shapes == shapes_of(arguments)

    def next_frame(self, arguments: Sequence[object]) -> None:
        """Forgets the frame at hand; `arguments` are those of the next one."""
        self.arguments = SavedTensors(_copies(arguments), self.arguments.copied)
        for call, saved in self.outputs.items():
            if saved is not None:
                self.outputs[call] = SavedTensors(copied=saved.copied)
        self.z0 = None
        self.z = None

    @property
    def has_front(self) -> bool:
        """Whether the front of the frame at hand has run, and no rear yet."""
        return self.z0 is not None and self.z is None

    def end_of_front(self) -> PnpDepthError:
        """Returns the error that ends the front's pass when the cut has given z_0.

        A network that catches it gets it again from its next call.
        """
        return PnpDepthError(f"layer {self._cut.layer!r} was reached, where the network is cut")

    def handle(self, module: nn.Module, inputs: object, run: Run) -> object:
        """Returns the output of a call of a submodule.

        It is the saved output for a recorded call, one with z in it for the cut, and what the
        submodule itself returns for every other call.

        Args:
            module: The submodule that is called.
            inputs: Its inputs (args, kwargs).
            run: Function that runs it on these.

        Raises:
            PnpDepthError: The call is the cut in the front's pass, or follows it (`end_of_front`).
        """
        if not self.in_pass:
            return self._handle_outside(module, run)
        if self._fills:  # the output of the call around it will be saved
            return run()
        if self.has_front:  # the network has caught the end of the front
            raise self.end_of_front()
        # A learning pass watches the call; a call that is not recorded yet is recorded.
        if self.recorder is not None:
            run = functools.partial(self.recorder.run_watched, module, run)
        call = module, self.calls[module]
        self.calls[module] += 1
        if call not in self.outputs:
            return run() if self.recorder is None else self.recorder.record(module, inputs, run)
        # A recorded call. The cut ends the front's pass; in the rear's it gives z.
        is_cut = call == self.cut_call
        if is_cut and self.z0 is not None:
            return self._output_with_z(run)
        output = self._saved_output(call, run)
        if is_cut:
            self.z0 = dict(tensors_in(output))[self.path].detach()
            raise self.end_of_front()
        return output

    def _handle_outside(self, module: nn.Module, run: Run) -> object:
        """The output of a call between passes, with z in it if it repeats the cut.

        Checkpointing (`torch.utils.checkpoint`) repeats calls in the backward pass. Of a layer that
        is called several times it cannot be told which call is repeated.
        """
        in_backward = torch._C._current_graph_task_id() != -1  # torch's number of no backward pass
        is_cut = module is self._cut.module and self.calls[module] == 1
        return self._output_with_z(run) if in_backward and is_cut else run()

    def _saved_output(self, call: Call, run: Run) -> object:
        """The output of a recorded call, which runs only once a frame if its output may be saved.

        Args:
            call: The call.
            run: Function that runs it.
        """
        saved = self.outputs[call]
        if saved is None:  # its output may not be saved
            return run()
        if saved.value is not None:  # it has run for this frame
            return saved.fresh()
        # It runs as a whole: calls inside it are not looked up meanwhile.
        self._fills = True
        try:
            output = run()
        finally:
            self._fills = False
        self.outputs[call] = SavedTensors.of(output, copied=saved.copied)
        return output

    def _output_with_z(self, run: Run) -> object:
        """The output of the cut layer, with z in place of z_0.

        Raises:
            RuntimeError: There is no z yet, which is a fault of the caller.
        """
        if self.z is None or self.z0 is None or self.cut_call is None:
            raise RuntimeError("the cut layer runs again before front() and rear()")
        # A copy, because the network may go on in place and z may be a leaf.
        z = self.z.to(self.z0.dtype, copy=True)
        saved = self.outputs[self.cut_call]
        # Without a saved output the layer runs for what else it does, as changing its input.
        output = run() if saved is None else saved.fresh()
        if self.recorder is not None:
            # The tensor that z stands for is in the network's hands only where the layer ran.
            original = dict(tensors_in(output))[self.path] if saved is None else None
            self.recorder.watch.note_injection(z, original)
        return map_tensors(output, lambda path, tensor: z if path == self.path else tensor)


def _copies(arguments: Sequence[object]) -> object:
    """Copies of the arguments, which the network may change in place; the caller's stay as is."""
    return map_tensors(tuple(arguments), lambda _, tensor: tensor.detach().clone())


class Recorder:
    """Notes the calls of one pass that the replay does not know yet.

    Args:
        cut: The layer where the network is cut.
        watch: Sees the operations of the pass.
        replay: Handles the pass; gets the recorded calls when the pass is over.
        uncacheable: Submodules that contain something which forbids to cache them as a whole; those
            that this pass meets are added. Their submodules are recorded one by one.
    """

    def __init__(
        self, cut: CutPoint, watch: Watch, replay: Replay, uncacheable: set[nn.Module]
    ) -> None:
        self.watch = watch
        self.ran: set[nn.Module] = set()
        """Submodules that ran in this pass, but for those inside one that is cached as a whole."""
        self._cut = cut
        self._replay = replay
        self._uncacheable = uncacheable
        self._saved = dict(replay.outputs)  # recorded calls, like `Replay.outputs`
        self._calls_before = len(self._saved)
        """Number of calls recorded before this pass; in the rear's, those up to the cut."""
        self._is_inside_cached = False  # in a submodule that is to be cached as a whole

    def run_watched(self, module: nn.Module, run: Run) -> object:
        """Returns what `run` returns, the output of a call of the module.

        Values of tensors that reach Python meanwhile are noted.
        """
        with self.watch.seeing_escapes_of(module):
            return run()

    def record(self, module: nn.Module, inputs: object, run: Run) -> object:
        """Returns the output of a call that was not recorded yet; now it is.

        Its output is saved if it can stand for all that the call does.

        Args:
            module: The submodule that is called.
            inputs: Its inputs (args, kwargs).
            run: Function that runs it on these.

        Raises:
            PnpDepthError: The call is the cut, where the front ends (`Replay.end_of_front`).
            ModelError: It is the cut, and its output has no tensor that can be z, or several.
        """
        # Inside a call that is cached as a whole there is nothing to record but the cut.
        if self._is_inside_cached and module is not self._cut.module:
            return run()
        self.ran.add(module)
        # The call is noted before it runs, so that calls are in the order in which they begin.
        number = 0
        while (module, number) in self._saved:
            number += 1
        call = (module, number)
        self._saved[call] = None
        first_inside = len(self._saved)
        # It runs, and what is inside is recorded too, unless it may be cached as a whole.
        since = self.watch.now()
        tensors_before = list(tensors_in(inputs))
        was_inside_cached = self._is_inside_cached
        may_be_cached = self._may_be_cached(module)
        self._is_inside_cached = may_be_cached
        try:
            output = run()
        finally:
            self._is_inside_cached = was_inside_cached
        if self._replay.has_front:  # the network has caught the end of the front
            return output
        # Its output is saved if to return it is all that the call did: no tensor was changed, nor a
        # list or dict among the inputs, and no hook inside waits to be called.
        changes_no_tensor = self.watch.can_stand_for(since, inputs, output)
        keeps_inputs = _ids(tensors_before) == _ids(list(tensors_in(inputs)))
        has_submodules = next(module.children(), None) is not None
        if changes_no_tensor and keeps_inputs and module not in self._cut.around_hooks:
            self._drop_from(first_inside)  # the saved output stands for the calls inside, too
            saved = SavedTensors.of(output)
            self._saved[call] = saved
            self.watch.protect(saved)
        elif may_be_cached and has_submodules:
            self._uncacheable.add(module)  # the next pass records what is in it
        # The front ends at the cut.
        if self._is_cut(module):
            self._replay.path, self._replay.z0 = self._cut.choose(output)
            self._replay.cut_call = call
            raise self._replay.end_of_front()
        return output

    def finish_rear(self) -> None:
        """Gives the replay all recorded calls.

        Raises:
            ModelError: The cut is ambiguous, or its output cannot be replaced.
        """
        layer = self._cut.layer
        calls = self._replay.calls[self._cut.module]
        if self._cut.call is None and calls > 1:
            choices = ", ".join(f"{layer}#{call}" for call in range(1, calls + 1))
            raise ModelError(f"layer {layer!r} is called {calls} times; say which call: {choices}")
        if self.watch.torn:  # z shares memory with a tensor that the network changes
            raise ModelError(
                f"layer {layer!r}: its output lies in the memory of an earlier tensor, and the"
                " network changes one in place and reads the other; cut one layer later"
            )
        # Another z may take another path behind the cut, as values reached Python there and it was
        # not promised that they do not matter. So no call there is recorded, and saved outputs are
        # cloned, as that path may change them.
        if self.watch.data_dependent:
            self._drop_from(self._calls_before)
            for saved in self._saved.values():
                if saved is not None:
                    saved.copied = True
        self.finish(complete=True)

    def finish(self, *, complete: bool) -> None:
        """Gives the replay the recorded calls.

        Args:
            complete: Whether these are all calls, those behind the cut included.
        """
        self._replay.outputs = self._saved
        self._replay.complete = complete
        # No value may reach Python in front of the cut or behind it.
        self._replay.static_graph &= not self.watch.escaped

    def _is_cut(self, module: nn.Module) -> bool:
        """Whether the call of this submodule that has just run is the one to cut at."""
        if self._replay.cut_call is not None or module is not self._cut.module:
            return False
        # Without a number the cut is the first call; if there are more, `finish_rear` raises.
        return self._cut.call in (None, self._replay.calls[module])

    def _may_be_cached(self, module: nn.Module) -> bool:
        """Whether a call that begins here may be cached as a whole, without a record of its inside.

        It may if it ends before the cut, and nothing in it is known to forbid it.
        """
        if self._replay.cut_call is not None:
            return False
        forbidden = (self._cut.containers, self._cut.around_hooks, self._uncacheable)
        return not any(module in group for group in forbidden)

    def _drop_from(self, first: int) -> None:
        """Forgets all but the first calls, in the order in which they began.

        Args:
            first: How many calls stay.
        """
        while len(self._saved) > first:
            _, saved = self._saved.popitem()
            if saved is not None:
                saved.value = None  # the watch would hold its tensors


def _ids(tensors: list[tuple[tuple[str, ...], Tensor]]) -> list[tuple[tuple[str, ...], int]]:
    """The paths of tensors and their identities, which are equal if the same tensors are there.

    So they tell whether a call has changed the lists or dicts among its inputs.

    Args:
        tensors: Paths and tensors as `tensors_in` yields them; while they are held, no other tensor
            gets the identity of one.
    """
    return [(path, id(tensor)) for path, tensor in tensors]
