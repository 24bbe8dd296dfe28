"""An ONNX file as a definition. Once for a size, onnxruntime checks what torch computes.

The network's submodules are the graph's nodes, under their own names. What depends on no input is
computed once, when the module is made, and arithmetic on shapes is no layer.

`net.onnx`, or `net.onnx:OUTPUT` if the graph has several outputs. Needs `pip install
pnpdepth[onnx]`.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.fx.node import Argument

from pnpdepth_cli.budget import check_claim, check_network_file, max_decoded_bytes
from pnpdepth_cli.errors import InputError, ModelError, wrap_user_errors
from pnpdepth_cli.models.decisions import recall_or_decide
from pnpdepth_cli.models.definition import (
    ASSUMED_MULTIPLE,
    ModelDefinition,
    Multiple,
    graph_definition,
)
from pnpdepth_cli.models.file_graph import FileGraph, Operation, SizeLimit
from pnpdepth_cli.models.onnx import image_operators  # noqa: F401  (it registers its operators)
from pnpdepth_cli.models.onnx.operators import HOST_INPUTS, ONLY, OPERATORS, Node
from pnpdepth_cli.models.weights.pickle_reader import wrap_content_errors
from pnpdepth_cli.spent import spent_on

if TYPE_CHECKING:
    from onnx import AttributeProto, ModelProto, NodeProto, TensorProto, ValueInfoProto

_OPSETS = range(7, 25)  # onnxruntime runs none that is older
_MAX_BYTES = 1 << 31  # of a protocol buffer; larger weights lie in files beside it
_SHARED = 2  # tensors that may have the same bytes of a file beside the model

_STANDARD = ("", "ai.onnx")
_TO_SHAPES = ("Shape", "Size")
_CONSTANT_ELEMENTS = 1 << 24
_CONSTANT_GROWTH = 4
_CONSTANTS = 4
"""One computed constant may have so many elements, or so many times those stored in the file; all
of them together so many times as many as one."""

_WORK = 1 << 32
"""Elements that may be read, and products summed, for all computed constants: seconds."""

MISMATCH = 1e-3
"""The largest deviation from onnxruntime's output, relative to that output's range."""

_AGREES = f"ONNX: agrees with onnxruntime to better than {MISMATCH:.1%} of its range"


def onnx_definition(file: Path, output: str | None = None, **stated: object) -> ModelDefinition:
    """Returns the definition of an ONNX depth network.

    Args:
        file: The .onnx file; it takes one rgb image 1×3×H×W or 1×H×W×3, unless another
            `input_kind` is stated.
        output: Name of the graph's output that is the depth; None if it has only one.
        **stated: Fields of `ModelDefinition` that a definition file states of it.

    Raises:
        ModelError: The file cannot be read, or the network cannot be run.
    """
    model, is_whole = _read(file)
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = {i.name: _shape(i) for i in model.graph.input if i.name not in constants}
    is_part = _prune(model, _choose_output(model, output, file))
    # onnxruntime must not run what is pruned. From the file, it reads weights that lie beside it.
    source = model.SerializeToString() if is_part else str(file)
    return graph_definition(
        list(inputs.values()), file, stated,
        size=Multiple(_patch_size(model) or ASSUMED_MULTIPLE),
        build=lambda: onnx_graph(model, file),
        summary=f"ONNX, opset {_opset(model)}, from {model.producer_name or 'no name'}",
        output=_as_map,
        verify=functools.partial(_verify, source, file, is_whole=is_whole),
    )  # fmt: skip


def _read(file: Path) -> tuple[ModelProto, bool]:
    """The onnx.ModelProto with its weights, of an opset that is covered.

    True if all of it lies in the file.
    """
    # The file, and the packages that read it.
    check_network_file(file, "ONNX file", _MAX_BYTES)
    try:
        with spent_on("import"):
            import onnx
            import onnxruntime  # noqa: F401
            from google.protobuf.message import DecodeError
    except ImportError as error:
        raise ModelError(
            f"reading {file} needs {error.name}: pip install 'pnpdepth[onnx]'"
        ) from None
    more = (DecodeError, onnx.checker.ValidationError)
    with wrap_content_errors(f"ONNX file {file} cannot be read", *more):
        model = onnx.load(str(file), load_external_data=False)
        is_whole = not _load_external(model, file.parent)
        _check_covered(model)
    return model, is_whole


def _check_covered(model: ModelProto) -> None:
    """InputError unless it is one graph whose names are text, of an opset that is covered."""
    if not model.graph.node:
        raise InputError("it holds no graph")
    if model.functions:
        raise InputError("it has functions, which onnx.inliner.inline_local_functions writes out")
    for node in model.graph.node:
        words = (node.name, node.op_type, node.domain, *node.input, *node.output)
        if not all(isinstance(word, str) for word in words):
            raise InputError("its names are not text in UTF-8")
    if _opset(model) not in _OPSETS:
        raise InputError(
            f"it is of opset {_opset(model)}; export it with one from {_OPSETS[0]} to {_OPSETS[-1]}"
        )


def _load_external(model: ModelProto, folder: Path) -> bool:
    """Reads the tensors that lie in files beside the model into it. True if there are any.

    InputError if they claim more than these files have, or more than memory holds.
    """
    from onnx import external_data_helper as external

    claims = [
        external.ExternalDataInfo(tensor)
        for tensor in external._get_all_tensors(model)
        if external.uses_external_data(tensor)
    ]
    sizes = dict[str, int]()
    for location in dict.fromkeys(claim.location for claim in claims):
        check_network_file(folder / location, "its file")
        sizes[location] = (folder / location).stat().st_size
    claimed = sum(claim.length or sizes[claim.location] for claim in claims)
    most = min(_SHARED * sum(sizes.values()), max_decoded_bytes())
    check_claim(f"its tensors have {claimed:,} bytes in other files", claimed, most)
    if claims:
        external.load_external_data_for_model(model, str(folder))
    return bool(claims)


def _shape(value: ValueInfoProto) -> list[int | str]:
    dims = value.type.tensor_type.shape.dim
    return [d.dim_value if d.dim_value > 0 else d.dim_param or "?" for d in dims]


def _choose_output(model: ModelProto, wanted: str | None, file: Path) -> str:
    outputs: dict[str, str] = {o.name: "×".join(map(str, _shape(o))) for o in model.graph.output}
    if wanted is None and len(outputs) == 1:
        return next(iter(outputs))
    if wanted is not None and wanted in outputs:
        return wanted
    listed = ", ".join(f"{name} {shape}" for name, shape in outputs.items())
    found = f"no output {wanted!r}" if wanted else f"{len(outputs)} outputs"
    raise ModelError(
        f"ONNX file {file} has {found}; name the depth as {file}:{next(iter(outputs), 'OUTPUT')};"
        f" it has {listed}"
    )


def _prune(model: ModelProto, output: str) -> bool:
    """Leaves in the model one output and the nodes that it needs. True if others were there."""
    graph = model.graph
    needed = {output}
    nodes = []
    for node in reversed(graph.node):
        if not needed.isdisjoint(node.output):
            nodes.append(node)
            needed.update(filter(None, node.input))
    is_part = len(nodes) < len(graph.node) or len(graph.output) > 1
    outputs = [value for value in graph.output if value.name == output]
    kept = type(graph)(node=reversed(nodes), output=outputs)
    graph.ClearField("node")
    graph.ClearField("output")
    graph.MergeFrom(kept)
    return is_part


def _as_map(output: Tensor) -> Tensor:
    last = output.ndim == 4 and output.shape[-1] == 1 and output.shape[1] != 1
    return output.permute(0, 3, 1, 2) if last else output


def _patch_size(model: ModelProto) -> int | None:
    """The patch size of a vision transformer: a convolution that steps by its own kernel."""
    for node in model.graph.node:
        if node.op_type == "Conv":
            by_name = {a.name: list(a.ints) for a in node.attribute}
            kernel = by_name.get("kernel_shape", [])
            stride = by_name.get("strides", [])
            if kernel == stride and kernel and min(kernel) >= 8:
                return int(kernel[0])
    return None


def _verify(
    source: str | bytes,
    file: Path,
    module: nn.Module,
    arguments: Sequence[Tensor],
    *,
    is_whole: bool,
) -> str:
    """Says that the network agrees with onnxruntime. ModelError if it does not.

    They are compared on the first image of a size, and not again as long as the file stays as it
    is. Weights in other files may change unseen, so with them each first image is compared.
    """

    def compare() -> list[str]:
        with spent_on("check"):
            _compare(source, file, module, arguments)
        return [_AGREES]

    sizes = [(tuple(tensor.shape), tensor.device.type) for tensor in arguments]
    recall_or_decide(
        module, file if is_whole else None, f"agrees for {sizes}", compare, [_AGREES].__eq__
    )
    return _AGREES


def _compare(
    source: str | bytes, file: Path, module: nn.Module, arguments: Sequence[Tensor]
) -> None:
    """Raises ModelError if the network does not agree with onnxruntime on an image.

    The source is the file that onnxruntime reads, or the content of one.
    """
    import onnxruntime

    assert isinstance(module, FileGraph)
    with torch.no_grad():
        actual = module(*arguments).cpu()  # first, since it allocates no more than it should
    feed = {n: a.float().cpu().numpy() for n, a in zip(module.inputs, arguments, strict=True)}
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = torch.get_num_threads()
    with wrap_user_errors(f"onnxruntime, which checks ONNX file {file},"):
        session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        expected = torch.from_numpy(session.run(None, feed)[0]).float()
    deviation = _deviation(actual, expected)
    if not deviation <= MISMATCH:
        raise ModelError(
            f"ONNX file {file}: its reading by torch differs from onnxruntime's by {deviation:.2g}"
            " of the output's range"
        )


def _deviation(actual: Tensor, expected: Tensor) -> float:
    """The largest difference relative to the largest expected value."""
    if actual.shape != expected.shape:
        return math.inf
    known = expected.isfinite()
    both = known & actual.isfinite()  # a network may be inf or NaN in the sky
    if int((known != actual.isfinite()).sum()) > MISMATCH * expected.numel() or not both.any():
        return math.inf
    actual = actual[both].float()
    expected = expected[both]
    largest = float(expected.abs().amax())
    difference = float((actual - expected).abs().amax())
    return difference / largest if largest else difference


def onnx_graph(model: ModelProto, path: Path) -> FileGraph:
    """Returns an ONNX model as a module: called with the graph's inputs, it returns its output.

    Args:
        model: The onnx.ModelProto with one output, its nodes in order.
        path: File of the model, for messages.

    Raises:
        ModelError: An operator is not covered; the message names every one.
    """
    _check_operators(model.graph.node, path)
    graph = FileGraph()
    opset = _opset(model)
    constants = {tensor.name: _tensor(tensor, path) for tensor in model.graph.initializer}
    stored = sum(constant.numel() for constant in constants.values())
    largest = max(_CONSTANT_ELEMENTS, _CONSTANT_GROWTH * stored)
    limit = SizeLimit(largest, in_all=_CONSTANTS * largest, work=_WORK)
    for value in model.graph.input:
        if value.name not in constants:
            graph.add_input(value.name)
    shapes = set[str]()
    for proto in model.graph.node:
        # The operator and its inputs, of which one may be left out.
        name = _name(proto)
        attributes = {a.name: _attribute(a, path) for a in proto.attribute}
        used = sum(bool(output) for output in proto.output)
        node = Node(op=proto.op_type, opset=opset, outputs=used, attributes=attributes)
        title = f"ONNX file {path}: node {name!r}: {node.op}"
        operation = Operation(title, functools.partial(_compute, node))
        handed_in = [n for n in proto.input if n and n not in constants]
        if not graph.values.keys() >= {*handed_in}:
            raise ModelError(f"{title} reads a value that nothing before it gives")
        # What only constants go into is computed now.
        if not handed_in:
            with torch.no_grad(), limit, wrap_user_errors(title):
                result = operation(*map(constants.get, proto.input))
            results = result if isinstance(result, tuple) else (result,)
            constants.update(zip(proto.output, results, strict=False))
            continue
        # Anything else is a node of the module.
        on_shapes = node.op in _TO_SHAPES or shapes.issuperset(handed_in)
        if on_shapes:
            shapes.update(filter(None, proto.output))
        inputs = _arguments_of(proto, graph, constants, on_shapes=on_shapes)
        outputs = proto.output if node.op == "Split" else proto.output[0]
        graph.add_operation(name, operation, inputs, {}, outputs, is_layer=not on_shapes)
    output = model.graph.output[0].name
    if output in constants:
        raise ModelError(f"ONNX file {path}: its output depends on no input")
    graph.set_outputs([output])
    return graph


def _arguments_of(
    proto: NodeProto, graph: FileGraph, constants: Mapping[str, Tensor], *, on_shapes: bool
) -> list[Argument]:
    """The inputs of a node of the module: constants become weights, but for those of the CPU.

    Args:
        proto: The node.
        graph: The module, with the nodes before it.
        constants: Tensors that are known, by name.
        on_shapes: Whether the node computes with shapes, which stay on the CPU.
    """
    arguments = list[Argument]()
    for index, name in enumerate(proto.input):
        if name in constants and (on_shapes or index in HOST_INPUTS[proto.op_type]):
            arguments.append(constants[name])
        elif name in constants and name not in graph.values:
            arguments.append(graph.add_tensor(name, constants[name]))
        else:
            arguments.append(graph.values.get(name))
    return arguments


def _compute(node: Node, *inputs: Tensor | None) -> Tensor | tuple[Tensor, ...]:
    """The node's outputs. Arithmetic on shapes stays on the CPU."""
    if node.outputs > 1 and node.op != "Split":
        raise ModelError("more than its first output")
    for name, only in ONLY.items():
        if node.get(name, only) != only:
            raise ModelError(f"{name} {node.get(name)!r}")
    devices = [value.device for value in inputs if value is not None and not value.is_cpu]
    device = devices[0] if devices else "cpu"
    host = HOST_INPUTS[node.op]
    moved: list[Any] = [
        None if value is None else value.to("cpu" if index in host else device)
        for index, value in enumerate(inputs)
    ]
    return OPERATORS[node.op](node, moved)


def _opset(model: ModelProto) -> int:
    return max((o.version for o in model.opset_import if o.domain in _STANDARD), default=1)


def _check_operators(nodes: Sequence[NodeProto], path: Path) -> None:
    names = [n.op_type if n.domain in _STANDARD else f"{n.domain}.{n.op_type}" for n in nodes]
    unknown = Counter(name for name in names if name not in OPERATORS)
    if unknown:
        listed = ", ".join(f"{op} ({count} ×)" for op, count in unknown.items())
        raise ModelError(
            f"ONNX file {path} uses operators that are not covered: {listed}; export the network"
            " with others, or bring it as a Python file"
        )


def _name(proto: NodeProto) -> str:
    """Name of the node for --layer; one without a name has operator and output."""
    name = proto.name or f"{proto.op_type}_{''.join(proto.output[:1])}"
    if name.replace(".", "").isdigit():
        name = f"{proto.op_type}_{name}"
    return name.translate(str.maketrans("#[]", "___"))


def _attribute(proto: AttributeProto, path: Path) -> object:
    from onnx import AttributeProto, helper

    if proto.type == AttributeProto.TENSOR:
        return _tensor(proto.t, path)
    value = helper.get_attribute_value(proto)
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return list(value) if proto.type in (AttributeProto.INTS, AttributeProto.FLOATS) else value


def _tensor(proto: TensorProto, path: Path) -> Tensor:
    from onnx import numpy_helper

    with wrap_content_errors(f"ONNX file {path}: tensor {proto.name!r} cannot be read"):
        if proto.data_type in (proto.FLOAT16, proto.BFLOAT16):
            raise InputError("it is in half precision; export the network in float32")
        return torch.tensor(numpy_helper.to_array(proto))
