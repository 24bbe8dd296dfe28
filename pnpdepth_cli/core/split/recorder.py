"""The learning passes of a cut network: which calls of submodules can be cached."""

from __future__ import annotations

from torch import nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.replay import RecordedCall, Recording, Replay, Run, shapes_of
from pnpdepth_cli.core.split.tensors import SavedTensors, tensors_in
from pnpdepth_cli.core.split.watch import Watch
from pnpdepth_cli.errors import LayerError


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
        self._calls = [call.module for call in replay.recording.calls]
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

    def finish_front(self, *, promised_static: bool) -> None:
        """Gives the replay the recording up to the cut."""
        self._finish(promised_static or not self.watch.escaped, complete=False)

    def finish_rear(self, *, promised_static: bool) -> None:
        """Gives the replay the whole recording.

        Args:
            promised_static: Whether the same calls are promised for all arguments of these shapes.

        Raises:
            LayerError: The cut is ambiguous, or its output cannot be replaced.
        """
        layer, calls = self._cut.layer, self._replay.calls[self._cut.module]
        if self._cut.name.call is None and calls > 1:
            choices = ", ".join(f"{layer}#{call}" for call in range(1, calls + 1))
            raise LayerError(f"layer {layer!r} is called {calls} times; say which call: {choices}")
        if self.watch.torn:  # z shares memory with a tensor that the network changes
            raise LayerError(
                f"layer {layer!r}: its output lies in the memory of an earlier tensor, and the"
                " network changes one in place and reads the other; cut one layer later"
            )
        # Another z may take another path behind the cut, unless the definition says otherwise. So
        # no call there is recorded, and saved outputs stay whole, as it may read or change them.
        if self.watch.data_dependent and not promised_static:
            self._drop_from(self._known)
            for saved in self._saved:
                if saved is not None:
                    saved.copied = True
        # It holds for other arguments if no value reached Python in front of the cut or behind it.
        static = self._replay.recording.static_graph
        self._finish(static and (promised_static or not self.watch.escaped), complete=True)

    def abandon(self) -> None:
        """Forgets what this pass has noted."""
        self._drop_from(self._known)

    def _finish(self, static_graph: bool, *, complete: bool) -> None:
        replay = self._replay
        replay.outputs = self._saved
        replay.recording = Recording(
            calls=tuple(
                RecordedCall(
                    module=module, cached=saved is not None, copied=bool(saved and saved.copied)
                )
                for module, saved in zip(self._calls, self._saved, strict=True)
            ),
            cut=replay.recording.cut,
            path=replay.recording.path,
            shapes=shapes_of(replay.arguments.value),
            static_graph=static_graph,
            complete=complete,
        )

    def _is_cut(self, module: nn.Module) -> bool:
        reached = self._replay.recording.cut is not None
        chosen = self._cut.name.call in (None, self._replay.calls[module])
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
