"""Weights from files, without running anything that is in them.

safetensors files hold tensors only. torch files are pickles; they are read with
`weights_only=True`, which refuses everything but tensors and plain containers. Where more is in
them (whole modules, optimisers, arguments), `tensor_pickle` takes the tensors out and runs nothing.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.foreign import describe
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.tensor_pickle import (
    Instance,
    is_module,
    module_state,
    read_tensor_file,
)

_STATE_KEYS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net", "params")
_SHOWN = 4


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name, on the CPU. CheckpointError if that cannot be had.

    In a torch file they may lie in an entry such as "state_dict" beside an epoch or an optimiser.
    """
    if not path.is_file():
        raise CheckpointError(
            f"checkpoint {path} {'is a folder' if path.exists() else 'does not exist'}"
        )
    if path.suffix == ".safetensors":
        return _read_safetensors(path)
    return _state_in(_read_torch(path)[0], path)


def load_checkpoint(network: nn.Module, definition: ModelDefinition, path: Path) -> list[str]:
    """The network has the weights of the file; returns notes on what was done to fit them.

    CheckpointError if a key is missing, left over, or of another shape.
    """
    state: Mapping[str, Tensor]
    notes: list[str] = []
    if path.is_file() and path.suffix != ".safetensors":
        content, notes = _read_torch(path)
        state = _state_in(content, path)
    else:
        state = read_checkpoint(path)
    own = {n: t for n, t in network.state_dict().items() if isinstance(t, Tensor)}
    if state and _all_in_module(state) and not _all_in_module(own):
        state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
        notes.append(f"checkpoint {path.name}: prefix 'module.' of every key stripped")
    if definition.read_checkpoint is not None:
        state = _converted(definition, state, path)
    problems = [
        *_listed("missing", [name for name in own if name not in state]),
        *_listed("unexpected", [name for name in state if name not in own]),
        *_listed(
            "of another shape",
            [
                f"{name} {tuple(state[name].shape)} for {tuple(own[name].shape)}"
                for name in own
                if name in state and state[name].shape != own[name].shape
            ],
        ),
    ]
    if problems:
        raise _misfit(path, definition, "; ".join(problems))
    try:
        network.load_state_dict(dict(state))
    except RuntimeError as error:
        raise _misfit(path, definition, describe(error)) from None
    return notes


def _misfit(path: Path, definition: ModelDefinition, why: str) -> CheckpointError:
    return CheckpointError(f"checkpoint {path} does not fit network {definition.name!r}: {why}")


def _all_in_module(state: Mapping[str, Any]) -> bool:
    return all(name.startswith("module.") for name in state)


def _listed(what: str, names: list[str]) -> list[str]:
    if not names:
        return []
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return [f"{len(names)} {what} ({', '.join(names[:_SHOWN])}{more})"]


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return dict(load_file(path))
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} is not a whole safetensors file: {error}"
        ) from None


def _read_torch(path: Path) -> tuple[Any, list[str]]:
    """What a torch file holds, and what to say of it."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True), []
    except pickle.UnpicklingError:
        read = read_tensor_file(path)
        foreign = [name for name in read.named if not name.startswith(("torch.", "collections."))]
        named = ", ".join(foreign[:_SHOWN]) or "classes of torch"
        more = f" and {len(foreign) - _SHOWN} more" if len(foreign) > _SHOWN else ""
        note = (
            f"checkpoint {path.name}: its pickle names {named}{more}; its tensors were taken out,"
            " nothing of it was run"
        )
        return read.content, [note]
    except Exception as error:  # torch raises a wide choice of types for a broken file
        reason = describe(error)[:160]
        if "TorchScript" in reason:
            reason = "it is a TorchScript archive; save the state_dict() of its module instead"
        raise CheckpointError(
            f"checkpoint {path} cannot be read as a torch file ({reason})"
        ) from None


def _state_in(content: Any, path: Path) -> dict[str, Tensor]:
    if is_module(content):
        return module_state(content)
    if not isinstance(content, Mapping):
        raise CheckpointError(f"checkpoint {path} holds a {_kind(content)}, not named tensors")
    if content and _only_tensors(content):
        return dict(content)
    for key in _STATE_KEYS:
        inner = content.get(key)
        if is_module(inner):
            return module_state(inner)
        if isinstance(inner, Mapping) and inner and _only_tensors(inner):
            return dict(inner)
    names = ", ".join(str(key) for key in list(content)[:8]) or "nothing"
    raise CheckpointError(f"checkpoint {path} has no state dict; it holds {names}")


def _kind(content: Any) -> str:
    return content.path if isinstance(content, Instance) else type(content).__name__


def _only_tensors(mapping: Mapping[Any, Any]) -> bool:
    return all(isinstance(k, str) and isinstance(v, Tensor) for k, v in mapping.items())


def _converted(
    definition: ModelDefinition, state: Mapping[str, Tensor], path: Path
) -> Mapping[str, Tensor]:
    assert definition.read_checkpoint is not None
    try:
        converted = definition.read_checkpoint(state)
    except Exception as error:  # what a definition raises at a layout it does not know is its own
        raise CheckpointError(
            f"checkpoint {path} is not in a layout that {definition.name!r} reads"
            f" ({describe(error)})"
        ) from None
    if not isinstance(converted, Mapping) or not _only_tensors(converted):
        raise ModelError(f"read_checkpoint of {definition.name!r} gives no named tensors")
    return converted
