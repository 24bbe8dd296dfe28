"""How often images are moved into the frame of the points: `python -m benchmarks.registration`.

With `--data PATH` the real sets: in how many frames a registration is found from the frame alone,
and which one all frames of the set show together. With `--rendered PATH` rendered frames, which are
registered: how often one is found nevertheless, and how often and how exactly where the image was
moved by a random zoom (standard deviation 7 %) and shift (2.5 % of the sides).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.frames import SETS, frame_pixels, points_on_grid
from model_zoo_defs.training.learning import patterns
from model_zoo_defs.training.learning.dataset import Frames
from pnpdepth_cli.completion.image_registration import ImageRegistration, estimated, evidence

Depth = NDArray[np.float32]
CELLS = (
    *(("7scenes", count) for count in (2000, 500, 200, 100, 20)),
    *(("icl_nuim", count) for count in (2000, 500, 200, 100, 20)),
    ("kitti_dc", None),
)


def uniform(count: int) -> Callable[[Generator, Depth, Depth], Depth]:
    """A pattern of so many random pixels."""
    return lambda rng, depth, grey: patterns.keep(depth, patterns.uniform(rng, depth, count))


PATTERNS: dict[str, Callable[[Generator, Depth, Depth], Depth]] = {
    **{f"{count} random pixels": uniform(count) for count in (5000, 2000, 500, 200, 100)},
    "500 random pixels with faults": lambda rng, depth, grey: patterns.faults(
        rng, uniform(500)(rng, depth, grey)
    ),
    "multi-zone sensor": lambda rng, depth, grey: patterns.zones(rng, depth),
    "300 SfM points": lambda rng, depth, grey: patterns.triangulated(
        rng, patterns.keep(depth, patterns.corners(rng, depth, grey, 300))
    ),
    "LiDAR": lambda rng, depth, grey: patterns.scan_lines(rng, depth),
}


def real(data: Path, half: int) -> Iterator[tuple[object, ...]]:
    """Rows of the real sets, of the frames `half`, `half` + 2, …"""
    for name, count in CELLS:
        frames = list(SETS[name](data))[half::2]
        known = [
            evidence(f.rgb, points_on_grid(*frame_pixels(f, count, 0), f.gt.shape)) for f in frames
        ]
        found = [one for each in known if (one := estimated([each])) is not None]
        zoom = [each.zoom for each in found]
        spread = f"{np.mean(zoom):.3f} ± {np.std(zoom):.3f}" if found else "–"
        together = estimated(known)
        yield name, count or "LiDAR", len(frames), len(found), spread, together or "–"


def rendered(folder: Path, every: int) -> Iterator[tuple[object, ...]]:
    """Rows of rendered frames, registered and moved."""
    frames = Frames(folder)
    chosen = range(0, len(frames), every)
    for name, pattern in PATTERNS.items():
        wrong, found, errors = 0, 0, []
        for number in chosen:
            rgb, depth = frames[number]
            rng, image = np.random.default_rng(number), (rgb / 255).astype(np.float32)
            sparse = pattern(rng, depth, image.mean(-1))
            rows, columns = np.nonzero(sparse)
            points = points_on_grid(rows, columns, sparse[rows, columns], depth.shape)
            wrong += estimated([evidence(image, points)]) is not None
            truth = _random(rng, depth.shape)
            estimate = estimated([evidence(truth.inverse().applied(image), points)])
            if estimate is not None:
                found += 1
                errors.append(_error(estimate, truth, depth.shape))
        error = f"{np.median(errors):.1f}" if errors else "–"
        yield name, len(chosen), f"{wrong / len(chosen):.1%}", f"{found / len(chosen):.0%}", error


def _random(rng: Generator, size: tuple[int, ...]) -> ImageRegistration:
    zoom, shift = np.exp(rng.normal(0, 0.07)), rng.normal(0, 0.025, 2).clip(-0.045, 0.045)
    return ImageRegistration(
        zoom=float(np.clip(zoom, 0.87, 1.13)),
        right=float(shift[0] * size[1]),
        down=float(shift[1] * size[0]),
    )


def _error(one: ImageRegistration, other: ImageRegistration, size: tuple[int, ...]) -> float:
    """Mean distance in pixels between where the two say that colours are."""
    y, x = np.mgrid[: size[0] : 8, : size[1] : 8]
    x, y = x - size[1] / 2, y - size[0] / 2
    right = (one.zoom - other.zoom) * x + one.right - other.right
    down = (one.zoom - other.zoom) * y + one.down - other.down
    return float(np.hypot(right, down).mean())


def main() -> None:
    """Measure, and print tables as they come."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--half", type=int, choices=(0, 1), default=1, help="even or odd frames")
    parser.add_argument("--rendered", type=Path)
    parser.add_argument("--every", type=int, default=1, help="use every n-th rendered frame")
    args = parser.parse_args()
    if args.data:
        _print(
            ("set", "points", "frames", "found alone", "zoom", "found together"),
            real(args.data, args.half),
        )
    if args.rendered:
        head = ("points", "frames", "found wrongly", "found", "error, px")
        _print(head, rendered(args.rendered, args.every))


def _print(head: tuple[str, ...], rows: Iterator[tuple[object, ...]]) -> None:
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    main()
