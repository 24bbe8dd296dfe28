"""From the name of a network, a file or a folder to its model definition.

A network can be named if `choices.NETWORKS` has a family with it: one file of `model_zoo_defs`, or
an entry point in the group `pnpdepth.models` of another package. A family is a module (or, for an
entry point, also the object itself) with one of

    definition = ModelDefinition(...)
    definitions = {"my-net": ModelDefinition(...), "my-net-tiny": ModelDefinition(...)}
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType

from pnpdepth_cli import choices
from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.python_file import python_definition
from pnpdepth_cli.models.weights.checkpoint import WEIGHT_SUFFIXES

_TORCHSCRIPT = (".ts", ".torchscript")


def names() -> list[str]:
    """Returns the names of all networks that can be named, each once, in the order of the families.

    A family of another package that cannot be loaded is left out; `find_definition` says why.
    """
    definitions = (one for some in families().values() for one in some.values())
    return list(dict.fromkeys(definition.name for definition in definitions))


def families() -> dict[str, Mapping[str, ModelDefinition]]:
    """Returns the definitions of all families that can be loaded, by the names they go by."""
    loadable = {}
    for family in choices.NETWORKS:
        with suppress(ModelError):
            loadable[family] = _definitions_of(family)
    return loadable


def _definitions_of(family: str) -> Mapping[str, ModelDefinition]:
    """The definitions of one family. ModelError if it cannot be loaded, or holds none."""
    try:
        entry = choices.NETWORKS[family]
    except PnpDepthError:
        raise
    except Exception as error:  # the code of another package
        raise ModelError(f"network family {family!r} cannot be loaded: {describe(error)}") from None
    if isinstance(entry, ModuleType):
        entry = getattr(entry, "definitions", None) or getattr(entry, "definition", None)
    definitions = {entry.name: entry} if isinstance(entry, ModelDefinition) else entry
    if not isinstance(definitions, Mapping) or not all(
        isinstance(definition, ModelDefinition) for definition in definitions.values()
    ):
        raise ModelError(
            f"network family {family!r} gives a {type(entry).__name__}; a module with `definition`"
            " or `definitions`, a ModelDefinition, or a dict of them by name is expected"
        )
    return definitions


def find_definition(spec: str) -> ModelDefinition:
    """Returns the definition that `--model` names.

    Args:
        spec: A name such as `fcrn-tiny`, a Python file `FILE.py` or `FILE.py:ATTRIBUTE` (which is
            run), an ONNX file `FILE.onnx` or `FILE.onnx:OUTPUT`, a torch.export archive `FILE.pt2`,
            or a Hugging Face folder.

    Raises:
        ModelError: There is no such name or file, or it does not define a network.
    """
    by_prefix = [f for f in choices.NETWORKS if spec == f or spec.startswith(f"{f}-")]
    for family in sorted(by_prefix, key=len, reverse=True):
        if spec in (definitions := _definitions_of(family)):
            return definitions[spec]
    from_file = _from_file(spec)
    if from_file is not None:
        return from_file
    for definitions in families().values():
        if spec in definitions:
            return definitions[spec]
    near = difflib.get_close_matches(spec, names(), n=1)
    way_out = f"did you mean {near[0]!r}?" if near else "`pnpdepth models` lists all names"
    raise ModelError(
        f"model {spec!r} is neither a known name nor a file or folder of a network; {way_out}"
    )


def _from_file(spec: str) -> ModelDefinition | None:
    """The definition of a file or folder; None if `spec` looks like neither."""
    file, part = spec, None
    if (found := re.fullmatch(r"(.*\.(?:py|onnx)):([^:]*)", spec, re.DOTALL)) is not None:
        file, part = found.groups()
    if file.endswith(".py"):
        return python_definition(Path(file), part)
    if file.endswith(".onnx"):
        from pnpdepth_cli.models.onnx.onnx_file import onnx_definition

        return onnx_definition(Path(file), part)
    if spec.endswith(".pt2"):
        from pnpdepth_cli.models.torch_export import exported_definition

        return exported_definition(Path(spec))
    if spec.endswith((*WEIGHT_SUFFIXES, *_TORCHSCRIPT)):
        raise ModelError(
            f"model {spec} is a file of weights, a pickled module or a TorchScript archive, which"
            " is not run; name the network's Python file with --model and the weights with"
            " --checkpoint, or export the network by torch.export (.pt2) or to ONNX"
        )
    if Path(spec).is_dir():
        from pnpdepth_cli.models.hugging_face import hf_definition

        return hf_definition(Path(spec))
    return None
