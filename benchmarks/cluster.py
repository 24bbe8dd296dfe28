"""Plan, resume and summary of many frames, and what a Ray cluster costs.

`python -m benchmarks.cluster entries --count 1000000` makes a list of so many frames, a record for
each that says it is done, and hard links for its other results, and prints CPU seconds and peak
memory of planning, and of a run that has nothing to do, with its summary.

`… overhead FOLDER --frames 60` refines frames of a data set with and without a Ray worker, compares
the results, and prints the CPU seconds of all processes between the first frame and the last.

`… nodes FOLDER --frames 60` refines them on a cluster of three nodes on loopback, one of which is
lost after a third of the frames, and compares the results with those of one process.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.batch import make_frames
from pnpdepth_cli.pipeline.batch.batch import run_batch
from pnpdepth_cli.pipeline.batch.request import LOCAL, BatchRequest, ClusterOptions
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.sensors import SamplePattern

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

    def frame(self, row: dict[str, Any]) -> None:
        """Nothing."""


def request_of(root: Path) -> BatchRequest:
    refine = RefineRequest.from_fields(propagate="gp")
    return BatchRequest(source=root / "list.csv", output=root / "out", refine=refine)


def make_entries(root: Path, count: int) -> None:
    """A list of frames that share one image, and records that say they are done."""
    make_frames(root, 1, 48, 64)
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


PLAN = """
import sys; from pathlib import Path
from benchmarks.cluster import request_of
from pnpdepth_cli.pipeline.batch.batch import plan_batch
assert not plan_batch(request_of(Path(sys.argv[1])), lambda text: None)
"""
RESUME = """
import sys; from pathlib import Path
from benchmarks.cluster import Quiet, request_of
from pnpdepth_cli.pipeline.batch.batch import run_batch
counts = run_batch(request_of(Path(sys.argv[1])), Quiet()).summary["counts"]
assert counts["done"] == counts["frames"], counts
"""


def entries(count: int, folder: Path | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        root = Path(temporary)
        make_entries(root, count)
        return {
            "entries": count,
            "plan": measured(PLAN, temporary),
            "resume and summary": measured(RESUME, temporary),
        }


class Clock(Quiet):
    """CPU seconds at the first frame and at the last."""

    def __init__(self) -> None:
        self.moments: list[tuple[float, float, float]] = []

    def frame(self, row: dict[str, Any]) -> None:
        """One more."""
        self.moments.append((*cpu_seconds(), time.perf_counter()))

    def between(self) -> dict[str, float]:
        """What the frames between the first row and the last took."""
        spent = np.subtract(self.moments[-1], self.moments[0])
        frames = len(self.moments) - 1
        return {
            "cpu_s_a_frame": round(spent[0] / frames, 4),
            "wall_s_a_frame": round(spent[2] / frames, 4),
            "daemons_of_a_core": round(spent[1] / spent[2], 4),
        }


def cpu_seconds() -> tuple[float, float]:
    """Of this process and its Ray workers, and of Ray's daemons."""
    own = psutil.Process()
    workers = daemons = 0.0
    for process in (own, *own.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            times, command = process.cpu_times(), " ".join(process.cmdline())
            if process == own or command.startswith("ray::"):
                workers += times.user + times.system
            else:
                daemons += times.user + times.system
    return workers, daemons


def overhead(source: Path, frames: int, model: str) -> dict[str, Any]:
    """Of a Ray worker over this process, on the same frames, and whether results are equal."""
    figures: dict[str, Any] = {"frames": frames}
    results = []
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "out"  # of one name, which is in the records
        for name, cluster in (
            ("one process", ClusterOptions()),
            ("one Ray worker", ClusterOptions(ray=LOCAL, ray_workers=1)),
        ):
            clock = Clock()
            results.append(made_by(clock, source, out, frames, model, cluster))
            figures[name] = clock.between()
    one, other = (figures[name]["cpu_s_a_frame"] for name in list(figures)[1:])
    equal = results[0] == results[1]
    return figures | {
        "overhead": round(other / one - 1, 3),
        "equal": equal,
        "files": len(results[0]),
    }


class LosingANode(Quiet):
    """Removes a node from a cluster when so many frames are done."""

    def __init__(self, cluster: Any, after: int) -> None:
        self._cluster, self._left = cluster, after

    def frame(self, row: dict[str, Any]) -> None:
        """Counts the frame."""
        self._left -= 1
        if self._left == 0:
            lost = next(iter(self._cluster.worker_nodes))
            self._cluster.remove_node(lost, allow_graceful=False)


def nodes(source: Path, frames: int, model: str) -> dict[str, Any]:
    """Whether results of three nodes, one of which is lost, equal those of one process."""
    from tests.pipeline.batch.ray_nodes import three_nodes

    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "out"
        one = made_by(Quiet(), source, out, frames, model, ClusterOptions())
        with three_nodes() as cluster:
            options = ClusterOptions(ray=cluster.address)
            losing = LosingANode(cluster, max(1, frames // 3))
            other = made_by(losing, source, out, frames, model, options)
    return {"frames": frames, "files": len(one), "equal": one == other}


def made_by(
    listener: Quiet, source: Path, out: Path, frames: int, model: str, cluster: ClusterOptions
) -> dict[str, bytes]:
    """The results of a batch, which are removed."""
    refine = RefineRequest.from_fields(model=model, preset="paper", sample=SamplePattern(count=500))
    request = BatchRequest(source=source, output=out, limit=frames, refine=refine, cluster=cluster)
    run_batch(request, listener)
    made = contents(out)
    shutil.rmtree(out)
    return made


def contents(folder: Path) -> dict[str, bytes]:
    """The results below a folder by name; of records, without times and memory."""
    results = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() or name.startswith(("summary.", "batch.", ".")):
            continue
        results[name] = path.read_bytes()
        if path.suffix == ".json":
            record = json.loads(results[name])
            del record["seconds"], record["peak_memory_mb"], record["batch"]
            results[name] = json.dumps(record).encode()
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    of_entries = commands.add_parser("entries")
    of_entries.add_argument("--count", type=int, default=1_000_000)
    of_entries.add_argument("--folder", type=Path, help="where the files are made")
    of_overhead = commands.add_parser("overhead")
    of_overhead.add_argument("source", type=Path)
    of_overhead.add_argument("--frames", type=int, default=60)
    of_overhead.add_argument("--model", default="compact")
    of_nodes = commands.add_parser("nodes")
    of_nodes.add_argument("source", type=Path)
    of_nodes.add_argument("--frames", type=int, default=60)
    of_nodes.add_argument("--model", default="compact")
    args = parser.parse_args()
    if args.command == "entries":
        result = entries(args.count, args.folder)
    elif args.command == "overhead":
        result = overhead(args.source, args.frames, args.model)
    else:
        result = nodes(args.source, args.frames, args.model)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
