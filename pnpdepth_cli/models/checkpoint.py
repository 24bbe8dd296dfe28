"""Weights from files, without running anything that is in them.

safetensors files hold tensors only. torch files are pickles; they are read with
`weights_only=True`, which refuses everything but tensors and plain containers.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.definition import ModelDefinition

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
    return _state_in(_read_torch(path), path)


def load_checkpoint(network: nn.Module, definition: ModelDefinition, path: Path) -> list[str]:
    """The network has the weights of the file; returns notes on what was done to fit them.

    CheckpointError if a key is missing, left over, or of another shape.
    """
    state: Mapping[str, Tensor] = read_checkpoint(path)
    notes = []
    if state and all(name.startswith("module.") for name in state):
        state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
        notes.append(f"checkpoint {path.name}: prefix 'module.' of every key stripped")
    if definition.read_checkpoint is not None:
        state = _converted(definition, state, path)
    own = network.state_dict()
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
        raise CheckpointError(
            f"checkpoint {path} does not fit network {definition.name!r}: {'; '.join(problems)}"
        )
    network.load_state_dict(dict(state))
    return notes


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


def _read_torch(path: Path) -> Any:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        found = _forbidden(str(error))
        raise CheckpointError(
            f"checkpoint {path} is a pickle that holds {found}; nothing of it was run. Where it was"
            " made, save the tensors alone: safetensors.torch.save_file(model.state_dict(),"
            " 'weights.safetensors')"
        ) from None
    except Exception as error:  # torch raises a wide choice of types for a broken file
        reason = (str(error).splitlines() or [""])[0][:160]
        raise CheckpointError(
            f"checkpoint {path} cannot be read as a torch file ({type(error).__name__}: {reason})"
        ) from None


def _forbidden(message: str) -> str:
    """What torch names in its refusal, as `GLOBAL argparse.Namespace`."""
    for line in message.splitlines():
        words = line.replace(",", " ").split()
        if "GLOBAL" in words and words.index("GLOBAL") + 1 < len(words):
            return f"more than tensors ({words[words.index('GLOBAL') + 1]})"
    return "more than tensors"


def _state_in(content: Any, path: Path) -> dict[str, Tensor]:
    if not isinstance(content, Mapping):
        raise CheckpointError(
            f"checkpoint {path} holds a {type(content).__name__}, not named tensors"
        )
    if content and _only_tensors(content):
        return dict(content)
    for key in _STATE_KEYS:
        inner = content.get(key)
        if isinstance(inner, Mapping) and inner and _only_tensors(inner):
            return dict(inner)
    names = ", ".join(str(key) for key in list(content)[:8]) or "nothing"
    raise CheckpointError(f"checkpoint {path} has no state dict; it holds {names}")


def _only_tensors(mapping: Mapping[Any, Any]) -> bool:
    return all(isinstance(value, Tensor) for value in mapping.values())


def _converted(
    definition: ModelDefinition, state: Mapping[str, Tensor], path: Path
) -> Mapping[str, Tensor]:
    assert definition.read_checkpoint is not None
    try:
        return definition.read_checkpoint(state)
    except (KeyError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"checkpoint {path} is not in a layout that {definition.name!r} reads"
            f" ({type(error).__name__}: {error})"
        ) from None
