"""Weights from elsewhere: `models fetch`, which alone uses the internet, and `models convert`."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from pnpdepth_cli.errors import CheckpointError, ModelError, OutputError, UsageError
from pnpdepth_cli.io.atomic import atomic_folder, atomic_path
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.io.record import sha256_of, write_json
from pnpdepth_cli.models.weights.checkpoint import read_checkpoint

_WANTED = re.compile(
    r"(preprocessor_)?config\.json|model[\w.-]*\.safetensors|[\w.-]+\.safetensors\.index\.json"
)
"""Files at the top of a repository: never code, never pickles."""

RECORD = "fetched.json"


def fetch_model(
    repo: str, revision: str | None = None, output: Path | None = None
) -> dict[str, Any]:
    """Downloads the settings and safetensors weights of a Hugging Face repository to a folder.

    What was downloaded is returned (repository, revision, folder, and sha256 by file), and stored
    as `fetched.json` in the folder. Nothing stays there unless every file has the digest that the
    repository states.

    Args:
        repo: ORG/NAME.
        revision: A branch, tag or commit; None is the main branch.
        output: The folder, which must be empty or missing; None is NAME.

    Raises:
        ModelError: The repository cannot be reached, or a file is not what it states.
        OutputError: The folder holds something.
        UsageError: `repo` is not of the form ORG/NAME.
    """
    organisation, slash, name = repo.partition("/")
    if not (organisation and slash and name) or "/" in name:
        raise UsageError(f"{repo!r} is not of the form ORG/NAME")
    folder = output or Path(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} exists; name another folder with -o")
    try:
        from huggingface_hub import HfApi, hf_hub_download
    except ImportError as error:
        raise ModelError(
            f"fetching needs the package {error.name!r}: pip install 'pnpdepth[hf]'"
        ) from None
    with atomic_folder(folder) as temporary:
        try:
            info = HfApi().model_info(repo, revision=revision, files_metadata=True)
            files = [file for file in info.siblings or () if _WANTED.fullmatch(file.rfilename)]
            for file in files:
                hf_hub_download(repo, file.rfilename, revision=info.sha, local_dir=temporary)
        except Exception as error:  # its own errors, the HTTP client's and the system's
            raise ModelError(
                f"{repo} cannot be fetched from Hugging Face ({type(error).__name__}:"
                f" {one_line(error)}); is this machine online, and the name right? A folder copied"
                " from elsewhere works too"
            ) from None
        if not files:
            raise ModelError(f"{repo} has no config.json and no model.safetensors; name another")
        shutil.rmtree(temporary / ".cache", ignore_errors=True)  # of huggingface_hub
        for file in files:
            _check_content(repo, temporary / file.rfilename, file)
        digests = {file.rfilename: sha256_of(temporary / file.rfilename) for file in files}
        fetched = {
            "repository": repo, "revision": info.sha, "folder": str(folder), "sha256": digests
        }  # fmt: skip
        write_json(temporary / RECORD, fetched)
    return fetched


def _check_content(repo: str, path: Path, stated: Any) -> None:
    """ModelError unless a file has the SHA-256 (in LFS) or Git blob that the repository states."""
    in_lfs = stated.lfs is not None
    if (sha256_of(path) if in_lfs else _git_blob(path)) != (
        stated.lfs.sha256 if in_lfs else stated.blob_id
    ):
        raise ModelError(
            f"{repo}: {path.name} arrived with another content than the repository states; fetch it"
            " again, over another connection if this repeats"
        )


def _git_blob(path: Path) -> str:
    content = path.read_bytes()  # a small file of text
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


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
