"""Cutting any network at any layer: f = f_rear ∘ f_front, without rewriting the network.

The front runs the network's own forward up to the cut and stops there. It remembers the output of
every *outermost* submodule that finished before: whatever ran before z existed cannot depend on z.
The rear runs the network's own forward again, but those submodules hand back what they gave, and
the cut layer hands back z. Skip connections and plain Python between the layers come out right by
construction.

Both are watched operation by operation (`Watch`), the rear in its first pass. A submodule that does
more than give an output (it works in place on its input, or hooks listen to its parts) is not
remembered itself, its parts are; remembered tensors are saved from in-place operations; and
submodules behind the cut that do not depend on z either are remembered as well.

What was learned so holds for other arguments of the same shapes, if no value of a tensor got out to
Python, where it could choose another path: further frames are neither watched nor copied.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.layer_name import LayerName
from pnpdepth_cli.core.split.state import NetworkState
from pnpdepth_cli.core.split.structure import map_tensors, tensors_in
from pnpdepth_cli.core.split.user_code import wrap_user_errors
from pnpdepth_cli.core.split.watch import Call, Remembered, Watch
from pnpdepth_cli.errors import LayerError

_FEW_BITS = (torch.float16, torch.bfloat16)


class _CutReached(BaseException):
    """Stops the front's pass at the cut; not an Exception, so that networks do not catch it."""


class Split:
    """A network cut at a layer, as a context manager; the network is as before when it closes.

    with Split(network, "decoder.up1") as split:
        z = split.front(rgb)        # once for each frame
        output = split.rear(z)      # many times; differentiable in z

    While open, the network is in eval mode and only z requires gradient. Raises LayerError for a
    layer that does not exist, never runs, or runs or returns several times without a choice.
    static_graph: the network runs the same submodules for all arguments of the same shapes, though
    values of tensors get out to Python; without a promise, each frame is then learnt anew.
    """

    _given: Remembered  # the arguments
    _z0: Tensor | None
    _z: Tensor | None
    _calls: list[Call]  # what each pass does, in order; grows behind the cut in the first rear pass
    _slots: dict[nn.Module, list[Call]]  # the same by submodule
    _counts: Counter[nn.Module]  # calls of each submodule in the pass under way
    _ran: set[nn.Module]
    _watch: Watch | None
    _cut_call: Call | None
    _path: tuple[str, ...]
    _learned: bool
    _static: bool  # what was learned holds for all arguments of `_shapes`
    _shapes: Any
    _passing: bool
    _filling: bool  # inside a submodule that is remembered as a whole, as was learned
    _sealed: bool  # inside a submodule that is to be remembered as a whole
    _open: set[nn.Module]  # submodules that turned out not to be fit for that

    def __init__(self, network: nn.Module, layer: str, *, static_graph: bool = False) -> None:
        self.layer, self._promised_static = layer, static_graph
        self._network = network
        self._name = LayerName.parse(layer)
        self._modules = dict(network.named_modules(remove_duplicate=False))
        if self._name.module not in self._modules or not self._name.module:
            raise LayerError(_unknown(self._name.module, [name for name in self._modules if name]))
        self._cut = self._modules[self._name.module]
        self._around_hooks = _around_hooks(self._modules)
        self._around_cut = _around(self._cut, self._modules)
        self._open = set()
        self._forget()

    def __enter__(self) -> Split:
        modules = list(dict.fromkeys(self._modules.values()))
        self._state = NetworkState(self._network)
        self._forwards = {module: module.__dict__.get("forward") for module in modules}
        try:
            self._stand_ins = {m: self._stand_in(m, m.forward) for m in modules}
            self._network.eval()
            self._state.freeze()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stand_in_for(())
        self._state.close()
        self._forget()

    def _stand_in_for(self, modules: Collection[nn.Module]) -> None:
        """Calls of these submodules come by here, and of no others."""
        for module, own_forward in self._forwards.items():
            if module in modules:
                module.__dict__["forward"] = self._stand_ins[module]
            elif own_forward is None:
                module.__dict__.pop("forward", None)
            else:
                module.__dict__["forward"] = own_forward

    @property
    def static_graph(self) -> bool:
        """True once it is known that the network treats all arguments of these shapes alike.

        Then no value of a tensor gets out to Python, which could choose another path by it, or it
        was promised (`static_graph`) that it does not.
        """
        return self._learned and self._static

    def front(self, *arguments: Any) -> Tensor:
        """z_0, the output of the cut layer for these arguments of the network.

        In float32 where the layer gives fewer bits: small steps would get lost in them.
        """
        if self._learned and self._static and self._shapes == _shapes(arguments):
            return self._front_of_another_frame(arguments)
        self._stand_in_for(self._forwards)
        while True:
            self._forget()
            self._shapes = _shapes(arguments)
            self._given.output = _own(arguments)
            known_open = len(self._open)
            try:
                with self._watching() as watch, watch.seeing_escapes():
                    self._run()
            except _CutReached:
                if len(self._open) > known_open:
                    continue  # once more, to remember what lies inside those
                self._index()
                self._static = self._promised_static or not watch.escaped
                assert self._z0 is not None
                return _handed_out(self._z0)
            raise LayerError(self._never_ran())

    def _front_of_another_frame(self, arguments: Sequence[Any]) -> Tensor:
        self._given.output, self._z0 = _own(arguments), None
        for call in self._calls:
            call.forget()
        with contextlib.suppress(_CutReached):
            self._run()
        if self._z0 is None:
            raise LayerError(self._never_ran())
        return _handed_out(self._z0)

    @property
    def in_half(self) -> bool:
        """True if the cut layer of the last frame gives float16, in which gradients may vanish."""
        return self._z0 is not None and self._z0.dtype == torch.float16

    def rear(self, z: Tensor) -> Any:
        """What the network returns when the cut layer gives z."""
        if self._z0 is None:
            raise RuntimeError("rear() needs front() first")
        self._z = z
        if self._learned:
            return self._run()
        known = len(self._calls)
        try:
            with self._watching(reads=True) as watch, watch.seeing_escapes():
                output = self._run()
            watch.note_reads(output)
            if self._name.call is None and self._counts[self._cut] > 1:
                raise LayerError(_several_calls(self.layer, self._counts[self._cut]))
            if watch.torn:
                raise LayerError(
                    f"layer {self.layer!r}: its output lies in the memory of an earlier tensor, and"
                    " the network changes one in place and reads the other; cut one layer later"
                )
        except BaseException:
            self._drop_calls_from(known)
            raise
        if watch.data_dependent:  # another z may take another path behind the cut
            self._drop_calls_from(known)
            for call in self._calls:
                call.copied = True
        else:
            self._release_unread(watch)
        self._index()
        self._learned = True
        self._static &= self._promised_static or not watch.escaped
        self._stand_in_for({call.module for call in self._calls if self._matters(call)})
        return output

    @contextmanager
    def _watching(self, *, reads: bool = False) -> Iterator[Watch]:
        watch = Watch((self._given, *self._calls, *self._state.tensors), reads=reads)
        self._watch = watch
        try:
            with watch:
                yield watch
        finally:
            self._watch = None

    def _run(self) -> Any:
        self._state.restore()
        self._counts.clear()
        self._passing = True
        try:
            with wrap_user_errors("the network's forward"):
                return self._network(*self._given.hand_back())
        finally:
            self._passing = False

    def _matters(self, call: Call) -> bool:
        return call.kept or call is self._cut_call

    def _forget(self) -> None:
        self._given, self._z0, self._z = Remembered(()), None, None
        self._calls, self._slots, self._ran = [], {}, set()
        self._counts = Counter()
        self._watch = self._cut_call = None
        self._learned = self._static = self._passing = self._filling = self._sealed = False

    def _index(self) -> None:
        self._slots = {}
        for call in self._calls:
            self._slots.setdefault(call.module, []).append(call)

    def _stand_in(self, module: nn.Module, original: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(original)
        def forward(*args: Any, **kwargs: Any) -> Any:
            def run() -> Any:
                if self._watch is not None:
                    self._watch.note_reads((args, kwargs))
                return original(*args, **kwargs)

            if not self._passing:
                return self._inject(run) if self._is_recomputed_cut(module) else run()
            if self._filling:
                return run()
            count = self._counts[module]
            self._counts[module] += 1
            slots = self._slots.get(module, ())
            if count < len(slots):
                call = slots[count]
                if call is self._cut_call and self._z0 is not None:
                    return self._inject(run)
                output = call.hand_back() if call.known else self._fill(call, run)
                if call is self._cut_call:
                    self._z0 = dict(tensors_in(output))[self._path].detach()
                    raise _CutReached
                return output
            if self._watch is None or (self._sealed and module is not self._cut):
                return run()
            return self._record(module, self._watch, (args, kwargs), run)

        return forward

    def _fill(self, call: Call, run: Callable[[], Any]) -> Any:
        """Run a call that was learned of; its output is remembered if it is one to keep."""
        if not call.kept:
            return run()
        self._filling = True
        try:
            output = run()
        finally:
            self._filling = False
        call.remember(output)
        return output

    def _is_recomputed_cut(self, module: nn.Module) -> bool:
        """True if torch.utils.checkpoint runs the cut layer again within a backward pass."""
        backward = torch._C._current_graph_task_id() != -1
        return backward and module is self._cut and self._counts[module] == 1

    def _record(self, module: nn.Module, watch: Watch, given: Any, run: Callable[[], Any]) -> Any:
        """Run a call and note it: kept where its output can stand for all that it does."""
        self._ran.add(module)
        call, place, since = Call(module=module), len(self._calls), watch.now()
        self._calls.append(call)
        before = list(tensors_in(given))
        outer, self._sealed = self._sealed, self._can_be_sealed(module)
        try:
            output = run()
        finally:
            sealed, self._sealed = self._sealed, outer
        here = module is self._cut and self._name.call in (None, self._counts[module])
        is_cut = here and self._cut_call is None
        if (
            watch.can_stand_for(since, given, output)
            and module not in self._around_hooks
            and _same_tensors(before, tensors_in(given))
        ):
            self._drop_calls_from(place + 1)
            call.kept = True
            call.remember(output)
            watch.protect(call)
        elif sealed and next(module.children(), None) is not None:
            self._open.add(module)
        if is_cut:
            self._cut_call = call
            self._z0 = self._choose(output)
            raise _CutReached
        return output

    def _can_be_sealed(self, module: nn.Module) -> bool:
        """True if it ends before the cut, so that what is inside needs no noting."""
        apart = module in self._around_cut or module in self._around_hooks or module in self._open
        return self._cut_call is None and not apart

    def _release_unread(self, watch: Watch) -> None:
        """Remembered outputs that only go into other remembered submodules lose their memory.

        Something of their shape is handed back in their place; every pass reads the same ones.
        """
        for call in self._calls:
            if call.kept and not call.copied:  # of those, copies were handed out, and may be read
                call.unread = frozenset(
                    path for path, t in tensors_in(call.output) if not _is_read(t, watch)
                )
                call.remember(call.output)

    def _drop_calls_from(self, place: int) -> None:
        for call in self._calls[place:]:
            call.forget()  # the watch knows the call, and would hold its tensors
        del self._calls[place:]

    def _choose(self, output: Any) -> Tensor:
        found = [
            (path, tensor)
            for path, tensor in tensors_in(output)
            if tensor.is_floating_point() and tensor.layout == torch.strided
        ]
        names = ", ".join(self._name.of_output(path) for path, _ in found)
        if self._name.key is None and len(found) == 1:
            self._path, z = found[0]
        elif self._name.key is None:
            what = f"returns several tensors; say which: {names}" if found else "returns no tensor"
            raise LayerError(f"layer {self.layer!r} {what}")
        else:
            self._path = self._name.key
            match = [tensor for path, tensor in found if path == self._path]
            if not match:
                raise LayerError(f"layer {self.layer!r} has no such output; it has {names}")
            z = match[0]
        return z.detach()

    def _inject(self, run: Callable[[], Any]) -> Any:
        # A clone, because the network may go on in place and z may be a leaf.
        assert self._z is not None
        assert self._cut_call is not None
        assert self._z0 is not None
        z = self._z.to(self._z0.dtype, copy=True)
        # What the layer does besides, such as changing its input in place, is done again.
        output = self._cut_call.hand_back() if self._cut_call.kept else run()
        if self._watch is not None:
            self._watch.touch(z)
            if not self._cut_call.kept:
                self._watch.replace(dict(tensors_in(output))[self._path], z)
        return map_tensors(output, lambda path, t: z if path == self._path else t)

    def _never_ran(self) -> str:
        if self._cut in self._ran:
            times = self._counts[self._cut]
            return f"layer {self.layer!r}: it is called only {times} time{'s' if times > 1 else ''}"
        inside = [
            name
            for name, module in self._modules.items()
            if name.startswith(self._name.module + ".") and module in self._ran
        ]
        hint = f"cut at a part of it: {', '.join(inside[:4])}" if inside else "choose another layer"
        return f"layer {self.layer!r} never runs in this network's forward; {hint}"


def gradient_at(z: Tensor, value: Tensor) -> Tensor | None:
    """∂value/∂z for a fresh leaf z; None where no gradient comes back to it.

    ModelError if the network cannot be differentiated.
    """
    if value.requires_grad:
        with wrap_user_errors("the gradient of the network"):
            value.backward()  # type: ignore[no-untyped-call]
    return z.grad


def _is_read(tensor: Tensor, watch: Watch) -> bool:
    """True unless it is known that nobody looks into the tensor's memory."""
    return watch.was_read(tensor) or tensor.is_inference() or tensor.layout != torch.strided


def _own(arguments: Sequence[Any]) -> Any:
    """Copies: the network may change them in place, the caller's must not change."""
    return map_tensors(tuple(arguments), lambda _, t: t.detach().clone())


def _handed_out(z0: Tensor) -> Tensor:
    """A copy, for the network may go on to change the memory that z_0 lies in."""
    return z0.to(torch.float32 if z0.dtype in _FEW_BITS else z0.dtype, copy=True)


def _shapes(arguments: Sequence[Any]) -> Any:
    """What two lists of arguments must share for a network without branches to treat them alike."""
    tensors = [(t.shape, t.dtype, t.device) for _, t in tensors_in(tuple(arguments))]
    return tensors, repr(map_tensors(tuple(arguments), lambda _, t: t.new_empty(0)))


def _around(inner: nn.Module, modules: dict[str, nn.Module]) -> set[nn.Module]:
    """The submodules that contain this one, itself included."""
    names = [f"{name}." for name, module in modules.items() if module is inner]
    return {
        module
        for name, module in modules.items()
        if not name or any(inside.startswith(f"{name}.") for inside in names)
    }


def _around_hooks(modules: dict[str, nn.Module]) -> set[nn.Module]:
    """The submodules with a hooked part; were they remembered whole, its hook would not run."""
    hooked = [name for name, m in modules.items() if m._forward_hooks or m._forward_pre_hooks]
    return {m for part, m in modules.items() for name in hooked if _is_within(name, part)}


def _is_within(name: str, part: str) -> bool:
    return name != part and (not part or name.startswith(f"{part}."))


def _same_tensors(one: Iterable[tuple[Any, Tensor]], other: Iterable[tuple[Any, Tensor]]) -> bool:
    """False where a call has changed the lists or dicts it was given."""
    return [(path, id(tensor)) for path, tensor in one] == [(p, id(t)) for p, t in other]


def _several_calls(layer: str, calls: int) -> str:
    choices = ", ".join(f"{layer}#{call}" for call in range(1, calls + 1))
    return f"layer {layer!r} is called {calls} times; say which call: {choices}"


def _unknown(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = (
        f"did you mean {', '.join(near)}?" if near else "`pnpdepth layers --all` lists all of them"
    )
    return f"layer {name!r} is not in this network; {hint}"
