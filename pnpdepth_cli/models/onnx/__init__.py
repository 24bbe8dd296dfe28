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

_OPSETS = range(7, 25)
"""Versions of the standard that are covered; onnxruntime runs none that is older."""
_MAX_BYTES = 1 << 31
"""Bytes of a protocol buffer; larger weights lie in files beside it."""
_SHARED = 2
"""Tensors that may have the same bytes of a file beside the model."""
_LEAST_PATCH = 8
"""Pixels of the smallest patch of a vision transformer."""

_STANDARD = ("", "ai.onnx")
"""Names of the standard's own domain of operators."""
_TO_SHAPES = ("Shape", "Size")
"""Operators that give the shape of a tensor, or its number of elements."""
_CONSTANT_ELEMENTS = 1 << 24
"""Elements that any one computed constant may have."""
_CONSTANT_GROWTH = 4
"""Elements of one computed constant for each that is stored in the file, if that is more."""
_CONSTANTS = 4
"""Elements of all computed constants together over those that one may have."""

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
    # A constant may be listed among the inputs, as a default that a caller can replace.
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = {value.name: _shape(value) for value in model.graph.input}
    shapes = [shape for name, shape in inputs.items() if name not in constants]
    is_pruned = _prune(model, _choose_output(model, output, file))
    # onnxruntime must not run what is pruned. From the file, it reads weights that lie beside it.
    source = model.SerializeToString() if is_pruned else str(file)
    return graph_definition(
        shapes, file, stated,
        size=Multiple(_patch_size(model) or ASSUMED_MULTIPLE),
        build=lambda: onnx_graph(model, file),
        summary=f"ONNX, opset {_opset(model)}, from {model.producer_name or 'no name'}",
        output=_as_map,
        verify=functools.partial(_verify, source, file, is_whole=is_whole),
    )  # fmt: skip


def _read(file: Path) -> tuple[ModelProto, bool]:
    """Returns the onnx.ModelProto with its weights, and whether all of it lies in the file.

    Raises:
        ModelError: A package is missing, or the file cannot be read or is not covered.
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
    errors_of_onnx = (DecodeError, onnx.checker.ValidationError)
    with wrap_content_errors(f"ONNX file {file} cannot be read", *errors_of_onnx):
        model = onnx.load(str(file), load_external_data=False)
        is_whole = not _load_external(model, file.parent)
        _check_covered(model)
    return model, is_whole


def _check_covered(model: ModelProto) -> None:
    """Raises InputError unless a model is one graph with names in UTF-8, of a covered opset."""
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
    """Reads tensors that lie in files beside the model into it; returns whether there are any.

    Args:
        model: The model, which is changed.
        folder: Folder of its file.

    Raises:
        InputError: They claim more than these files have, or more than memory holds.
        ModelError: A file is missing.
    """
    from onnx import external_data_helper as external

    claims = [
        external.ExternalDataInfo(tensor)
        for tensor in external._get_all_tensors(model)
        if external.uses_external_data(tensor)
    ]
    # All of them together claim no more than the files have; one without a length claims the whole
    # file.
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
    """Returns the shape of an input or output; a side of any length has a name, or "?"."""
    sides = value.type.tensor_type.shape.dim
    return [side.dim_value if side.dim_value > 0 else side.dim_param or "?" for side in sides]


def _choose_output(model: ModelProto, wanted: str | None, file: Path) -> str:
    """Returns the name of the output that is the depth.

    Args:
        model: The model.
        wanted: Name that the user gave; None takes the only output.
        file: File of the model, for messages.

    Raises:
        ModelError: There is no such output, or there are several and none was named.
    """
    shapes: dict[str, str] = {
        output.name: "×".join(map(str, _shape(output))) for output in model.graph.output
    }
    if wanted is None and len(shapes) == 1:
        return next(iter(shapes))
    if wanted is not None and wanted in shapes:
        return wanted
    listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    fact = f"no output {wanted!r}" if wanted else f"{len(shapes)} outputs"
    example = next(iter(shapes), "OUTPUT")
    raise ModelError(
        f"ONNX file {file} has {fact}; name the depth as {file}:{example}; it has {listed}"
    )


def _prune(model: ModelProto, output: str) -> bool:
    """Leaves one output and the nodes that it needs in a model; returns whether it had others.

    Args:
        model: The model, which is changed.
        output: Name of the output that stays.
    """
    graph = model.graph
    # From the last node back: each one whose result is needed, and then its inputs.
    needed = {output}
    kept_nodes = []
    for node in reversed(graph.node):
        if not needed.isdisjoint(node.output):
            kept_nodes.append(node)
            needed.update(filter(None, node.input))
    is_pruned = len(kept_nodes) < len(graph.node) or len(graph.output) > 1
    kept_outputs = [value for value in graph.output if value.name == output]
    kept_graph = type(graph)(node=reversed(kept_nodes), output=kept_outputs)
    graph.ClearField("node")
    graph.ClearField("output")
    graph.MergeFrom(kept_graph)
    return is_pruned


def _as_map(output: Tensor) -> Tensor:
    """Returns an output (1, h, w, 1) as (1, 1, h, w), any other as it is."""
    is_channels_last = output.ndim == 4 and output.shape[-1] == 1 and output.shape[1] != 1
    return output.permute(0, 3, 1, 2) if is_channels_last else output


def _patch_size(model: ModelProto) -> int | None:
    """Returns the pixels of a patch of a vision transformer; None for any other network.

    Patches are the kernels of a convolution that steps by its own kernel.
    """
    for node in model.graph.node:
        if node.op_type == "Conv":
            by_name = {attribute.name: list(attribute.ints) for attribute in node.attribute}
            kernel = by_name.get("kernel_shape", [])
            stride = by_name.get("strides", [])
            if kernel and kernel == stride and min(kernel) >= _LEAST_PATCH:
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
    """Returns the note that the network agrees with onnxruntime.

    They are compared on the first image of a size, and not again as long as the file stays as it
    is. Weights in other files may change unseen, so with them each first image is compared.

    Args:
        source: The ONNX file, or the content of one, that onnxruntime runs.
        file: The ONNX file that the network was read from.
        module: The network.
        arguments: Arguments of its forward for a frame.
        is_whole: Whether all weights lie in the file.

    Raises:
        ModelError: They do not agree.
    """

    def compare() -> list[str]:
        """Returns the note that is stored; raises ModelError if they do not agree."""
        with spent_on("check"):
            _compare(source, file, module, arguments)
        return [_AGREES]

    def is_agreement(answer: list[str]) -> bool:
        """Whether a kept answer is this note."""
        return answer == [_AGREES]

    sizes = [(tuple(tensor.shape), tensor.device.type) for tensor in arguments]
    # Without a file, no agreement is kept.
    kept_by = file if is_whole else None
    recall_or_decide(module, kept_by, f"agrees for {sizes}", compare, is_agreement)
    return _AGREES


def _compare(
    source: str | bytes, file: Path, module: nn.Module, arguments: Sequence[Tensor]
) -> None:
    """Raises ModelError if the network's output differs from onnxruntime's by over `MISMATCH`.

    Args:
        source: The ONNX file, or the content of one, that onnxruntime runs.
        file: The ONNX file, for messages.
        module: The network.
        arguments: Arguments of its forward for a frame.
    """
    import onnxruntime

    assert isinstance(module, FileGraph)
    with torch.no_grad():
        actual = module(*arguments).cpu()  # first, since it allocates no more than it should
    feed = {
        name: argument.float().cpu().numpy()
        for name, argument in zip(module.inputs, arguments, strict=True)
    }
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # it says fatal errors only
    options.intra_op_num_threads = torch.get_num_threads()
    with wrap_user_errors(f"onnxruntime, which checks ONNX file {file},"):
        session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        expected = torch.from_numpy(session.run(None, feed)[0]).float()
    deviation = _deviation(actual, expected)
    if not deviation <= MISMATCH:  # written so that NaN is refused, too
        raise ModelError(
            f"ONNX file {file}: its reading by torch differs from onnxruntime's by {deviation:.2g}"
            " of the output's range"
        )


def _deviation(actual: Tensor, expected: Tensor) -> float:
    """Returns the largest difference of two outputs over the largest expected value.

    Infinite if they differ in shape, or in where they are finite.
    """
    if actual.shape != expected.shape:
        return math.inf
    # A network may be inf or NaN in the sky.
    is_actual_finite = actual.isfinite()
    is_expected_finite = expected.isfinite()
    unlike_count = int((is_actual_finite != is_expected_finite).sum())
    are_finite = is_actual_finite & is_expected_finite
    if unlike_count > MISMATCH * expected.numel() or not are_finite.any():
        return math.inf
    actual = actual[are_finite].float()
    expected = expected[are_finite]
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
    # Constants, and how large those may become that are computed of them.
    constants = {tensor.name: _tensor(tensor, path) for tensor in model.graph.initializer}
    stored = sum(constant.numel() for constant in constants.values())
    largest = max(_CONSTANT_ELEMENTS, _CONSTANT_GROWTH * stored)
    limit = SizeLimit(largest, in_all=_CONSTANTS * largest, work=_WORK)
    for value in model.graph.input:
        if value.name not in constants:
            graph.add_input(value.name)
    # Names of values that are shapes, or computed of shapes only.
    shape_values = set[str]()
    for proto in model.graph.node:
        # The operator, and those of its inputs that are no constants. An input that is left out has
        # an empty name.
        name = _layer_name(proto)
        node = _node(proto, opset, path)
        title = f"ONNX file {path}: node {name!r}: {node.op}"
        operation = Operation(title, functools.partial(_compute, node))
        computed = [value for value in proto.input if value and value not in constants]
        if not graph.values.keys() >= {*computed}:
            raise ModelError(f"{title} reads a value that nothing before it gives")
        # What only constants go into is computed now.
        if not computed:
            with torch.no_grad(), limit, wrap_user_errors(title):
                result = operation(*map(constants.get, proto.input))
            results = result if isinstance(result, tuple) else (result,)
            # Of an operator with several outputs, all but Split's give the first one only.
            constants.update(zip(proto.output, results, strict=False))
            continue
        # Anything else is a node of the module.
        on_shapes = node.op in _TO_SHAPES or shape_values.issuperset(computed)
        if on_shapes:
            shape_values.update(filter(None, proto.output))
        inputs = _arguments_of(proto, graph, constants, on_shapes=on_shapes)
        outputs = proto.output if node.op == "Split" else proto.output[0]
        graph.add_operation(name, operation, inputs, {}, outputs, is_layer=not on_shapes)
    # The one output.
    output = model.graph.output[0].name
    if output in constants:
        raise ModelError(f"ONNX file {path}: its output depends on no input")
    graph.set_outputs([output])
    return graph


def _node(proto: NodeProto, opset: int, path: Path) -> Node:
    """Returns what the function of an operator needs to know of a node of the file.

    Args:
        proto: The node.
        opset: Version of the standard.
        path: File of the model, for messages.
    """
    attributes = {attribute.name: _attribute(attribute, path) for attribute in proto.attribute}
    used_outputs = sum(bool(output) for output in proto.output)
    return Node(op=proto.op_type, opset=opset, outputs=used_outputs, attributes=attributes)


def _arguments_of(
    proto: NodeProto, graph: FileGraph, constants: Mapping[str, Tensor], *, on_shapes: bool
) -> list[Argument]:
    """Returns the inputs of a node of the module, None for one that is left out.

    Constants become weights of the module, which move to its device, but for those that are read as
    Python numbers: these stay tensors of the CPU.

    Args:
        proto: The node.
        graph: The module, with the nodes before it; weights are added.
        constants: Tensors that depend on no input, by name.
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
    """Returns the output of a node, of Split the tuple of all.

    Arithmetic on shapes stays on the CPU.

    Args:
        node: The operator with its attributes.
        *inputs: Inputs in the operator's order, on any devices; None for one that is left out.

    Raises:
        ModelError: This use of the operator is not covered.
    """
    if node.outputs > 1 and node.op != "Split":
        raise ModelError("more than its first output")
    for name, default in ONLY.items():
        if node.get(name, default) != default:
            raise ModelError(f"{name} {node.get(name)!r}")
    # The inputs on the device of the first that is not on the CPU, but for Python numbers.
    devices = [value.device for value in inputs if value is not None and not value.is_cpu]
    device = devices[0] if devices else "cpu"
    on_cpu = HOST_INPUTS[node.op]
    moved: list[Any] = [
        None if value is None else value.to("cpu" if index in on_cpu else device)
        for index, value in enumerate(inputs)
    ]
    return OPERATORS[node.op](node, moved)


def _opset(model: ModelProto) -> int:
    """Returns the version of the standard that a model uses."""
    versions = [entry.version for entry in model.opset_import if entry.domain in _STANDARD]
    return max(versions, default=1)


def _check_operators(nodes: Sequence[NodeProto], path: Path) -> None:
    """Raises ModelError, naming all of them, if nodes have operators that are not covered."""
    names = [
        node.op_type if node.domain in _STANDARD else f"{node.domain}.{node.op_type}"
        for node in nodes
    ]
    uncovered = Counter(name for name in names if name not in OPERATORS)
    if uncovered:
        listed = ", ".join(f"{name} ({count} ×)" for name, count in uncovered.items())
        raise ModelError(
            f"ONNX file {path} uses operators that are not covered: {listed}; export the network"
            " with others, or bring it as a Python file"
        )


def _layer_name(proto: NodeProto) -> str:
    """Returns the name of a node for --layer; of one without a name, its operator and output.

    A name of digits and dots alone gets the operator in front. Characters with a meaning in the
    names of layers become underscores.
    """
    name = proto.name or f"{proto.op_type}_{''.join(proto.output[:1])}"
    if name.replace(".", "").isdigit():
        name = f"{proto.op_type}_{name}"
    return name.translate(str.maketrans("#[]", "___"))


def _attribute(proto: AttributeProto, path: Path) -> object:
    """Returns the value of an attribute: a tensor, a text, a number or a list of numbers.

    The path is for messages.
    """
    from onnx import AttributeProto, helper

    if proto.type == AttributeProto.TENSOR:
        return _tensor(proto.t, path)
    value = helper.get_attribute_value(proto)
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return list(value) if proto.type in (AttributeProto.INTS, AttributeProto.FLOATS) else value


def _tensor(proto: TensorProto, path: Path) -> Tensor:
    """Returns a tensor of the file.

    Raises:
        ModelError: It cannot be read, or is in half precision; the path is for the message.
    """
    from onnx import numpy_helper

    with wrap_content_errors(f"ONNX file {path}: tensor {proto.name!r} cannot be read"):
        if proto.data_type in (proto.FLOAT16, proto.BFLOAT16):
            raise InputError("it is in half precision; export the network in float32")
        return torch.tensor(numpy_helper.to_array(proto))
