"""With which settings a frame is refined, as one digest: equal where the results would be."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pnpdepth_cli import __version__
from pnpdepth_cli.io.record import plain, sha256_of
from pnpdepth_cli.pipeline.refinement.request import RefineRequest

_FILES = ("image", "sparse", "gt", "output", "overwrite", "model", "checkpoint")
"""Fields of a request that say where something lies; what lies there has digests of its own."""


def settings_of(request: RefineRequest, model: dict[str, Any]) -> dict[str, Any]:
    """All that decides the result but the frame's own files, in JSON's own types.

    model: what `model_identity` says.
    """
    asked = {name: value for name, value in asdict(request).items() if name not in _FILES}
    # Two devices of a kind give the same, so shards may have one each.
    asked["device"] = request.device.split(":")[0]
    asked["scan"].pop("calib")
    settings: dict[str, Any] = plain(asked | model)
    return settings


def settings_digest(request: RefineRequest, model: dict[str, Any]) -> str:
    """The digest of `settings_of`."""
    text = json.dumps(settings_of(request, model), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def model_identity(request: RefineRequest) -> dict[str, Any]:
    """The program's version, which decides a named network, and the digests of a network's files.

    A file's name, which may have an :ATTRIBUTE or :OUTPUT behind it, counts; its folder does not.
    """
    spec, checkpoint = request.model, request.checkpoint
    path, colon, choice = Path(spec), "", ""
    if not path.exists() and ":" in spec:
        start, colon, choice = spec.rpartition(":")
        path = Path(start)
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.is_file())
    return {
        "version": __version__,
        "model": f"{path.name}{colon}{choice}" if files else spec,
        "model_files": {p.name: sha256_of(p) for p in files},
        "checkpoint": None if checkpoint is None else sha256_of(checkpoint),
    }
