"""Plan, resume and summary of many frames, and what a Ray cluster costs.

`python -m benchmarks.cluster entries --count 1000000` makes a list of so many frames and a manifest
that says they are done, with a hard link for each result, and prints CPU seconds and peak memory of
planning, of a run that has nothing to do, and of its summary.

`… overhead FOLDER --frames 60` refines frames of a data set with and without a Ray worker, compares
the results, and prints the CPU seconds of all processes between the first frame and the last.

`… nodes FOLDER --frames 60` refines them on a cluster of three nodes on loopback, one of which is
lost after a third of the frames, and compares the results with those of one process.

`… scaling --workers 16` gives 1 and 16 workers frames whose stand-in network only waits, and prints
frames a second, and the driver's CPU time with the manifest's lines of such frames written.
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
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from pnpdepth_cli.pipeline.batch.spread import DoneFrame

from benchmarks.batch import make_frames
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.io.journal import EncodedLine, Journal
from pnpdepth_cli.pipeline.batch.batch import run_batch
from pnpdepth_cli.pipeline.batch.frames import COMPARED_EVERY
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.cluster.options import LOCAL, ClusterOptions, spread_of
from pnpdepth_cli.pipeline.cluster.pool import worker_pool
from pnpdepth_cli.pipeline.cluster.worker import Done, Work
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.sensors import SamplePattern

LINKS = 50_000
"""Hard links of a file; ext4 allows 65,000."""
FOLDER = 1000
"""Frames of a folder."""
LINES = 1000
"""Lines of the manifest written at once."""


class Quiet:
    """Receives the progress of a batch."""

    def say(self, text: str) -> None:
        """Nothing."""

    def begin(self, to_do: int) -> None:
        """Nothing."""

    def frame(self, row: dict[str, Any]) -> None:
        """Nothing."""


def request_of(root: Path) -> BatchRequest:
    refine = RefineRequest.from_fields(preset="fast")
    return BatchRequest(source=root / "list.csv", output=root / "out", refine=refine)


def make_entries(root: Path, count: int) -> None:
    """A list of frames that share one image, and a manifest that says they are done."""
    make_frames(root, 1, 48, 64)
    with (root / "list.csv").open("w") as file:
        file.write("name,image,sparse,gt\n")
        for number in range(count):
            file.write(f"{name_of(number)},rgb/000000.png,sparse/000000.png,gt/000000.png\n")
    lines = (root / "list.csv").read_text().splitlines()[:3]
    (root / "two.csv").write_text("\n".join(lines) + "\n")
    refine = RefineRequest.from_fields(preset="fast")
    two = BatchRequest(source=root / "two.csv", output=root / "first", refine=refine)
    run_batch(two, Quiet())  # the first has other settings: it is compared
    journal = Journal(root / "first" / "batch.jsonl", "frame")
    first = [line for n in (0, 1) if (line := journal.newest(name_of(n))) is not None]
    made = Journal(root / "out" / "batch.jsonl", "frame")
    for start in range(0, count, LINKS):
        numbers = range(start, min(start + LINKS, count))
        lines_of = [linked(root, line, n, numbers) for n, line in enumerate(first)]
        for block in range(start, numbers.stop, LINES):
            made.append(
                *(
                    renamed(lines_of[bool(n % COMPARED_EVERY)], n)
                    for n in range(block, min(block + LINES, numbers.stop))
                )
            )


def name_of(number: int) -> str:
    return f"d{number // FOLDER:05}/f{number:07}"


def linked(root: Path, line: dict[str, Any], kind: int, numbers: range) -> bytes:
    """Links the results of one of the two frames for others of its kind; returns their line."""
    old, known = name_of(kind), {}
    mine = [n for n in numbers if bool(n % COMPARED_EVERY) == kind]
    for path in line["outputs"]:
        source = root / f"{numbers.start}{path.replace('/', '')}"
        shutil.copy(root / "first" / path, source)
        for number in mine:
            target = root / "out" / path.replace(old, name_of(number))
            if number % FOLDER in (0, 1):
                target.parent.mkdir(parents=True, exist_ok=True)
            os.link(source, target)
        known[path] = fingerprint(source).as_record()
    return EncodedLine.of(line | {"outputs": known}, "frame").data.replace(old.encode(), b"%s")


def renamed(line: bytes, number: int) -> EncodedLine:
    """The line with the name of another frame."""
    name = name_of(number)
    rest = line[len(b'{"crc32": "00000000", ') : -1].replace(b"%s", name.encode())
    data = b'{"crc32": "%08x", ' % zlib.crc32(rest) + rest + b"\n"
    return EncodedLine(key=name, data=data)


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
            "manifest_mb": round((root / "out" / "batch.jsonl").stat().st_size / 1e6),
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
    from tests.pipeline.cluster.nodes import three_nodes

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
            del record["seconds"], record["peak_memory_mb"]
            results[name] = json.dumps(record).encode()
    return results


@dataclass(frozen=True, kw_only=True)
class WaitingJob:
    """Waits as if for a GPU, and returns a line of a manifest for each frame."""

    line: dict[str, Any]
    """Of a frame that was refined."""
    wait_s: float
    """For each frame."""

    @contextlib.contextmanager
    def opened(self) -> Iterator[Work]:
        """Yields the function of a piece."""

        def work(names: Sequence[str], checked: bool, finish: bool) -> Done:
            time.sleep(self.wait_s * len(names))
            lines = (self.line | {"frame": name} for name in names)
            return Done(results=[DoneFrame.of(line, whole=False) for line in lines])

        yield work


def scaling(workers: int, rate: float, seconds: float) -> dict[str, Any]:
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray

    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        line = one_line_of(root)
        wait_s = workers / rate
        ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False)
        speeds = {
            f"{count} workers": waited(root, count, WaitingJob(line=line, wait_s=wait_s), seconds)
            for count in (1, workers)
        }
        ray.shutdown()
    one, many = (each["frames_a_second"] for each in speeds.values())
    return {"wait_s": wait_s, **speeds, "speedup": round(many / one, 2)}


def waited(root: Path, workers: int, job: WaitingJob, seconds: float) -> dict[str, float]:
    """Frames a second and the driver's CPU time, once all workers have begun."""
    spread = spread_of("cpu", ClusterOptions(ray=LOCAL, ray_workers=workers))
    assert spread is not None
    journal = Journal(root / f"{workers}.jsonl", "frame")
    names = [f"f{number:07}" for number in range(int(seconds * workers / job.wait_s))]

    def begin(begun: Sequence[str]) -> None:
        journal.append(*({"frame": name, "state": "begun"} for name in begun))

    with worker_pool(spread, print, inputs=[root]) as pool:
        while sum(1 for _ in pool.figures()) < workers:
            pool.call(time.sleep, 0.1)
            list(pool.results(job, names[:1]))
        start, cpu = time.perf_counter(), time.process_time()
        for part in pool.results(job, names, begin=begin):
            journal.append(*(done.line for _, done in part))
        wall = time.perf_counter() - start
    return {
        "frames": len(names),
        "frames_a_second": round(len(names) / wall, 2),
        "driver_cpu": round((time.process_time() - cpu) / wall, 4),
    }


def one_line_of(root: Path) -> dict[str, Any]:
    """A line of the manifest of a frame that was refined."""
    make_frames(root, 1, 48, 64)
    request = BatchRequest(
        source=root, output=root / "out", refine=RefineRequest.from_fields(preset="fast")
    )
    run_batch(request, Quiet())
    line = Journal(root / "out" / "batch.jsonl", "frame").newest("000000")
    assert line is not None
    return line


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
    of_scaling = commands.add_parser("scaling")
    of_scaling.add_argument("--workers", type=int, default=16)
    of_scaling.add_argument("--rate", type=float, default=200.0, help="frames a second of all")
    of_scaling.add_argument("--seconds", type=float, default=30.0)
    args = parser.parse_args()
    if args.command == "entries":
        result = entries(args.count, args.folder)
    elif args.command == "overhead":
        result = overhead(args.source, args.frames, args.model)
    elif args.command == "nodes":
        result = nodes(args.source, args.frames, args.model)
    else:
        result = scaling(args.workers, args.rate, args.seconds)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
