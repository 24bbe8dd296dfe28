"""Refinement by hidden points against plain and updates of z.

Usage: `python -m benchmarks.masked --data PATH --csv FILE`. MAE and RMSE in metres over the pixels
with known ground truth, CPU seconds of a refinement, and steps that were kept. Points are drawn
from the ground truth; KITTI's are its own LiDAR's without occluded points. Constants were chosen on
the even frames of each set (`--half even`); the odd ones are for reporting.

FILE gets a line for each method and frame as soon as it is measured. What it holds already is not
measured again, so that a run that was cut goes on where it ended. The table is made from FILE.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.accuracy import frames_of, opened
from benchmarks.frames import (
    SETS,
    EvalFrame,
    frame_inputs,
    frame_pixels,
    points_on_grid,
    without_occluded,
)
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.frames.frame import DepthMap, is_dense
from pnpdepth_cli.frames.refine import refine_frame, with_propagation
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.settings import Settings

_OUTLIER_FACTORS = (0.3, 3.0)
"""Range of the factor on the depth of outliers."""
MASKED = Settings(target="masked")
METHODS: Mapping[str, Settings] = {
    "updates of z": Settings(),
    "masked, 4 steps": replace(MASKED, iterations=4),
    "masked, 8 steps": replace(MASKED, iterations=8),
    "masked, 40 steps": replace(MASKED, iterations=40),
    "masked": MASKED,
    "channels of z": Settings(parameters="channels"),
    "all points, weights": Settings(parameters="weights"),
    "masked, lora:8": replace(MASKED, parameters="lora:8"),
}
TABLE = ("updates of z", "masked, 8 steps", "masked", "masked, 40 steps")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A frame with some points."""

    network: str
    """Name of the network."""
    frames: str
    """Name of the set, or a folder of rendered frames."""
    points: int | None
    """Number of points; None for the sensor's own."""
    outliers: float
    """Fraction of the points with a wrong depth."""
    seed: int
    """Of the points."""
    frame: str
    """Name of the frame."""


@dataclass(frozen=True, kw_only=True)
class Row(Case):
    """One method on one frame."""

    method: str
    """Its name in the table."""
    mae: float
    """Metres."""
    rmse: float
    """Metres."""
    cpu_s: float
    """CPU time of the refinement, the plain prediction included."""
    kept: int
    """Updates that the depth was predicted after."""


def inputs_of(frame: EvalFrame, case: Case) -> Inputs:
    """Returns the frame with the points of the case."""
    if case.points is None:  # as the program does with a projected scan
        frame = without_occluded(frame)
    rows, columns, depth = frame_pixels(frame, case.points, case.seed)
    rng = np.random.default_rng(case.seed)
    outlier = rng.random(len(depth)) < case.outliers
    factors = np.exp(rng.uniform(*np.log(_OUTLIER_FACTORS), len(depth)))
    depth = np.where(outlier, depth * factors, depth).astype(np.float32)
    points = points_on_grid(rows, columns, depth, frame.gt.shape)
    return frame_inputs(frame.rgb, points, frame.gt)


def measured(network: Network, method: str, inputs: Inputs, case: Case) -> list[Row]:
    """Returns the rows of a method on one frame: plain, refined, and with propagation."""
    options = replace(METHODS[method], seed=case.seed)
    settings = resolve_settings(network.definition, options, dense=is_dense(inputs.points))
    layer = resolve_layer(network.definition, options.layer)
    start = time.process_time()
    with network.cut_at_points() if settings.masked else network.cut_at(layer) as split:
        frame = refine_frame(network, split, settings, inputs.registered())
    seconds = time.process_time() - start
    rows = [
        _row(case, inputs, "plain", frame.before, 0.0),
        _row(case, inputs, method, frame.after, seconds, frame.refinement.kept),
    ]
    if method in ("masked", "updates of z"):
        depth = with_propagation(inputs.registered(), frame.after, "gp")
        seconds = time.process_time() - start
        rows.append(_row(case, inputs, f"{method} + gp", depth, seconds, frame.refinement.kept))
    return rows


def _row(
    case: Case, inputs: Inputs, method: str, depth: DepthMap, cpu_s: float, kept: int = 0
) -> Row:
    assert inputs.gt is not None
    scores = score(torch.from_numpy(depth), torch.from_numpy(inputs.gt))
    return Row(
        **asdict(case), method=method, mae=scores.mae, rmse=scores.rmse, cpu_s=cpu_s, kept=kept
    )


class Results:
    """The rows of a CSV file, which gets a new one as soon as it is known.

    Args:
        path: The file; made if there is none.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._names = path, [field.name for field in fields(Row)]
        if not path.exists():
            path.write_text(",".join(self._names) + "\n")
        with path.open(newline="") as file:
            self.rows = [_parsed(line) for line in csv.DictReader(file)]

    def has(self, case: Case, method: str) -> bool:
        """Whether the method was measured on this frame."""
        return any(_case(row) == case and row.method == method for row in self.rows)

    def add(self, rows: Sequence[Row]) -> None:
        """Writes rows of one frame; one that is there already is left out."""
        new = [row for row in rows if not self.has(_case(row), row.method)]
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._names).writerows(asdict(row) for row in new)
        self.rows += new


def _case(row: Row) -> Case:
    return Case(**{field.name: getattr(row, field.name) for field in fields(Case)})


def _parsed(line: Mapping[str, str]) -> Row:
    return Row(
        network=line["network"],
        frames=line["frames"],
        points=int(line["points"]) if line["points"] else None,
        outliers=float(line["outliers"]),
        seed=int(line["seed"]),
        frame=line["frame"],
        method=line["method"],
        mae=float(line["mae"]),
        rmse=float(line["rmse"]),
        cpu_s=float(line["cpu_s"]),
        kept=int(line["kept"]),
    )


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Yields the lines of a table with a row for each group of cases and method."""
    yield "| network, set, points | cases | method | MAE | RMSE | CPU s | kept | worse |"
    yield "|" + "---|" * 8
    plain = {_case(row): row for row in rows if row.method == "plain"}
    groups = dict.fromkeys(
        (row.network, row.frames, row.points, row.outliers, row.method) for row in rows
    )
    for group in sorted(groups, key=lambda g: (g[:2], g[2] or 0, g[3], list(groups).index(g))):
        chosen = [
            row
            for row in rows
            if (row.network, row.frames, row.points, row.outliers, row.method) == group
        ]
        yield _line(chosen, [plain[_case(row)] for row in chosen])


def _line(rows: Sequence[Row], plain: Sequence[Row]) -> str:
    first = rows[0]
    wrong = f", {first.outliers:.0%} wrong" if first.outliers else ""
    label = f"{first.network}, {first.frames}, {first.points or 'LiDAR'}{wrong}"
    errors = []
    for name in ("mae", "rmse"):
        mean, before = (
            float(np.mean([getattr(row, name) for row in some])) for some in (rows, plain)
        )
        errors.append(f"{mean:.4f} ({mean / before - 1:+.1%})")
    cpu_s, kept = (
        float(np.mean([getattr(row, name) for row in rows])) for name in ("cpu_s", "kept")
    )
    worse = float(np.mean([a.mae > 1.01 * b.mae for a, b in zip(rows, plain, strict=True)]))
    cells = (label, len(rows), first.method, *errors, f"{cpu_s:.1f}", f"{kept:.0f}", f"{worse:.0%}")
    return f"| {' | '.join(map(str, cells))} |"


def _cases(args: argparse.Namespace, model: str) -> Iterator[tuple[EvalFrame, Case]]:
    """Evenly spaced frames of one half of each set, with the points of each seed."""
    for seed in range(args.seeds):
        for name in args.sets:
            half = frames_of(name, args.data, model)[args.half == "odd" :: 2]
            count = min(args.frames, len(half))
            indices = np.linspace(0, len(half) - 1, count).round().astype(int)
            for points in [None] if name == "kitti_dc" else args.points:
                if points is None and seed:  # the LiDAR's points are the same
                    continue
                for frame in (half[index] for index in indices):
                    yield (
                        frame,
                        Case(
                            network=model,
                            frames=name,
                            points=points,
                            outliers=args.outliers,
                            seed=seed,
                            frame=frame.name,
                        ),
                    )


def main() -> None:
    """Measure what FILE lacks, and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--csv", type=Path, required=True, help="Results, one line a frame.")
    parser.add_argument(
        "--sets", nargs="+", default=list(SETS), help="Names, or folders of rendered frames."
    )
    parser.add_argument("--points", nargs="+", type=int, default=[20, 100, 500])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=100, help="Of each set, at most.")
    parser.add_argument("--half", choices=("even", "odd"), default="odd")
    parser.add_argument("--models", nargs="+", default=["compact"])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=TABLE)
    parser.add_argument(
        "--wrong", dest="outliers", type=float, default=0.0, help="Fraction of outliers."
    )
    args = parser.parse_args()
    results = Results(args.csv)
    for model in args.models:
        network = opened(model, args.data)
        for frame, case in _cases(args, model):
            for method in args.methods:
                if not results.has(case, method):
                    results.add(measured(network, method, inputs_of(frame, case), case))
    print("\n".join(table(results.rows)))


if __name__ == "__main__":
    main()
