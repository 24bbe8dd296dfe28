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
"""Entries of a torch file under which the weights usually lie, in the order of preference."""
_PREFIXES = ("module.", "_orig_mod.", "model.")
"""Prefixes of torch's DataParallel, of torch.compile, and of modules that hold the network."""

_ALL_PREFIXES = re.compile(f"^(?:{'|'.join(map(re.escape, _PREFIXES))})+")
"""Any number of prefixes at the beginning of a name."""
_Reader = Callable[[Path], dict[str, Tensor] | tuple[object, list[str]]]
_READERS: dict[str, tuple[str, _Reader]] = {
    ".safetensors": ("safetensors file", load_file),
    ".npy": ("numpy file", read_numpy_file),
    ".index": ("TensorFlow checkpoint", read_tensor_bundle),
}
"""Kind and reader by suffix; any other file is one of torch."""

WEIGHT_SUFFIXES = (*_READERS, ".pth", ".pt", ".bin", ".ckpt", ".tar")

_BATCH_COUNTER = "num_batches_tracked"
"""How the name of the counter of a batch normalisation ends, which matters in training only."""
_SHOWN_NAMES = 4
"""Names out of a file that a message shows."""
_MAX_WORD = 60
"""Characters of a name out of a file that a message shows."""


def read_checkpoint(path: Path, notes: list[str] | None = None) -> dict[str, Tensor]:
    """Returns the tensors of a checkpoint by name, on the CPU.

    Args:
        path: A torch, safetensors or .npy file, the PREFIX.index of a TensorFlow checkpoint, or a
            folder with several of these, such as encoder.pth and decoder.pth; then each name is
            preceded by the name of its file up to the first dot. In a torch file the tensors may
            lie in an entry such as "state_dict" beside an epoch or an optimiser; FILE:KEY names it.
        notes: List to which notes are appended on what was read, a text each.

    Raises:
        ModelError: The file is missing or broken, or holds no named tensors.
    """
    notes = [] if notes is None else notes
    path, key = file_and_part(path)
    if path.is_dir():
        return _read_folder(path, notes)
    check_network_file(path, "checkpoint")
    # The reader gives named tensors; that of torch files gives all that the file holds.
    kind, read = _READERS.get(path.suffix, ("torch file", read_torch_file))
    what = f"checkpoint {path} cannot be read as a {kind}"
    with wrap_content_errors(what, SafetensorError):
        content = read(path)
    if isinstance(content, dict):
        if key:
            raise ModelError(f"checkpoint {path} is a {kind}, which has no {key!r} to choose")
        return content
    # The state dict in all that a torch file holds.
    whole, names = content
    if names:
        notes.append(f"checkpoint {path.name}: its pickle names {_some(names)}; none of it was run")
    return _state_in(whole, path, key, notes)


def _read_folder(folder: Path, notes: list[str]) -> dict[str, Tensor]:
    """Returns the tensors of all files of weights in a folder; appends notes to the list.

    The names of several files are preceded by the file's, as in "encoder.conv1.weight".

    Raises:
        ModelError: There is no such file, or one of them cannot be read.
    """
    files = sorted(file for file in folder.iterdir() if file.suffix in WEIGHT_SUFFIXES)
    if not files:
        kinds = ", ".join(WEIGHT_SUFFIXES)
        raise ModelError(f"checkpoint {folder} is a folder without weights; these are {kinds}")
    notes.append(f"checkpoint {folder.name}: {', '.join(file.name for file in files)}")
    if len(files) == 1:
        return read_checkpoint(files[0], notes)
    state = dict[str, Tensor]()
    for file in files:
        module_name = file.name.partition(".")[0]
        tensors = _without_prefixes(read_checkpoint(file, notes), file, notes)
        state |= {f"{module_name}.{name}": tensor for name, tensor in tensors.items()}
    return state


def _state_in(content: object, path: Path, key: str, notes: list[str]) -> dict[str, Tensor]:
    """Returns the state dict in what a torch file holds; appends a note if there are several.

    Args:
        content: What the file holds.
        path: The file, for messages.
        key: Name of an entry that is the state dict or has it in it; empty for a usual one.
        notes: List of notes.

    Raises:
        ModelError: There is no such entry, or no state dict.
    """
    if not isinstance(content, Mapping):
        kind = _some([content.path]) if isinstance(content, StandIn) else type(content).__name__
        raise ModelError(f"checkpoint {path} holds a {kind}, not named tensors")
    # The file is the state dict itself.
    if not key and content and _only_tensors(content):
        return dict(content)
    # Or it has entries that are.
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
    # Or the named entry has the state dict in it, beside other things.
    if key in content:
        return _state_in(content[key], path, "", notes)
    fact = f"no state dict {key!r}" if key else "no state dict of plain tensors"
    held = _some([str(name) for name in content]) or "nothing"
    raise ModelError(f"checkpoint {path} has {fact}, which {path}:KEY reads; it holds {held}")


def _only_tensors(mapping: Mapping[Any, object]) -> bool:
    """Whether all keys are texts and all values tensors."""
    return all(isinstance(key, str) and isinstance(value, Tensor) for key, value in mapping.items())


def _some(names: list[str]) -> str:
    """Returns the first few of the names, shortened, and how many more there are."""
    shown = [
        name if len(name) <= _MAX_WORD else f"{name[:_MAX_WORD]}…" for name in names[:_SHOWN_NAMES]
    ]
    listing = ", ".join(shown)
    if len(names) > _SHOWN_NAMES:
        listing += f" and {len(names) - _SHOWN_NAMES} more"
    return listing


def _without_prefixes(
    state: dict[str, Tensor], path: Path, notes: list[str], own: Mapping[str, object] | None = None
) -> dict[str, Tensor]:
    """Returns tensors of a file without the prefixes that wrappers put before every name.

    A note on these is appended to the list.

    Args:
        state: Tensors of the file by name.
        path: The file, for the note.
        notes: List of notes.
        own: The network's own names; a prefix that they have stays. None if they are not known.
    """
    own = own or {}
    stripped = list[str]()
    while True:
        prefix = _common_prefix(state)
        if prefix is None or prefix == _common_prefix(own):
            break
        # "model." also begins the names of published files, whose names without it are not the
        # network's either.
        bare_names = {_ALL_PREFIXES.sub("", name) for name in state}
        if prefix == "model." and own.keys().isdisjoint(bare_names):
            break
        state = {name.removeprefix(prefix): tensor for name, tensor in state.items()}
        if prefix not in stripped:
            stripped.append(prefix)
    if stripped:
        listing = " and ".join(map(repr, stripped))
        notes.append(f"checkpoint {path.name}: prefix {listing} of every key stripped")
    return state


def _common_prefix(state: Mapping[str, object]) -> str | None:
    """Returns the one of `_PREFIXES` that all names have; None if there is none."""
    if not state:
        return None
    prefixes = (prefix for prefix in _PREFIXES if all(name.startswith(prefix) for name in state))
    return next(prefixes, None)


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
    own = {
        name: tensor
        for name, tensor in network.state_dict().items()
        if isinstance(tensor, Tensor)  # a module may keep other things in it
    }
    # The tensors of the file, under the network's names.
    stored = _without_prefixes(read_checkpoint(path, notes), path, notes, own)
    state: Mapping[str, Tensor] = stored
    if definition.read_checkpoint is not None:
        with wrap_user_errors(f"read_checkpoint of network {definition.name!r} for {path}"):
            state = definition.read_checkpoint(stored)
        if not isinstance(state, Mapping) or not _only_tensors(state):
            raise ModelError(f"read_checkpoint of {definition.name!r} gives no named tensors")
    # Whether they are the network's.
    parameters = [name for name, _ in network.named_parameters()]
    misfits = _misfits(own, state, parameters)
    if misfits:
        raise ModelError(
            f"checkpoint {path} does not fit network {definition.name!r}: {'; '.join(misfits)}"
        )
    network.load_state_dict(state, strict=False)
    return notes


def _misfits(
    own: Mapping[str, Tensor], state: Mapping[str, Tensor], parameters: list[str]
) -> list[str]:
    """Returns what is wrong with a file's tensors, a text for each kind of fault.

    Args:
        own: The network's tensors by name.
        state: The file's tensors by name.
        parameters: Names of the network's parameters, which must be finite.
    """
    both = [name for name in own if name in state]
    # Files from before PyTorch 0.4.1 have no counters of batch normalisations.
    faulty_names = {
        "missing": [
            name for name in own if name not in state and not name.endswith(_BATCH_COUNTER)
        ],
        "complex": [
            name for name in both if state[name].is_complex() and not own[name].is_complex()
        ],
        "unexpected": [name for name in state if name not in own],
        "of another shape": [
            f"{name} {tuple(state[name].shape)} for {tuple(own[name].shape)}"
            for name in both
            if state[name].shape != own[name].shape
        ],
        "NaN or infinite, as of a training that broke off": [
            name for name in parameters if name in state and not _is_finite(state[name])
        ],
    }
    return [
        f"{len(names)} {fault} ({_some(names)})" for fault, names in faulty_names.items() if names
    ]


def _is_finite(tensor: Tensor) -> bool:
    """Whether no value of real numbers is NaN or infinite: a sum shows it, without a copy.

    Complex numbers are not looked at.
    """
    return tensor.is_complex() or bool(tensor.sum(dtype=torch.float64).isfinite())
