"""Weights from files, without running anything that is in them.

safetensors files hold tensors only, numpy files arrays, TensorFlow checkpoints variables. torch
files are pickles, often with more in them (whole modules, optimisers, arguments); `torch_file`
takes the tensors out and runs nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.budget import size_problem
from pnpdepth_cli.core.user_code import describe, wrap_user_errors
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models import registry
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.weights.numpy_file import SUFFIXES as NUMPY_SUFFIXES
from pnpdepth_cli.models.weights.numpy_file import read_numpy_file
from pnpdepth_cli.models.weights.pickle_reader import StandIn
from pnpdepth_cli.models.weights.tensor_bundle import SUFFIX as BUNDLE_SUFFIX
from pnpdepth_cli.models.weights.tensor_bundle import read_tensor_bundle
from pnpdepth_cli.models.weights.torch_file import (
    TensorFile,
    is_module,
    module_state,
    read_tensor_file,
)

_STATE_KEYS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net", "params")
WEIGHT_SUFFIXES = (
    *(".safetensors", ".pth", ".pt", ".bin", ".ckpt", ".tar"), *NUMPY_SUFFIXES, BUNDLE_SUFFIX
)  # fmt: skip
_COUNTER = "num_batches_tracked"
_LFS_POINTER = b"version https://git-lfs"
_TRAINING_ARGUMENTS = ("data", "dataset", "arch", "decoder", "modality", "height", "width")
_SHOWN_NAMES = 4
_MAX_SIDE = 1 << 20  # pixels of an image that training may have seen
_MAX_WORD = 60  # characters of a word out of a file that are shown
_NOT_WORTH_A_NOTE = (
    *("torch.", "collections.", "_codecs.encode", "builtins.set", "__builtin__.set"),
    *("builtins.bytearray", "__builtin__.bytearray", "builtins.complex", "__builtin__.complex"),
)


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """Returns the tensors of a checkpoint by name, on the CPU.

    Args:
        path: A torch, safetensors or numpy file, the PREFIX.index of a TensorFlow checkpoint, or a
            folder with several of these, such as encoder.pth and decoder.pth; then each name is
            preceded by the name of its file up to the first dot. In a torch file the tensors may
            lie in an entry such as "state_dict" beside an epoch or an optimiser.

    Raises:
        CheckpointError: The file is missing or broken, or holds no named tensors.
    """
    return _read(path)[0]


def load_checkpoint(network: nn.Module, definition: ModelDefinition, path: Path) -> list[str]:
    """Loads the weights of a file into a network; returns notes on what was done to fit them.

    The counters of batch normalisations may be missing, as in files from before PyTorch 0.4.1: they
    matter in training only.

    Args:
        network: Built by `definition`; its weights are replaced.
        definition: Its `read_checkpoint` renames the tensors of a published file.
        path: See `read_checkpoint`.

    Raises:
        CheckpointError: A tensor is missing, unexpected, of another shape, or not finite. If the
            file fits another network that can be named, the message names that.
    """
    stored, notes = _read(path)
    own = {n: t for n, t in network.state_dict().items() if isinstance(t, Tensor)}
    if not _all_in_module(own):
        stored, prefix_notes = _without_module(stored, path)
        notes = [*notes, *prefix_notes]
    try:
        state = _fitted(definition, own, stored, path)
    except CheckpointError:
        fitting = _networks_it_fits(stored, path, definition.name)
        if not fitting:
            raise
        raise CheckpointError(
            f"checkpoint {path} does not fit network {definition.name!r}: this is"
            f" {_some(fitting, ' or ')}; use --model {fitting[0]}"
        ) from None
    parameters = dict(network.named_parameters())
    broken = [n for n, t in state.items() if n in parameters and not _is_finite(t)]
    if broken:
        raise CheckpointError(
            f"checkpoint {path}: {len(broken)} of its weights are NaN or infinite"
            f" ({_some(broken)}); was its training broken off?"
        )
    try:
        network.load_state_dict({**own, **state})
    except RuntimeError as error:
        raise _misfit(path, definition, describe(error)) from None
    return notes


def _fitted(
    definition: ModelDefinition,
    own: Mapping[str, Tensor],
    stored: Mapping[str, Tensor],
    path: Path,
) -> Mapping[str, Tensor]:
    """The state dict that replaces the network's own. CheckpointError if it does not fit."""
    state = stored if definition.read_checkpoint is None else _converted(definition, stored, path)
    problems = [
        *_listed("missing", [n for n in own if n not in state and not n.endswith(_COUNTER)]),
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
    return state


def _networks_it_fits(stored: Mapping[str, Tensor], path: Path, wanted: str) -> list[str]:
    """The names of the networks whose weights these are; those that end as `wanted` come first.

    Tensor names and shapes decide, so variants for other image sizes (`-kitti`) fit too.
    """
    by_class: dict[Any, list[str]] = {}
    for name in registry.names():
        build = registry.find_definition(name).build
        by_class.setdefault(getattr(build, "func", build), []).append(name)
    fitting = [
        name
        for names in by_class.values()
        if any(_shares_names(name, names[0], stored, path) for name in names)
        for name in names
        if _fits(name, stored, path)
    ]
    ending = wanted.rpartition("-")[2]
    return sorted(fitting, key=lambda name: name.rpartition("-")[2] != ending)


def _shares_names(name: str, built: str, stored: Mapping[str, Tensor], path: Path) -> bool:
    """True if tensors, as the network `name` reads them, have names of the network `built`.

    Building every network would take seconds.
    """
    definition = registry.find_definition(name)
    try:
        state = (
            stored if definition.read_checkpoint is None else _converted(definition, stored, path)
        )
        return not _shapes_of(built).keys().isdisjoint(state)
    except ModelError:
        return False


def _fits(name: str, stored: Mapping[str, Tensor], path: Path) -> bool:
    try:
        _fitted(registry.find_definition(name), _shapes_of(name), stored, path)
    except ModelError:
        return False
    return True


@functools.cache
def _shapes_of(name: str) -> dict[str, Tensor]:
    """The state dict of a network that can be named, without its values."""
    with wrap_user_errors(f"build of network {name!r}"), torch.device("meta"):
        return registry.find_definition(name).build().state_dict()


def _misfit(path: Path, definition: ModelDefinition, why: str) -> CheckpointError:
    return CheckpointError(f"checkpoint {path} does not fit network {definition.name!r}: {why}")


def _all_in_module(state: Mapping[str, Any]) -> bool:
    return bool(state) and all(name.startswith("module.") for name in state)


def _without_module(state: dict[str, Tensor], path: Path) -> tuple[dict[str, Tensor], list[str]]:
    """The tensors without the prefix of torch's DataParallel, and a note if there was one."""
    notes = []
    while _all_in_module(state):
        state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
        notes = [f"checkpoint {path.name}: prefix 'module.' of every key stripped"]
    return state, notes


def _is_finite(tensor: Tensor) -> bool:
    """True if no value is NaN or infinite; a sum shows it without a copy of the tensor."""
    return not tensor.is_floating_point() or math.isfinite(tensor.sum(dtype=torch.float64).item())


def _listed(what: str, names: list[str]) -> list[str]:
    return [f"{len(names)} {what} ({_some(names)})"] if names else []


def _some(names: list[str], between: str = ", ") -> str:
    """The first few of the names, and how many more there are."""
    more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return f"{between.join(map(_short, names[:_SHOWN_NAMES]))}{more}"


def _short(word: str) -> str:
    return word if len(word) <= _MAX_WORD else f"{word[:_MAX_WORD]}…"


def _read(path: Path) -> tuple[dict[str, Tensor], list[str]]:
    """The named tensors of a file or folder, and notes about it."""
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        index = path.with_name(path.name + BUNDLE_SUFFIX)
        hint = f"; {index.name} does, name that" if index.is_file() else ""
        raise CheckpointError(f"checkpoint {path} does not exist{hint}")
    with path.open("rb") as file:
        is_lfs_pointer = file.read(len(_LFS_POINTER)) == _LFS_POINTER
    if is_lfs_pointer:
        raise CheckpointError(
            f"checkpoint {path} is a Git LFS pointer, not the file it points to; `git lfs pull`"
            " fetches that"
        )
    if problem := size_problem(path):
        raise CheckpointError(f"checkpoint {path} {problem}")
    if path.suffix == ".safetensors":
        return _read_safetensors(path), []
    if path.suffix in NUMPY_SUFFIXES:
        return read_numpy_file(path), []
    if path.suffix == BUNDLE_SUFFIX:
        return read_tensor_bundle(path), []
    torch_file = read_tensor_file(path)
    return _state_in(torch_file.content, path), _notes_on(torch_file, path)


def _read_folder(folder: Path) -> tuple[dict[str, Tensor], list[str]]:
    files = sorted(file for file in folder.iterdir() if file.suffix in WEIGHT_SUFFIXES)
    if not files:
        raise CheckpointError(
            f"checkpoint {folder} is a folder without weights; it may hold"
            f" {', '.join(WEIGHT_SUFFIXES)}"
        )
    notes = [f"checkpoint {folder.name}: {', '.join(file.name for file in files)}"]
    if len(files) == 1:
        state, file_notes = _read(files[0])
        return state, notes + file_notes
    state = {}
    for file in files:
        part, file_notes = _read(file)
        part, stripped = _without_module(part, file)
        state |= {f"{file.name.partition('.')[0]}.{name}": tensor for name, tensor in part.items()}
        notes += [*file_notes, *stripped]
    return state, notes


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return dict(load_file(path))
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} is not a whole safetensors file: {error}"
        ) from None


def _notes_on(file: TensorFile, path: Path) -> list[str]:
    """What else a torch file holds, and what the arguments of the training say if it has them.

    Weights for other data, or for images of another size, may fit all the same.
    """
    notes = []
    classes = [name for name in file.named if not name.startswith(_NOT_WORTH_A_NOTE)]
    if classes or file.has_stand_ins:
        notes.append(
            f"checkpoint {path.name}: its pickle names {_some(classes) or 'classes of torch'}; its"
            " tensors were taken out, nothing of it was run"
        )
    arguments = file.content.get("args") if isinstance(file.content, Mapping) else None
    arguments = arguments.state if isinstance(arguments, StandIn) else arguments
    if isinstance(arguments, Mapping):
        values = {key: arguments.get(key) for key in _TRAINING_ARGUMENTS}
        shown = [
            f"{key} {_short(str(value))}"
            for key, value in values.items()
            if isinstance(value, str) or (isinstance(value, int) and abs(value) < _MAX_SIDE)
        ]
        if shown:
            notes.append(f"checkpoint {path.name}: trained with {', '.join(shown)}")
    return notes


def _state_in(content: Any, path: Path) -> dict[str, Tensor]:
    """The state dict in what a torch file holds."""
    if is_module(content):
        return module_state(content)
    if not isinstance(content, Mapping):
        kind = _short(content.path) if isinstance(content, StandIn) else type(content).__name__
        raise CheckpointError(f"checkpoint {path} holds a {kind}, not named tensors")
    for candidate in (content, *(content.get(key) for key in _STATE_KEYS)):
        if is_module(candidate):
            return module_state(candidate)
        if isinstance(candidate, Mapping) and candidate:
            _refuse_unusual_tensors(candidate, path)
            if _only_tensors(candidate):
                return dict(candidate)
    names = ", ".join(_short(str(key)) for key in list(content)[:8]) or "nothing"
    raise CheckpointError(f"checkpoint {path} has no state dict; it holds {names}")


def _refuse_unusual_tensors(state: Mapping[Any, Any], path: Path) -> None:
    for name, value in state.items():
        if isinstance(value, StandIn) and value.path.startswith("torch._utils._rebuild_"):
            kind = value.path.removeprefix("torch._utils._rebuild_")
            raise CheckpointError(
                f"checkpoint {path}: {_short(str(name))} is not a plain tensor ({_short(kind)});"
                " save its values as a dense tensor of floats"
            )


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
