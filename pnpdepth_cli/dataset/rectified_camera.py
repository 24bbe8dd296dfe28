"""Which camera images are of that may be rectified: the raw one, or a rectified one.

A calibration such as ROS' camera_info has both. The edges of an image lie where depth jumps by the
right one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.points import in_frame
from pnpdepth_cli.sensors.edge_fit import edge_map, jumps_of

_CLEARLY_BETTER = 1.0
"""Standard deviations of the score by chance, by which another camera replaces the usual one."""
_CHANCE_PX = 80.0
"""Largest shift of the points, across and down, whose scores tell chance."""
_LEAST_INSIDE = 0.5
"""Fraction of the jumps of depth that a camera puts into the image, at least, to be compared."""


def choose_camera(
    raw: Calibration,
    frames: Iterable[tuple[NDArray[np.float32], NDArray[np.floating]]],
    topic: str = "",
) -> tuple[Calibration, str]:
    """Returns the camera of images that may be rectified, and a line that says which it is.

    A topic image_rect* is of rectified images. Any other image is raw, unless a rectified camera
    puts the jumps of depth clearly better onto its edges: some bags hold rectified images as
    image_raw.

    Args:
        raw: The camera of raw images and the pose of the scanner, with the rectified cameras.
        frames: Images (H, W, 3) in 0…1, each with a scan (N, 3) in the scanner's coordinates.
        topic: Topic of the images. Empty: they are of files, or their topic is not known.
    """
    # The candidates. The first is the usual one: a rectified camera if the topic says so, else the
    # raw one.
    cameras = dict[str, Calibration]()
    for name, (camera, pose_of_raw) in raw.rectified.items():
        scanner = None if raw.scanner is None else pose_of_raw @ raw.scanner
        cameras[name] = Calibration(camera=camera, scanner=scanner)
    candidates = cameras if "image_rect" in topic else {"K and distortion": raw} | cameras
    choice = next(iter(candidates))
    usual = candidates[choice]
    why = f"the topic {topic}" if topic else "the usual meaning of camera_info"
    # How well jumps of depth meet edges, in the mean of the frames.
    scores = list[dict[str, float]]()
    if usual.scanner is not None and len(candidates) > 1:
        for rgb, xyz in frames:
            frame_scores = _scores(xyz, rgb, usual, candidates)
            if frame_scores is not None:
                scores.append(frame_scores)
    if scores:
        means = {
            name: float(np.mean([frame_scores[name] for frame_scores in scores]))
            for name in candidates
        }
        best = max(means, key=lambda name: means[name])
        if means[best] - means[choice] > _CLEARLY_BETTER:
            choice = best
        compared = ", ".join(f"{name} {score:+.2f}" for name, score in means.items())
        why = f"image edges at jumps of depth: {compared}"
    images = "rectified" if choice in cameras else "raw"
    note = f"camera: {images} images, by {choice} ({why}); --calib gives another"
    return candidates[choice], note


def _scores(
    scan: NDArray[np.floating],
    rgb: NDArray[np.float32],
    usual: Calibration,
    candidates: Mapping[str, Calibration],
) -> dict[str, float] | None:
    """How well each calibration puts jumps of depth onto the image's edges, by its name.

    Scores are in standard deviations by chance. A calibration that puts few of the jumps into the
    image has 0.

    Args:
        scan: (N, 3) in the scanner's coordinates.
        rgb: (H, W, 3) in 0…1, the image.
        usual: The calibration by which jumps of depth are found.
        candidates: All calibrations, by name.

    Returns:
        None where the points tell nothing.
    """
    # The jumps of depth are those that the usual camera sees. Chance is their score at all shifts.
    size = (rgb.shape[0], rgb.shape[1])
    jumps = jumps_of(scan, usual.camera, usual.known_scanner, size)
    if jumps is None:
        return None
    edges = edge_map(rgb)
    xy, weights = jumps.projected(usual.camera)
    shifted = edges.shifted(xy, weights, (_CHANCE_PX, _CHANCE_PX))
    chance = float(shifted.mean())
    spread = float(shifted.std()) + 1e-9  # above 0, of an image without edges
    # Each candidate projects them anew.
    scores = dict.fromkeys(candidates, 0.0)
    for name, candidate in candidates.items():
        motion = candidate.known_scanner @ usual.known_scanner.inverse()
        xy, weights = jumps.moved(motion).projected(candidate.camera)
        if np.count_nonzero(in_frame(xy, size)) >= _LEAST_INSIDE * len(jumps.xyz):
            scores[name] = (edges.score(xy, weights) - chance) / spread
    return scores
