"""The settings of a frame that decide its result, by which a batch knows what is done."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.io.record import plain, sha256_of

_ONLY_IF_SET = {"window", "neighbours", "calibration"}


def settings_of(request: RefineRequest, model: dict[str, Any], *groups: str) -> dict[str, Any]:
    """Returns the settings that decide a frame's result, in JSON's own types.

    A frame is refined again if its record has other settings. The files of the frame, its
    calibration among them, are compared by their content elsewhere.

    Args:
        request: How the frame is refined.
        model: The `model_identity` of the request.
        *groups: Names of the request's groups. None: all of them.
    """
    fields = {
        name: value
        for name, value in request.settings(*groups).items()
        if name != "more_models" and (value or name not in _ONLY_IF_SET)
    }
    if "neighbours" in fields:
        fields["neighbours"] = [(each.motion, each.apart) for each in fields["neighbours"]]
    if "device" in fields:  # devices of one kind give equal results, so shards may use one each
        fields["device"] = fields["device"].split(":")[0]
    settings: dict[str, Any] = plain(fields | model)
    for name in ("calib", "extrinsics"):
        settings.get("scan", {}).pop(name, None)
    return settings


def model_identity(request: RefineRequest) -> dict[str, Any]:
    """Returns the program's version and the digests of the network's files.

    A file's name with its :ATTRIBUTE or :OUTPUT counts; its folder does not.
    """
    checkpoint = request.network.checkpoint
    identity = {
        "version": __version__,
        **_identity(request.network.model),
        "checkpoint": None if checkpoint is None else sha256_of(checkpoint),
    }
    more = [_identity(spec) for spec in request.network.more_models]
    return identity | ({"more_models": more} if more else {})


def _identity(spec: str) -> dict[str, Any]:
    path, colon, choice = Path(spec), "", ""
    if not path.exists() and ":" in spec:
        start, colon, choice = spec.rpartition(":")
        path = Path(start)
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.is_file())
    return {
        "model": f"{path.name}{colon}{choice}" if files else spec,
        "model_files": {p.name: sha256_of(p) for p in files},
    }
