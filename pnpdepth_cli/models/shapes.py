"""Networks run on torch's meta device, where tensors have shapes but no values: in no time."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import TypeVar

from torch import Tensor, nn
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode

from pnpdepth_cli.models.file_graph import FileGraph, result_without_values

_Result = TypeVar("_Result")


def run_by_shapes(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    run: Callable[[nn.Module, tuple[Tensor, ...]], _Result],
) -> _Result:
    """Returns run(module, arguments), computed without values where the network allows that.

    A network of a file or of transformers is run without values, which takes no time. The code of
    any other may keep tensors outside itself, which would have no values later: it is run as it is.

    Args:
        module: The network.
        arguments: Arguments of its forward.
        run: Function of the network and its arguments whose result follows from shapes and from
            torch's graph alone.
    """
    if isinstance(module, FileGraph) or is_of_transformers(module):
        # Any exception: where a network reads values, or torch knows no shapes, its code fails
        # somewhere. It is run as it is then.
        with suppress(Exception), _WithoutValues():  # type: ignore[no-untyped-call]
            return run(_without_values(module), tuple(tensor.to("meta") for tensor in arguments))
    return run(module, arguments)


def is_of_transformers(module: nn.Module) -> bool:
    """Whether the network is a class of the package transformers."""
    return type(module).__module__.startswith("transformers.")


def _without_values(module: nn.Module) -> nn.Module:
    """Returns a copy of the network on the meta device."""
    # deepcopy takes what stands here under an object's id for that object's copy.
    copies = dict[int, object]()
    for parameter in module.parameters():
        copies[id(parameter)] = nn.Parameter(parameter.detach().to("meta"), requires_grad=False)
    for buffer in module.buffers():
        copies[id(buffer)] = buffer.to("meta")
    return copy.deepcopy(module, copies)


class _WithoutValues(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Inside, torch's operations on meta tensors give their results by `result_without_values`."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # without this mark, torch would import its whole compiler

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: Sequence[object] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        """Returns the result of one operation; torch calls this (TorchDispatchMode)."""
        return result_without_values(func, args, kwargs or {})
