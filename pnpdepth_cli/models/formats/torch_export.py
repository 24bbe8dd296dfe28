"""A torch.export archive (.pt2) as a definition; the nodes of its graph are the layers.

The archive is checked before torch reads it, and the source code of its guards is never run.
"""

from __future__ import annotations

import contextlib
import logging
import operator
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, fx, nn

from pnpdepth_cli.budget import size_problem
from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import UNTUNED_DEFAULTS, Fixed, ModelDefinition, Multiple
from pnpdepth_cli.models.formats.export_archive import check_archive

_ASSUMED_MULTIPLE = 32


class ExportedOperation(nn.Module):
    """One operation of the exported graph."""

    def __init__(self, operation: Any) -> None:
        super().__init__()
        self._operation = operation

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Returns the operation's result."""
        return self._operation(*args, **kwargs)

    def extra_repr(self) -> str:
        """Returns the operation, for `print(network)`."""
        return str(self._operation)


def exported_definition(file: Path) -> ModelDefinition:
    """Returns the definition of a network saved by torch.export.save.

    Args:
        file: The .pt2 file; it takes one rgb image 1×3×H×W.

    Raises:
        ModelError: The file cannot be read, would do more than compute, or has other inputs.
    """
    if not file.is_file():
        raise ModelError(f"exported program {file} does not exist")
    if problem := size_problem(file):
        raise ModelError(f"exported program {file} {problem}")
    try:
        check_archive(file)
        with _without_logs_of_torch():
            graph = torch.export.load(file).module(check_guards=False)
    except ModelError:
        raise
    except Exception as error:  # every part of torch.export has its own way to fail
        raise ModelError(
            f"exported program {file} cannot be read: {describe(error)[:160]}; it must be written"
            f" by torch.export.save of about this version of torch ({torch.__version__})"
        ) from None
    shapes = [
        tuple(node.meta["val"].shape)
        for node in graph.graph.nodes
        if node.op == "placeholder" and isinstance(node.meta.get("val"), Tensor)
    ]
    if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][1] != 3:
        raise ModelError(
            f"exported program {file} takes inputs {shapes}; one rgb image 1×3×H×W is expected"
        )
    height, width = shapes[0][2:]
    fixed = isinstance(height, int) and isinstance(width, int)
    return ModelDefinition(
        name=file.stem,
        summary="torch.export archive",
        input_kind="rgb",
        size=Fixed(height, width) if fixed else Multiple(_ASSUMED_MULTIPLE),
        normalisation=None,
        output_kind="unknown",
        output_scale="unknown",
        build=lambda: _with_operations_as_modules(graph),
        complete=True,
        checkpoint=file,
        defaults=UNTUNED_DEFAULTS,
    )


@contextlib.contextmanager
def _without_logs_of_torch() -> Iterator[None]:
    """torch.export logs the traceback of each attempt to read a damaged file; the error says it."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def _with_operations_as_modules(exported: Any) -> nn.Module:
    """The same graph, with every operation on tensors as a submodule under its node's name."""
    root, graph = nn.Module(), fx.Graph()
    copies: dict[fx.Node, Any] = {}
    taken: set[str] = set()
    for node in exported.graph.nodes:
        copy = graph.node_copy(node, lambda n: copies[n])
        copies[node] = copy
        if node.op == "get_attr":
            name = str(node.target).replace(".", "_")
            if name not in taken:
                _hold(root, name, operator.attrgetter(str(node.target))(exported))
            taken.add(name)
            copy.target = name
        elif _is_layer(node):
            name = node.name
            while hasattr(root, name):  # as a node named `to`, a method of every module
                name += "_"
            root.add_module(name, ExportedOperation(node.target))
            copy.op, copy.target = "call_module", name
    return fx.GraphModule(root, graph)


def _is_layer(node: fx.Node) -> bool:
    gives_tensors = isinstance(node.meta.get("val"), Tensor | Sequence)
    return node.op == "call_function" and gives_tensors and node.target is not operator.getitem


def _hold(root: nn.Module, name: str, value: Tensor | nn.Module) -> None:
    if isinstance(value, nn.Module):
        root.add_module(name, value)  # a nested graph, such as one without gradients
    elif value.is_floating_point():
        root.register_parameter(name, nn.Parameter(value.detach(), requires_grad=False))
    else:
        root.register_buffer(name, value)
