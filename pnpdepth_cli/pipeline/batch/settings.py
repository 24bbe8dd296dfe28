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


def settings_of(request: RefineRequest, model: dict[str, Any], *groups: str) -> dict[str, Any]:
    """Returns all that decides the result except the frame's own files, in JSON's own types.

    Args:
        request: What is asked for.
        model: What `model_identity` returns.
        *groups: Names of the request's groups. None: all of them.
    """
    asked = request.settings(*groups)
    if "device" in asked:  # two devices of a kind give the same, so shards may have one each
        asked["device"] = asked["device"].split(":")[0]
    if "scan" in asked:
        asked["scan"] = asdict(asked["scan"])
        del asked["scan"]["calib"]
    for name in ("sample", "protocol"):
        if asked.get(name) is not None:
            asked[name] = asdict(asked[name])
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
    spec, checkpoint = request.network.model, request.network.checkpoint
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
