"""From the name of a network, a file or a folder to its model definition.

A network can be named if `choices.NETWORKS` has a family with it: one file of `model_zoo_defs`, or
an entry point in the group `pnpdepth.models` of another package. A family is a module (or, for an
entry point, also the object itself) with one of

    definition = ModelDefinition(...)
    definitions = {"my-net": ModelDefinition(...), "my-net-tiny": ModelDefinition(...)}
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from pnpdepth_cli import choices
from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.formats.python_file import python_definition

DEFAULT_MODEL = "compact"

_WEIGHTS_ONLY = (
    *(".pt", ".pth", ".ts", ".torchscript", ".ckpt", ".bin", ".safetensors", ".tar"),
    *(".npy", ".npz", ".index"),
)


def names() -> list[str]:
    """Returns the names of all networks that can be named, each once, in the order of the families.

    A family of another package that cannot be loaded is left out; `find_definition` says why.
    """
    definitions = (one for some in _loadable_families().values() for one in some.values())
    return list(dict.fromkeys(definition.name for definition in definitions))


def family_of(name: str) -> str:
    """Returns the family (the file or entry point) that defines the network of this name.

    Raises:
        ModelError: No family defines it.
    """
    for family in _families_by_prefix(name):
        if name in family_definitions(family):
            return family
    for family, definitions in _loadable_families().items():
        if name in definitions:
            return family
    raise ModelError(f"no network is named {name!r}; {_near_names(name)}")


def family_definitions(family: str) -> Mapping[str, ModelDefinition]:
    """Returns the definitions of one family by the names they can be called by.

    Raises:
        ModelError: Its file or entry point cannot be loaded, or holds no definitions.
    """
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
    for family in _families_by_prefix(spec):
        definitions = family_definitions(family)
        if spec in definitions:
            return definitions[spec]
    from_file = _from_file(spec)
    if from_file is not None:
        return from_file
    for definitions in _loadable_families().values():
        if spec in definitions:
            return definitions[spec]
    raise ModelError(
        f"model {spec!r} is neither a known name nor a Python file; {_near_names(spec)}"
    )


def _families_by_prefix(name: str) -> list[str]:
    """The families whose name the network's name begins with, longest first."""
    families = [f for f in choices.NETWORKS if name == f or name.startswith(f"{f}-")]
    return sorted(families, key=len, reverse=True)


def _loadable_families() -> dict[str, Mapping[str, ModelDefinition]]:
    loadable = {}
    for family in choices.NETWORKS:
        try:
            loadable[family] = family_definitions(family)
        except ModelError:
            continue
    return loadable


def _near_names(name: str) -> str:
    near = difflib.get_close_matches(name, names(), n=1)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names())}"


def _from_file(spec: str) -> ModelDefinition | None:
    """The definition of a file or folder; None if `spec` looks like neither."""
    file, colon, attribute = spec.rpartition(":")
    if spec.endswith(".py"):
        return python_definition(Path(spec))
    if colon and file.endswith(".py"):
        return python_definition(Path(file), attribute)
    if spec.endswith(".onnx") or (colon and file.endswith(".onnx")):
        from pnpdepth_cli.models.formats.onnx.network import onnx_definition

        whole = spec.endswith(".onnx")
        return onnx_definition(Path(spec)) if whole else onnx_definition(Path(file), attribute)
    if spec.endswith(".pt2"):
        from pnpdepth_cli.models.formats.torch_export import exported_definition

        return exported_definition(Path(spec))
    if spec.endswith(_WEIGHTS_ONLY):
        raise ModelError(
            f"model {spec} is a file of weights or a TorchScript archive, which cannot be cut; name"
            " the network's Python file with --model and this file with --checkpoint, or export it"
            " by torch.export (.pt2) or to ONNX"
        )
    if Path(spec).is_dir():
        from pnpdepth_cli.models.formats.hugging_face import hf_definition

        return hf_definition(Path(spec))
    return None
