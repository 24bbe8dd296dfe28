"""`pnpdepth models convert`: the tensors of a published checkpoint as a safetensors file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError, OutputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint

_MAX_GROWTH = 4
"""How much larger than its memory a checkpoint may become, tensors that share it written apart."""

_ALWAYS_ALLOWED = 1 << 28  # bytes
_RESERVED_NAME = "__metadata__"  # of the safetensors format


def convert_checkpoint(
    source: Path, target: Path, *, overwrite: bool = False
) -> dict[str, str | int]:
    """Writes the named tensors of a checkpoint to a safetensors file; nothing in it is run.

    Tensors that share memory are written one by one.

    Args:
        source: See `pnpdepth_cli.models.weights.checkpoint.read_checkpoint`.
        target: A path that ends in .safetensors.
        overwrite: Whether `target` may exist and is replaced.

    Returns:
        The paths `source` and `output`, and the numbers of `tensors` and of their `values`.

    Raises:
        CheckpointError: The checkpoint cannot be read, or its tensors cannot be stored.
        OutputError: The target exists.
        UsageError: The target has another suffix, or is the source.
    """
    if target.suffix != ".safetensors":
        raise UsageError(f"{target}: name the converted file .safetensors")
    if target.exists() and source.exists() and target.samefile(source):
        raise UsageError(f"{target} is the checkpoint itself; name another file")
    if target.exists() and not overwrite:
        raise OutputError(f"{target} exists; --overwrite replaces it")
    state = read_checkpoint(source)
    _refuse_what_cannot_be_stored(state, source)
    copies = {name: tensor.clone().contiguous() for name, tensor in state.items()}
    with atomic_path(target) as path:
        try:
            save_file(copies, path)
        except (SafetensorError, KeyError, ValueError) as error:  # a type the format lacks
            raise CheckpointError(
                f"checkpoint {source} cannot be stored as safetensors:"
                f" {type(error).__name__}: {str(error)[:120]}"
            ) from None
    values = sum(tensor.numel() for tensor in state.values())
    return {"source": str(source), "output": str(target), "tensors": len(state), "values": values}


def _refuse_what_cannot_be_stored(state: Mapping[str, Tensor], source: Path) -> None:
    if _RESERVED_NAME in state:
        raise CheckpointError(
            f"checkpoint {source} has a tensor named {_RESERVED_NAME!r}, which safetensors files"
            " keep for themselves"
        )
    storages = {
        t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in state.values()
    }
    written = sum(tensor.numel() * tensor.element_size() for tensor in state.values())
    if written > _MAX_GROWTH * sum(storages.values()) + _ALWAYS_ALLOWED:
        raise CheckpointError(
            f"checkpoint {source}: its tensors share memory; written one by one they would take"
            f" {written / 1e9:,.1f} GB"
        )
