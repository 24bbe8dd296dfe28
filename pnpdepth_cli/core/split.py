"""Cutting any network at any layer: f = f_rear ∘ f_front, without rewriting the network.

The front runs the network's own forward up to the cut and stops there. It remembers the output of
every *outermost* submodule that finished before: whatever ran before z existed cannot depend on z.
The rear runs the network's own forward again, but those submodules hand back what they gave, and
the cut layer hands back z. Skip connections and plain Python between the layers come out right by
construction.

The first rear pass is watched operation by operation (`Watch`). It learns which submodules behind
the cut do not depend on z either, so that they are remembered as well, and it saves remembered
tensors from in-place operations.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.foreign import blaming
from pnpdepth_cli.core.structure import map_tensors, tensors_in
from pnpdepth_cli.core.watch import Call, Watch
from pnpdepth_cli.errors import LayerError


@dataclass(frozen=True)
class LayerName:
    """A place to cut: `module`, `module#2` for its second call, `module[key]` for one output."""

    module: str
    call: int | None = None
    key: tuple[str, ...] | None = None

    @classmethod
    def parse(cls, text: str) -> LayerName:
        """The name in its parts. LayerError if it has no such form."""
        match = re.fullmatch(
            r"(?P<module>[^#\[\]]*)(?:#(?P<call>\d+))?(?P<keys>(?:\[[^\[\]]+\])*)", text
        )
        if match is None or match["call"] == "0":
            raise LayerError(f"layer {text!r}: the form is NAME, NAME#CALL or NAME[OUTPUT]")
        keys = tuple(re.findall(r"\[([^\[\]]+)\]", match["keys"]))
        return cls(match["module"], int(match["call"]) if match["call"] else None, keys or None)


class _CutReached(BaseException):
    """Stops the front's pass at the cut; not an Exception, so that networks do not catch it."""


class Split:
    """A network cut at a layer, as a context manager; the network is as before when it closes.

    with Split(network, "decoder.up1") as split:
        z = split.front(rgb)        # once
        output = split.rear(z)      # many times; differentiable in z

    While open, the network is in eval mode and only z requires gradient. Raises LayerError for a
    layer that does not exist, never runs, or runs or returns several times without a choice.
    """

    _arguments: tuple[Any, ...]
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
    _sealed: bool

    def __init__(self, network: nn.Module, layer: str) -> None:
        self.layer = layer
        self._network = network
        self._name = LayerName.parse(layer)
        self._modules = dict(network.named_modules())
        if self._name.module not in self._modules or not self._name.module:
            raise LayerError(_unknown(self._name.module, [name for name in self._modules if name]))
        self._cut = self._modules[self._name.module]
        self._around_cut = _ancestors(network, self._cut)
        self._forget()

    def __enter__(self) -> Split:
        self._modes = [(module, module.training) for module in self._network.modules()]
        self._frozen = [p for p in self._network.parameters() if p.requires_grad]
        self._forwards = [
            (module, module.__dict__.get("forward"))
            for module in self._network.modules()
            if not isinstance(module, torch.jit.ScriptModule)
        ]
        self._network.eval()
        for parameter in self._frozen:
            parameter.requires_grad_(False)
        for module, _ in self._forwards:
            module.__dict__["forward"] = self._stand_in(module, module.forward)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for module, own_forward in self._forwards:
            if own_forward is None:
                module.__dict__.pop("forward", None)
            else:
                module.__dict__["forward"] = own_forward
        for parameter in self._frozen:
            parameter.requires_grad_(True)
        for module, training in self._modes:
            module.training = training
        self._forget()

    def front(self, *arguments: Any) -> Tensor:
        """z_0, the output of the cut layer for these arguments of the network."""
        self._forget()
        self._arguments = arguments
        try:
            with self._watching():
                self._run()
        except _CutReached:
            self._index()
            assert self._z0 is not None
            return self._z0
        raise LayerError(self._never_ran())

    def rear(self, z: Tensor) -> Any:
        """What the network returns when the cut layer gives z."""
        if not self._calls:
            raise RuntimeError("rear() needs front() first")
        self._z = z
        self._counts.clear()
        if self._learned:
            return self._run()
        known = len(self._calls)
        try:
            with self._watching() as watch:
                output = self._run()
        except BaseException:
            del self._calls[known:]
            raise
        if self._name.call is None and self._counts[self._cut] > 1:
            raise LayerError(_several_calls(self.layer, self._counts[self._cut]))
        if watch.data_dependent:  # another z may take another path behind the cut
            del self._calls[known:]
        self._index()
        self._learned = True
        return output

    @contextmanager
    def _watching(self) -> Iterator[Watch]:
        watch = Watch(call for call in self._calls if call.output is not None)
        self._watch = watch
        try:
            with watch:
                yield watch
        finally:
            self._watch = None

    def _run(self) -> Any:
        with blaming("the network's forward"):
            return self._network(*self._arguments)

    def _forget(self) -> None:
        self._arguments, self._z0, self._z = (), None, None
        self._calls, self._slots, self._ran = [], {}, set()
        self._counts = Counter()
        self._watch = self._cut_call = None
        self._learned = self._sealed = False

    def _index(self) -> None:
        self._slots = {}
        for call in self._calls:
            self._slots.setdefault(call.module, []).append(call)

    def _stand_in(self, module: nn.Module, original: Callable[..., Any]) -> Callable[..., Any]:
        def forward(*args: Any, **kwargs: Any) -> Any:
            count = self._counts[module]
            self._counts[module] += 1
            slots = self._slots.get(module, ())
            if count < len(slots):
                call = slots[count]
                if call is self._cut_call:
                    return self._inject(call)
                return call.hand_back() if call.kept else original(*args, **kwargs)
            if self._watch is None or (self._sealed and module is not self._cut):
                return original(*args, **kwargs)
            return self._record(module, self._watch, lambda: original(*args, **kwargs))

        return forward

    def _record(self, module: nn.Module, watch: Watch, run: Callable[[], Any]) -> Any:
        """Run a call and note it: kept with its output where nothing in it depended on z."""
        self._ran.add(module)
        call, place, touched = Call(module), len(self._calls), watch.touched
        self._calls.append(call)
        # Inside a submodule that will be remembered as a whole, nothing needs noting.
        sealed, self._sealed = (
            self._sealed,
            self._cut_call is None and module not in self._around_cut,
        )
        try:
            output = run()
        finally:
            self._sealed = sealed
        here = module is self._cut and self._name.call in (None, self._counts[module])
        if here and self._cut_call is None:
            self._drop_calls_after(place)
            self._cut_call, call.output = call, output
            self._z0 = self._choose(output)
            raise _CutReached
        if watch.touched == touched and not watch.is_touched(output):
            self._drop_calls_after(place)
            call.kept, call.output = True, output
            watch.protect(call)
        return output

    def _drop_calls_after(self, place: int) -> None:
        for call in self._calls[place + 1 :]:
            call.output = None
        del self._calls[place + 1 :]

    def _choose(self, output: Any) -> Tensor:
        found = [
            (path, tensor) for path, tensor in tensors_in(output) if tensor.is_floating_point()
        ]
        names = ", ".join(_output_name(self._name.module, path) for path, _ in found)
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

    def _inject(self, call: Call) -> Any:
        # A clone, because the network may go on in place and z may be a leaf.
        assert self._z is not None
        z = self._z.clone()
        if self._watch is not None:
            self._watch.touch(z)
        return map_tensors(call.output, lambda path, t: z if path == self._path else t)

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


def _ancestors(network: nn.Module, cut: nn.Module) -> set[nn.Module]:
    """The submodules that contain the cut one, itself included."""
    modules = dict(network.named_modules(remove_duplicate=False))
    names = [name for name, module in modules.items() if module is cut]
    return {m for part, m in modules.items() for n in names if f"{n}.".startswith(f"{part}.")} | {
        network
    }


def _output_name(module: str, path: tuple[str, ...]) -> str:
    return module + "".join(f"[{key}]" for key in path)


def _several_calls(layer: str, calls: int) -> str:
    choices = ", ".join(f"{layer}#{call}" for call in range(1, calls + 1))
    return f"layer {layer!r} is called {calls} times; say which call: {choices}"


def _unknown(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = (
        f"did you mean {', '.join(near)}?" if near else "`pnpdepth layers --all` lists all of them"
    )
    return f"layer {name!r} is not in this network; {hint}"
