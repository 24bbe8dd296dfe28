"""What the default makes of networks of any strength: `python -m benchmarks.strong --data PATH`.

Rows are stored predictions of strong networks (`strong/` in PATH), networks of 2, 4 and 9 % error
that are simulated on frames with truth, FastDepth, the tiny networks, and networks of random
weights. Each is given 5 to 500 points at random pixels, or scan lines.

For each row, set and number of points the table has geometric means over frames and seeds of the
MAE in metres: the network aligned with the points, its z updated, its residual propagated;
`compact` alone, and with the aligned depth as its prior; the result; linear interpolation. All are
scored on the same pixels, those with ground truth. Below are the mean weights in the result, and
the part of the truth within ± 2σ.

    python -m benchmarks.strong --data PATH --groups stored --points 20 100 500

`--json FILE` keeps every run. `--tables FILE ...` prints the tables of such files and measures
nothing. `--figure FILE` draws how far the points lower the error of each network.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.frames import drawn_inputs, errors_of, print_row
from benchmarks.strong_maps import GROUPS, StrongFrame, can_draw, strong_frames, with_lines
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.experts import weighted_mean
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.open_network import MIRRORED_BELOW
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.measures import AFTER, ALONE, BEFORE, LINEAR, PROPAGATED, UPDATED
from pnpdepth_cli.settings import Settings

COUNTS = (5, 10, 20, 50, 100, 500)
LINES = "lines"
WITH_PRIOR = "with prior"
"""A column of the table: `compact` with the aligned depth as its prior."""
STAGES = (BEFORE, UPDATED, PROPAGATED, ALONE, WITH_PRIOR, AFTER, LINEAR)
HEADS = ("aligned", "z updated", "propagated", "compact", "with prior", "**result**", "linear")
OWN = ("network", "network as prior", "compact", "no image")
"""Kinds of experts, whose weights are shown."""
DRAWN = (20, 100, 500)
"""Numbers of points of the figure."""
ALL = "all"
"""Instead of a set: every frame of the row."""
SIGMAS = 2

Run = dict[str, Any]
"""One frame, network, number of points and seed: MAE by stage, weights by kind of expert."""


def measure(case: StrongFrame, count: int | None, seed: int) -> Run:
    """Returns the run of one frame with so many points; None: scan lines."""
    # The result, and what `compact` makes of the aligned network.
    frame = case.frame if count is not None else with_lines(case.frame)
    inputs = drawn_inputs(frame, count, seed)
    start = time.process_time()
    with Method([case.network], Settings(seed=seed), inputs, uncertainty=True) as method:
        refined = method.refine(inputs, with_stages=True)
        seconds = time.process_time() - start
        prior = depth_with_prior(method, inputs, refined)
    # All stages, scored on the same pixels.
    depths = {name: torch.from_numpy(depth) for name, depth in refined.stages.items()}
    depths.setdefault(UPDATED, depths[BEFORE])  # of a network whose z was not updated
    depths |= {
        WITH_PRIOR: prior,
        AFTER: torch.from_numpy(refined.depth),
        LINEAR: linear(inputs.points),
    }
    errors = errors_of(depths, torch.from_numpy(frame.gt))
    return {
        "row": case.row,
        "set": case.set,
        "frame": frame.name,
        "network": case.network.definition.name,
        "points": LINES if count is None else count,
        "seed": seed,
        "mae": {stage: errors[stage][0] for stage in STAGES},
        "rmse": {stage: errors[stage][1] for stage in STAGES},
        "weights": weights_by_kind(case.network.definition.name, refined),
        "within": within_sigma(refined, frame.gt),
        "cpu_s": seconds,
    }


def depth_with_prior(method: Method, inputs: Frame, refined: Refined) -> Tensor:
    """(H, W) metres: what `compact` alone makes of the network's aligned depth as its prior.

    It is not updated, sees the mirrored frame as well where the points are few, and its residual is
    propagated, as in the default method.
    """
    (compact,) = (member for member in method.members if member.takes_prior)
    prior = torch.from_numpy(refined.before)
    frame = replace(inputs.registered(), points=refined.used.tensors(), prior=prior)
    compact.next_image()
    depths = [(compact.refine(frame, updates=False).updated, 1.0)]
    if len(frame.points) < MIRRORED_BELOW:
        compact.next_image()
        turned = compact.refine(frame.mirrored(), updates=False)
        depths.append((turned.updated.flip(-1), 1.0))
    field = ResidualField(weighted_mean(depths), frame.points, frame.rgb)
    return field.depth(kind=refined.propagation)


def weights_by_kind(network: str, refined: Refined) -> dict[str, float]:
    """Returns the experts' weights in the result, summed up by the kinds of `OWN`."""
    kinds = {network: OWN[0], f"compact with {network}": OWN[1], "compact": OWN[2]}
    weights = dict.fromkeys(OWN, 0.0)
    for name, weight in refined.weights.items():
        weights[kinds.get(name, OWN[3])] += weight
    return weights


def within_sigma(refined: Refined, gt: np.ndarray[Any, Any]) -> float:
    """Returns the fraction of the pixels whose error is within two standard deviations."""
    assert refined.sigma is not None
    known = (gt > 0) & (refined.depth > 0)
    error = np.abs(gt - refined.depth)[known]
    return float((error <= SIGMAS * refined.sigma[known]).mean())


def print_tables(runs: Sequence[Run]) -> None:
    """Prints the MAE of every row, set and number of points, and the weights and σ below."""
    cases = defaultdict[tuple[str, str, Any], list[Run]](list)
    for run in runs:
        cases[run["row"], run["set"], run["points"]].append(run)
    # Rows of several sets have a line of all their frames, too.
    for row in {row for row, _, _ in cases}:
        names = {name for row_of_case, name, _ in cases if row_of_case == row}
        for run in [run for run in runs if run["row"] == row and len(names) > 1]:
            cases[row, ALL, run["points"]].append(run)
    order = {number: place for place, number in enumerate((*COUNTS, LINES))}
    first = list(dict.fromkeys((run["row"], run["set"]) for run in runs))
    places = {case: place for place, case in enumerate(first)}
    last_of_row = {row: place for (row, _), place in places.items()}

    def place(case: tuple[str, str, Any]) -> tuple[float, float]:
        """Returns the place of a line: as measured, a row's line of all frames behind its sets."""
        row, name, points = case
        at = last_of_row[row] + 0.5 if name == ALL else places[row, name]
        return at, order.get(points, points)

    ordered = sorted(cases, key=place)
    print_row("network", "set", "runs", "points", *HEADS, "result / best of one", head=True)
    for row, name, points in ordered:
        mean = {stage: geometric_mean(cases[row, name, points], stage) for stage in STAGES}
        best = min(mean[stage] for stage in STAGES if stage != AFTER)
        cells = [f"{mean[stage]:.4f}" for stage in STAGES]
        cells[STAGES.index(AFTER)] = f"**{mean[AFTER]:.4f}**"
        runs_of = len(cases[row, name, points])
        print_row(row, name, runs_of, points, *cells, f"{mean[AFTER] / best - 1:+.1%}")
    print()
    print_row("network", "set", "points", *OWN, "within ± 2σ", "CPU s", head=True)
    for row, name, points in ordered:
        some = cases[row, name, points]
        weights = [f"{np.mean([run['weights'][kind] for run in some]):.0%}" for kind in OWN]
        within = np.mean([run["within"] for run in some])
        seconds = np.median([run["cpu_s"] for run in some])
        print_row(row, name, points, *weights, f"{within:.1%}", f"{seconds:.1f}")


def geometric_mean(runs: Sequence[Run], stage: str) -> float:
    """The geometric mean of the MAE of a stage over runs."""
    return float(np.exp(np.mean([np.log(run["mae"][stage]) for run in runs])))


def draw(runs: Sequence[Run], path: Path) -> None:
    """Draws the MAE of the result over that of the aligned network, by network and points.

    Beside it is linear interpolation, over the same. Raises UsageError without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("--figure needs matplotlib: pip install matplotlib") from None
    # A panel for each number of points, a bar for each network.
    rows = list(dict.fromkeys(run["row"] for run in runs))
    figure = Figure(figsize=(9, 0.5 * len(rows) + 1.4), layout="constrained")
    panels = figure.subplots(1, len(DRAWN), sharex=True, sharey=True)
    for count, axes in zip(DRAWN, panels, strict=True):
        for place, row in enumerate(rows):
            some = [run for run in runs if run["row"] == row and run["points"] == count]
            if not some:
                continue
            own = geometric_mean(some, BEFORE)
            ratio = geometric_mean(some, AFTER) / own
            axes.barh(place, ratio, height=0.6, color="tab:blue")
            axes.text(ratio / 1.06, place, f"{ratio:.2f}", va="center", ha="right", color="white")
            of_linear = geometric_mean(some, LINEAR) / own
            axes.plot(of_linear, place, marker="D", color="tab:orange", linestyle="none")
        # The network as it is: 1.
        axes.axvline(1, color="black", linewidth=0.8)
        axes.set_title(f"{count} points", fontsize=10)
        axes.set_xscale("log")
        axes.set_xlim(0.02, 5)
        axes.set_xticks([0.05, 0.2, 1, 4], ["0.05", "0.2", "1", "4"])
        axes.minorticks_off()
    # The names, with the number of maps.
    maps = {row: len({run["frame"] for run in runs if run["row"] == row}) for row in rows}
    panels[0].set_yticks(range(len(rows)), [f"{row} ({maps[row]})" for row in rows])
    panels[0].invert_yaxis()
    figure.supxlabel(
        "MAE of the result (bar) and of linear interpolation (diamond), MAE of the network = 1",
        fontsize=10,
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, format=path.suffix.removeprefix("."))


def count_of(text: str) -> int | None:
    """The number of points, or None for scan lines."""
    return None if text == LINES else int(text)


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    # What is measured.
    parser.add_argument("--data", type=Path, help="the folder of real frames")
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=GROUPS)
    parser.add_argument("--sets", nargs="+", help="only these")
    parser.add_argument("--rows", nargs="+", help="only these rows, such as 'simulated, 2 %%'")
    parser.add_argument("--points", nargs="+", default=[*map(str, COUNTS), LINES])
    parser.add_argument("--frames", type=int, default=3, help="frames of each set with truth")
    parser.add_argument("--seeds", type=int, default=1, help="draws of the points of each frame")
    # What becomes of it.
    parser.add_argument("--json", type=Path, help="file that every run is written to")
    parser.add_argument("--tables", type=Path, nargs="+", help="print the runs of such files only")
    parser.add_argument("--figure", type=Path, help="image file of the gain over each network")
    args = parser.parse_args()
    if args.tables:
        report([run for file in args.tables for run in json.loads(file.read_text())], args.figure)
        return
    if args.data is None:
        parser.error("--data is needed to measure")
    # Every run is written at once, so that a stopped benchmark leaves what it has.
    runs = list[Run]()
    for case in strong_frames(args.data, args.groups, args.sets, args.frames):
        if args.rows and case.row not in args.rows:
            continue
        for count in map(count_of, args.points):
            for seed in range(args.seeds if can_draw(case.frame, count) else 0):
                runs.append(measure(case, count, seed))
                if args.json:
                    args.json.write_text(json.dumps(runs))
        print(f"{len(runs)} runs, the last {case.row}, {case.frame.name}", file=sys.stderr)
    report(runs, args.figure)


def report(runs: Sequence[Run], figure: Path | None) -> None:
    """Prints the tables of the runs, and draws the figure if it has a file."""
    print_tables(runs)
    if figure is not None:
        draw(runs, figure)


if __name__ == "__main__":
    main()
