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
_TOUCHES_FILES = re.compile("file|save|load")
_DTYPES = {
    1: torch.uint8, 2: torch.int8, 3: torch.int16, 4: torch.int32, 5: torch.int64,
    6: torch.float16, 7: torch.float32, 8: torch.float64, 12: torch.bool, 13: torch.bfloat16,
}  # fmt: skip
_MEMORY_FORMATS = {1: torch.contiguous_format, 2: torch.channels_last, 4: torch.preserve_format}
_STRIDED = 7
_KEYWORD = 2

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
    """The program, and its tensors by name."""
    with zipfile.ZipFile(file) as archive:
        entries = {info.filename.partition("/")[2]: info for info in archive.infolist()}
        refuse_inflated(archive, file)
        program = json.loads(archive.read(entries["models/model.json"]))
        tensors, storages = {}, {}
        for folder, kind in (("weights", "model_weights"), ("constants", "model_constants")):
            config = json.loads(archive.read(entries[f"data/{folder}/{kind}_config.json"]))
            for name, stated in dict(config["config"]).items():
                if stated["use_pickle"]:
                    raise InputError(f"{name[:80]!r} is pickled, and no pickle is run")
                path = f"data/{folder}/{stated['path_name']}"
                if path not in storages:
                    storages[path] = bytearray(archive.read(entries[path]))
                tensors[name] = _tensor(storages[path], stated["tensor_meta"])
    return program, tensors


def _graph(program: _Json, tensors: Mapping[str, Tensor]) -> FileGraph:
    """The program of models/model.json as a module, whose submodules are its nodes."""
    graph = FileGraph()
    module = program["graph_module"]
    for spec in module["signature"]["input_specs"]:
        ((kind, value),) = dict(spec).items()
        if kind == "user_input":
            graph.add_input(value["arg"]["as_tensor"]["name"])
        elif kind in ("parameter", "buffer", "tensor_constant"):
            graph.add_tensor(value["arg"]["name"], tensors[value[f"{kind}_name"]])
        else:
            raise InputError(f"its input is a {str(kind)[:40]!r}")
    for node in module["graph"]["nodes"]:
        if node["outputs"]:  # the others only check what the exporter saw
            _add_node(graph, node["target"], node["inputs"], node["outputs"])
    outputs = [spec.get("user_output") for spec in module["signature"]["output_specs"]]
    graph.set_outputs([value["arg"]["as_tensor"]["name"] for value in outputs if value])
    return graph


def _add_node(graph: FileGraph, target: str, inputs: list[_Json], outputs: list[_Json]) -> None:
    values = [(argument, _argument(argument["arg"], graph.values)) for argument in inputs]
    positional = [value for argument, value in values if argument.get("kind") != _KEYWORD]
    keywords = {
        argument["name"]: value for argument, value in values if argument.get("kind") == _KEYWORD
    }
    named = [name for output in outputs for name in _outputs_in(output)]
    alone = len(outputs) == 1 and "as_tensors" not in outputs[0]
    name = str(named[0] if alone else target.split(".")[-2]).replace(".", "_")
    operation = Operation(f"exported program: {target}", _function(target))
    graph.add_operation(name, operation, positional, keywords, str(named[0]) if alone else named)


def _tensor(content: bytearray, meta: _Json) -> Tensor:
    dtype = _DTYPES[meta["dtype"]]
    flat = torch.frombuffer(content, dtype=dtype) if content else torch.empty(0, dtype=dtype)
    shape, stride = ([number["as_int"] for number in meta[key]] for key in ("sizes", "strides"))
    return view_of(flat, meta["storage_offset"]["as_int"], shape, stride)


def _function(target: str) -> Callable[..., object]:
    """The operator named torch.ops.LIBRARY.NAME.OVERLOAD, and nothing else."""
    found = _OPERATOR.fullmatch(target)
    if found is not None and not _TOUCHES_FILES.search(found[2]):
        called: Any = torch.ops
        for name in found.groups():
            called = getattr(called, name, None)
        if isinstance(called, torch._ops.OpOverload):  # and no other attribute on the way
            return called
    raise InputError(f"it calls {target[:80]!r}, which is no operator of torch")


def _argument(stated: _Json, values: Mapping[str, fx.Node]) -> Argument:
    """An argument of a call, with the nodes of what the graph computes."""
    # The kind of the argument, without what says how it may vary.
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
        # A list, whose entries may be stated or computed.
        case "tensors" | "ints" | "floats" | "bools":
            kind = kind.removesuffix("s")
            entries = [
                entry if isinstance(entry, Mapping) and "name" not in entry else {kind: entry}
                for entry in value
            ]
            return [_argument(entry, values) for entry in entries]
        # Names of torch's own constants.
        case "scalar_type":
            return _DTYPES[value]
        case "memory_format":
            return _MEMORY_FORMATS[value]
        case "device":
            return torch.device(value["type"])
        case "layout" if value == _STRIDED:
            return torch.strided
    raise InputError(f"it has an argument {str(kind)[:40]!r}")


def _outputs_in(stated: _Json) -> list[str | None]:
    """The names that a stated output gives to values; None for a part without one."""
    match stated:
        case {"as_tensor": {"name": name}}:
            return [str(name)]
        case {"as_tensors": tensors}:
            return [tensor["name"] for tensor in tensors]
        case {"as_none": _}:
            return [None]
    raise InputError(f"it computes {str([*stated])[:40]}; export it with fixed sizes")
