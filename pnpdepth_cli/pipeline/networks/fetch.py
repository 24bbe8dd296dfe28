"""`pnpdepth models fetch`: the only place that opens a network connection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import ModelError, OutputError, UsageError
from pnpdepth_cli.io.record import sha256_of, write_json

_WANTED = [  # never code, never pickles
    "config.json",
    "preprocessor_config.json",
    "model*.safetensors",
    "*.safetensors.index.json",
]
RECORD = "fetched.json"


def fetch_model(
    repo: str, revision: str | None = None, output: Path | None = None
) -> dict[str, Any]:
    """A Hugging Face repository's settings and safetensors weights are in a folder.

    Which revision that was, and the files' hashes, are in `fetched.json` there and returned.
    Raises ModelError where the repository or the network cannot be reached.
    """
    organisation, slash, name = repo.partition("/")
    if not (organisation and slash and name) or "/" in name:
        raise UsageError(f"{repo!r} is not of the form ORG/NAME")
    folder = output or Path(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} exists; name another folder with -o")
    try:
        from huggingface_hub import HfApi, snapshot_download
    except ImportError as error:
        raise ModelError(
            f"--fetch needs the package {error.name!r}: pip install 'pnpdepth[hf]'"
        ) from None
    try:
        pinned = HfApi().model_info(repo, revision=revision).sha
        snapshot_download(repo, revision=pinned, local_dir=folder, allow_patterns=_WANTED)
    except Exception as error:  # its own errors, the HTTP client's and the system's
        reason = " ".join(str(error).split())[:200]
        raise ModelError(
            f"{repo} cannot be fetched from Hugging Face ({type(error).__name__}: {reason}); is"
            " this machine online, and the name right? A folder copied from elsewhere works too"
        ) from None
    files = sorted(path for path in folder.iterdir() if path.is_file())
    record = {
        "repository": repo,
        "revision": pinned,
        "folder": str(folder),
        "sha256": {path.name: sha256_of(path) for path in files},
    }
    write_json(folder / RECORD, record)
    return record
