"""Plan, resume and summary of many frames, and what a Ray cluster costs.

`python -m benchmarks.cluster entries --count 1000000` makes a list of so many frames and a manifest
that says they are done, with a hard link for each result, and prints CPU seconds and peak memory of
planning, of a run that has nothing to do, and of its summary.
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
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.batch import make_frames
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.io.journal import Journal
from pnpdepth_cli.pipeline.batch.batch import run_batch
from pnpdepth_cli.pipeline.batch.frames import find_frames, task_of
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.settings import model_identity, settings_digest
from pnpdepth_cli.pipeline.refinement.request import RefineRequest

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
    """A list of frames that share one image, and a manifest of an equal line for each."""
    make_frames(root, 1, 48, 64)
    with (root / "list.csv").open("w") as file:
        file.write("name,image,sparse,gt\n")
        for number in range(count):
            name = f"d{number // FOLDER:05}/f{number:07}"
            file.write(f"{name},rgb/000000.png,sparse/000000.png,gt/000000.png\n")
    first = root / "first"
    lines = (root / "list.csv").read_text().splitlines()[:2]
    (root / "one.csv").write_text("\n".join(lines) + "\n")
    one = BatchRequest(
        source=root / "one.csv", output=first, refine=RefineRequest.from_fields(preset="fast")
    )
    run_batch(one, Quiet())
    line = Journal(first / "batch.jsonl", "frame").newest("d00000/f0000000")
    assert line is not None
    made = {kind: first / path for kind, path in line["row"]["outputs"].items()}
    linked(root, made, count)
    manifest(root, line, count)


def linked(root: Path, made: dict[str, Path], count: int) -> None:
    """The results of each frame, as hard links."""
    sources: dict[str, Path] = {}
    for number in range(count):
        if number % FOLDER == 0:
            (root / "out" / f"d{number // FOLDER:05}").mkdir(parents=True)
        for kind, path in made.items():
            if number % LINKS == 0:
                sources[kind] = root / f"{kind}{number}{path.suffix}"
                shutil.copy(path, sources[kind])
            name = path.name.replace("f0000000", f"f{number:07}")
            os.link(sources[kind], root / "out" / f"d{number // FOLDER:05}" / name)


def manifest(root: Path, line: dict[str, Any], count: int) -> None:
    request = request_of(root)
    frame = find_frames(request).frames[0]
    digest = settings_digest(task_of(request, frame).request, model_identity(request.refine))
    journal = Journal(root / "out" / "batch.jsonl", "frame")
    lines: list[dict[str, Any]] = []
    for number in range(count):
        folder, stem = f"d{number // FOLDER:05}", f"f{number:07}"
        name = f"{folder}/{stem}"
        outputs = {
            f"{folder}/{Path(path).name.replace('f0000000', stem)}" for path in line["outputs"]
        }
        known = {path: asdict(fingerprint(root / "out" / path)) for path in sorted(outputs)}
        lines.append(
            line | {"frame": name, "settings": digest, "outputs": known,
                    "row": line["row"] | {"name": name}}
        )  # fmt: skip
        if len(lines) == LINES or number == count - 1:
            journal.append(*lines)
            lines.clear()


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    of_entries = commands.add_parser("entries")
    of_entries.add_argument("--count", type=int, default=1_000_000)
    of_entries.add_argument("--folder", type=Path, help="where the files are made")
    args = parser.parse_args()
    print(json.dumps(entries(args.count, args.folder), indent=2))


if __name__ == "__main__":
    main()
