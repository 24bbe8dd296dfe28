"""What was decided about a network's structure, kept from run to run in the user's cache folder.

Each network has a file of a few kB, named by the digest of what it was read from. It holds what the
same version of this program decided with the same versions of torch and of the network's package.
A file that cannot be read, is damaged or is of another version counts as absent. It is written
whole, so that processes at once do not spoil it; of two that write, the last one stays.

Nothing is kept of networks in Python files, whose code may be anywhere.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.models.file_graph import FileGraph
from pnpdepth_cli.models.shapes import is_of_transformers
from pnpdepth_cli.version import __version__

if TYPE_CHECKING:
    from torch import nn

    from pnpdepth_cli.models.definition import ModelDefinition

FOLDER = "PNPDEPTH_CACHE"
"""Environment variable that names another cache folder."""

_MOST_BYTES = 1 << 18  # of a file that is read
_MOST_ANSWERS = 100  # of a network; a batch asks some for each size of image
_HEADER_BYTES = 1 << 24  # of a safetensors file, with the names and shapes of its tensors

# Each network's digest, as long as the network is in use: its file is read once.
_DIGESTS = WeakKeyDictionary["nn.Module", str]()


def cache_folder() -> Path:
    """Returns the folder of the files, which need not be there."""
    stated = os.environ.get(FOLDER)
    if stated:
        return Path(stated)
    from platformdirs import user_cache_path

    return user_cache_path("pnpdepth", appauthor=False) / "networks"


def recall_or_decide(
    module: nn.Module,
    file: Path | None,
    question: str,
    decide: Callable[[], list[str]],
    valid: Callable[[list[str]], bool] = bool,
) -> list[str]:
    """Returns what was decided about a network before, else what is decided now, which is kept.

    Args:
        module: The network.
        file: File or weights that it was read from; None keeps nothing.
        question: What is decided, with all that it depends on besides the network.
        decide: Function that decides it; called unless the answer is known.
        valid: Whether an answer can be right; another one is not taken.
    """
    digest = None if file is None else _digest(module, file)
    if digest is None:
        return decide()
    path = cache_folder() / f"{digest}.json"
    known = _read(path).get(question)
    if known is not None and valid(known):
        return known
    answer = decide()
    _write(path, {question: answer} | {q: a for q, a in _read(path).items() if q != question})
    return answer


def recall_or_decide_layers(
    module: nn.Module,
    definition: ModelDefinition,
    question: str,
    decide: Callable[[], list[str]],
) -> list[str]:
    """Returns layers of a network that were decided before, else what is decided now.

    Args:
        module: The network.
        definition: Its definition.
        question: What is decided, with all that it depends on besides the network.
        decide: Function that decides it; called unless the answer is known.
    """
    names = {name for name, _ in module.named_modules()}
    return recall_or_decide(
        module,
        definition.checkpoint if definition.complete else None,
        question,
        decide,
        lambda layers: bool(layers) and names.issuperset(layers),
    )


def kept_files() -> list[Path]:
    """Returns the files of all networks."""
    return sorted(cache_folder().glob("*.json"))


def forget() -> None:
    """Removes the files of all networks.

    Raises:
        OutputError: One cannot be removed.
    """
    for path in (*kept_files(), *cache_folder().glob("*.part")):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path} cannot be removed ({error.strerror})") from None


@functools.cache
def _versions() -> dict[str, str]:
    versions = {"pnpdepth": __version__}
    for package in ("torch", "transformers", "onnx", "onnxruntime"):
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions


def _digest(module: nn.Module, file: Path) -> str | None:
    """The digest of what describes the network; None if its code is not in files that are known."""
    known = _DIGESTS.get(module)
    if known is not None:
        return known
    parts = list[bytes]()
    try:
        if isinstance(module, FileGraph):
            # The nodes tell which output of the file it is.
            parts = [file.read_bytes(), "\n".join(module._modules).encode()]
        elif is_of_transformers(module):
            with file.open("rb") as weights:
                size = int.from_bytes(weights.read(8), "little")
                parts = [weights.read(min(size, _HEADER_BYTES))]
            parts += [file.with_name("config.json").read_bytes()]
    except OSError:
        return None
    if not parts:
        return None
    digest = hashlib.sha256()
    for content in parts:
        digest.update(len(content).to_bytes(8, "little"))
        digest.update(content)
    _DIGESTS[module] = digest.hexdigest()
    return _DIGESTS[module]


def _read(path: Path) -> dict[str, list[str]]:
    """The answers in a file by their questions; none if it is not as it should be."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            return {}
        content = json.loads(path.read_bytes())
        if content["versions"] != _versions():
            return {}
        answers = dict(content["answers"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}
    good = all(
        isinstance(answer, list) and all(isinstance(word, str) for word in answer)
        for answer in answers.values()
    )
    return answers if good else {}


def _write(path: Path, answers: dict[str, list[str]]) -> None:
    """Replaces a file by these answers, the first ones if they are many; or does nothing."""
    latest = dict(list(answers.items())[:_MOST_ANSWERS])
    content = json.dumps({"versions": _versions(), "answers": latest}, indent=1)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(content)
            Path(temporary).replace(path)
        finally:
            Path(temporary).unlink(missing_ok=True)
