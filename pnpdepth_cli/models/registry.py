"""From a name or a Python file to a model definition."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from pnpdepth_cli.core.split.user_code import describe
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.models.definition import FOREIGN, ModelDefinition, Multiple

DEFAULT_MODEL = "compact"

_ATTRIBUTE = "definition"
_MULTIPLE = 32  # what the sides of a picture are padded to where nobody says
_WEIGHTS_ONLY = (
    *(".pt", ".pth", ".ts", ".torchscript", ".ckpt", ".bin", ".safetensors", ".tar"),
    *(".npy", ".npz", ".index"),
)

# Each is a file of model_zoo_defs with `definitions`, by name: the family itself and its variants.
_FAMILIES = (
    "compact",
    "eigen",
    "fcrn",
    "sfmlearner",
    "sparseconv",
    "adnn",
    "sparse2dense",
    "latefusion",
    "nconv",
    "pncnn",
)


def names() -> list[str]:
    """The networks that can be named: every family with its variants, each by its own name."""
    every = (_definitions(family).values() for family in _FAMILIES)
    return list(dict.fromkeys(definition.name for some in every for definition in some))


def _definitions(family: str) -> Mapping[str, ModelDefinition]:
    definitions: Mapping[str, ModelDefinition]
    definitions = importlib.import_module(f"model_zoo_defs.{family}").definitions
    return definitions


def find_definition(spec: str) -> ModelDefinition:
    """The definition for `NAME` or `file.py[:attribute]` (attribute `definition` by default).

    A name is that of a family, or of a variant of it as in `fcrn-tiny`. The Python file is run, as
    importing it would. ModelError if there is no such name or file, if the file raises, or if what
    it defines is not a ModelDefinition.
    """
    family = spec.partition("-")[0]
    if family in _FAMILIES and spec in _definitions(family):
        return _definitions(family)[spec]
    foreign = _foreign(spec)
    if foreign is not None:
        return foreign
    file, attribute = _file_and_attribute(spec)
    if file.suffix != ".py":
        near = difflib.get_close_matches(spec, names(), n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names())}"
        raise ModelError(f"model {spec!r} is neither a known name nor a Python file; {hint}")
    module = _run(file)
    found = getattr(module, attribute, None)
    if found is None and attribute == _ATTRIBUTE:
        attribute, found = _only_network(module) or (attribute, None)
    if found is None:
        raise ModelError(f"model file {file} defines no {attribute!r}; name it as {file}:ATTRIBUTE")
    if callable(found) and not isinstance(found, ModelDefinition):
        return _assumed(found, attribute, file)
    if not isinstance(found, ModelDefinition):
        raise ModelError(
            f"{attribute!r} in model file {file} is a {type(found).__name__}, not a ModelDefinition"
        )
    return found


@contextmanager
def importing_beside(spec: str) -> Iterator[None]:
    """Inside, what lies beside the model file that `spec` names can be imported, as when it runs.

    A function that makes a network may import more when it is called. Nothing is changed where
    `spec` names no Python file.
    """
    file, _ = _file_and_attribute(spec)
    if file.suffix != ".py":
        yield
        return
    folder = str(file.resolve().parent)
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with suppress(ValueError):  # the file's own code may have taken it out
            sys.path.remove(folder)


def _only_network(module: ModuleType) -> tuple[str, Any] | None:
    """The one torch module class that the file itself defines; None if there is no one such."""
    from torch import nn

    own = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type)
        and issubclass(value, nn.Module)
        and value.__module__ == module.__name__
    }
    inner = {name for one in own.values() for name in _mentioned(one)}
    outer = [(name, value) for name, value in own.items() if name not in inner]
    return outer[0] if len(outer) == 1 else None


def _mentioned(network: type) -> set[str]:
    """The names that a class's constructor uses; a network's blocks are among them."""
    code = getattr(network.__init__, "__code__", None)  # type: ignore[misc]
    return set(code.co_names) if code is not None else set()


def _assumed(build: Callable[..., Any], attribute: str, file: Path) -> ModelDefinition:
    """A definition around a class or function that gives a network, and nothing else is known."""
    from torch import nn

    if isinstance(build, nn.Module):
        raise ModelError(
            f"{attribute!r} in model file {file} is a {type(build).__name__} that is made already;"
            " name its class, a function that returns it, or a definition"
        )
    needed = [
        name
        for name, p in inspect.signature(build).parameters.items()
        if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]
    if needed:
        raise ModelError(
            f"{attribute!r} in model file {file} needs arguments ({', '.join(needed)}); write a"
            " function without any that returns the network, and name that"
        )
    return ModelDefinition(
        name=f"{file.stem}.{attribute}",
        summary=f"{attribute} of {file.name}",
        input_kind="rgb",
        size=Multiple(_MULTIPLE),
        normalisation=None,
        output_kind="unknown",
        output_scale="unknown",
        build=build,
        defaults=FOREIGN,
        assumed=f"{attribute!r} of {file.name} is no definition; assumed: one rgb picture in, sides"
        f" padded to multiples of {_MULTIPLE}; what its numbers mean is decided from the points",
    )


def _foreign(spec: str) -> ModelDefinition | None:
    """The definition of a network that is no Python file of ours; None if it is none such."""
    file, colon, output = spec.rpartition(":")
    if spec.endswith(".onnx") or (colon and file.endswith(".onnx")):
        from pnpdepth_cli.models.formats.onnx.network import onnx_definition

        named = not spec.endswith(".onnx")
        return onnx_definition(Path(file), output) if named else onnx_definition(Path(spec))
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


def _file_and_attribute(spec: str) -> tuple[Path, str]:
    file, colon, attribute = spec.rpartition(":")
    if colon and file.endswith(".py"):
        return Path(file), attribute
    return Path(spec), _ATTRIBUTE


def _run(file: Path) -> ModuleType:
    if not file.is_file():
        raise ModelError(f"model file {file} does not exist")
    name = f"pnpdepth_user_model_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickling inside the file look it up
    try:
        with importing_beside(str(file)):
            spec.loader.exec_module(module)
    except PnpDepthError as error:
        said = describe(error, file).removeprefix(f"{type(error).__name__}: ")
        raise ModelError(f"model file {file}: {said}") from error
    except (Exception, SystemExit) as error:
        raise ModelError(f"model file {file} raises {describe(error, file)}") from error
    return module
