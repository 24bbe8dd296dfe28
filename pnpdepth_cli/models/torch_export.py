"""A torch.export archive (.pt2) as a definition; the nodes of its graph are the layers.

`torch.export.load` trusts its file: it unpickles inputs, evaluates expressions of sizes and the
code of guards, and finds functions by dotted names. Here the graph is read from its JSON, tensors
are plain bytes, and nothing but operators of torch is called; no size is computed. Whatever else
lies in the archive is left alone (layout and schema: torch/_export/serde/schema.py).
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, fx
from torch.fx.node import Argument

from pnpdepth_cli.budget import check_network_file
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.models.definition import ModelDefinition, graph_definition
from pnpdepth_cli.models.file_graph import FileGraph, Operation
from pnpdepth_cli.models.weights.pickle_reader import view_of, wrap_content_errors
from pnpdepth_cli.models.weights.pickled_files import refuse_inflated

_OPERATOR = re.compile(r"torch\.ops\.(aten|prims?)\.(\w+)\.(\w+)")
"""Library, name and overload of an operator that only computes."""
_TOUCHES_FILES = re.compile("file|save|load")
"""What the name of an operator that reads or writes files may have in it."""
_DTYPES = {
    1: torch.uint8, 2: torch.int8, 3: torch.int16, 4: torch.int32, 5: torch.int64,
    6: torch.float16, 7: torch.float32, 8: torch.float64, 12: torch.bool, 13: torch.bfloat16,
}  # fmt: skip
"""Types of elements by the schema's number."""
_MEMORY_FORMATS = {1: torch.contiguous_format, 2: torch.channels_last, 4: torch.preserve_format}
"""Memory formats by the schema's number."""
_STRIDED = 7
"""The schema's number of the layout torch.strided."""
_KEYWORD = 2
"""The schema's number of the kind of an argument that is passed by its name."""

_MAX_SHOWN = 80
"""Characters of a wrong name that are shown."""
_MAX_KIND = 40
"""Characters of the kind of an argument or a result that are shown."""

_Json = Mapping[str, Any]
"""An object of the archive's JSON; what is not as expected in it raises one of CONTENT_ERRORS."""


def exported_definition(file: Path, **stated: object) -> ModelDefinition:
    """Returns the definition of a network saved by torch.export.save.

    Args:
        file: The .pt2 file; it takes one rgb image 1×3×H×W, unless another `input_kind` is stated.
        **stated: Fields of `ModelDefinition` that a definition file states of it.

    Raises:
        ModelError: The file cannot be read, would do more than compute, or has other inputs.
    """
    check_network_file(file, "exported program")
    way_out = f"write it by torch.export.save of about this version of torch ({torch.__version__})"
    with wrap_content_errors(f"exported program {file} cannot be read, {way_out}"):
        program, tensors = _read(file)
        graph = _graph(program, tensors)
        values = program["graph_module"]["graph"]["tensor_values"]
        sizes = [values[name]["sizes"] for name in graph.inputs]
        shapes = [[dict(side).get("as_int", "?") for side in size] for size in sizes]
    return graph_definition(
        shapes, file, stated,
        summary="torch.export archive", build=lambda: _graph(program, tensors),
    )  # fmt: skip


def _read(file: Path) -> tuple[_Json, dict[str, Tensor]]:
    """Returns the program in an archive, as its JSON has it, and its tensors by name.

    Raises:
        Exception: The archive is not as expected; one of CONTENT_ERRORS.
    """
    with zipfile.ZipFile(file) as archive:
        # Entries by their paths in the one folder of the archive.
        entries = {info.filename.partition("/")[2]: info for info in archive.infolist()}
        refuse_inflated(archive, file)
        program = json.loads(archive.read(entries["models/model.json"]))
        # The tensors, of which several may lie in one storage.
        tensors: dict[str, Tensor] = {}
        storages: dict[str, bytearray] = {}
        for folder, kind in (("weights", "model_weights"), ("constants", "model_constants")):
            config = json.loads(archive.read(entries[f"data/{folder}/{kind}_config.json"]))
            for name, description in dict(config["config"]).items():
                if description["use_pickle"]:
                    raise InputError(f"{name[:_MAX_SHOWN]!r} is pickled, and no pickle is run")
                path = f"data/{folder}/{description['path_name']}"
                if path not in storages:
                    storages[path] = bytearray(archive.read(entries[path]))
                tensors[name] = _tensor(storages[path], description["tensor_meta"])
    return program, tensors


def _graph(program: _Json, tensors: Mapping[str, Tensor]) -> FileGraph:
    """Returns a program as a module whose submodules are its nodes.

    Args:
        program: Content of models/model.json.
        tensors: Weights and constants of the archive by name.

    Raises:
        Exception: The program is not as expected; one of CONTENT_ERRORS.
    """
    graph = FileGraph()
    module = program["graph_module"]
    # Inputs, weights and constants.
    for spec in module["signature"]["input_specs"]:
        ((kind, value),) = dict(spec).items()
        if kind == "user_input":
            graph.add_input(value["arg"]["as_tensor"]["name"])
        elif kind in ("parameter", "buffer", "tensor_constant"):
            graph.add_tensor(value["arg"]["name"], tensors[value[f"{kind}_name"]])
        else:
            raise InputError(f"its input is a {str(kind)[:_MAX_KIND]!r}")
    # Operations. One without a result only checks what the exporter saw.
    for node in module["graph"]["nodes"]:
        if node["outputs"]:
            _add_node(graph, node["target"], node["inputs"], node["outputs"])
    # What forward returns, without what the program would write back into its weights.
    outputs = [spec.get("user_output") for spec in module["signature"]["output_specs"]]
    graph.set_outputs([value["arg"]["as_tensor"]["name"] for value in outputs if value])
    return graph


def _add_node(graph: FileGraph, target: str, inputs: list[_Json], outputs: list[_Json]) -> None:
    """Adds a call to the graph.

    Args:
        graph: Graph with all that comes before.
        target: Operator that is called, as in "torch.ops.aten.relu.default".
        inputs: Arguments, each with its `name`, `kind` (by position or keyword) and `arg`.
        outputs: Results, one entry each; a list of tensors is one entry.

    Raises:
        InputError: The operator, an argument or a result is of a kind that is not taken.
    """
    positional = list[Argument]()
    keywords: dict[str, Argument] = {}
    for argument in inputs:
        value = _argument(argument["arg"], graph.values)
        if argument.get("kind") == _KEYWORD:
            keywords[argument["name"]] = value
        else:
            positional.append(value)
    operation = Operation(f"exported program: {target}", _function(target))
    output_names = [name for output in outputs for name in _output_names(output)]
    is_one_tensor = len(outputs) == 1 and "as_tensors" not in outputs[0]
    if is_one_tensor:
        # The layer has the name of its result.
        output_name = str(output_names[0])
        layer = output_name.replace(".", "_")
        graph.add_operation(layer, operation, positional, keywords, output_name)
    else:
        # The layer has the name of the operator.
        layer = target.split(".")[-2]
        graph.add_operation(layer, operation, positional, keywords, output_names)


def _tensor(storage: bytearray, meta: _Json) -> Tensor:
    """Returns a tensor over the bytes of its storage, of the type and shape in its description."""
    dtype = _DTYPES[meta["dtype"]]
    flat = torch.frombuffer(storage, dtype=dtype) if storage else torch.empty(0, dtype=dtype)
    shape = [side["as_int"] for side in meta["sizes"]]
    stride = [step["as_int"] for step in meta["strides"]]
    return view_of(flat, meta["storage_offset"]["as_int"], shape, stride)


def _function(target: str) -> Callable[..., object]:
    """Returns the operator that is named torch.ops.LIBRARY.NAME.OVERLOAD.

    Raises:
        InputError: It is anything else than an operator of torch that only computes.
    """
    match = _OPERATOR.fullmatch(target)
    if match is not None and not _TOUCHES_FILES.search(match[2]):
        attribute: Any = torch.ops
        for name in match.groups():
            attribute = getattr(attribute, name, None)
        if isinstance(attribute, torch._ops.OpOverload):  # and no other attribute on the way
            return attribute
    raise InputError(f"it calls {target[:_MAX_SHOWN]!r}, which is no operator of torch")


def _argument(stated: _Json, values: Mapping[str, fx.Node]) -> Argument:
    """Returns an argument of a call.

    Args:
        stated: The argument in the program's JSON, {KIND: VALUE}.
        values: Nodes of the graph before, by name.

    Raises:
        InputError: The argument is of a kind that is not taken, such as a computed size.
    """
    # The kind without what says that it may be None or computed: "tensors" of
    # "as_optional_tensors", and "int" of "as_sym_int".
    ((kind, value),) = dict(stated).items()
    match kind.removeprefix("as_").replace("optional_", "").replace("sym_", ""):
        case "none":
            return None
        case "tensor" if "name" in value:
            return values[value["name"]]
        case "float" if not isinstance(value, Mapping):
            return float(value)  # JSON has a text for an infinite one
        case "tensor" | "int" | "float" | "bool" | "string":
            return _argument(value, values) if isinstance(value, Mapping) else value
        # A list. Its entries are plain values, nodes by `name`, or state their own kind, as where
        # only some of them are None.
        case "tensors" | "ints" | "floats" | "bools":
            kind_of_entry = kind.removesuffix("s")
            entries = list[Argument]()
            for entry in value:
                states_kind = isinstance(entry, Mapping) and "name" not in entry
                stated_entry = entry if states_kind else {kind_of_entry: entry}
                entries.append(_argument(stated_entry, values))
            return entries
        # Names of torch's own constants.
        case "scalar_type":
            return _DTYPES[value]
        case "memory_format":
            return _MEMORY_FORMATS[value]
        case "device":
            return torch.device(value["type"])
        case "layout" if value == _STRIDED:
            return torch.strided
    raise InputError(f"it has an argument {str(kind)[:_MAX_KIND]!r}")


def _output_names(stated: _Json) -> list[str | None]:
    """Returns the names of a result's tensors; None for one without a name, which nothing reads.

    Args:
        stated: The result in the program's JSON.

    Raises:
        InputError: The result is a computed size.
    """
    match stated:
        case {"as_tensor": {"name": name}}:
            return [str(name)]
        case {"as_tensors": tensors}:
            return [tensor["name"] for tensor in tensors]
        case {"as_none": _}:
            return [None]
    raise InputError(f"it computes {str([*stated])[:_MAX_KIND]}; export it with fixed sizes")
