"""What commands write and read again: scores, records, journals, and what lies beside a depth."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pnpdepth_cli.cli.main import run
from pnpdepth_cli.io.depth import write_depth
from tests.fuzz.seeds.seed import Seed

_NETWORK = ("--model", "fcrn-tiny", "--propagate", "none")


def write_seeds(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    """Returns results of `eval`, `batch` and `refine`, and poses."""
    return [*_scores(folder), *_journals(folder), *_clouds(folder, depth)]


def _scores(folder: Path) -> list[Seed]:
    text = _output_of(["eval", "gt.npy", "gt.npy", "--json"])
    for name in ("run.json", "other.json"):
        (folder / name).write_text(text)
    return [Seed(file="run.json", command=("compare", "run.json", "other.json"))]


def _journals(folder: Path) -> list[Seed]:
    """A finished batch, which goes on where it ended."""
    batch = ("batch", "frames.csv", *_NETWORK, "--iterations", "1", "-o", "finished")
    _output_of(batch)
    (record,) = {*Path("finished").glob("*.json")} - {Path("finished/summary.json")}
    return [
        Seed(file=record.as_posix(), command=batch),
        Seed(
            file="finished/summary.json",
            command=("compare", "finished/summary.json:before", "finished/summary.json"),
        ),
    ]


def _output_of(arguments: Sequence[str]) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(io.StringIO()):
        code = run(list(arguments))
    assert code == 0, f"{arguments}: exit code {code}"
    return text.getvalue()


def _clouds(folder: Path, depth: np.ndarray) -> list[Seed]:
    """A depth map with all that `refine` writes beside it, and poses for it."""
    (folder / "refined_before").mkdir()
    write_depth(folder / "refined_before/a_depth.png", depth)
    write_depth(folder / "refined_before/a_sigma.png", depth / 100, scale=1000)
    cv2.imwrite(str(folder / "refined_before/a_valid.png"), np.full(depth.shape, 255, np.uint8))
    (folder / "refined_before/a.json").write_text('{"inputs": {"image": {"path": "rgb.png"}}}\n')
    (folder / "poses_kitti.txt").write_text("1 0 0 0.5 0 1 0 0 0 0 1 0\n")
    (folder / "poses_tum.txt").write_text("# time x y z qx qy qz qw\n1.5 0.5 0 0 0 0 0 1\n")
    cloud = ("cloud", "refined_before", "--fov", "60", "-o", "out.ply", "--overwrite")
    beside = ("a_depth.png", "a_sigma.png", "a_valid.png", "a.json")
    return [
        *(
            Seed(file=f"refined_before/{name}", command=(*cloud, "--max-sigma", "0.1"))
            for name in beside
        ),
        *(
            Seed(file=name, command=(*cloud, "--poses", name))
            for name in ("poses_kitti.txt", "poses_tum.txt")
        ),
    ]
