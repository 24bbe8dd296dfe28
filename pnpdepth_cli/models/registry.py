"""From the name of a network, a file or a folder to its model definition.

A network can be named if `choices.NETWORKS` has a family with it: one file of `model_zoo_defs`, or
an entry point in the group `pnpdepth.models` of another package. A family is a module (or, for an
entry point, also the object itself) with one of

    definition = ModelDefinition(...)
    definitions = {"my-net": ModelDefinition(...), "my-net-tiny": ModelDefinition(...)}

A Python file is run, as importing it would run it. `net.py` holds a `definition`; `net.py:NAME`
names another definition in it, or a class or function that makes a network without arguments.
"""

from __future__ import annotations

import difflib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

from pnpdepth_cli import choices
from pnpdepth_cli.budget import check_network_file
from pnpdepth_cli.errors import ModelError, describe, wrap_user_errors
from pnpdepth_cli.models.definition import ASSUMED_MULTIPLE, ModelDefinition, assume_definition
from pnpdepth_cli.models.output_parts import part_of, split_parts
from pnpdepth_cli.models.weights import WEIGHT_SUFFIXES

if TYPE_CHECKING:
    from torch import Tensor


def all_definitions() -> dict[str, ModelDefinition]:
    """Returns the definitions of all networks that can be named, in the order of the families.

    A family of another package that cannot be loaded is left out; `find_definition` says why.
    """
    by_name = dict[str, ModelDefinition]()
    for family in choices.NETWORKS:
        with suppress(ModelError):
            by_name |= {n: d for n, d in _definitions_of(family).items() if n not in by_name}
    return by_name


def _definitions_of(family: str) -> Mapping[str, ModelDefinition]:
    """The definitions of one family. ModelError if it cannot be loaded, or holds none."""
    with wrap_user_errors(f"network family {family!r}"):  # the code of another package
        entry = choices.NETWORKS[family]
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
            or a Hugging Face folder. Behind a file or folder, `:[1]` or `OUTPUT[z]` names a part of
            its output: `output_parts.part_of`.

    Raises:
        ModelError: There is no such name or file, or it does not define a network.
    """
    by_prefix = [f for f in choices.NETWORKS if spec == f or spec.startswith(f"{f}-")]
    for family in sorted(by_prefix, key=len, reverse=True):
        if spec in (definitions := _definitions_of(family)):
            return definitions[spec]
    named = split_parts(spec)
    from_file = _from_file(named.spec)
    if from_file is not None:
        return _with_parts(from_file, named.parts)
    known = all_definitions()
    if spec in known:
        return known[spec]
    near = difflib.get_close_matches(spec, known, n=1)
    if near:
        raise ModelError(
            f"model {spec!r} is neither a known name nor a file or folder of a network; did you"
            f" mean {near[0]!r}?"
        )
    raise ModelError(
        f"model {spec!r} is neither a known name nor a file or folder of a network; `pnpdepth"
        " models` lists all names"
    )


def _with_parts(definition: ModelDefinition, parts: tuple[str, ...]) -> ModelDefinition:
    """The definition whose output is a part of what its own would be."""
    if not parts:
        return definition
    before = definition.output

    def output(given: Any) -> Tensor:
        found = given if before is None else before(given)
        for name in parts:
            found = part_of(found, name)
        return cast("Tensor", found)

    return replace(definition, output=output)


def _from_file(spec: str) -> ModelDefinition | None:
    """The definition of a file or folder; None if `spec` looks like neither."""
    # A Python or an ONNX file, perhaps with the name of a part behind a colon.
    file = spec
    part = None
    if (found := re.fullmatch(r"(.*\.(?:py|onnx)):([^:]*)", spec, re.DOTALL)) is not None:
        file, part = found.groups()
    if file.endswith(".py"):
        return _python_definition(Path(file), part)
    if file.endswith(".onnx"):
        from pnpdepth_cli.models.onnx import onnx_definition

        return onnx_definition(Path(file), part)
    # An exported program has one graph.
    if spec.endswith(".pt2"):
        from pnpdepth_cli.models.torch_export import exported_definition

        return exported_definition(Path(spec))
    # Weights alone, and what would have to be run, are refused.
    if spec.endswith((*WEIGHT_SUFFIXES, ".ts", ".torchscript")):
        raise ModelError(
            f"model {spec} is a file of weights, a pickled module or a TorchScript archive, which"
            " is not run; name the network's Python file as the model and the weights as the"
            " checkpoint, or export the network by torch.export (.pt2) or to ONNX"
        )
    # A folder of transformers has its configuration and weights.
    if Path(spec).is_dir():
        from pnpdepth_cli.models.hugging_face import hf_definition

        return hf_definition(Path(spec))
    return None


def _python_definition(file: Path, attribute: str | None) -> ModelDefinition:
    """The definition in a Python file, or one assumed for the network class in it."""
    named = attribute or "definition"
    value = getattr(_run(file), named, None)
    if value is None:
        raise ModelError(f"model file {file} defines no {named!r}; name it as {file}:ATTRIBUTE")
    if isinstance(value, ModelDefinition):
        return value
    if not callable(value):
        raise ModelError(f"{named!r} in model file {file} is not a ModelDefinition")
    return assume_definition(
        name=f"{file.stem}.{named}",
        summary=f"{named} of {file.name}",
        build=value,
        assumed=f"{named!r} of {file.name} is not a definition; assumed: one rgb image in, sides"
        f" padded to multiples of {ASSUMED_MULTIPLE}; what its numbers mean is decided from the"
        " points",
    )


def _run(file: Path) -> ModuleType:
    """The module that a Python file makes."""
    check_network_file(file, "model file")
    name = f"pnpdepth_user_model_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ModelError(f"{file} is no Python file; name it NAME.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickling inside the file look it up
    try:
        with importing_beside(str(file)):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ModelError(f"model file {file} raises {describe(error, file)}") from error
    return module


@contextmanager
def importing_beside(spec: str) -> Iterator[None]:
    """Inside, modules beside the Python file that `spec` names can be imported.

    The file itself runs inside this context, and so must a `build` that imports when it is called.
    If `spec` names no Python file, nothing changes.
    """
    file = Path(spec if spec.endswith(".py") else spec.rpartition(":")[0])
    if file.suffix != ".py":
        yield
        return
    folder = str(Path(os.path.realpath(file)).parent)
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with suppress(ValueError):  # the file's own code may have removed it
            sys.path.remove(folder)
