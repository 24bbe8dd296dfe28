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
from pnpdepth_cli.errors import ModelError, UsageError, describe
from pnpdepth_cli.models.definition import ASSUMED_MULTIPLE, ModelDefinition, assume_definition
from pnpdepth_cli.models.output_parts import part_of, split_parts
from pnpdepth_cli.models.weights import WEIGHT_SUFFIXES

if TYPE_CHECKING:
    from torch import Tensor

_FILE_AND_NAME = re.compile(r"(.*\.(?:py|onnx)):([^:]*)", re.DOTALL)
"""FILE.py:ATTRIBUTE or FILE.onnx:OUTPUT."""


def all_definitions() -> dict[str, ModelDefinition]:
    """Returns the definitions of all networks that can be named, in the order of the families.

    A family of another package that cannot be loaded is left out; `find_definition` says why.
    """
    by_name = dict[str, ModelDefinition]()
    for family in choices.NETWORKS:
        with suppress(ModelError):
            for name, definition in _definitions_of(family).items():
                by_name.setdefault(name, definition)
    return by_name


def _definitions_of(family: str) -> Mapping[str, ModelDefinition]:
    """Returns the definitions of one family of `choices.NETWORKS`, by the networks' names.

    Raises:
        ModelError: The family cannot be loaded, or holds no definitions.
    """
    try:
        entry = choices.NETWORKS[family]
    except UsageError as error:  # another package's entry cannot be imported
        raise ModelError(str(error)) from error
    # A module has one of two names; an entry point may also be the object itself.
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
    # A network is mostly named FAMILY or FAMILY-VARIANT; then no other family is loaded. Of several
    # families that the name begins with, the longest is tried first.
    families = [
        family for family in choices.NETWORKS if spec == family or spec.startswith(f"{family}-")
    ]
    for family in sorted(families, key=len, reverse=True):
        definitions = _definitions_of(family)
        if spec in definitions:
            return definitions[spec]
    # A file or folder.
    named = split_parts(spec)
    from_file = _from_file(named.spec)
    if from_file is not None:
        return _with_parts(from_file, named.parts)
    # A network whose name does not begin with its family's.
    by_name = all_definitions()
    if spec in by_name:
        return by_name[spec]
    similar_names = difflib.get_close_matches(spec, by_name, n=1)
    if similar_names:
        raise ModelError(
            f"model {spec!r} is neither a known name nor a file or folder of a network; did you"
            f" mean {similar_names[0]!r}?"
        )
    raise ModelError(
        f"model {spec!r} is neither a known name nor a file or folder of a network; `pnpdepth"
        " models` lists all names"
    )


def _with_parts(definition: ModelDefinition, parts: tuple[str, ...]) -> ModelDefinition:
    """Returns the definition with an output that is a part of its own output.

    Args:
        definition: Definition of the network.
        parts: Names for `part_of`, the outermost first; the definition stays as it is without any.
    """
    if not parts:
        return definition
    choose_own_output = definition.output

    def output(returned: Any) -> Tensor:
        """Returns the part, of what the network's forward returned."""
        chosen = returned if choose_own_output is None else choose_own_output(returned)
        for name in parts:
            chosen = part_of(chosen, name)
        return cast("Tensor", chosen)

    return replace(definition, output=output)


def _from_file(spec: str) -> ModelDefinition | None:
    """Returns the definition of a file or folder; None if `spec` looks like neither.

    Args:
        spec: File or folder as `find_definition` takes it, without parts in brackets.

    Raises:
        ModelError: It cannot be read, or is of a kind that is not run.
    """
    # A Python or an ONNX file, perhaps with an attribute or an output behind a colon.
    file = spec
    name = None
    match = _FILE_AND_NAME.fullmatch(spec)
    if match is not None:
        file, name = match.groups()
    if file.endswith(".py"):
        return _python_definition(Path(file), name)
    if file.endswith(".onnx"):
        from pnpdepth_cli.models.onnx import onnx_definition

        return onnx_definition(Path(file), name)
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
    """Returns the definition in a Python file, or one assumed for the network class in it.

    Args:
        file: The Python file, which is run.
        attribute: Name of the definition, or of a class or function that makes the network; None
            or empty for `definition`.

    Raises:
        ModelError: The file raises, or has no such attribute.
    """
    name = attribute or "definition"
    value = getattr(_run(file), name, None)
    if value is None:
        raise ModelError(f"model file {file} defines no {name!r}; name it as {file}:ATTRIBUTE")
    if isinstance(value, ModelDefinition):
        return value
    if not callable(value):
        raise ModelError(f"{name!r} in model file {file} is not a ModelDefinition")
    return assume_definition(
        name=f"{file.stem}.{name}",
        summary=f"{name} of {file.name}",
        build=value,
        assumed=f"{name!r} of {file.name} is not a definition; assumed: one rgb image in, sides"
        f" padded to multiples of {ASSUMED_MULTIPLE}; what its numbers mean is decided from the"
        " points",
    )


def _run(file: Path) -> ModuleType:
    """Runs a Python file as a new module, and returns the module.

    Raises:
        ModelError: The file is missing, or raises.
    """
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
    # FILE.py, or FILE.py:ATTRIBUTE.
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
