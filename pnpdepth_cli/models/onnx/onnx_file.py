"""An ONNX file as a definition. On the first image, onnxruntime checks what torch computes.

`net.onnx`, or `net.onnx:OUTPUT` if the graph has several outputs. Needs `pip install
pnpdepth[onnx]`.
"""

from __future__ import annotations

import graphlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import (
    ASSUMED_MULTIPLE,
    ModelDefinition,
    Multiple,
    graph_definition,
)
from pnpdepth_cli.models.onnx.graph import OnnxGraph
from pnpdepth_cli.models.onnx.limits import inline, load_external
from pnpdepth_cli.models.onnx.quantised import Quantised, outputs_of, quantises, session_of

MISMATCH = 1e-3
"""The largest deviation from onnxruntime's output, relative to that output's range."""

_HALF_MISMATCH = 1e-2  # half precision itself is no better
_OPSETS = range(7, 25)  # onnxruntime runs none that is older
_MAX_BYTES = 1 << 31  # of a protocol buffer; larger weights lie in files beside it


def onnx_definition(file: Path, output: str | None = None, **stated: Any) -> ModelDefinition:
    """Returns the definition of an ONNX depth network.

    Args:
        file: The .onnx file; it takes one rgb image 1×3×H×W or 1×H×W×3, unless another
            `input_kind` is stated.
        output: Name of the graph's output that is the depth; None if it has only one.
        **stated: Fields of `ModelDefinition` that a definition file states of it.

    Raises:
        ModelError: The file cannot be read, or the network cannot be run.
    """
    model = inline(_read(file), file)
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = {i.name: _shape(i) for i in model.graph.input if i.name not in constants}
    is_part = _prune(model, _choose_output(model, output, file), file)
    # From the file, onnxruntime reads weights that lie beside it.
    source = model.SerializeToString() if is_part else str(file)
    definition = graph_definition(
        list(inputs.values()), file, stated,
        size=Multiple(_patch_size(model) or ASSUMED_MULTIPLE),
        build=lambda: OnnxGraph(model, file),
        summary=f"ONNX, opset {_opset(model)}, from {model.producer_name or 'an unknown program'}",
        output=_as_map,
        verify=_FirstImageCheck(source, file),
    )  # fmt: skip
    if not quantises(model):
        return definition
    if len(inputs) > 1:
        raise ModelError(f"ONNX file {file} is quantised and has several inputs: not covered")
    return replace(
        definition,
        build=lambda: Quantised(source, file, model, next(iter(inputs))),
        verify=None,
        layers=("output",),
        defaults=replace(definition.defaults, iterations=0),
        assumed="its activations are quantised, which leaves no gradient; onnxruntime predicts, and"
        " z is not updated",
    )


def _prune(model: Any, output: str, path: Path) -> bool:
    """Leaves in the model one output and the nodes that it needs. True if others were there.

    Each node comes after those it reads. The order is that of the file if possible; files converted
    to half precision are not in order. ModelError if a node reads a value that nothing gives, or
    nodes read each other in a circle.
    """
    # What gives each value.
    graph = model.graph
    nodes, outputs = list(graph.node), [o for o in graph.output if o.name == output]
    known = {*(t.name for t in graph.initializer), *(i.name for i in graph.input)}
    producer = {name: n for n, proto in enumerate(nodes) for name in proto.output if name}
    # The nodes that the output needs, from the output backwards.
    reads: dict[int, set[int]] = {}
    pending = [producer[output]] if output in producer else []
    while pending:
        n = pending.pop()
        if n in reads:
            continue
        inputs = {name for name in nodes[n].input if name and name not in known}
        absent = sorted(inputs - producer.keys())
        if absent:
            raise ModelError(f"ONNX file {path}: a node reads {absent[0]!r}, which nothing gives")
        reads[n] = {producer[name] for name in inputs}
        pending += reads[n]
    # Their order is the file's, unless a node would come before what it reads.
    order = sorted(reads)
    if any(before >= n for n, befores in reads.items() for before in befores):
        try:
            by_number = dict(sorted(reads.items()))
            order = [*graphlib.TopologicalSorter(by_number).static_order()]
        except graphlib.CycleError:
            raise ModelError(f"ONNX file {path}: its nodes read each other in a circle") from None
    # They replace the graph's.
    pruned = len(order) < len(nodes) or len(outputs) < len(graph.output)
    kept = type(graph)()
    kept.node.extend(nodes[n] for n in order)
    kept.output.extend(outputs)
    graph.ClearField("node")
    graph.ClearField("output")
    graph.MergeFrom(kept)
    return pruned


def _as_map(output: Any) -> Tensor:
    tensor: Tensor = output
    last = tensor.ndim == 4 and tensor.shape[-1] == 1 and tensor.shape[1] != 1
    return tensor.permute(0, 3, 1, 2) if last else tensor


def _read(file: Path) -> Any:
    # The file, and the packages that read it.
    if not file.is_file():
        raise ModelError(f"ONNX file {file} does not exist")
    size = file.stat().st_size
    check_claim(f"ONNX file {file} has {size:,} bytes", size, _MAX_BYTES, error=ModelError)
    try:
        import onnx
        import onnxruntime  # noqa: F401
        from google.protobuf.message import DecodeError
    except ImportError as error:
        raise ModelError(
            f"{file} is an ONNX file, which needs the package {error.name!r}:"
            " pip install 'pnpdepth[onnx]'"
        ) from None
    try:
        model = onnx.load(str(file), load_external_data=False)
        load_external(model, file.parent)
    except (DecodeError, onnx.checker.ValidationError, ValueError, TypeError, OSError) as error:
        raise ModelError(f"ONNX file {file} cannot be read: {describe(error)}") from None
    # A graph whose names are text, of an opset that is covered.
    if not model.graph.node:
        raise ModelError(f"ONNX file {file} cannot be read: it holds no graph")
    for node in (*model.graph.node, *(node for f in model.functions for node in f.node)):
        words = (node.name, node.op_type, node.domain, *node.input, *node.output)
        if not all(isinstance(word, str) for word in words):
            raise ModelError(f"ONNX file {file} cannot be read: its names are not text in UTF-8")
    if _opset(model) not in _OPSETS:
        raise ModelError(
            f"ONNX file {file} is of opset {_opset(model)}; export it with one from"
            f" {_OPSETS[0]} to {_OPSETS[-1]}"
        )
    return model


def _opset(model: Any) -> int:
    return max((o.version for o in model.opset_import if o.domain in ("", "ai.onnx")), default=1)


def _shape(value: Any) -> list[int | str]:
    dims = value.type.tensor_type.shape.dim
    return [d.dim_value if d.dim_value > 0 else d.dim_param or "?" for d in dims]


def _choose_output(model: Any, wanted: str | None, file: Path) -> str:
    outputs: dict[str, list[int | str]] = {o.name: _shape(o) for o in model.graph.output}
    if wanted is None and len(outputs) == 1:
        return next(iter(outputs))
    if wanted in outputs:
        return str(wanted)
    listed = ", ".join(f"{n} {'×'.join(map(str, s))}" for n, s in outputs.items())
    first = next(iter(outputs), "OUTPUT")
    fact = f"no output {wanted!r}" if wanted else f"{len(outputs)} outputs"
    raise ModelError(
        f"ONNX file {file} has {fact}; name the depth as --model {file}:{first}; it has {listed}"
    )


def _patch_size(model: Any) -> int | None:
    """The patch size of a vision transformer: a convolution that steps by its own kernel."""
    for node in model.graph.node:
        if node.op_type == "Conv":
            by_name = {a.name: list(a.ints) for a in node.attribute}
            kernel, stride = by_name.get("kernel_shape", []), by_name.get("strides", [])
            if kernel == stride and kernel and min(kernel) >= 8:
                return int(kernel[0])
    return None


class _FirstImageCheck:
    """Compares the network with onnxruntime on the first image.

    Args:
        source: File that onnxruntime reads, or the content of one.
        file: The network's file, for messages.
    """

    def __init__(self, source: str | bytes, file: Path) -> None:
        self._source, self._file, self._note = source, file, ""

    def __call__(self, module: nn.Module, arguments: Sequence[Tensor]) -> str:
        """Returns how well they agree; compares only once. ModelError if they differ."""
        if self._note:
            return self._note
        assert isinstance(module, OnnxGraph)
        inputs = {n: a.detach().cpu() for n, a in zip(module.input_names, arguments, strict=True)}
        with torch.no_grad():
            actual = module(*arguments).cpu()  # first, since it allocates no more than it should
        expected = outputs_of(session_of(self._source, self._file), inputs, self._file)
        deviation = _deviation(actual, expected)
        if not deviation <= (_HALF_MISMATCH if module.is_half else MISMATCH):
            raise ModelError(
                f"ONNX file {self._file}: its reading by torch differs from onnxruntime's by"
                f" {deviation:.2g} of the output's range"
            )
        self._note = f"ONNX: agrees with onnxruntime on this image to {deviation:.1g} of its range"
        return self._note


def _deviation(actual: Tensor, expected: Tensor) -> float:
    """The largest difference relative to the largest expected value."""
    if actual.shape != expected.shape:
        return math.inf
    if not expected.numel():
        return 0.0
    known = expected.isfinite()
    both = known & actual.isfinite()  # a network may be inf or NaN in the sky
    if int((known != actual.isfinite()).sum()) > MISMATCH * expected.numel():
        return math.inf
    actual, expected = actual[both].float(), expected[both]
    largest = float(expected.abs().amax()) if len(expected) else 0.0
    difference = float((actual - expected).abs().amax()) if len(expected) else math.inf
    return difference / largest if largest else difference
