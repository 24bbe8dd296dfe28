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

_MOST_BYTES = 1 << 18
"""Bytes of the largest file of answers that is read."""
_MOST_ANSWERS = 100
"""Answers that are kept of a network; a batch asks some for each size of image."""
_HEADER_BYTES = 1 << 24
"""Bytes that are read of a safetensors file's header, with the names and shapes of its tensors."""
_LENGTH_BYTES = 8
"""Bytes of a length: that of a safetensors file's header, and of each part of a digest."""

_DIGESTS = WeakKeyDictionary["nn.Module", str]()
"""Each network's digest, as long as the network is in use: its file is read once."""


def cache_folder() -> Path:
    """Returns the folder of the cache files, one for each network; it need not exist."""
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
    """Returns the answer to a question about a network: the kept one, or a new one, kept from now.

    Args:
        module: The network.
        file: File or weights that the network was read from; None keeps nothing.
        question: What is decided, with all that it depends on besides the network.
        decide: Function that decides it, called unless a valid answer is kept.
        valid: Predicate of a kept answer: whether it can be right. By default it is not empty.
    """
    digest = None if file is None else _digest_of(module, file)
    if digest is None:
        return decide()
    path = cache_folder() / f"{digest}.json"
    kept_answer = _read(path).get(question)
    if kept_answer is not None and valid(kept_answer):
        return kept_answer
    new_answer = decide()
    # Another process may have kept answers meanwhile. The newest comes first.
    answers = _read(path)
    answers.pop(question, None)
    _write(path, {question: new_answer} | answers)
    return new_answer


def recall_or_decide_layers(
    module: nn.Module,
    definition: ModelDefinition,
    question: str,
    decide: Callable[[], list[str]],
) -> list[str]:
    """Returns names of layers: the kept answer to a question about a network, or a new one.

    Only for a network whose one file holds its structure and weights; else it is decided anew.

    Args:
        module: The network.
        definition: Definition of the network.
        question: What is decided, with all that it depends on besides the network.
        decide: Function that decides it, called unless a valid answer is kept.
    """
    names = {name for name, _ in module.named_modules()}

    def are_layers(answer: list[str]) -> bool:
        """Whether a kept answer names layers, all of which the network has."""
        return bool(answer) and names.issuperset(answer)

    file = definition.checkpoint if definition.complete else None
    return recall_or_decide(module, file, question, decide, are_layers)


def kept_files() -> list[Path]:
    """Returns the paths of the cache files of all networks."""
    return sorted(cache_folder().glob("*.json"))


def forget() -> None:
    """Removes the cache files of all networks, and what interrupted runs have left of such.

    Raises:
        OutputError: A file cannot be removed.
    """
    for path in (*kept_files(), *cache_folder().glob("*.part")):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path} cannot be removed ({error.strerror})") from None


@functools.cache
def _versions() -> dict[str, str]:
    """Returns the versions of this program and of the installed packages that decide with it."""
    versions = {"pnpdepth": __version__}
    for package in ("torch", "transformers", "onnx", "onnxruntime"):
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions


def _digest_of(module: nn.Module, file: Path) -> str | None:
    """Returns a digest that changes with the network's structure.

    None for a network whose code may be anywhere, as that of a Python file, and if its files cannot
    be read.

    Args:
        module: The network.
        file: File of its graph, or safetensors file of its weights beside its config.json.
    """
    if module in _DIGESTS:
        return _DIGESTS[module]
    try:
        contents = _structure_of(module, file)
    except OSError:
        return None  # nothing is kept, and the network itself is in hand
    if not contents:
        return None
    # Each length goes in, too, so that no two lists of contents give the same bytes.
    digest = hashlib.sha256()
    for content in contents:
        digest.update(len(content).to_bytes(_LENGTH_BYTES, "little"))
        digest.update(content)
    _DIGESTS[module] = digest.hexdigest()
    return _DIGESTS[module]


def _structure_of(module: nn.Module, file: Path) -> list[bytes]:
    """Returns the bytes that tell the structure of a network; empty if its code may be anywhere.

    Args:
        module: The network.
        file: File of its graph, or safetensors file of its weights beside its config.json.

    Raises:
        OSError: A file cannot be read.
    """
    if isinstance(module, FileGraph):
        # The nodes tell which output of the file it is.
        return [file.read_bytes(), "\n".join(module._modules).encode()]
    if is_of_transformers(module):
        with file.open("rb") as weights:
            size = int.from_bytes(weights.read(_LENGTH_BYTES), "little")
            header = weights.read(min(size, _HEADER_BYTES))
        return [header, file.with_name("config.json").read_bytes()]
    return []


def _read(path: Path) -> dict[str, list[str]]:
    """Returns the answers in a file by their questions; none if it is absent, damaged or old."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            return {}
        content = json.loads(path.read_bytes())
        if content["versions"] != _versions():
            return {}
        answers = dict(content["answers"])
    # What `json.loads` and the look-ups raise on other content; such a file counts as absent.
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}
    are_lists_of_text = all(
        isinstance(answer, list) and all(isinstance(word, str) for word in answer)
        for answer in answers.values()
    )
    return answers if are_lists_of_text else {}


def _write(path: Path, answers: dict[str, list[str]]) -> None:
    """Replaces a file by the first `_MOST_ANSWERS` of the answers; leaves it if that fails."""
    first_answers = dict(list(answers.items())[:_MOST_ANSWERS])
    content = json.dumps({"versions": _versions(), "answers": first_answers}, indent=1)
    # Without the file, the next run decides again.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(content)
            Path(temporary).replace(path)
        finally:
            Path(temporary).unlink(missing_ok=True)
