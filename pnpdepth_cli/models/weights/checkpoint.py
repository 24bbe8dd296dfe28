"""Weights from files, without running anything that is in them.

safetensors files hold tensors only, numpy files arrays, TensorFlow checkpoints variables. torch
files are pickles; they are read with `weights_only=True`, which refuses everything but tensors and
plain containers. Where more is in them (whole modules, optimisers, arguments), `tensor_pickle`
takes the tensors out and runs nothing.
"""

from __future__ import annotations

import functools
import math
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.user_code import describe
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models import registry
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.weights.numpy_file import SUFFIXES as NUMPY_SUFFIXES
from pnpdepth_cli.models.weights.numpy_file import read_numpy_file
from pnpdepth_cli.models.weights.pickle_machine import Instance
from pnpdepth_cli.models.weights.tensor_bundle import SUFFIX as BUNDLE_SUFFIX
from pnpdepth_cli.models.weights.tensor_bundle import read_tensor_bundle
from pnpdepth_cli.models.weights.tensor_pickle import (
    is_module,
    module_state,
    read_tensor_file,
    refuse_compressed,
)

_STATE_KEYS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net", "params")
WEIGHT_SUFFIXES = (
    *(".safetensors", ".pth", ".pt", ".bin", ".ckpt", ".tar"), *NUMPY_SUFFIXES, BUNDLE_SUFFIX
)  # fmt: skip
_COUNTER = "num_batches_tracked"
_LFS_POINTER = b"version https://git-lfs"
_TOLD = ("data", "dataset", "arch", "decoder", "modality", "height", "width")
_SHOWN = 4
_MOST_PIXELS = 1 << 20  # along a side
_LONGEST = 60  # characters of a word out of a file


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name, on the CPU. CheckpointError if that cannot be had.

    In a torch file they may lie in an entry such as "state_dict" beside an epoch or an optimiser.
    Numpy files hold them as arrays, TensorFlow checkpoints (PREFIX.index) as variables. A folder
    may hold several files, such as encoder.pth and decoder.pth; then the name of the file, up to
    its first dot, comes before the names in it.
    """
    return _read(path)[0]


def load_checkpoint(network: nn.Module, definition: ModelDefinition, path: Path) -> list[str]:
    """The network has the weights of the file; returns notes on what was done to fit them.

    CheckpointError if a key is missing, left over, or of another shape; it names the network of the
    registry that the file does fit. Or if a weight is not finite. The counters of batch
    normalisations may be missing, as in files from before PyTorch 0.4.1: they matter in training
    only.
    """
    given, notes = _read(path)
    own = {n: t for n, t in network.state_dict().items() if isinstance(t, Tensor)}
    if not _all_in_module(own):
        given, said = _without_module(given, path)
        notes = [*notes, *said]
    try:
        state = _fitted(definition, own, given, path)
    except CheckpointError:
        fitting = _networks_it_fits(given, path, definition.name)
        if not fitting:
            raise
        raise CheckpointError(
            f"checkpoint {path} does not fit network {definition.name!r}: this is"
            f" {_some(fitting, ' or ')}; use --model {fitting[0]}"
        ) from None
    learnt = dict(network.named_parameters())
    broken = [n for n, t in state.items() if n in learnt and not _is_finite(t)]
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
    given: Mapping[str, Tensor],
    path: Path,
) -> Mapping[str, Tensor]:
    """The state dict for a network whose own it is to replace. CheckpointError if it is not one."""
    state = given if definition.read_checkpoint is None else _converted(definition, given, path)
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


def _networks_it_fits(given: Mapping[str, Tensor], path: Path, asked: str) -> list[str]:
    """The networks of the registry whose weights these are; those that end as `asked` come first.

    Names and shapes decide, so variants for other picture sizes (`-kitti`) fit too.
    """
    fitting = [name for name in registry.names() if _fits(name, given, path)]
    ending = asked.rpartition("-")[2]
    return sorted(fitting, key=lambda name: name.rpartition("-")[2] != ending)


def _fits(name: str, given: Mapping[str, Tensor], path: Path) -> bool:
    try:
        _fitted(registry.find_definition(name), _shapes_of(name), given, path)
    except ModelError:
        return False
    return True


@functools.cache
def _shapes_of(name: str) -> dict[str, Tensor]:
    """The state dict of a network of the registry, without its values."""
    with torch.device("meta"):
        return registry.find_definition(name).build().state_dict()


def _misfit(path: Path, definition: ModelDefinition, why: str) -> CheckpointError:
    return CheckpointError(f"checkpoint {path} does not fit network {definition.name!r}: {why}")


def _all_in_module(state: Mapping[str, Any]) -> bool:
    return bool(state) and all(name.startswith("module.") for name in state)


def _without_module(state: dict[str, Tensor], path: Path) -> tuple[dict[str, Tensor], list[str]]:
    """The tensors by their names without torch's DataParallel, once or more, and what to say."""
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
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"{between.join(map(_short, names[:_SHOWN]))}{more}"


def _short(word: str) -> str:
    return word if len(word) <= _LONGEST else f"{word[:_LONGEST]}…"


def _read(path: Path) -> tuple[dict[str, Tensor], list[str]]:
    """The named tensors of a file or folder, and what to say of it."""
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        index = path.with_name(path.name + BUNDLE_SUFFIX)
        instead = f"; {index.name} does, name that" if index.is_file() else ""
        raise CheckpointError(f"checkpoint {path} does not exist{instead}")
    if _is_lfs_pointer(path):
        raise CheckpointError(
            f"checkpoint {path} is a Git LFS pointer, not the file it points to; `git lfs pull`"
            " fetches that"
        )
    if path.suffix == ".safetensors":
        return _read_safetensors(path), []
    if path.suffix in NUMPY_SUFFIXES:
        return read_numpy_file(path), []
    if path.suffix == BUNDLE_SUFFIX:
        return read_tensor_bundle(path), []
    content, notes = _read_torch(path)
    return _state_in(content, path), notes + _trained_with(content, path)


def _is_lfs_pointer(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_LFS_POINTER)) == _LFS_POINTER


def _read_folder(folder: Path) -> tuple[dict[str, Tensor], list[str]]:
    files = sorted(file for file in folder.iterdir() if file.suffix in WEIGHT_SUFFIXES)
    if not files:
        raise CheckpointError(
            f"checkpoint {folder} is a folder without weights; it may hold"
            f" {', '.join(WEIGHT_SUFFIXES)}"
        )
    notes = [f"checkpoint {folder.name}: {', '.join(file.name for file in files)}"]
    if len(files) == 1:
        state, said = _read(files[0])
        return state, notes + said
    state = {}
    for file in files:
        part, said = _read(file)
        part, stripped = _without_module(part, file)
        state |= {f"{file.name.partition('.')[0]}.{name}": tensor for name, tensor in part.items()}
        notes += [*said, *stripped]
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


def _read_torch(path: Path) -> tuple[Any, list[str]]:
    """What a torch file holds, and what to say of it."""
    refuse_compressed(path)
    try:
        return torch.load(path, map_location="cpu", weights_only=True), []
    except pickle.UnpicklingError:
        read = read_tensor_file(path)
        foreign = [name for name in read.named if not name.startswith(("torch.", "collections."))]
        named = _some(foreign) or "classes of torch"
        note = (
            f"checkpoint {path.name}: its pickle names {named}; its tensors were taken out,"
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


def _trained_with(content: Any, path: Path) -> list[str]:
    """What the training's arguments say, where they are kept beside the weights.

    Weights for other data or pictures of another size may fit all the same.
    """
    given = content.get("args") if isinstance(content, Mapping) else None
    given = given.state if isinstance(given, Instance) else given
    if not isinstance(given, Mapping):
        return []
    told = {key: given.get(key) for key in _TOLD}
    said = [
        f"{key} {_short(str(value))}"
        for key, value in told.items()
        if isinstance(value, str) or (isinstance(value, int) and abs(value) < _MOST_PIXELS)
    ]
    return [f"checkpoint {path.name}: trained with {', '.join(said)}"] if said else []


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
    names = ", ".join(_short(str(key)) for key in list(content)[:8]) or "nothing"
    raise CheckpointError(f"checkpoint {path} has no state dict; it holds {names}")


def _kind(content: Any) -> str:
    return _short(content.path) if isinstance(content, Instance) else type(content).__name__


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
