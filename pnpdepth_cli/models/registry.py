"""From a name or a Python file to a model definition."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from pnpdepth_cli.core.foreign import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import ModelDefinition

DEFAULT_MODEL = "compact"

_MODULES = {
    "compact": "model_zoo_defs.compact",
    "nconv": "model_zoo_defs.nconv",
    "pncnn": "model_zoo_defs.pncnn",
}


def names() -> list[str]:
    """The networks that can be named."""
    return list(_MODULES)


def find_definition(spec: str) -> ModelDefinition:
    """The definition for `NAME` or `file.py[:attribute]` (attribute `definition` by default).

    The Python file is run, as importing it would. ModelError if there is no such name or file, if
    the file raises, or if what it defines is not a ModelDefinition.
    """
    if spec in _MODULES:
        definition = importlib.import_module(_MODULES[spec]).definition
        assert isinstance(definition, ModelDefinition)
        return definition
    foreign = _foreign(spec)
    if foreign is not None:
        return foreign
    file, attribute = _file_and_attribute(spec)
    if file.suffix != ".py":
        near = difflib.get_close_matches(spec, _MODULES, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(_MODULES)}"
        raise ModelError(f"model {spec!r} is neither a known name nor a Python file; {hint}")
    found = getattr(_run(file), attribute, None)
    if found is None:
        raise ModelError(f"model file {file} defines no {attribute!r}; name it as {file}:ATTRIBUTE")
    if not isinstance(found, ModelDefinition):
        raise ModelError(
            f"{attribute!r} in model file {file} is a {type(found).__name__}, not a ModelDefinition"
        )
    return found


def _foreign(spec: str) -> ModelDefinition | None:
    """The definition of a network that is no Python file of ours; None if it is none such."""
    file, colon, output = spec.rpartition(":")
    if spec.endswith(".onnx") or (colon and file.endswith(".onnx")):
        from pnpdepth_cli.models.onnx_network import onnx_definition

        named = not spec.endswith(".onnx")
        return onnx_definition(Path(file), output) if named else onnx_definition(Path(spec))
    if Path(spec).is_dir():
        from pnpdepth_cli.models.hf_network import hf_definition

        return hf_definition(Path(spec))
    return None


def _file_and_attribute(spec: str) -> tuple[Path, str]:
    file, colon, attribute = spec.rpartition(":")
    if colon and file.endswith(".py"):
        return Path(file), attribute
    return Path(spec), "definition"


def _run(file: Path) -> ModuleType:
    if not file.is_file():
        raise ModelError(f"model file {file} does not exist")
    name = f"pnpdepth_user_model_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickling inside the file look it up
    sys.path.insert(0, str(file.resolve().parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ModelError(f"model file {file} raises {describe(error, file)}") from error
    finally:
        sys.path.remove(str(file.resolve().parent))
    return module
