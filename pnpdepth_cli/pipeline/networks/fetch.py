"""`pnpdepth models fetch`: the only place that opens a network connection."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from pnpdepth_cli.errors import ModelError, OutputError, UsageError
from pnpdepth_cli.io.record import sha256_of, write_json

_WANTED = [  # never code, never pickles
    "config.json",
    "preprocessor_config.json",
    "model*.safetensors",
    "*.safetensors.index.json",
]
RECORD = "fetched.json"


@dataclass(frozen=True, kw_only=True)
class FetchedModel:
    """What was downloaded."""

    repository: str
    """ORG/NAME."""
    revision: str | None
    """The commit that was downloaded."""
    folder: str
    """Where the files are."""
    sha256: dict[str, str]
    """Hash of each file by its name."""


def fetch_model(repo: str, revision: str | None = None, output: Path | None = None) -> FetchedModel:
    """Downloads the settings and safetensors weights of a Hugging Face repository to a folder.

    What was downloaded is returned, and stored as `fetched.json` in the folder.

    Args:
        repo: ORG/NAME.
        revision: A branch, tag or commit; None is the main branch.
        output: The folder, which must be empty or missing; None is NAME.

    Raises:
        ModelError: The repository cannot be reached.
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
        from huggingface_hub import HfApi, snapshot_download
    except ImportError as error:
        raise ModelError(
            f"fetching needs the package {error.name!r}: pip install 'pnpdepth[hf]'"
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
    fetched = FetchedModel(
        repository=repo,
        revision=pinned,
        folder=str(folder),
        sha256={path.name: sha256_of(path) for path in files},
    )
    write_json(folder / RECORD, asdict(fetched))
    return fetched
