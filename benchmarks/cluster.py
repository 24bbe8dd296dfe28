"""Plan, resume and summary of many frames.

`python -m benchmarks.cluster entries --count 1000000` makes a list of so many frames, a record for
each that says it is done, and hard links for its other results, and prints CPU seconds and peak
memory of a run that has nothing to do, with its summary.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.commands.batch.run_batch import run_batch
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import write_depth

LINKS = 50_000
"""Hard links of a file; ext4 allows 65,000."""
FOLDER = 1000
"""Frames of a folder."""


class Quiet:
    """Receives the progress of a batch."""

    def say(self, text: str) -> None:
        """Nothing."""

    def begin(self, to_do: int) -> None:
        """Nothing."""

    def frame(self, record: FrameRecord) -> None:
        """Nothing."""


def request_of(root: Path) -> BatchRequest:
    refine = RefineRequest.from_fields(propagate="gp")
    return BatchRequest(source=root / "list.csv", output=root / "out", refine=refine)


def make_frame(root: Path) -> None:
    """rgb/ sparse/ gt/ with one small frame of slanted depth."""
    y, x = np.mgrid[:48, :64] / 64
    depth, keep = (1 + x + y).astype(np.float32), np.random.default_rng(0).random((48, 64)) < 0.07
    rgb = (127 + 120 * np.sin(6 * np.stack([x, y, x + y], axis=-1))).astype(np.uint8)
    for part in ("rgb", "sparse", "gt"):
        (root / part).mkdir(parents=True)
    cv2.imwrite(str(root / "rgb" / "000000.png"), rgb)
    write_depth(root / "sparse" / "000000.png", np.where(keep, depth, 0), scale=1000)
    write_depth(root / "gt" / "000000.png", depth, scale=1000)


def make_entries(root: Path, count: int) -> None:
    """A list of frames that share one image, and records that say they are done."""
    make_frame(root)
    with (root / "list.csv").open("w") as file:
        file.write("name,image,sparse,gt\n")
        for number in range(count):
            file.write(f"{name_of(number)},rgb/000000.png,sparse/000000.png,gt/000000.png\n")
    lines = (root / "list.csv").read_text().splitlines()[:2]
    (root / "one.csv").write_text("\n".join(lines) + "\n")
    refine = RefineRequest.from_fields(propagate="gp")
    run_batch(BatchRequest(source=root / "one.csv", output=root / "out", refine=refine), Quiet())
    first = name_of(0)
    record = (root / "out" / f"{first}.json").read_text()
    others = [path for path in (root / "out" / first).parent.iterdir() if path.suffix != ".json"]
    source: dict[Path, Path] = {}
    for number in range(1, count):
        target = root / "out" / name_of(number)
        if number % FOLDER in (0, 1):
            target.parent.mkdir(parents=True, exist_ok=True)
        target.with_suffix(".json").write_text(record.replace(first, name_of(number)))
        for path in others:
            if number % LINKS == 1:
                source[path] = root / f"{number}{path.name}"
                shutil.copy(path, source[path])
            os.link(source[path], target.parent / path.name.replace(Path(first).name, target.name))


def name_of(number: int) -> str:
    return f"d{number // FOLDER:05}/f{number:07}"


def measured(program: str, *arguments: str) -> dict[str, float]:
    """CPU seconds, wall seconds and peak memory of a Python process."""
    before = os.times()
    start = time.perf_counter()
    text = "\n".join((
        program,
        "status = open('/proc/self/status').read()",
        "print(status.split('VmHWM:')[1].split()[0])",
    ))  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", text, *arguments], capture_output=True, text=True, check=True
    )
    after = os.times()
    cpu = after.children_user + after.children_system
    return {
        "cpu_s": round(cpu - before.children_user - before.children_system, 1),
        "wall_s": round(time.perf_counter() - start, 1),
        "peak_mb": round(int(done.stdout.split()[-1]) * 1024 / 1e6),
    }


RESUME = """
import sys; from pathlib import Path
from benchmarks.cluster import Quiet, request_of
from pnpdepth_cli.commands.batch.run_batch import run_batch
counts = run_batch(request_of(Path(sys.argv[1])), Quiet()).summary.counts
assert counts["done"] == counts["frames"], counts
"""


def entries(count: int, folder: Path | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        root = Path(temporary)
        make_entries(root, count)
        return {
            "entries": count,
            "resume and summary": measured(RESUME, temporary),
        }


def main() -> None:
    """Make the entries, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    of_entries = commands.add_parser("entries")
    of_entries.add_argument("--count", type=int, default=1_000_000)
    of_entries.add_argument("--folder", type=Path, help="where the files are made")
    args = parser.parse_args()
    print(json.dumps(entries(args.count, args.folder), indent=2))


if __name__ == "__main__":
    main()
