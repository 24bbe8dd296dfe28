"""Whether the images of a bag are rectified, and by which of the cameras of its camera_info."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.pipeline.sparse.scans import camera_of
from pnpdepth_cli.sensors import edge_agreement, project_velodyne

_COMPARED_FRAMES = 5
_CLEARLY_BETTER = 0.03
"""Difference of `edge_agreement` by which another camera is preferred to the one that is named."""

_FEW_INSIDE = 0.5
"""Of the most points that a camera puts into the image; fewer rule it out."""


def chosen_camera(
    folder: Path,
    image_topic: str,
    raw: Calibration,
    rectified: Mapping[str, Calibration],
    say: Callable[[str], None],
) -> Calibration:
    """Returns the camera of the images, and says which one.

    A topic image_rect* is of rectified images. Any other topic is of raw images unless a rectified
    camera puts the jumps of depth clearly better onto the edges of the images, as in bags that hold
    rectified images as image_raw.

    Args:
        folder: Of the frames, with rgb/ and sparse/.
        image_topic: Of the images.
        raw: K, distortion and the pose of the scanner.
        rectified: Cameras without distortion, relative to the raw one; the first by definition.
        say: Receives which camera is used.
    """
    named = "image_rect" in image_topic
    cameras = {name: _posed(camera, raw) for name, camera in rectified.items()}
    candidates = cameras if named else {"K and distortion": raw} | cameras
    scores = _scores(folder, candidates) if raw.has_pose and len(candidates) > 1 else {}
    first = next(iter(candidates))
    best = max(scores, key=lambda name: scores[name], default=first)
    margin = scores.get(best, 0) - scores.get(first, 0)
    choice = best if margin > _CLEARLY_BETTER else first
    images = "raw" if choice not in cameras else "rectified"
    why = f"the topic {image_topic}" if named else "the usual meaning of camera_info"
    if choice != first or not named:
        compared = ", ".join(f"{name} {score:+.2f}" for name, score in scores.items())
        if compared:
            why = f"image edges at jumps of depth: {compared}"
    say(f"camera: {images} images, by {choice} ({why}); --calib gives another")
    return candidates[choice]


def _posed(camera: Calibration, raw: Calibration) -> Calibration:
    """The camera with the pose of the scanner, which is given relative to the raw camera."""
    return replace(
        camera,
        rotation=camera.rotation @ raw.rotation,
        translation=camera.rotation @ raw.translation + camera.translation,
        has_pose=raw.has_pose,
    )


def _scores(folder: Path, candidates: Mapping[str, Calibration]) -> dict[str, float]:
    """The mean edge agreement of frames by camera, −1 for one that puts few points into them."""
    scans = sorted((folder / "sparse").iterdir())
    positions = np.linspace(0, len(scans) - 1, min(_COMPARED_FRAMES, len(scans)))
    agreement = {name: list[float]() for name in candidates}
    counts = dict.fromkeys(candidates, 0)
    for scan in (scans[round(position)] for position in positions):
        (image,) = (folder / "rgb").glob(f"{scan.stem}.*")
        rgb, xyz = read_rgb(image).values, read_scan(scan).points
        for name, calibration in candidates.items():
            try:
                points = project_velodyne(xyz, camera_of(calibration), rgb.shape[:2])
            except NoPointsError:
                continue
            counts[name] += len(points)
            agreement[name].append(edge_agreement(points, rgb))
    few = _FEW_INSIDE * max(counts.values())
    return {
        name: float(np.mean(values)) if values and counts[name] >= few else -1.0
        for name, values in agreement.items()
    }
