"""The paper's tables I and II for the seven networks: `python -m benchmarks.paper_tables`.

    python -m benchmarks.paper_tables --shared ../shared/data --plot t.png

The tiny editions that come with the program, on rooms and streets rendered from seeds that nothing
else uses (into --cache, once; needs pnpdepth[train]), and with --shared on the real frames at hand.
Networks with published weights on NYU and KITTI are measured by `pnpdepth batch --method paper` and
`pnpdepth eval`.

Each network: as it is, refined at the paper's setting (sign, α = 0.01, K = 5, L1, the paper's z)
and with its definition's defaults; beside it, the points interpolated linearly without any network.
Points are drawn per frame by its number: all networks with as many points get the same. Measures
are averaged over frames, each over the pixels with known ground truth where all depths are
positive; `coverage` is the fraction of these. A network with depth up to scale gets the factor that
fits the points, once for before and after alike.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.frames import Depth, EvalFrame, drawn_inputs, refined
from benchmarks.paper_figures import FINE_THRESHOLDS, MEASURES, ROWS, PaperRow
from benchmarks.paper_report import heading, markdown, plot
from benchmarks.paper_sets import ROOMS, STREETS, FrameSet, cut_by, rendered, shared
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.measures import DELTA_THRESHOLDS, score, with_thresholds
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.registry import all_definitions
from pnpdepth_cli.settings import PAPER, ClosedSettings, Settings

KINDS = {"rgb": "rgb", "sparse": "sd", "rgb+sparse": "rgb + sd"}  # as the paper writes them
ROOM_FRAMES = 96  # of streets, which are three times as wide, a quarter
SHARED_FRAMES = 24  # of each set: neighbours in a video tell little more


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A network in a row of the tables; settings: (layer, how) of "paper" and of "tuned"."""

    row: PaperRow
    network: Network
    settings: dict[str, tuple[str, ClosedSettings]]

    @property
    def name(self) -> str:
        """The network's."""
        return self.network.definition.name


def entry_of(row: PaperRow, network: Network) -> Entry:
    """Returns the network with the paper's setting and with its own defaults, aligned alike."""
    definition = network.definition
    # One factor, as in the evaluation of networks that know depth up to one; "auto" might take two.
    align = "scale" if definition.output_scale == "scale" else definition.default_alignment
    tuned = resolve_settings(definition, Settings(align=align))
    paper = replace(PAPER.closed(), align=align)
    settings = {"paper": (row.layer, paper), "tuned": (resolve_layer(definition, None), tuned)}
    return Entry(row=row, network=network, settings=settings)


def scores_of(depths: dict[str, Depth], gt: Depth) -> tuple[dict[str, dict[str, float]], float]:
    """The measures of each depth over the pixels where the ground truth and all depths are known.

    δ in per cent, `fine…` those at 1.01^k; and the coverage of the known ground truth.
    """
    known = gt > 0
    scored = known & np.logical_and.reduce([np.isfinite(d) & (d > 0) for d in depths.values()])
    kept = torch.from_numpy(np.where(scored, gt, np.float32(0)))
    measured = {}
    for state, depth in depths.items():
        standard, fine = (
            score(torch.from_numpy(depth), kept, with_thresholds(limits))
            for limits in (DELTA_THRESHOLDS, FINE_THRESHOLDS)
        )
        measured[state] = {name: standard[name] for name in MEASURES[:3]}
        measured[state] |= {f"delta{k}": 100 * standard[f"delta{k}"] for k in (1, 2, 3)}
        measured[state] |= {f"fine{k}": 100 * fine[f"delta{k}"] for k in (1, 2, 3)}
    return measured, float(scored.sum() / known.sum())


def frame_figures(entry: Entry, frame: EvalFrame, number: int) -> dict[str, Any]:
    """Returns a frame's scores, loss at the points, and standard deviation of z, of a network.

    Args:
        entry: The network and its two settings.
        frame: The frame, which is cut as the row of the table asks.
        number: Random seed of the points.
    """
    frame = cut_by(frame, entry.row.cut)
    inputs = drawn_inputs(frame, entry.row.points, number)
    layer, paper = entry.settings["paper"]
    results = {"paper": refined(entry.network, layer, paper, inputs)}
    same = entry.settings["tuned"] == entry.settings["paper"]
    results["tuned"] = (
        results["paper"] if same else refined(entry.network, *entry.settings["tuned"], inputs)
    )
    # A step of 100 % is what the engine takes for the standard deviation of z_0.
    moved = refined(entry.network, layer, replace(paper, iterations=1, lr="100%"), inputs)
    depths = {"linear": linear(inputs.points).numpy(), "before": results["paper"].before}
    depths |= {state: result.depth for state, result in results.items()}
    scores, coverage = scores_of(depths, frame.gt)
    return {
        "points": len(inputs.points),
        "coverage": coverage,
        "std_z": moved.step,
        "diverged": sum(result.diverged is not None for result in results.values()),
        "aligned": None if (fit := results["paper"].alignment) is None else fit.kind,
        "scores": scores,
        "loss": {n: [r.losses[i] for i in (0, -1)] for n, r in results.items()},
    }


def gains(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    """Returns per cent by which the errors fell, and percentage points by which the δ rose."""
    errors = MEASURES[:3]
    return {
        name: 100 * (1 - after[name] / before[name]) if name in errors else value - before[name]
        for name, value in after.items()
    }


def result_of(entry: Entry, frames: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns a network's line in the tables: means of `frame_figures` over the frames."""

    def mean(*path: str | int) -> float:
        """Returns the mean over the frames of what these keys lead to, one in the other."""
        values: list[Any] = list(frames)
        for key in path:
            values = [value[key] for value in values]
        return float(np.mean(values))

    # Scores of every state, and how each setting changed the loss and the errors.
    states = {
        state: {name: mean("scores", state, name) for name in measured}
        for state, measured in frames[0]["scores"].items()
    }
    settings = {}
    for state, (layer, how) in entry.settings.items():
        won = [frame["scores"][state]["mae"] < frame["scores"]["before"]["mae"] for frame in frames]
        settings[state] = {
            "layer": layer,
            **asdict(how),
            "loss_before": mean("loss", state, 0),
            "loss_after": mean("loss", state, 1),
            "gains": gains(states["before"], states[state]),
            "frames_with_lower_mae": float(np.mean(won)),
        }
    return {
        "network": entry.name,
        "paper_row": entry.row.name,
        "kind": KINDS[entry.network.definition.input_kind],
        "fine": entry.row.fine,
        "frames": len(frames),
        "points": mean("points"),
        "coverage": mean("coverage"),
        "std_z": mean("std_z"),
        "diverged": sum(frame["diverged"] for frame in frames),
        "aligned": dict(Counter(frame["aligned"] for frame in frames if frame["aligned"])),
        "scores": states,
        "settings": settings,
    }


def table_of(frame_set: FrameSet, entries: Sequence[Entry]) -> dict[str, Any]:
    """A set's table, frame by frame, so that all networks get what they get of the same frame."""
    notes = []
    entries = [entry for entry in entries if entry.row.street == frame_set.street]
    figures: list[list[dict[str, Any]]] = [[] for _ in entries]
    bar = tqdm(frame_set.frames(), frame_set.name, frame_set.count, unit="frame", disable=None)
    for number, frame in enumerate(bar):
        for entry, measured in zip(entries, figures, strict=True):
            if entry.row.points is not None or frame.sensor is not None:
                measured.append(frame_figures(entry, frame, number))
    rows = []
    for entry, measured in zip(entries, figures, strict=True):
        if measured:
            rows.append(result_of(entry, measured))
        else:
            notes.append(
                f"`{entry.name}` needs a LiDAR and a ground truth besides it; there is none here"
            )
    return {
        "set": frame_set.name,
        "street": frame_set.street,
        "beside_paper": frame_set.beside_paper,
        "rows": rows,
        "notes": notes,
    }


def entries_of(only: Sequence[str]) -> tuple[list[Entry], list[str]]:
    """Returns the tiny networks of each row of the paper, and notes on rows that have none.

    Args:
        only: Names of the networks; empty: all.

    Raises:
        UsageError: There is no such network.
    """
    tiny = [name for name in all_definitions() if "-tiny" in name]
    if unknown := set(only) - set(tiny):
        raise UsageError(f"--only: no {', '.join(sorted(unknown))}; there are {', '.join(tiny)}")
    entries, notes = [], []
    loaded: dict[str, Network] = {}
    for row in ROWS:
        wanted = [name for name in only or tiny if row.takes(name)]
        if not wanted and not only:
            notes.append(row.missing)
        for name in wanted:
            loaded[name] = loaded.get(name) or load_network(name, None)
            entries.append(entry_of(row, loaded[name]))
    return entries, notes


def sets_of(args: argparse.Namespace, entries: Sequence[Entry]) -> Iterable[FrameSet]:
    """The sets that the command line asks for, each rendered when its turn comes, if needed."""
    rooms = args.frames or ROOM_FRAMES
    for scenes, count in ((ROOMS, rooms), (STREETS, -(-rooms // 4))):
        if any(entry.row.street == (scenes is STREETS) for entry in entries):
            yield rendered(scenes, args.cache, count, args.workers)
    if args.shared:
        yield from shared(args.shared, args.frames or SHARED_FRAMES)


def parsed() -> argparse.Namespace:
    """Returns the options of the command line; ends the program if they are wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--frames", type=int, help="of rooms and each real set; a quarter as many streets"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these networks")
    parser.add_argument("--cache", type=Path, default=Path("out/paper_tables"))
    parser.add_argument("--shared", type=Path, help="also these real frames (../shared/data)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="that render")
    parser.add_argument("--plot", type=Path, help="draw the gains into this image")
    chosen = parser.parse_args()
    if chosen.frames is not None and chosen.frames < 1:
        parser.error("--frames: give 1 or more")
    return chosen


def main() -> None:
    """Prints the tables."""
    args = parsed()
    began = time.monotonic()
    entries, notes = entries_of(args.only)
    tables = []
    for frame_set in sets_of(args, entries):
        table = table_of(frame_set, entries)
        if table["rows"]:
            print(markdown(table), flush=True)
        else:
            notes += [f"{heading(table)}: no row"]
            notes += table["notes"] or ["none of the networks belongs in it"]
        tables.append(table)
    for note in notes:
        print(f"- {note}")
    if args.plot:
        plot(tables, args.plot)
    print(f"{time.monotonic() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
