"""Networks without their values, on torch's meta device: shapes and graphs in no time."""

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
    """Returns what a function of a network and its arguments gives that reads no values.

    A network of a file or of transformers is run without values, which takes no time. The code of
    any other may keep tensors outside itself, which would have no values later: it is run as it is.
    """
    if isinstance(module, FileGraph) or is_of_transformers(module):
        # Where a network reads values, or torch knows no shapes, this fails.
        with suppress(Exception), _WithoutValues():  # type: ignore[no-untyped-call]
            return run(_without_values(module), tuple(tensor.to("meta") for tensor in arguments))
    return run(module, arguments)


def is_of_transformers(module: nn.Module) -> bool:
    """Whether the network is a class of that package."""
    return type(module).__module__.startswith("transformers.")


def _without_values(module: nn.Module) -> nn.Module:
    """A copy of the network on the meta device."""
    empty = dict[int, object]()
    for parameter in module.parameters():
        empty[id(parameter)] = nn.Parameter(parameter.detach().to("meta"), requires_grad=False)
    for buffer in module.buffers():
        empty[id(buffer)] = buffer.to("meta")
    return copy.deepcopy(module, empty)


class _WithoutValues(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Runs operations on meta tensors."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # as in `Watch`

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: Sequence[object] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        """The result of the operation; see TorchDispatchMode."""
        return result_without_values(func, args, kwargs or {})
