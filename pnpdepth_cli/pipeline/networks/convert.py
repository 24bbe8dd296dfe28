"""`pnpdepth models convert`: the tensors of a published checkpoint as a safetensors file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safetensors.torch import save_file

from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint


def convert_checkpoint(source: Path, target: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """The named tensors of `source` are in `target`; nothing that is in `source` was run.

    Tensors that share memory are written one by one. Raises CheckpointError or OutputError.
    """
    if target.suffix != ".safetensors":
        raise UsageError(f"{target}: name the converted file .safetensors")
    if target.resolve() == source.resolve():
        raise OutputError(f"{target} is the file to convert; name another output")
    if target.exists() and not overwrite:
        raise OutputError(f"{target} exists; --overwrite replaces it")
    state = {name: tensor.clone().contiguous() for name, tensor in read_checkpoint(source).items()}
    with atomic_path(target) as path:
        save_file(state, path)
    return {
        "source": str(source),
        "output": str(target),
        "tensors": len(state),
        "values": sum(tensor.numel() for tensor in state.values()),
    }
