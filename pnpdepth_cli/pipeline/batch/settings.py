"""Reduces the settings of a frame to one digest, equal where the results would be equal."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli import __version__
from pnpdepth_cli.io.record import plain, sha256_of
from pnpdepth_cli.pipeline.refinement.request import RefineRequest


def settings_of(request: RefineRequest, model: dict[str, Any], *groups: str) -> dict[str, Any]:
    """Returns the settings that decide a frame's result, in JSON's own types.

    A frame is refined again if its record has other settings. The files of the frame, its
    calibration among them, are compared by their content elsewhere.

    Args:
        request: How the frame is refined.
        model: The `model_identity` of the request.
        *groups: Names of the request's groups. None: all of them.
    """
    fields = request.settings(*groups)
    fields.pop("more_models", None)  # `model` has the digests of all networks
    if "device" in fields:  # devices of one kind give equal results, so shards may use one each
        fields["device"] = fields["device"].split(":")[0]
    if "scan" in fields:
        fields["scan"] = asdict(fields["scan"])
        del fields["scan"]["calib"], fields["scan"]["extrinsics"]
    if not fields.get("window"):
        fields.pop("window", None)
    neighbours = fields.pop("neighbours", ())
    if neighbours:
        fields["neighbours"] = [(each.motion, each.apart) for each in neighbours]
    calibration = fields.pop("calibration", None)
    if calibration is not None:
        fields["calibration"] = asdict(calibration)
    for name in ("colmap", "sample", "protocol"):
        if fields.get(name) is not None:
            fields[name] = asdict(fields[name])
    settings: dict[str, Any] = plain(fields | model)
    return settings


def settings_digest(request: RefineRequest, model: dict[str, Any]) -> str:
    """Returns the SHA-256 of `settings_of`."""
    text = json.dumps(settings_of(request, model), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class SettingsDigests:
    """The `settings_digest` of frames, computed once for consecutive frames of equal settings.

    Args:
        model: The `model_identity` of their requests.
    """

    def __init__(self, model: dict[str, Any]) -> None:
        self._model = model
        self._last: tuple[Any, str] | None = None

    def of(self, request: RefineRequest) -> str:
        """Returns the digest of a frame's request."""
        files = request.files
        if files.calibration is not None or files.neighbours:  # of arrays, and of each frame alone
            return settings_digest(request, self._model)
        scan = replace(files.scan, calib=None, extrinsics=None)
        alike = replace(
            files, image=None, sparse=None, gt=None, gt_masks=(), scan=scan,
            camera_file=None, camera_number=None,
        )  # fmt: skip
        key = (alike, request.network, request.method, request.hold_out, request.outputs)
        last = self._last  # several threads may ask
        if last is None or last[0] != key:
            last = self._last = key, settings_digest(request, self._model)
        return last[1]


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
