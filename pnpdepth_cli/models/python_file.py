"""A Python file as a definition. The file is run, as importing it would run it.

`net.py` holds a `definition`, or is one network whose class takes no arguments; `net.py:NAME` names
another definition, class or function in it.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError, PnpDepthError
from pnpdepth_cli.models.definition import ASSUMED_MULTIPLE, ModelDefinition, assume_definition


def python_definition(file: Path, attribute: str | None = None) -> ModelDefinition:
    """Returns the definition in a Python file, or one assumed for the network class in it.

    Args:
        file: The Python file; it may import modules beside it.
        attribute: The name of a ModelDefinition, of a network class, or of a function that returns
            a network. None takes `definition`, or else the file's only network class.

    Raises:
        ModelError: The file is missing or raises, or the attribute is missing or something else.
    """
    module = _run(file)
    named = attribute or "definition"
    value = getattr(module, named, None)
    if value is None and attribute is None:
        named, value = _only_network_class(module) or (named, None)
    if value is None:
        raise ModelError(f"model file {file} defines no {named!r}; name it as {file}:ATTRIBUTE")
    if callable(value) and not isinstance(value, ModelDefinition):
        return _assumed_definition(value, named, file)
    if not isinstance(value, ModelDefinition):
        raise ModelError(
            f"{named!r} in model file {file} is a {type(value).__name__}, not a ModelDefinition"
        )
    return value


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
    folder = str(file.resolve().parent)
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with suppress(ValueError):  # the file's own code may have removed it
            sys.path.remove(folder)


def _only_network_class(module: ModuleType) -> tuple[str, Any] | None:
    """The one network class that the file itself defines and no other class in it uses."""
    from torch import nn

    own = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type)
        and issubclass(value, nn.Module)
        and value.__module__ == module.__name__
    }
    blocks = {name for network in own.values() for name in _names_in_constructor(network)}
    networks = [(name, value) for name, value in own.items() if name not in blocks]
    return networks[0] if len(networks) == 1 else None


def _names_in_constructor(network: type) -> set[str]:
    code = getattr(network.__init__, "__code__", None)  # type: ignore[misc]
    return set(code.co_names) if code is not None else set()


def _assumed_definition(build: Callable[..., Any], attribute: str, file: Path) -> ModelDefinition:
    """A definition around a class or function that returns a network; the rest is assumed."""
    return assume_definition(
        name=f"{file.stem}.{attribute}",
        summary=f"{attribute} of {file.name}",
        build=build,
        assumed=f"{attribute!r} of {file.name} is not a definition; assumed: one rgb image in,"
        f" sides padded to multiples of {ASSUMED_MULTIPLE}; what its numbers mean is decided from"
        " the points",
    )


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
        reason = describe(error, file).removeprefix(f"{type(error).__name__}: ")
        raise ModelError(f"model file {file}: {reason}") from error
    except (Exception, SystemExit) as error:
        raise ModelError(f"model file {file} raises {describe(error, file)}") from error
    return module
