"""Calls of a network's submodules go to a handler first, without any change to the network."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from torch import nn

Handler = Callable[[nn.Module, Any, Callable[[], Any]], Any]
"""Called with a submodule, its inputs (args, kwargs) and a function that runs it."""


class Interception:
    """Replaces `forward` of chosen submodules, and puts their own back.

    Args:
        modules: All submodules that may be intercepted, each once.
    """

    def __init__(self, modules: Iterable[nn.Module]) -> None:
        self._handler: Handler = _run_only
        self._own = {module: module.__dict__.get("forward") for module in modules}
        self._stand_ins = {module: self._stand_in(module, module.forward) for module in self._own}

    def only(self, modules: Collection[nn.Module]) -> None:
        """Intercepts the calls of these submodules and of no others."""
        for module, own_forward in self._own.items():
            if module in modules:
                module.__dict__["forward"] = self._stand_ins[module]
            elif own_forward is None:
                module.__dict__.pop("forward", None)
            else:
                module.__dict__["forward"] = own_forward

    def all(self) -> None:
        """Intercepts the calls of all submodules."""
        self.only(self._own)

    def close(self) -> None:
        """Gives every submodule its own forward back, and lets go of the handler."""
        self.only(())
        self._handler = _run_only

    @contextmanager
    def handled_by(self, during: Handler, afterwards: Handler) -> Iterator[None]:
        """Sets the handler of intercepted calls during and after the block."""
        self._handler = during
        try:
            yield
        finally:
            self._handler = afterwards

    def _stand_in(self, module: nn.Module, original: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(original)
        def forward(*args: Any, **kwargs: Any) -> Any:
            return self._handler(module, (args, kwargs), lambda: original(*args, **kwargs))

        return forward


def _run_only(module: nn.Module, inputs: Any, run: Callable[[], Any]) -> Any:
    return run()
