"""Weights from files, without running anything that is in them.

safetensors files hold tensors only, numpy files arrays, TensorFlow checkpoints variables. torch
files are pickles, often with more in them (whole modules, optimisers, arguments); the tensors are
taken out, and nothing is run.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from pnpdepth_cli.budget import check_network_file
from pnpdepth_cli.errors import ModelError, wrap_user_errors
from pnpdepth_cli.models.definition import ModelDefinition, file_and_part
from pnpdepth_cli.models.weights.pickle_reader import StandIn, wrap_content_errors
from pnpdepth_cli.models.weights.pickled_files import read_numpy_file, read_torch_file
from pnpdepth_cli.models.weights.tensor_bundle import read_tensor_bundle

_STATE_KEYS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net", "params")
_PREFIXES = ("module.", "_orig_mod.", "model.")
"""Prefixes of torch's DataParallel, of torch.compile, and of modules that hold the network."""

_WRAPPED = re.compile(f"^(?:{'|'.join(map(re.escape, _PREFIXES))})+")
_Reader = Callable[[Path], dict[str, Tensor] | tuple[object, list[str]]]
_READERS: dict[str, tuple[str, _Reader]] = {
    ".safetensors": ("safetensors file", load_file),
    ".npy": ("numpy file", read_numpy_file),
    ".index": ("TensorFlow checkpoint", read_tensor_bundle),
}
"""Kind and reader by suffix; any other file is one of torch."""

WEIGHT_SUFFIXES = (*_READERS, ".pth", ".pt", ".bin", ".ckpt", ".tar")

_COUNTER = "num_batches_tracked"
_SHOWN_NAMES = 4
_MAX_WORD = 60  # characters of a word out of a file that are shown


def read_checkpoint(path: Path, notes: list[str] | None = None) -> dict[str, Tensor]:
    """Returns the tensors of a checkpoint by name, on the CPU.

    Args:
        path: A torch, safetensors or .npy file, the PREFIX.index of a TensorFlow checkpoint, or a
            folder with several of these, such as encoder.pth and decoder.pth; then each name is
            preceded by the name of its file up to the first dot. In a torch file the tensors may
            lie in an entry such as "state_dict" beside an epoch or an optimiser; FILE:KEY names it.
        notes: List that gets what a person should know of the reading.

    Raises:
        ModelError: The file is missing or broken, or holds no named tensors.
    """
    notes = [] if notes is None else notes
    path, key = file_and_part(path)
    if path.is_dir():
        return _read_folder(path, notes)
    check_network_file(path, "checkpoint")
    # Its reader gives named tensors, or what a torch file holds.
    kind, read = _READERS.get(path.suffix, ("torch file", read_torch_file))
    what = f"checkpoint {path} cannot be read as a {kind}"
    with wrap_content_errors(what, SafetensorError):
        content = read(path)
    if isinstance(content, dict):
        if key:
            raise ModelError(f"checkpoint {path} is a {kind}, which has no {key!r} to choose")
        return content
    # The state dict in that.
    whole, names = content
    if names:
        notes.append(f"checkpoint {path.name}: its pickle names {_some(names)}; none of it was run")
    return _state_in(whole, path, key, notes)


def _read_folder(folder: Path, notes: list[str]) -> dict[str, Tensor]:
    files = sorted(file for file in folder.iterdir() if file.suffix in WEIGHT_SUFFIXES)
    if not files:
        kinds = ", ".join(WEIGHT_SUFFIXES)
        raise ModelError(f"checkpoint {folder} is a folder without weights; these are {kinds}")
    notes.append(f"checkpoint {folder.name}: {', '.join(file.name for file in files)}")
    if len(files) == 1:
        return read_checkpoint(files[0], notes)
    state = dict[str, Tensor]()
    for file in files:
        part = _without_prefixes(read_checkpoint(file, notes), file, notes)
        state |= {f"{file.name.partition('.')[0]}.{name}": tensor for name, tensor in part.items()}
    return state


def _state_in(content: object, path: Path, key: str, notes: list[str]) -> dict[str, Tensor]:
    """The state dict in what a torch file holds: the one that the key names, or a usual one."""
    if not isinstance(content, Mapping):
        kind = _some([content.path]) if isinstance(content, StandIn) else type(content).__name__
        raise ModelError(f"checkpoint {path} holds a {kind}, not named tensors")
    if not key and content and _only_tensors(content):
        return dict(content)
    states = {
        str(name): dict(value)
        for name, value in content.items()
        if isinstance(value, Mapping) and value and _only_tensors(value)
    }
    chosen = key or next((name for name in _STATE_KEYS if name in states), "")
    if chosen in states:
        others = _some([repr(name) for name in states if name != chosen])
        if others:
            fact = f"{chosen!r} is read, not {others}; {path.name}:KEY chooses"
            notes.append(f"checkpoint {path.name}: {fact}")
        return states[chosen]
    if key in content:  # with a state dict in it, beside other things
        return _state_in(content[key], path, "", notes)
    fact = f"no state dict {key!r}" if key else "no state dict of plain tensors"
    held = _some([str(name) for name in content]) or "nothing"
    raise ModelError(f"checkpoint {path} has {fact}, which {path}:KEY reads; it holds {held}")


def _only_tensors(mapping: Mapping[Any, object]) -> bool:
    return all(isinstance(k, str) and isinstance(v, Tensor) for k, v in mapping.items())


def _some(names: list[str]) -> str:
    """The first few of the names, shortened, and how many more there are."""
    shown = [n if len(n) <= _MAX_WORD else f"{n[:_MAX_WORD]}…" for n in names[:_SHOWN_NAMES]]
    more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return f"{', '.join(shown)}{more}"


def _without_prefixes(
    state: dict[str, Tensor], path: Path, notes: list[str], own: Mapping[str, object] | None = None
) -> dict[str, Tensor]:
    """The tensors without prefixes of wrappers that a network's own names lack."""
    own = own or {}
    stripped = list[str]()
    while (prefix := _prefix(state)) is not None and prefix != _prefix(own):
        if prefix == "model." and own.keys().isdisjoint(_WRAPPED.sub("", name) for name in state):
            break  # part of the names of a published file
        state = {name.removeprefix(prefix): tensor for name, tensor in state.items()}
        stripped += [] if prefix in stripped else [prefix]
    if stripped:
        listing = " and ".join(map(repr, stripped))
        notes.append(f"checkpoint {path.name}: prefix {listing} of every key stripped")
    return state


def _prefix(state: Mapping[str, object]) -> str | None:
    """The one of `_PREFIXES` that all names have."""
    return next((p for p in _PREFIXES if state and all(n.startswith(p) for n in state)), None)


def load_checkpoint(network: nn.Module, definition: ModelDefinition, path: Path) -> list[str]:
    """Loads the weights of a file into a network; returns notes on what was done to fit them.

    The counters of batch normalisations may be missing, as in files from before PyTorch 0.4.1: they
    matter in training only.

    Args:
        network: Network built by `definition`; its weights are replaced.
        definition: Definition whose `read_checkpoint` renames the tensors of a published file.
        path: File or folder, as `read_checkpoint` takes it.

    Raises:
        ModelError: A tensor is missing, unexpected, of another shape, or not finite.
    """
    notes = list[str]()
    own = {n: t for n, t in network.state_dict().items() if isinstance(t, Tensor)}
    stored = _without_prefixes(read_checkpoint(path, notes), path, notes, own)
    state: Mapping[str, Tensor] = stored
    if definition.read_checkpoint is not None:
        with wrap_user_errors(f"read_checkpoint of network {definition.name!r} for {path}"):
            state = definition.read_checkpoint(stored)
        if not isinstance(state, Mapping) or not _only_tensors(state):
            raise ModelError(f"read_checkpoint of {definition.name!r} gives no named tensors")
    # Whether they are the network's.
    both = [name for name in own if name in state]
    problems = {
        "missing": [n for n in own if n not in state and not n.endswith(_COUNTER)],
        "complex": [n for n in both if state[n].is_complex() > own[n].is_complex()],
        "unexpected": [name for name in state if name not in own],
        "of another shape": [
            f"{n} {tuple(state[n].shape)} for {tuple(own[n].shape)}"
            for n in both
            if state[n].shape != own[n].shape
        ],
        "NaN or infinite, as of a training that broke off": [
            n for n, _ in network.named_parameters() if n in state and not _is_finite(state[n])
        ],
    }
    misfits = [f"{len(some)} {what} ({_some(some)})" for what, some in problems.items() if some]
    if misfits:
        raise ModelError(
            f"checkpoint {path} does not fit network {definition.name!r}: {'; '.join(misfits)}"
        )
    network.load_state_dict(state, strict=False)
    return notes


def _is_finite(tensor: Tensor) -> bool:
    """Whether no value of real numbers is NaN or infinite: a sum shows it, without a copy."""
    return tensor.is_complex() or bool(tensor.sum(dtype=torch.float64).isfinite())
