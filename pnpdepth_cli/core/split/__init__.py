"""Cutting any network at any layer: f = f_rear ∘ f_front, without rewriting.

The front runs the network's own forward up to the cut and stops there. It saves the output of every
*outermost* submodule that has finished: what ran before z existed cannot depend on z. The rear runs
the network's own forward again, but those submodules return their saved outputs and the cut layer
returns z. Skip connections and plain Python between the layers are right by construction.

The first front and the first rear are learning passes, watched operation by operation (`Recorder`
with a `Watch`). They find the submodules that cannot be cached, because they do more than return an
output: they work in place on their input, or hooks listen to their parts. Saved tensors are
protected from in-place operations. Submodules behind the cut that do not depend on z are cached as
well.

What is recorded holds for other arguments of the same shapes, if no value of a tensor reached
Python, where the network could branch on it. Then further frames are only replayed (`Replay`),
neither watched nor copied.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.replay import Recorder, Replay, Run, intercepted
from pnpdepth_cli.core.split.tensors import NetworkState
from pnpdepth_cli.core.split.watch import Watch
from pnpdepth_cli.errors import PnpDepthError, wrap_user_errors

if TYPE_CHECKING:
    from typing_extensions import Self

_LOW_PRECISION = (torch.float16, torch.bfloat16)


class Split:
    """A network cut at a layer, as a context manager; on exit the network is as before.

        with Split(network, "decoder.up1") as split:
            z = split.front(rgb)        # once for each frame
            output = split.rear(z)      # many times; differentiable in z

    While open, the network is in eval mode and only z requires gradient.

    Args:
        layer: Name of a submodule; `NAME#2` for its second call, `NAME[KEY]` for one output.
        static_graph: Promises that the network runs the same submodules in the same order for all
            arguments of the same shapes. Without a promise, it is learned anew for every frame if
            values of tensors reach Python.

    Raises:
        ModelError: The layer does not exist, never runs, or runs or returns several times without a
            choice.
    """

    def __init__(self, network: nn.Module, layer: str, *, static_graph: bool = False) -> None:
        self.layer = layer
        self._network = network
        self._promised_static = static_graph
        self._cut = CutPoint.find(network, layer)
        self._uncacheable: set[nn.Module] = set()
        self._replay: Replay | None = None

    def __enter__(self) -> Self:
        """Opens the split: calls of submodules are intercepted, in eval mode, without gradients."""
        # If a step of opening fails, those before it are undone.
        with ExitStack() as opening:
            self._state = NetworkState(self._network)
            opening.callback(self._state.close)
            opening.enter_context(intercepted(self._cut.modules.values(), self._handle))
            self._network.eval()
            self._state.freeze()
            self._open = opening.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the network, and frees the tensors of the last frame."""
        self._open.close()
        self._replay = None

    @property
    def static_graph(self) -> bool:
        """Whether all arguments of the recorded shapes are known to make the same calls.

        It is known once a front and a rear were recorded, in which no value of a tensor reached
        Python, where the network could branch on it; or if the caller promised it.
        """
        replay = self._replay
        return replay is not None and replay.complete and replay.static_graph

    @property
    def in_half(self) -> bool:
        """Whether the cut layer gives float16 for this frame, in which gradients may underflow."""
        z0 = None if self._replay is None else self._replay.z0
        return z0 is not None and z0.dtype == torch.float16

    def front(self, *arguments: object) -> Tensor:
        """Returns z_0, the output of the cut layer for these arguments of the network.

        In float32 if the layer gives a shorter type, in which small steps would be rounded away.

        Raises:
            ModelError: The network does not come to the cut, or fails before.
        """
        if self._replay is not None and self._replay.holds_for(arguments):
            self._replay.next_frame(arguments)
            z0 = self._run_front(self._replay)
        else:
            self._replay = None  # frees the tensors of the last frame
            z0 = self._record_front(arguments)
        # A copy, because the network may go on to change the memory of z_0.
        return z0.to(torch.float32 if z0.dtype in _LOW_PRECISION else z0.dtype, copy=True)

    def rear(self, z: Tensor) -> Any:
        """Returns what the network returns for the front's arguments when the cut layer gives z.

        Raises:
            ModelError: The network fails, the layer runs several times without a choice, or its
                output cannot be replaced.
            RuntimeError: `front` was not called before.
        """
        replay = self._replay
        if replay is None or replay.z0 is None:
            raise RuntimeError("rear() needs front() first")
        replay.z = z
        if replay.complete:
            return self._run(replay)
        # The first rear also learns which calls behind the cut can be cached.
        recorder = self._recorder(replay)
        output = self._run(replay, recorder)
        recorder.finish_rear()
        return output

    def _record_front(self, arguments: tuple[object, ...]) -> Tensor:
        """Returns z_0, after the network has run up to the cut as often as its calls need.

        `self._replay` then has the recorded calls, up to the cut.
        """
        while True:
            self._replay = replay = Replay(self._cut, arguments)
            uncacheable_before = len(self._uncacheable)
            recorder = self._recorder(replay)
            z0 = self._run_front(replay, recorder)
            # Once more, if the network set hooks in its first pass, as those of transformers do.
            cut = CutPoint.find(self._network, self.layer)
            if cut.hooked != self._cut.hooked:
                self._cut = cut
                continue
            # Once more, if this pass met submodules that cannot be cached as a whole: the next one
            # caches what is in them.
            if len(self._uncacheable) == uncacheable_before:
                recorder.finish(complete=False)
                return z0

    def _run_front(self, replay: Replay, recorder: Recorder | None = None) -> Tensor:
        """Returns z_0, after the network has run up to the cut.

        Args:
            replay: The calls that are recorded, with the arguments of the frame.
            recorder: Recorder of a learning pass; None if all calls are recorded.

        Raises:
            ModelError: The network does not come to the cut.
        """
        try:
            self._run(replay, recorder)
        except PnpDepthError:
            # The replay itself ends the pass at the cut, by `Replay.end_of_front`.
            if not replay.has_front:
                raise
        if replay.z0 is None or not replay.has_front:  # the former for mypy alone
            ran = {module for module, _ in replay.outputs} if recorder is None else recorder.ran
            raise self._cut.not_reached_error(ran, replay.calls[self._cut.module])
        return replay.z0

    def _recorder(self, replay: Replay) -> Recorder:
        """A recorder for the next pass, whose watch protects every saved tensor from changes."""
        saved = [output for output in replay.outputs.values() if output is not None]
        tensors = (replay.arguments, *saved, *self._state.tensors)
        # With a promise, it does not matter which values the network can branch on.
        watch = Watch(tensors, escapes=not self._promised_static)
        return Recorder(self._cut, watch, replay, self._uncacheable)

    def _handle(self, module: nn.Module, inputs: object, run: Run) -> object:
        """The output of a call of a submodule, which the replay decides if there is one."""
        if self._replay is None:  # before the first frame
            return run()
        return self._replay.handle(module, inputs, run)

    def _run(self, replay: Replay, recorder: Recorder | None = None) -> object:
        """What the network returns in one pass of its forward.

        Args:
            replay: Decides what the calls of submodules return in the pass.
            recorder: Watches the pass and notes its calls. None: all calls are recorded.

        Raises:
            ModelError: The network's forward fails.
        """
        self._state.restore()  # the pass before may have changed buffers or parameters
        replay.calls.clear()
        replay.in_pass = True
        replay.recorder = recorder
        arguments = replay.arguments.fresh()
        assert isinstance(arguments, tuple)  # as it was saved; for mypy
        try:
            with wrap_user_errors("the network's forward"):
                if recorder is None:
                    return self._network(*arguments)
                with recorder.watch, recorder.watch.seeing_escapes_of(self._network):
                    return self._network(*arguments)
        finally:
            replay.in_pass = False
            replay.recorder = None


def gradient_at(z: Tensor, value: Tensor) -> Tensor | None:
    """Returns ∂value/∂z, of the shape of z; None where no gradient comes back to z.

    Args:
        z: Leaf tensor that requires gradient and has none yet.
        value: Scalar that was computed from z, such as a loss.

    Raises:
        ModelError: The network cannot be differentiated.
    """
    if value.requires_grad:
        with wrap_user_errors("the gradient of the network"):
            value.backward()  # type: ignore[no-untyped-call]
    return z.grad
