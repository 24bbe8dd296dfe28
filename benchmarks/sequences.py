"""Points accumulated over a sequence: `python -m benchmarks.sequences --data PATH`.

KITTI raw drive 2011_09_26_0023, seven consecutive frames. A fifth of a frame's own LiDAR points is
held out, as single points or as scan lines, and predicted from the other points, alone and with
those of the neighbouring frames. MAE in metres at the held-out points, and at those of them where
a moved point within two pixels contradicts them by a tenth or more: something moved, or is
occluded from one of the two positions. Poses are those of the drive's inertial system, or with
--estimated none, so that motion is estimated from the images. Constants were chosen on frames 2 and
4, those of contradiction on 0, 2, 4 and 6, with seed 0; frames 1, 3 and 5 with seeds 1 and up are
for reporting. --motion prints how far estimated motion is from that of the inertial system.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.pipeline.batch.frames import task_of
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.sequence import with_neighbours
from pnpdepth_cli.pipeline.refinement.inputs import Inputs, read_inputs, split_points
from pnpdepth_cli.pipeline.refinement.refine import load_refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.scan_pattern import scan_lines
from pnpdepth_cli.sensors import Points
from pnpdepth_cli.sensors.accumulation import registered, surface_of
from pnpdepth_cli.sensors.motion import motion_of_scans

DRIVE = Path("kitti_raw/2011_09_26/2011_09_26_drive_0023_sync")
HELD_OUT = 0.2
_NEAR_PX, _CONTRADICTS = 2.0, 0.1

Predict = Callable[[Inputs, SparsePoints, SparsePoints], torch.Tensor]
"""Depth (M,) at the held-out points, from those used."""


def drive_frames(data: Path, reach: int, *, estimated: bool = False) -> list[Frame]:
    """Returns the frames of the drive, each with so many neighbours to each side.

    With `estimated`, their poses are unknown.
    """
    drive = data / DRIVE
    frames = [
        Frame(
            name=image.stem,
            image=image,
            sparse=drive / "proj_depth/velodyne/image_02" / f"{image.stem}.npz",
            calib=drive.parent,
            camera=2,
            oxts=None if estimated else drive / "oxts/data" / f"{image.stem}.txt",
        )
        for image in sorted((drive / "image_02/data").glob("*.png"))
    ]
    return with_neighbours(frames, reach, None)


def inputs_of(data: Path, reach: int, *, estimated: bool = False) -> list[Inputs]:
    """Returns the frames of the drive in memory."""
    request = BatchRequest(source=data, output=data, refine=RefineRequest())
    frames = drive_frames(data, reach, estimated=estimated)
    return [read_inputs(task_of(request, frame).request) for frame in frames]


def motion_errors(data: Path, apart: int) -> dict[str, NDArray[np.float64]]:
    """(pairs, 2) metres and degrees between estimated motion and that of the inertial system.

    As estimated from the images, from the scans, and each corrected by the surfaces; at last the
    inertial motion itself, corrected.
    """
    known, images = inputs_of(data, apart), inputs_of(data, apart, estimated=True)
    rows: dict[str, list[tuple[float, float]]] = {}
    for reference, by_images in zip(known, images, strict=True):
        assert reference.camera is not None
        camera, own = reference.camera.camera, reference.points
        points = Points(xy=own.xy.numpy(), depth=own.depth.numpy(), size=own.size)
        surface = surface_of(points, camera)
        for each, estimate in zip(reference.neighbours, by_images.neighbours, strict=True):
            if each.apart != apart:
                continue
            by_scans = motion_of_scans(points, each.points, camera).motion
            assert by_scans is not None
            xyz = camera.unproject(each.points.xy, each.points.depth)
            kinds = {"images": estimate.motion, "scans": by_scans}
            for kind, motion in (kinds | {"inertial": each.motion}).items():
                corrected = registered(surface, xyz, motion, camera)
                rows.setdefault(kind, []).append(_between(motion, each.motion))
                rows.setdefault(f"{kind}, corrected", []).append(_between(corrected, each.motion))
    return {kind: np.array(values) for kind, values in rows.items()}


def _between(motion: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[float, float]:
    """Metres and degrees between two motions."""
    turn = Rotation.from_matrix(motion[:, :3].T @ other[:, :3]).magnitude()
    return float(np.linalg.norm(motion[:, 3] - other[:, 3])), float(np.degrees(turn))


def print_motion_errors(data: Path) -> None:
    """Prints median and largest errors of the motion."""
    print("| frames apart | motion | pairs | m: median | largest | degrees: median | largest |")
    print("|" + "---|" * 7)
    for apart in (1, 2):
        for kind, values in motion_errors(data, apart).items():
            (metres, degrees), (far, turned) = np.median(values, axis=0), values.max(axis=0)
            print(
                f"| {apart} | {kind} | {len(values)} | {metres:.3f} | {far:.3f} |"
                f" {degrees:.3f} | {turned:.3f} |"
            )


def split(points: SparsePoints, how: str, seed: int) -> tuple[SparsePoints, SparsePoints]:
    """Returns the points to use and those held out, single ones or whole scan lines."""
    if how == "points":
        return split_points(points, HELD_OUT, seed)
    line = scan_lines(points.xy.numpy(), points.size)
    assert line is not None
    lines = np.random.default_rng(seed).permutation(line.max() + 1)
    held = torch.from_numpy(np.isin(line, lines[: round(HELD_OUT * len(lines))]))
    return points.select(~held), points.select(held)


def contradicted(inputs: Inputs, held: SparsePoints) -> NDArray[np.bool_]:
    """Returns (M,) true where an unfiltered moved point contradicts the held-out one."""
    assert inputs.camera is not None
    camera = inputs.camera.camera
    result = np.zeros(len(held), bool)
    for each in inputs.neighbours:
        xyz = camera.unproject(each.points.xy, each.points.depth)
        xyz = xyz @ each.motion[:, :3].T + each.motion[:, 3]
        xyz = xyz[xyz[:, 2] > 0]
        distance, index = cKDTree(camera.pixels_of(xyz)).query(held.xy.numpy())
        apart = np.abs(np.log(xyz[index, 2] / held.depth.numpy()))
        result |= (distance < _NEAR_PX) & (apart > _CONTRADICTS)
    return result


def interpolated(inputs: Inputs, used: SparsePoints, held: SparsePoints) -> torch.Tensor:
    """Linear interpolation."""
    return linear(of_used(inputs, used).points, held.xy)


def of_used(inputs: Inputs, used: SparsePoints) -> Inputs:
    """The frame with these of its own points, and its neighbours'."""
    moved = torch.arange(len(inputs.points)) >= inputs.own_used
    return replace(inputs, points=used.joined(inputs.points.select(moved)))


def refined_by(**options: object) -> Predict:
    """Returns a prediction by the refinement with these options."""

    def predict(inputs: Inputs, used: SparsePoints, held: SparsePoints) -> torch.Tensor:
        without_held = of_used(inputs, used)
        refiner = load_refiner(RefineRequest.from_fields(**options), without_held)
        with refiner:
            frame = refiner.refine_frame(without_held)
        return held.sample(torch.from_numpy(frame.after))

    return predict


METHODS: dict[str, Predict] = {
    "linear": interpolated,
    "compact": refined_by(iterations=0, propagate="none"),
    "compact, updates of z": refined_by(propagate="none"),
    "default": refined_by(),
}


def errors(predict: Predict, inputs: Inputs, how: str, seed: int) -> Iterator[NDArray[np.float64]]:
    """Absolute errors at the held-out points: with the frame's own points, then accumulated."""
    used, held = split(inputs.own, how, seed)
    for each in (replace(inputs, neighbours=()), inputs):
        yield (predict(each, used, held) - held.depth).abs().double().numpy()


def flicker_of_linear(frames: list[Inputs], seed: int) -> tuple[float, float]:
    """Flicker of linear interpolation in metres: with the frames' own points, then accumulated.

    As `eval --measures flicker` has it, at the pixels that are held out in both of two frames.
    """
    errors: list[list[dict[tuple[float, ...], float]]] = [[], []]
    for inputs in frames:
        used, held = split(inputs.own, "points", seed)
        for of_kind, each in zip(errors, (replace(inputs, neighbours=()), inputs), strict=True):
            error = (interpolated(each, used, held) - held.depth).tolist()
            of_kind.append(dict(zip(map(tuple, held.xy.tolist()), error, strict=True)))
    alone, accumulated = (
        float(
            np.mean(
                [
                    np.mean([abs(after[xy] - before[xy]) for xy in before.keys() & after.keys()])
                    for before, after in itertools.pairwise(of_kind)
                ]
            )
        )
        for of_kind in errors
    )
    return alone, accumulated


def interval(ratios: NDArray[np.float64]) -> str:
    """The mean change in per cent with its 95 % interval over frames (Student's t)."""
    from scipy.stats import t

    mean, count = float(ratios.mean()), len(ratios)
    if count < 2:
        return f"{mean - 1:+.1%}"
    half = t.ppf(0.975, count - 1) * ratios.std(ddof=1) / count**0.5
    return f"{mean - 1:+.1%} ({mean - 1 - half:+.1%} … {mean - 1 + half:+.1%})"


def main() -> None:
    """Measure, and print a row for each method and way of holding out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--reach", type=int, default=2)
    parser.add_argument("--frames", nargs="+", type=int, default=[1, 3, 5])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--hold-out", nargs="+", default=["points", "lines"])
    parser.add_argument("--flicker", action="store_true", help="Of linear interpolation only.")
    parser.add_argument("--estimated", action="store_true", help="Without the drive's poses.")
    parser.add_argument("--motion", action="store_true", help="Errors of estimated motion only.")
    args = parser.parse_args()
    if args.motion:
        print_motion_errors(args.data)
        return
    frames = inputs_of(args.data, args.reach, estimated=args.estimated)
    if args.flicker:
        pairs = np.array([flicker_of_linear(frames, seed) for seed in args.seeds])
        print(
            "flicker, alone and accumulated:", pairs.mean(axis=0).round(4), pairs.round(4).tolist()
        )
        return
    print("| held out | method | n | alone | accumulated | change | contradicted: alone | acc. |")
    print("|" + "---|" * 8)
    for how in args.hold_out:
        for name in args.methods:
            print(_row(args, frames, how, name), flush=True)


def _row(args: argparse.Namespace, frames: list[Inputs], how: str, name: str) -> str:
    means, ratios = [], []
    for index in args.frames:
        of_frame = []
        for seed in args.seeds:
            inputs = frames[index]
            wrong = contradicted(inputs, split(inputs.own, how, seed)[1])
            pair = list(errors(METHODS[name], inputs, how, seed))
            of_frame.append([each[part].mean() for part in (slice(None), wrong) for each in pair])
        means += of_frame
        alone, accumulated = np.mean(of_frame, axis=0)[:2]
        ratios.append(accumulated / alone)
    alone, accumulated, of_wrong, of_wrong_after = np.mean(means, axis=0)
    cells = (
        *(how, name, f"{len(args.frames)} × {len(args.seeds)}"),
        *(f"{alone:.3f}", f"{accumulated:.3f}", interval(np.array(ratios))),
        *(f"{of_wrong:.2f}", f"{of_wrong_after:.2f}"),
    )
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
